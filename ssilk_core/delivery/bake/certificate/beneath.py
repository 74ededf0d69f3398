# SPDX-License-Identifier: Apache-2.0
"""Garments beneath the one that is certified, as the files of their own pose them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ....errors import fail
from ....scene.assets import Floats, Ints
from ..opened import open_shot

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot

    from ...gltf.play import GlbShot


class GarmentsBeneath:
    """Garments in files of their own, which stay where they are.

    Attributes:
        files: their paths, by their names.
        times: time codes of the frames.
        faces: triangles of all, of W vertices together, shape (G, 3).

    Args:
        samples: of each frame.

    Raises:
        SsilkError: a file cannot be read, or has other frames than the first.
    """

    def __init__(self, files: Mapping[str, Path], samples: int) -> None:
        self.files = dict(files)
        self._shots: list[Shot | GlbShot] = [open_shot(path) for path in self.files.values()]
        self.times = self._shots[0].sample_times(samples)
        faces, count = list[Ints](), 0
        for path, shot in zip(self.files.values(), self._shots):
            if shot.sample_times(samples) != self.times:
                fail(str(path), "other frames than the garments beside it", "all are of one range", "bake it again")
            faces.append(next(mesh.faces for mesh in shot.meshes if mesh.is_garment) + count)
            count += len(shot.garment_points(self.times[0]))
        self.faces: Ints = np.concatenate(faces)

    def points(self, frame: int) -> Floats:
        """Return the vertices of all in a frame, in the world [m], shape (W, 3)."""
        return np.concatenate([shot.garment_points(self.times[frame]) for shot in self._shots])

    def named(self, folder: Path) -> dict[str, str]:
        """Return the files relative to a folder, with forward slashes, by their names."""
        return {name: Path(os.path.relpath(path, folder)).as_posix() for name, path in self.files.items()}
