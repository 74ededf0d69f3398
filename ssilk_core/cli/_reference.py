# SPDX-License-Identifier: Apache-2.0
"""Simulated clips as point caches: the reference that garments are compared with."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import fail
from ..scene.assets import Floats

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot

OPEN = 4  # shots at once; clips are read one after the other


def shots(folder: Path, garment: str) -> dict[str, Path]:
    """Return the files of a garment's shots by clip: in its own subfolder, where there is one.

    Raises:
        SsilkError: there is no such folder.
    """
    from ssilk_usd.opening.stage import LAYER_SUFFIXES

    if not folder.is_dir():
        fail(str(folder), "there is no such folder", "one with shots of 'ssilk simulate --points' is needed")
    within = folder / garment if (folder / garment).is_dir() else folder
    return {path.stem: path for path in sorted(within.iterdir()) if path.suffix in LAYER_SUFFIXES}


class References:
    """Shots of one garment, named after their clips, in a folder or in its subfolder named after the garment.

    Attributes:
        clips: names of the clips with a shot.
    """

    def __init__(self, folder: Path, garment: str, vertex_count: int, fps: float) -> None:
        """Find the shots.

        Raises:
            SsilkError: there is no such folder.
        """
        self._paths = shots(folder, garment)
        self.vertex_count, self.fps = vertex_count, fps
        self._shot = lru_cache(OPEN)(self._opened)

    @property
    def clips(self) -> frozenset[str]:
        return frozenset(self._paths)

    def read(self, clip: str, frames: range) -> Floats:
        """Return the points of some frames of a clip in the world [m], shape (frames, V, 3).

        Raises:
            SsilkError: the shot is of another garment, at another rate, or shorter than the clip.
        """
        shot, path = self._shot(clip), str(self._paths[clip])
        count = len(shot.frame_times)
        if not frames.stop <= count:
            fail(path, f"{count} frames", f"the clip has {frames.stop} or more", "simulate it again")
        points = np.stack([shot.garment_points(shot.frame_times[frame]) for frame in frames])
        if points.shape[1] != self.vertex_count:
            fail(
                path,
                f"a garment of {points.shape[1]} vertices",
                f"the model's has {self.vertex_count}",
                "simulate the model's garment",
            )
        return points

    def _opened(self, clip: str) -> Shot:
        from ssilk_usd.shots.play import Shot

        path = self._paths[clip]
        shot = Shot(path)
        if not abs(shot.fps - self.fps) < 1e-6:
            fail(
                str(path),
                f"{shot.fps:g} frames per second",
                f"the model steps at {self.fps:g}",
                f"simulate with --fps {self.fps:g}",
            )
        if shot.is_skinned:
            fail(
                str(path),
                "joints and blendshapes, which are millimetres off what was simulated",
                "references are points",
                "simulate with --points",
            )
        return shot
