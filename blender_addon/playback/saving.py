# SPDX-License-Identifier: GPL-3.0-or-later
"""Keep relative paths valid when the blend file, or a copy of it, is saved in another folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..motions.sources import FILE
from ..scene.linked import is_override, origin
from .models import job_of, relative, remembered, trainings

_before: list[tuple[Any, str, str]] = []


def paths() -> Iterator[tuple[Any, str]]:
    """Yield each relative path that a garment remembers of its own, as what holds it and under which name."""
    for thing in bpy.data.objects:
        if thing.library is None and thing.type == "MESH":
            training = thing.ssilk.training
            files = [(item, "name") for item in training.motions if item.kind == FILE and not is_override(thing)]
            linked = {origin(thing).ssilk.model, origin(thing).ssilk.training.folder} if is_override(thing) else set()
            own = ((thing.ssilk, "model"), (training, "folder"), (thing.ssilk.try_on, "stage"))
            for holder, name in (*own, *files):
                if getattr(holder, name).startswith("//") and getattr(holder, name) not in linked:
                    yield holder, name


def remember_trainings() -> None:
    """Let garments remember their trainings again, which an undo may have taken from them."""
    known = trainings()
    for thing in bpy.data.objects:
        if thing.library is None and thing.type == "MESH" and not is_override(thing):
            folder = job_of(thing, known)
            if folder and folder != remembered(thing):
                thing.ssilk.training.folder = relative(folder)


@persistent
def before_saving(path: str, *_: object) -> None:
    """Remember trainings, and make paths relative to where the file is about to be saved."""
    _before.clear()
    remember_trainings()
    if not bpy.data.filepath or os.path.dirname(path) == os.path.dirname(bpy.data.filepath):
        return
    for holder, name in list(paths()):
        found = getattr(holder, name)
        _before.append((holder, name, found))
        setattr(holder, name, bpy.path.relpath(bpy.path.abspath(found), start=os.path.dirname(path)))


@persistent
def after_saving(path: str, *_: object) -> None:
    """Put paths back where only a copy was saved, or nothing."""
    if bpy.data.filepath != path:
        for holder, name, found in _before:
            setattr(holder, name, found)
    _before.clear()


def start_listening() -> None:
    """Register the handlers."""
    bpy.app.handlers.save_pre.append(before_saving)
    bpy.app.handlers.save_post.append(after_saving)
    bpy.app.handlers.save_post_fail.append(after_saving)


def stop_listening() -> None:
    """Remove the handlers."""
    bpy.app.handlers.save_pre.remove(before_saving)
    bpy.app.handlers.save_post.remove(after_saving)
    bpy.app.handlers.save_post_fail.remove(after_saving)
