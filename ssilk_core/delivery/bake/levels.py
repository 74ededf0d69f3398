# SPDX-License-Identifier: Apache-2.0
"""Levels of quality of garments in shots: what one may be a level of, checked before anything is baked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from ...errors import fail
from .shots import finished
from .task import BakeTask

ALLOWED = "each level is a variant of a garment that is none"


def need_levels(folder: Path, tasks: Iterable[BakeTask], *, complete: bool) -> None:
    """Raise `SsilkError` where a task would be a level of a level, or have the variant's name of another level.

    Args:
        folder: of layers.
        complete: also where the garment that it is a level of is neither among the tasks nor in the shot. A farm may
            bake that with another job.
    """
    tasks = list(tasks)
    for shot in dict.fromkeys(task.shot for task in tasks if task.level_of):
        own = {task.garment: task.level_of for task in tasks if task.shot == shot}
        there = {name: record.level_of if record else None for name, record in finished(folder, shot).items()}
        levels = {**there, **own}
        for garment, base in own.items():
            if base:
                _need_level(folder / "shots" / shot, garment, base, levels, complete)


def _need_level(shot: Path, garment: str, base: str, levels: Mapping[str, str | None], complete: bool) -> None:
    """Check one level.

    Args:
        levels: what each garment of the shot is a level of, None for nothing.
    """
    from ssilk_usd.shots.layers_stage import level_name

    where = f"{shot}: --level-of {base}"
    if complete and base not in levels:
        fail(where, f"no garment '{base}' is baked in this shot", ALLOWED, "bake that one first, or name another one")
    if other := levels.get(base):
        fail(where, f"'{base}' is a level of '{other}' itself", ALLOWED, f"name '{other}'")
    for another, of in levels.items():
        if of == garment:
            found, todo = f"'{garment}' has a level itself, '{another}'", "name this garment with --garment-name"
            fail(where, found, ALLOWED, todo)
        name = level_name(garment, base)
        if of == base and another != garment and level_name(another, base) == name:
            found = f"'{garment}' and '{another}' would both be its level '{name}'"
            fail(where, found, "each level has a name of its own", "name this garment otherwise with --garment-name")
