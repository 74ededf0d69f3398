# SPDX-License-Identifier: Apache-2.0
"""The rest shape of a shot's garments, which on another body or skeleton need not be where they lie.

A shot has a garment where it lies on its body, and says which model moves it. Whether that model keeps the rest shape
of the body of its training is in the model's file alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SsilkError
from ...files import sha256
from ...network.checkpoint import ModelFile, load_model
from ...scene.assets import Mesh

SAME = 1e-4  # [m] between points of a garment that lies where it was trained


def model_of(origins: Mapping[Path, Mapping[str, Any]], digest: str) -> ModelFile | None:
    """Return the model that moves a garment of a shot; None where it is not where the shot was baked from.

    Args:
        origins: provenance of the shot's file, or of each of its layers, which names models by paths from its folder.
        digest: SHA-256 of the model, as the garment states it.
    """
    for path in dict.fromkeys(file.parent / named for file, said in origins.items() for named in _models(said)):
        if path.is_file() and sha256(path) == digest:
            try:
                return load_model(path)
            except SsilkError:  # of another version: then it is as if it were not there
                return None
    return None


def sewn_mesh(mesh: Mesh, file: ModelFile) -> Mesh:
    """Return a garment of a shot in the rest shape that its model trained it with."""
    garment = file.scene.garment
    if garment.graded or garment.mesh.vertex_count != mesh.vertex_count:
        return mesh
    sewn = garment.sewn_mesh.points
    if file.bodies is None and np.abs(mesh.points - sewn).max(initial=0) < SAME:
        return mesh
    return replace(mesh, points=sewn)


def _models(said: Mapping[str, Any]) -> Iterator[str]:
    """Yield the models that a provenance names, however deep."""
    for name, value in said.items():
        if isinstance(value, Mapping):
            yield from _models(value)
        elif name == "model" and isinstance(value, str):
            yield value
