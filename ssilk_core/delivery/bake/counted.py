# SPDX-License-Identifier: Apache-2.0
"""What is counted in a written file: covered skin that shows, cloth through cloth, and cloth in colliders.

Its own meshes are posed as its format says. Skin and colliders are counted in every frame, and triangles that
intersect others in every `EVERY`-th from the first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...devices import select_device
from ...errors import fail
from ...physics.intersections.figures import EVERY, NOT_COUNTED, SelfIntersections
from ...physics.intersections.pairs import can_find
from ...physics.skin.figures import ShownSkin
from ...physics.world.colliders import voting_points
from ...physics.world.sunk import SunkCloth, SunkCounter
from ...scene.assets import Floats, Ints, Motion, Scene, ShotWorld
from ...scene.kinematics import body_at_rest, centred_matrices, skin_points
from ...scene.plain import from_plain
from ...scene.riders import Rider
from ..targets import GLB
from ..view.player import ShotPlayer
from .entered import EnteredCloth, EnteredCounter
from .opened import add_provenance, open_shot, provenance_of
from .rollout import BakeRollout
from .shots import finished, is_stage, place_of

if TYPE_CHECKING:
    import torch

    from ...physics.intersections.cloth import ClothIntersections, IntersectionCounts
    from ...physics.skin.covered_skin import CoveredSkin, ShownCounts

# What a shot says under these names.
SHOWN_SKIN, INTERSECTIONS, SUNK, ENTERED = "shown_skin", "intersections", "sunk_cloth", "riders_in_cloth"
FRAMES_AT_ONCE = 32


@dataclass(frozen=True, kw_only=True)
class ShotCounts:
    """What was counted in a written file.

    Attributes:
        shown_skin: the share of the covered skin that shows; None where the garment covers nothing.
        intersections: the share of triangles that intersect others of the garment; None without libigl.
        sunk: the share of vertices inside colliders; None where there are no colliders.
        entered: riders that enter their cloth.
    """

    shown_skin: ShownSkin | None
    intersections: SelfIntersections | None
    sunk: SunkCloth | None = None
    entered: tuple[EnteredCloth, ...] = ()


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
        met=MetWorld(rollout.around.seen, rollout.seconds) if rollout.around.seen else None,
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
    skin = _covered_skin(scene, select_device(device)) if scene.character.bodies else None
    cloth = _cloth(scene) if can_find() else None
    shot = _opened(path, points)
    times, body = shot.frame_times, body_in(shot, scene) if skin else None
    garment = next(number for number, mesh in enumerate(shot.meshes) if mesh.is_garment)
    shown: list[ShownCounts] = []
    crossed: list[IntersectionCounts] = []
    entered = EnteredCounter(riders, scene.garment.mesh) if riders and can_find() else None
    sunk = SunkCounter(met.world) if met and met.world.colliders and can_find() else None
    for first in range(0, len(times), FRAMES_AT_ONCE) if skin or cloth or sunk or entered else ():
        some = times[first : first + FRAMES_AT_ONCE]
        posed = [shot.points(time) for time in some]
        samples = samples_per_frame * np.arange(first, first + len(some))
        if sunk and met:
            voters = voting_points(motion.picked(samples), scene)
            for points_there, votes, sample, time in zip(posed, voters, samples.tolist(), some):
                sunk.add(points_there[garment], votes, met.seconds(sample), time)
        if entered:
            for each, time in zip(posed, some):
                ridden = [points for mesh, points in zip(shot.meshes, each) if mesh.is_rider]
                entered.add(each[garment], ridden, time)
        if skin:
            bodies = None if body is None else [np.concatenate([each[mesh] for mesh in body]) for each in posed]
            shown.append(_shown([each[garment] for each in posed], skin, bodies, scene, motion, some, samples))
        if cloth:  # blocks begin with a frame that is counted
            crossed.append(cloth.counts([each[garment] for each in posed[::EVERY]], some[::EVERY]))
    found = ShotCounts(
        shown_skin=skin.figures([(name, part) for part in shown]) if skin else None,
        intersections=cloth.figures([(name, part) for part in crossed]) if cloth else None,
        sunk=sunk.figures(name) if sunk and times else None,
        entered=entered.figures(name) if entered else (),
    )
    skin_said = {SHOWN_SKIN: found.shown_skin.to_metadata()} if found.shown_skin else {}
    said = found.intersections.to_metadata() if found.intersections else {"none": NOT_COUNTED}
    sunk_said = {SUNK: found.sunk.to_metadata()} if found.sunk else {}
    if met and met.world.colliders and not can_find():
        sunk_said = {SUNK: {"none": NOT_COUNTED}}
    deep = {each.rider: each.to_metadata() for each in found.entered}
    entered_said = {ENTERED: deep} if deep else {}
    add_provenance(path, {**skin_said, INTERSECTIONS: said, **sunk_said, **entered_said})
    return found


def stated_sunk(path: Path, garments: Mapping[int, str]) -> dict[int, SunkCloth]:
    """Return what bakes counted inside colliders, of garments of a shot or of a stage of layers that have it.

    Args:
        garments: paths of their meshes in the stage, by any number.

    Raises:
        SsilkError: not a readable shot, or it says so otherwise than this version does.
    """
    if is_stage(path):
        records = finished(*place_of(path))
        results = {name: record.result.sunk for name, record in records.items() if record and record.result.sunk}
        named = {number: prim.split("/")[2:3] for number, prim in garments.items()}
        return {number: results[name[0]] for number, name in named.items() if name and name[0] in results}
    said = provenance_of(path).get(SUNK)
    if not isinstance(said, Mapping) or "none" in said or len(garments) != 1:
        return {}
    try:
        found = from_plain(SunkCloth, {"colliders": {}, **said})
    except (TypeError, ValueError) as error:
        fail(str(path), f"its cloth inside colliders is told in another way ({error})", "a shot of this version",
             "bake it again")  # fmt: skip
    return dict.fromkeys(garments, found)


def _opened(path: Path, points: bool) -> ShotPlayer:
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


def _shown(
    cloth: Sequence[Floats],
    skin: CoveredSkin,
    bodies: Sequence[Floats] | None,
    scene: Scene,
    motion: Motion,
    times: Sequence[float],
    samples: Ints,
) -> ShownCounts:
    """Count the skin that shows in frames of cloth (V, 3) and of bodies (B, 3) [m], at samples of their motion."""
    import torch

    from ...physics.skin.covered_skin import ShownCounts

    device = skin.points.device
    part = motion.picked(samples)
    matrices, origin = centred_matrices(part, scene.character.skeleton)

    def tensor(frames: Sequence[Floats]) -> torch.Tensor:
        return torch.as_tensor(np.stack(frames, axis=-1), dtype=torch.float32, device=device)

    if bodies is None and part.shapes:
        body_skin = scene.character.merged_body().skin
        bodies = list(skin_points(body_at_rest(scene.character, part), body_skin, matrices) + origin)
    body = None if bodies is None else tensor([points[skin.points.vertices] - origin for points in bodies])
    states = skin.states(tensor([points - origin for points in cloth]), tensor(list(matrices[:, :, :3])), body)
    return ShownCounts.of(states, list(times))


@lru_cache(maxsize=1)
def _covered_skin(scene: Scene, device: torch.device) -> CoveredSkin | None:
    """Return the skin that a garment covers; None where it covers nothing."""
    from ...physics.skin.covered_skin import CoveredSkin

    found = CoveredSkin(scene, device=device)
    return found if len(found) else None


@lru_cache(maxsize=1)
def _cloth(scene: Scene) -> ClothIntersections:
    from ...physics.intersections.cloth import ClothIntersections

    return ClothIntersections.of(scene)
