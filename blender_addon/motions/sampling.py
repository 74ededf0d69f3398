# SPDX-License-Identifier: GPL-3.0-or-later
"""The motion of an armature, sampled as Blender evaluates it with constraints and drivers, a little at a time.

Each slice of time uses a temporary scene that holds the armature alone, where nothing reads the artist's. So nothing
of that is evaluated or moved, and nothing is left behind if the artist saves or undoes in between. `ChosenMotions`
are those of a training, sampled here or read from USD files.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ssilk_core.scene.assets import Motion
from ssilk_core.scene.kinematics import local_transforms, quaternion_from_matrix

from ..arrays.joints import Joints, identifiers
from ..errors import SetupError
from ..scene.armature import leader_of
from ..scene.gather import ROOT
from ..scene.handover import MOTIONS, loading_usd
from ..scene.objects import found_again, scene_rate, scene_units
from .evaluating import evaluating
from .sources import FILE, Source, frames_of, moves_alone, playing

SLICE = 0.04  # seconds that Blender waits for us at a time
STILL = 1e-6  # how far an armature that stays in place may move, as a share of its size
UNEVEN = 1e-3  # how far a bone's axes may be from unit length and right angles, as ssilk has it


@dataclass(eq=False)
class SampledTake:
    """A motion that is being sampled.

    Attributes:
        worlds: joint to world of the frames sampled so far, rigid, in Blender's units, shape (J, 4, 4) each.
        placements: object to world of the armature at these frames, shape (4, 4) each.
        above: object to world of the objects that it hangs on, by name, likewise.
    """

    source: Source
    frames: range
    worlds: list[np.ndarray] = field(default_factory=list)
    placements: list[np.ndarray] = field(default_factory=list)
    above: dict[str, list[np.ndarray]] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        return len(self.worlds) == len(self.frames)

    def motion(self, joints: Joints) -> Motion:
        """Return what was sampled of these joints, at the scene's rate; frames are counted as the timeline does."""
        return motion_of(np.array(self.worlds), joints.parents, self.source.name, self.frames.start)


def motion_of(placed: np.ndarray, parents: np.ndarray, name: str, start: int = 0) -> Motion:
    """Return joints to world in Blender's units, shape (F, J, 4, 4), as a motion at the scene's rate."""
    local = local_transforms(scene_units().transforms_to_core(placed), parents)
    return Motion(name, scene_rate(), quaternion_from_matrix(local[..., :3, :3]), local[..., :3, 3], start)


def prepare_takes(armature: bpy.types.Object, chosen: Sequence[Source]) -> list[SampledTake]:
    """Return takes to sample.

    Raises:
        SetupError: a motion is gone, or the armature cannot be evaluated.
    """
    if armature.data.pose_position != "POSE":
        raise SetupError(
            f"'{armature.name}' shows its rest position; switch to Pose Position in its data properties."
        )
    if armature.hide_viewport:
        raise SetupError(f"'{armature.name}' is disabled in viewports; enable it in the outliner.")
    return [SampledTake(source, frames_of(leader_of(armature), source)) for source in chosen]


def need_company(garment: bpy.types.Object, armature: bpy.types.Object, take: SampledTake) -> None:
    """Check that a garment moves along where its armature moves as an object, besides its bones.

    It does where it hangs on the armature, or with it on something that moves both, as on an empty above a character.

    Raises:
        SetupError: it stays where it is, so that Blender would deform it from a wrong place.
    """
    still = STILL * max(armature.dimensions)
    carriers = [above.name for above in _above(garment)]
    if np.ptp(take.placements, axis=0).max() <= still or armature.name in carriers:
        return
    shared = next((name for name in carriers if name in take.above), None)
    if shared is not None:
        own = carriers[: carriers.index(shared)]
        alone = [name for name in (garment.name, *own) if moves_alone(bpy.data.objects[name])]
        inside = np.linalg.inv(take.above[shared]) @ np.array(take.placements)
        if not alone and np.ptp(inside, axis=0).max() <= still:
            return
    raise SetupError(
        f"'{armature.name}' moves as an object and leaves '{garment.name}' behind; make it the parent, or let one "
        "object above both move them."
    )


def _above(thing: bpy.types.Object) -> list[bpy.types.Object]:
    """Return what an object hangs on, the nearest first."""
    found: list[bpy.types.Object] = []
    while (thing := thing.parent) is not None:
        found.append(thing)
    return found


def sample(armature: bpy.types.Object, joints: Joints, takes: Sequence[SampledTake]) -> Iterator[float]:
    """Fill takes, yielding the part that is done after each slice of time.

    Args:
        joints: of the character.

    Raises:
        SetupError: the armature or a bone was deleted meanwhile, or a bone is scaled.
    """
    uid, name, total = armature.session_uid, armature.name, sum(len(take.frames) for take in takes)
    for take in takes:
        while not take.complete:
            _sample_slice(found_again(uid, name), joints, take)
            yield sum(len(take.worlds) for take in takes) / total


def _sample_slice(armature: bpy.types.Object, joints: Joints, take: SampledTake) -> None:
    lost = [name for name in joints.names if name not in armature.pose.bones]
    if lost:
        raise SetupError(f"'{armature.name}' lost the bone '{lost[0]}' meanwhile; begin again.")
    columns = [armature.pose.bones.find(name) for name in joints.names]
    until = time.monotonic() + SLICE
    with playing(leader_of(armature), take.source), evaluating(armature) as frames:
        while True:
            frame = take.frames[len(take.worlds)]
            depsgraph = frames(frame)
            evaluated = armature.evaluated_get(depsgraph)
            take.placements.append(np.array(evaluated.matrix_world))
            _need_same_size(armature, evaluated, take.source.name, frame)
            for above in _above(armature):
                placed = np.array(above.evaluated_get(depsgraph).matrix_world)
                take.above.setdefault(above.name, []).append(placed)
            take.worlds.append(_rigid(worlds(evaluated)[columns], joints, take.source.name, frame))
            if take.complete or time.monotonic() > until:
                return


def _need_same_size(armature: bpy.types.Object, evaluated: bpy.types.Object, motion: str, frame: int) -> None:
    """Raise `SetupError` if an armature has another scale in a frame than when its joints were read."""
    now, then = armature.matrix_world.median_scale, evaluated.matrix_world.median_scale
    if abs(then - now) > UNEVEN * now:
        raise SetupError(
            f"'{armature.name}' is scaled {then:.4g} at frame {frame} of '{motion}' and {now:.4g} in the frame that "
            "is shown; cloth does not move alike in another size: remove the keys of its scale."
        )


def worlds(armature: bpy.types.Object) -> np.ndarray:
    """Return bone to world of all bones, without the armature's scale in their axes, shape (bones, 4, 4)."""
    poses = np.empty(len(armature.pose.bones) * 16, dtype=np.float32)
    armature.pose.bones.foreach_get("matrix", poses)
    placement = np.array(armature.matrix_world)
    found = placement @ poses.reshape(-1, 4, 4).swapaxes(-1, -2)
    found[:, :3, :3] /= armature.matrix_world.median_scale
    return found


def _rigid(worlds: np.ndarray, joints: Joints, motion: str, frame: int) -> np.ndarray:
    axes = worlds[:, :3, :3]
    error = np.abs(axes.swapaxes(-1, -2) @ axes - np.eye(3)).max(axis=(1, 2))
    worst = int(error.argmax())
    if not error[worst] <= UNEVEN:
        raise SetupError(
            f"The bone '{joints.names[worst]}' is scaled at frame {frame} of '{motion}'; it may turn and move only."
        )
    return worlds


@dataclass(frozen=True, eq=False)
class ChosenMotions:
    """Motions to train on.

    Attributes:
        takes: those that Blender plays, to be sampled.
        files: those that lie in USD files.
    """

    takes: list[SampledTake]
    files: list[Path]

    @classmethod
    def of(cls, garment: bpy.types.Object, armature: bpy.types.Object) -> ChosenMotions:
        """Return what was chosen for a garment.

        Raises:
            SetupError: a motion is gone, or the armature cannot be evaluated.
        """
        used = [item for item in garment.ssilk.training.motions if item.use]
        played = [Source(item.kind, item.name, item.track) for item in used if item.kind != FILE]
        files = [Path(bpy.path.abspath(item.name)) for item in used if item.kind == FILE]
        return cls(prepare_takes(armature, played) if played else [], files)

    @property
    def names(self) -> list[str]:
        """Names of the files that takes are written to."""
        return [f"{name}.usdc" for name in identifiers(take.source.name for take in self.takes)]

    @property
    def words(self) -> dict[str, str]:
        """Names of the motions by the files that they are written to, for `outside.wording`."""
        return {f"{MOTIONS}/{name}": f"'{take.source.name}'" for name, take in zip(self.names, self.takes)}

    def writing(self, armature: bpy.types.Object, joints: Joints, folder: Path) -> Iterator[float]:
        """Sample the takes and write them into a new folder, yielding the part of each of both that is done.

        Args:
            joints: of the character.

        Raises:
            SetupError: as `sample` does.
        """
        yield from sample(armature, joints, self.takes)
        yield from loading_usd()
        from ssilk_usd.writing.files import write_motion

        folder.mkdir()
        for done, (name, take) in enumerate(zip(self.names, self.takes)):
            yield done / len(self.takes)
            write_motion(folder / name, take.motion(joints), joints.skeleton(ROOT))
