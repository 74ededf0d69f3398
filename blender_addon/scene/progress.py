# SPDX-License-Identifier: GPL-3.0-or-later
"""How garments' trainings are, read by a timer: panels are drawn many times a second, and the disk may be slow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy

from ..errors import SetupError
from ..outside.jobs import MODEL, JobState, OwnedJob, read_curve, read_state, stamp
from .models import job_of, need_model

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
        if thing.type == "MESH":
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
