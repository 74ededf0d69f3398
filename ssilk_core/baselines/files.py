# SPDX-License-Identifier: Apache-2.0
"""Files of trained baselines: those of models, with what the baseline is among their provenance."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ..checkpoint import ModelFile, load_model, save_model
from ..config import ModelConfig
from ..errors import need
from ..fabrics import Fabric
from .networks import Baseline, BaselineConfig, baseline

KEY = "baseline"  # of the provenance


def save_baseline(path: str | Path, model: Baseline, fabric: Fabric, provenance: dict[str, Any]) -> None:
    """Write a baseline whole or not at all."""
    parameters = {name: value.detach().cpu().numpy() for name, value in model.state_dict().items()}
    told = {**provenance, KEY: asdict(model.config)}
    save_model(
        path, ModelFile(model.scene, ModelConfig(fps=model.config.fps), fabric, model.joints, parameters, told)
    )


def load_baseline(path: str | Path) -> tuple[ModelFile, Baseline]:
    """Read what `save_baseline` wrote: the file and its network, on the CPU.

    Raises:
        SsilkError: as `load_model` does, or it is no baseline.
    """
    file = load_model(path, _shapes)
    model = _network(file)
    model.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in file.parameters.items()})
    return file, model.eval()


def _shapes(file: ModelFile) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {name: tuple(value.shape) for name, value in _network(file).state_dict().items()}


def _network(file: ModelFile) -> Baseline:
    where = file.scene.garment.mesh.path
    need(KEY in file.provenance, where, "this is no baseline", "the provenance of one says which it is")
    return baseline(file.scene, BaselineConfig(**file.provenance[KEY]), file.joints)
