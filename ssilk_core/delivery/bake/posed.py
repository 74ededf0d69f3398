# SPDX-License-Identifier: Apache-2.0
"""The meshes of a written file, frame by frame, as its format poses them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...scene.assets import Floats, Ints, Scene
from ..targets import GLB
from ..view.player import ShotPlayer
from .opened import open_shot

FRAMES_AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class PosedFrames:
    """Consecutive frames of a shot.

    Attributes:
        times: their time codes.
        samples: of the motion at these, shape (F,).
        garment: points of the garment in each [m], shape (V, 3).
        bodies: points of all bodies together in each [m], shape (B, 3); None where the file lacks some.
        riders: points of each mesh that rides on the garment, in each [m].
    """

    times: Sequence[float]
    samples: Ints
    garment: Sequence[Floats]
    bodies: Sequence[Floats] | None
    riders: Sequence[Sequence[Floats]]


def posed_frames(shot: ShotPlayer, samples_per_frame: int, body: Sequence[int] | None) -> Iterator[PosedFrames]:
    """Yield the frames of a shot, `FRAMES_AT_ONCE` at a time.

    Args:
        samples_per_frame: of the motion.
        body: meshes that are its bodies; None to leave these out.
    """
    garment = next(number for number, mesh in enumerate(shot.meshes) if mesh.is_garment)
    for first in range(0, len(shot.frame_times), FRAMES_AT_ONCE):
        times = shot.frame_times[first : first + FRAMES_AT_ONCE]
        posed = [shot.points(time) for time in times]
        yield PosedFrames(
            times=times,
            samples=samples_per_frame * np.arange(first, first + len(times)),
            garment=[each[garment] for each in posed],
            bodies=None if body is None else [np.concatenate([each[mesh] for mesh in body]) for each in posed],
            riders=[[points for mesh, points in zip(shot.meshes, each) if mesh.is_rider] for each in posed],
        )


def opened(path: Path, points: bool) -> ShotPlayer:
    """Open a shot, with the points that it offers beside joints where these are asked for."""
    if not points or path.suffix == GLB:
        return open_shot(path)
    from ssilk_usd.shots.layers_animation import with_points

    return with_points(path)


def body_in(shot: ShotPlayer, scene: Scene) -> list[int] | None:
    """Return the meshes of a shot that are the bodies of a scene, in their order; None where some are missing."""
    found = [number for number, mesh in enumerate(shot.meshes) if not (mesh.is_garment or mesh.is_rider)]
    counts = [len(points) for points in shot.points(shot.frame_times[0])]
    wanted = [body.mesh.vertex_count for body in scene.character.bodies]
    return found if [counts[number] for number in found] == wanted else None
