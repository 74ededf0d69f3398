# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked garments beneath the one that a solver or a certificate moves, as Blender shows them in its frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model

from ..errors import SetupError
from ..motions.keys import has_keys
from ..motions.simulated import sample_vertices
from ..scene.garment import beneath
from ..scene.gather import read_mesh
from ..scene.meshes import rest_points
from ..scene.objects import found_again, scene_rate
from .models import model_of


class ShownBeneath:
    """The garments beneath one that are visible and were baked, over some frames.

    Attributes:
        files: point caches of them once `write` is done, by the names of their objects.
    """

    def __init__(self, garment: bpy.types.Object, frames: range) -> None:
        shown = [each for each in beneath(garment) if each.visible_get()]  # Blender does not evaluate others
        inner = [each for each in shown if has_keys(each) and model_of(each).exists()]
        self._inner, self._frames = [(each.session_uid, each.name) for each in inner], frames
        self.files: dict[str, Path] = {}

    def write(self, folder: Path) -> Iterator[float]:
        """Play the timeline and write what it shows; yield the part of each garment that is done.

        Raises:
            SetupError: a garment was deleted meanwhile, or has not the vertices of its model.
            SsilkError: a model cannot be read, or a file not be written.
        """
        from ssilk_usd.opening.garment_api import GarmentRecord
        from ssilk_usd.writing.files import write_cache

        for number, (uid, name) in enumerate(self._inner):
            points: list[np.ndarray] = []
            yield from sample_vertices(found_again(uid, name), self._frames, points)
            garment = found_again(uid, name)
            file = load_model(model := model_of(garment))
            if len(points[0]) != file.scene.garment.mesh.vertex_count:
                raise SetupError(f"'{name}' has other vertices than its model; train it again, and bake it.")
            mesh = read_mesh(garment, garment.data, file.scene.garment.mesh.path, rest_points(garment))
            made = GarmentRecord(model_hash=sha256(model), parameters={"thickness": file.fabric.thickness})
            own = folder / str(number)  # names that are clean may be the same: the command line tells of it
            own.mkdir(parents=True, exist_ok=True)
            path = own / f"{bpy.path.clean_name(name)}.usdc"
            write_cache(path, mesh, points, scene_rate(), self._frames.start, made)
            self.files[name] = path
