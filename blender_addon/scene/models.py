# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment's training and model.

Trainings are found beside the blend file, by what they say they train: an undo, or closing without saving, changes
nothing about them. What a garment remembers of its training, relative to the file, finds it where either was renamed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..errors import SetupError
from ..outside.jobs import MODEL, OwnedJob, owned, owner, read_state

FIRST = "wait for the training's first validation, or resume it"
FOLDER = "ssilk"  # of trainings, beside the blend file


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


def orphans() -> list[OwnedJob]:
    """Return the trainings beside the blend file that go on and belong to no garment in it."""
    known = trainings()
    if not known:
        return []
    things = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    linked = {job for thing in things if (job := job_of(thing, known)) and thing.users_scene}
    alone = [job for job in known if job.folder not in linked]
    return [job for job in alone if (state := read_state(job.folder)) and state.alive]


def model_of(garment: bpy.types.Object) -> Path:
    """Return the model that was chosen for a garment, else the one that its training has reached.

    Raises:
        SetupError: there is none.
    """
    job, chosen = job_of(garment), garment.ssilk.model
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
