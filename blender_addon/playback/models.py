# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment's training, how far it is, and its model.

Trainings are found beside the blend file, by what they say they train: an undo, or closing without saving, changes
nothing about them. What a garment remembers of its training, relative to the file, finds it where either was renamed.
A timer reads how they are: panels are drawn many times a second, and the disk may be slow.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from ssilk_usd.shots.skinned import SkinnedGarment

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.sight import collider_sight
from ssilk_core.physics.world.felt import ColliderSight
from ssilk_core.physics.world.surface import Search
from ssilk_core.scene.assets import ShotWorld
from ssilk_core.scene.fabric_range import FabricRange
from ssilk_core.scene.fabrics import Fabric

from ..arrays.joints import Joints, joint_order
from ..arrays.renamed import TrainedJoints, growth, known_as, renames
from ..errors import SetupError
from ..outside.jobs import MODEL, JobState, OwnedJob, owned, owner, read_curve, read_state, stamp
from ..outside.wording import recall, reworded
from ..scene.linked import absolute, home, origin
from .bake import need_movable
from .fabrics import in_fabric, played_factors
from .family import on_its_body
from .laying import Laid, lay

FIRST = "wait for its training, or resume it"
FOLDER = "ssilk"  # of trainings, beside the blend file
_orphans: tuple[str, list[Orphan]] = ("", [])  # the blend file, and what was found beside it


def trainings_folder() -> Path:
    """Return the folder of the trainings that are begun in this file; the file was saved."""
    return Path(os.path.normpath(bpy.data.filepath)).parent / FOLDER


def trainings() -> list[OwnedJob]:
    """Return the trainings beside the blend file, the latest one last; none where it was never saved."""
    return owned(trainings_folder()) if bpy.data.filepath else []


def remembered(garment: bpy.types.Object) -> Path | None:
    """Return the folder of the training that a garment remembers; None where it remembers none."""
    folder = garment.ssilk.training.folder
    return absolute(garment, folder, origin(garment).ssilk.training.folder) if folder else None


def job_of(garment: bpy.types.Object, known: Sequence[OwnedJob] | None = None) -> Path | None:
    """Return the folder of a garment's latest training; None where it has none.

    Args:
        known: the trainings beside the file, where they were read already.
    """
    own, name, file = remembered(garment), origin(garment).name, home(garment).name
    if origin(garment).library:  # it was trained where it is linked from
        known = owned(home(garment).parent / FOLDER)
    found = [job for job in (trainings() if known is None else known) if (job.garment, job.file) == (name, file)]
    before = owner(own) if own else None
    if found and not (before and before.begun > found[-1].begun):
        return found[-1].folder
    return own


@dataclass(frozen=True)
class Orphan:
    """A training that goes on without its garment, and the part of it that is done, in [0, 1]."""

    job: OwnedJob
    fraction: float


def orphans() -> list[Orphan]:
    """Return the trainings of this file that went on and belonged to no garment in it when they were looked for."""
    file, found = _orphans
    return found if file == bpy.data.filepath else []


def look_for_orphans(known: Sequence[OwnedJob] | None = None) -> bool:
    """Read from disk what `orphans` returns from now on; return whether it has changed.

    Args:
        known: the trainings beside the file, where they were read already.
    """
    global _orphans
    before = orphans()
    _orphans = bpy.data.filepath, _read_orphans(trainings() if known is None else known)
    return before != orphans()


def _read_orphans(known: Sequence[OwnedJob]) -> list[Orphan]:
    here = [job for job in known if job.file == Path(bpy.data.filepath).name]
    if not here:
        return []
    things = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    linked = {job for thing in things if thing.users_scene and (job := job_of(thing, known))}
    states = ((job, read_state(job.folder)) for job in here if job.folder not in linked)
    return [Orphan(job, state.fraction) for job, state in states if state and state.alive]


def model_of(garment: bpy.types.Object) -> Path:
    """Return the model that was chosen for a garment, else the one that its training has reached.

    Raises:
        SetupError: there is none.
    """
    return need_model(garment, job_of(garment))


def need_model(garment: bpy.types.Object, job: Path | None) -> Path:
    """Return the model that was chosen for a garment, else the one in the folder of its training.

    Raises:
        SetupError: there is none.
    """
    chosen = garment.ssilk.model
    if not chosen and not job:
        raise SetupError(f"'{garment.name}' has no trained model; train it, or choose a model in the Baking panel.")
    path = absolute(garment, chosen, origin(garment).ssilk.model) if chosen else job / MODEL
    if not path.is_file():
        where, todo = (f" at {path}", "choose another") if chosen else (" yet", FIRST)
        raise SetupError(f"'{garment.name}' has no model{where}; {todo}.")
    return path


def relative(path: Path) -> str:
    """Return a path as the blend file should remember it: relative to itself where it has a place on that drive."""
    try:
        return bpy.path.relpath(str(path)) if bpy.data.filepath else str(path)
    except ValueError:  # another drive
        return str(path)


Question = tuple[str, str, str]  # what decides which training is a garment's


@dataclass(frozen=True)
class TrainingProgress:
    """A garment's training as it was when it was read.

    Attributes:
        state: None where there is none.
        curve: what validations found (`read_curve`).
        written: when the state was written [s].
        has_model: whether there is a model to play.
    """

    folder: Path
    state: JobState | None
    curve: dict[str, Any] = field(compare=False)
    written: float
    has_model: bool

    @property
    def alive(self) -> bool:
        """Whether somebody works on it, or waits to."""
        return bool(self.state and self.state.alive)


_facts: dict[Path, tuple[float, ModelFacts]] = {}  # when a model was written that was read, and what it says
_known: dict[int, tuple[Question, TrainingProgress | None]] = {}


def progress_of(garment: bpy.types.Object) -> TrainingProgress | None:
    """Return a garment's training as it was read last; it is read now where it was not, or is another one by now."""
    question, known = _known.get(garment.session_uid, (None, None))
    return known if question == _question(garment) else _read(garment)


def read_all(jobs: Sequence[OwnedJob]) -> bool:
    """Read from disk what `progress_of` returns from now on; return whether anything has changed.

    Args:
        jobs: the trainings beside the file.
    """
    before = dict(_known)
    forget()
    for thing in bpy.data.objects:
        if thing.type == "MESH" and not thing.library:
            _known[thing.session_uid] = (_question(thing), _read(thing, jobs))
    return before != _known


def forget() -> None:
    """Let every training be read again: one began, or was asked to end."""
    _known.clear()


def no_model(garment: bpy.types.Object) -> str:
    """Return why a garment has no model to play; empty if it has one."""
    found = progress_of(garment)
    if found and found.has_model and not garment.ssilk.model:
        return ""
    try:
        need_model(garment, found.folder if found else None)
    except SetupError as error:
        return str(error).removesuffix(".")
    return ""


def _question(garment: bpy.types.Object) -> Question:
    return (bpy.data.filepath, garment.name, garment.ssilk.training.folder)


def _read(garment: bpy.types.Object, jobs: Sequence[OwnedJob] | None = None) -> TrainingProgress | None:
    folder = job_of(garment, jobs)
    if folder is None:
        return None
    return TrainingProgress(
        folder, read_state(folder), read_curve(folder), stamp(folder), (folder / MODEL).is_file()
    )  # fmt: skip


def chosen_bones(garment: bpy.types.Object) -> dict[str, str]:
    """Return what the artist says that bones were called when a garment was trained, by their names now."""
    return {item.bone: item.name for item in garment.ssilk.bones if item.bone}


def joints_known_to(
    garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, trained: TrainedJoints
) -> Joints:
    """Return an armature's joints under the names that a garment was trained with.

    Raises:
        SetupError: the character has another size than then.
    """
    known = known_as(joints, trained, chosen_bones(garment))
    ratio = growth(known, trained)
    if ratio != 1:
        scale = armature.matrix_world.median_scale
        raise SetupError(
            f"'{armature.name}' is scaled to {ratio:.4g} times its size when '{garment.name}' was trained, and cloth "
            f"does not move alike in another size; scale it to {scale / ratio:.4g} (now {scale:.4g}), or train it at "
            "this size."
        )
    return known


def told_renames(joints: Joints) -> str:
    """Return a note about bones that were renamed since a garment was trained; empty where none was."""
    found = renames(joints)
    if not found:
        return ""
    name = next(iter(found))
    count = "1 bone is" if len(found) == 1 else f"{len(found)} bones are"
    return f" ({count} called otherwise than in the training and matched, as '{name}', which was '{found[name]}')"


def fabrics_of(garment: bpy.types.Object) -> tuple[Fabric, FabricRange] | None:
    """Return the fabric that a garment's model was trained with, and the range of others; None where it knows none.

    Raises:
        SsilkError: there is no model, or it cannot be read.
    """
    return facts_of(model_of(garment)).fabrics


def sees_colliders(garment: bpy.types.Object) -> bool:
    """Return whether a garment's model was trained to see colliders.

    Raises:
        SsilkError: there is no model, or it cannot be read.
    """
    return facts_of(model_of(garment)).sees_colliders


@dataclass(frozen=True, eq=False)
class Sewing:
    """How a garment of a family of bodies is sewn: its points on the first body [m], shape (V, 3), and whether it is
    graded to each."""

    first: np.ndarray
    graded: bool


@dataclass(frozen=True, eq=False)
class ModelFacts:
    """What panels and pictures ask of a model.

    Attributes:
        fabrics: the fabric of its training, and the range of others that it knows; None for that one alone.
        sewing: None for a model of one body.
    """

    sees_colliders: bool
    fabrics: tuple[Fabric, FabricRange] | None
    sewing: Sewing | None


def facts_of(path: Path) -> ModelFacts:
    """Return what a model says; the file is read where it is another by now.

    Raises:
        SsilkError: it cannot be read.
    """
    written = path.stat().st_mtime
    if path not in _facts or _facts[path][0] != written:
        file = load_model(path)
        garment = file.scene.garment
        _facts[path] = (
            written,
            ModelFacts(
                file.config.proximity_points > 0,
                (file.fabric, file.fabrics.range) if file.fabrics else None,
                Sewing(garment.mesh.points, garment.graded) if file.bodies else None,
            ),
        )
    return _facts[path][1]


class TrainedGarment:
    """A model on an armature. One of a family of bodies is put on the body that the character has in this frame.

    Attributes:
        file: the model, on that body.
        factors: of its training's fabric, as which it plays, shape (5,).
        player: plays it.
        on: the model of a family on that body; None for one of one body.
        joints: of the armature, under the names that the model knows.
        own: joints of the armature in the order of the model's character, shape (J,).
        order: joints of the model in the order of the armature, proxies included, shape (J + P,).

    Raises:
        SsilkError: it cannot be read, or has other joints than the armature, or those of another size.
    """

    def __init__(self, path: Path, garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints) -> None:
        try:
            file = load_model(path)
        except SsilkError as error:
            raise SetupError(reworded(str(error), path.parent, recall(path.parent))) from error
        self.on = on_its_body(file, garment, armature, joints, chosen_bones(garment)) if file.bodies else None
        self.file = self.on.worn.file if self.on else file
        self.factors = played_factors(garment)
        self.player = Player(in_fabric(self.file, self.factors))
        scene = self.player.file.scene
        trained = TrainedJoints(scene.joint_names, scene.bind_transforms)
        self.joints = joints = self.on.joints if self.on else joints_known_to(garment, armature, joints, trained)
        self.order = joint_order(joints, scene.joint_names)
        self.own = np.argsort(self.order[: joints.character_count])

    def in_fabric(self, garment: bpy.types.Object) -> TrainedGarment:
        """Return this in the fabric that is chosen for the garment now."""
        other = copy(self)
        other.factors = played_factors(garment)
        other.player = Player(in_fabric(self.file, other.factors))
        return other

    @property
    def sees_colliders(self) -> bool:
        """Whether the network was trained to."""
        return self.player.file.config.proximity_points > 0

    def sight(self, world: ShotWorld, search: Search) -> ColliderSight:
        """Return what the network sees of the colliders around it; `search` finds nearest points on triangles."""
        return collider_sight(self.player, world, search)

    @property
    def told(self) -> str:
        """What there is to say of the body of a family that it plays on, in sentences; empty where nothing is."""
        return self.on.told if self.on else ""

    def lay(
        self, garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, skinned: SkinnedGarment
    ) -> Laid | None:
        """Return how a garment of a family is brought to its body; None for a model of one body.

        Raises:
            SetupError: as `laying.lay` does, or proxies that rest elsewhere cannot move by themselves.
        """
        if self.on is None:
            return None
        laid = lay(garment, armature, joints, skinned, self.order, self.on.base)
        if laid.moves_proxies:
            need_movable(armature, joints.proxies)
        return laid

    @property
    def proxies(self) -> np.ndarray:
        """Proxies of the model in the order of the armature, counted from the first one, shape (P,)."""
        return self.order[self.joints.character_count :] - self.joints.character_count
