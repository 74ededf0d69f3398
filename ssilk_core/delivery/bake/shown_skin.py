# SPDX-License-Identifier: Apache-2.0
"""The covered skin that shows in a written file: its own meshes are posed as its format says, in every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...devices import select_device
from ...physics.skin.figures import ShownSkin
from ...scene.assets import Floats, Ints, Motion, Scene
from ...scene.kinematics import centred_matrices
from ..targets import GLB
from ..view.player import ShotPlayer
from .opened import add_provenance, open_shot
from .rollout import BakeRollout

if TYPE_CHECKING:
    import torch

    from ...physics.skin.covered_skin import CoveredSkin, ShownCounts

SHOWN_SKIN = "shown_skin"  # what a shot says under this name
FRAMES_AT_ONCE = 32


def state_rollout_skin(path: Path, rollout: BakeRollout) -> ShownSkin | None:
    """Count and state the covered skin that shows in the file of a rollout, as `state_shown_skin` does."""
    request = rollout.request
    return state_shown_skin(
        path,
        rollout.deformer.scene,
        rollout.motion,
        name=Path(request.motion).stem,
        samples_per_frame=request.samples_per_frame,
        device=request.device,
        points=rollout.refinement is not None and request.writes_points,
    )


def state_shown_skin(
    path: Path,
    scene: Scene,
    motion: Motion,
    *,
    name: str,
    samples_per_frame: int = 1,
    device: str = "cpu",
    points: bool = False,
) -> ShownSkin | None:
    """Count the covered skin that shows in every frame of a written shot, and let the file say it.

    It takes two to three seconds of one processor core for 100 frames of a dress.

    The garment is where the file's joints and blendshapes, or its points, have it. So is the body, where the file has
    the whole of it; otherwise the motion poses it.

    Args:
        scene: the garment on its character.
        motion: of the character, at the shot's samples.
        name: of the motion, as figures tell it.
        points: look at the points that the file offers beside joints.

    Returns:
        None where the garment covers nothing.

    Raises:
        SsilkError: the file cannot be read, or written again.
    """
    skin = _covered_skin(scene, select_device(device)) if scene.character.bodies else None
    if skin is None or not len(skin):
        return None
    shot = _opened(path, points)
    times, body, parts = shot.frame_times, _body_in(shot, scene), []
    for first in range(0, len(times), FRAMES_AT_ONCE):
        some = times[first : first + FRAMES_AT_ONCE]
        samples = samples_per_frame * np.arange(first, first + len(some))
        parts.append(_counted(shot, skin, body, scene, motion, some, samples))
    found = skin.figures([(name, part) for part in parts])
    assert found  # the garment covers skin
    add_provenance(path, {SHOWN_SKIN: found.to_metadata()})
    return found


def _opened(path: Path, points: bool) -> ShotPlayer:
    """Open a shot, with the points that it offers beside joints where these are asked for."""
    if not points or path.suffix == GLB:
        return open_shot(path)
    from ssilk_usd.shots.layers import with_points

    return with_points(path)


def _body_in(shot: ShotPlayer, scene: Scene) -> list[int] | None:
    """Return the meshes of a shot that are the bodies of a scene, in their order; None where some are missing."""
    found = [number for number, mesh in enumerate(shot.meshes) if not mesh.is_garment]
    counts = [len(points) for points in shot.points(shot.frame_times[0])]
    wanted = [body.mesh.vertex_count for body in scene.character.bodies]
    return found if [counts[number] for number in found] == wanted else None


def _counted(
    shot: ShotPlayer,
    skin: CoveredSkin,
    body: list[int] | None,
    scene: Scene,
    motion: Motion,
    times: Sequence[float],
    samples: Ints,
) -> ShownCounts:
    """Count in some frames of a shot, at the samples of its motion."""
    import torch

    from ...physics.skin.covered_skin import ShownCounts

    device = skin.points.device
    part = replace(motion, rotations=motion.rotations[samples], translations=motion.translations[samples])
    matrices, origin = centred_matrices(part, scene.character.skeleton)

    def tensor(frames: Sequence[Floats]) -> torch.Tensor:
        return torch.as_tensor(np.stack(frames, axis=-1), dtype=torch.float32, device=device)

    garment = next(number for number, mesh in enumerate(shot.meshes) if mesh.is_garment)
    cloth, bodies = [], []
    for time in times:
        points = shot.points(time)
        cloth.append(points[garment] - origin)
        if body is not None:
            bodies.append(np.concatenate([points[number] for number in body])[skin.points.vertices] - origin)
    states = skin.states(tensor(cloth), tensor(list(matrices[:, :, :3])), tensor(bodies) if bodies else None)
    return ShownCounts.of(states, list(times))


@lru_cache(maxsize=1)
def _covered_skin(scene: Scene, device: torch.device) -> CoveredSkin:
    from ...physics.skin.covered_skin import CoveredSkin

    return CoveredSkin(scene, device=device)
