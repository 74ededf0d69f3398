# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths of a garment's training and model, stored relative to the blend file."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..errors import SetupError
from ..outside.jobs import MODEL

FIRST = "wait for the training's first validation, or resume it"


def job_of(garment: bpy.types.Object) -> Path | None:
    """Return the folder of a garment's training; None where it has none."""
    folder = garment.ssilk.training.folder
    return Path(bpy.path.abspath(folder)) if folder else None


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
    """Return a path as the blend file should remember it: relative to itself where it has a place."""
    return bpy.path.relpath(str(path)) if bpy.data.filepath else str(path)
