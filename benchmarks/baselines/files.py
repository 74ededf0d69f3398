# SPDX-License-Identifier: Apache-2.0
"""Files of trained baselines: model files whose provenance says which baseline they hold."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ssilk_core.network.checkpoint import ModelFile, load_model, network, save_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.parameters import Shapes, parameter_shapes
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.fabrics import Fabric

from .networks import Baseline, BaselineConfig, baseline

KEY = "baseline"  # of the provenance


def save_baseline(path: str | Path, model: Baseline, fabric: Fabric, provenance: dict[str, Any]) -> None:
    """Write a baseline whole or not at all."""
    parameters = {name: value.detach().cpu().numpy() for name, value in model.state_dict().items()}
    told = {**provenance, KEY: asdict(model.config)}
    save_model(
        path, ModelFile(model.scene, ModelConfig(fps=model.config.fps), fabric, model.joints, parameters, told)
    )


def load_network(path: str | Path) -> tuple[ModelFile, Baseline | GarmentModel]:
    """Read a trained baseline or a model of 'ssilk train', whichever the file holds: the file and its network.

    Raises:
        SsilkError: as `load_model` does.
    """
    file = load_model(path, _shapes)
    if KEY not in file.provenance:
        return file, network(file)
    model = _untrained(file)
    model.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in file.parameters.items()})
    return file, model.eval()


def _shapes(file: ModelFile) -> Shapes:
    if KEY not in file.provenance:
        return parameter_shapes(file.scene, file.config, file.joints)
    with torch.device("meta"):
        return {name: tuple(value.shape) for name, value in _untrained(file).state_dict().items()}


def _untrained(file: ModelFile) -> Baseline:
    return baseline(file.scene, BaselineConfig(**file.provenance[KEY]), file.joints)
