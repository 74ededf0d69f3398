# SPDX-License-Identifier: Apache-2.0
"""Count in a written file, whose own meshes are posed as its format says, and let the file say what was found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...devices import select_device
from ...physics.intersections.figures import NOT_COUNTED
from ...physics.intersections.pairs import can_find
from ...scene.assets import Motion, Scene, ShotWorld
from ...scene.riders import Rider
from .counters import ColliderCounter, FrameCounter, IntersectionCounter, RiderCounter, SkinCounter, covered_skin
from .opened import add_provenance
from .posed import body_in, opened, posed_frames
from .rollout import BakeRollout
from .stated import SUNK, ShotCounts


@dataclass(frozen=True, eq=False)
class MetWorld:
    """What surrounds the character of a shot, and the time of each of its samples in it [s]."""

    world: ShotWorld
    seconds: Callable[[int], float]


def state_rollout_counts(path: Path, rollout: BakeRollout) -> ShotCounts:
    """Count in the file of a rollout, and let the file say it, as `state_counts` does."""
    request = rollout.request
    return state_counts(
        path,
        rollout.deformer.scene,
        rollout.motion,
        name=Path(request.motion).stem,
        samples_per_frame=request.samples_per_frame,
        device=request.device,
        points=rollout.refinement is not None and request.writes_points,
        met=MetWorld(rollout.around.seen, rollout.samples.seconds) if rollout.around.seen else None,
        riders=rollout.riders,
    )


def state_counts(
    path: Path,
    scene: Scene,
    motion: Motion,
    *,
    name: str,
    samples_per_frame: int = 1,
    device: str = "cpu",
    points: bool = False,
    met: MetWorld | None = None,
    riders: Sequence[Rider] = (),
) -> ShotCounts:
    """Count skin that shows, cloth through cloth and cloth in colliders in a written shot, and let the file say it.

    For 100 frames of a dress skin takes one processor core two to three seconds, and cloth a second.

    The garment is where the file's joints and blendshapes, or its points, have it. So is the body, where the file has
    the whole of it; otherwise the motion poses it. Where libigl is not installed, the file says that cloth was not
    counted.

    Args:
        scene: the garment on its character.
        motion: of the character, at the shot's samples.
        name: of the motion, as figures tell it.
        points: look at the points that the file offers beside joints.
        met: whose colliders are looked at.
        riders: what rides on the garment.

    Raises:
        SsilkError: the file cannot be read, or written again.
    """
    skin = covered_skin(scene, select_device(device)) if scene.character.bodies else None
    shown = SkinCounter(skin, scene, motion) if skin else None
    crossed, sunk, entered, seen = None, None, None, met.world.colliders if met else ()
    if can_find():
        crossed = IntersectionCounter(scene)
        sunk = ColliderCounter(met.world, met.seconds, scene, motion) if met and seen else None
        entered = RiderCounter(riders, scene) if riders else None
    counters: list[FrameCounter] = [each for each in (shown, crossed, sunk, entered) if each]
    shot = opened(path, points)
    for frames in posed_frames(shot, samples_per_frame, body_in(shot, scene) if skin else None) if counters else ():
        for counter in counters:
            counter.add(frames)
    found = ShotCounts(
        shown_skin=shown.figures(name) if shown else None,
        intersections=crossed.figures(name) if crossed else None,
        sunk=sunk.figures(name) if sunk else None,
        entered=entered.figures(name) if entered else (),
    )
    uncounted = {SUNK: {"none": NOT_COUNTED}} if seen and not sunk else {}
    add_provenance(path, {**found.to_metadata(), **uncounted})
    return found
