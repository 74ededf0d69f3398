# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment's training and model.

Trainings are found beside the blend file, by what they say they train: an undo, or closing without saving, changes
nothing about them. What a garment remembers of its training, relative to the file, finds it where either was renamed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..errors import SetupError
from ..outside.jobs import MODEL, OwnedJob, owned, owner, read_state

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
    return Path(os.path.normpath(bpy.path.abspath(folder))) if folder else None


def job_of(garment: bpy.types.Object, known: Sequence[OwnedJob] | None = None) -> Path | None:
    """Return the folder of a garment's latest training; None where it has none.

    Args:
        known: the trainings beside the file, where they were read already.
    """
    own, name, file = remembered(garment), garment.name, Path(bpy.data.filepath).name
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
    linked = {job for thing in things if (job := job_of(thing, known)) and thing.users_scene}
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
    path = Path(bpy.path.abspath(chosen)) if chosen else job / MODEL
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
