# SPDX-License-Identifier: Apache-2.0
"""The shots of a folder of layers: each gathers the garments that were baked for it, whoever baked them, and when."""

from __future__ import annotations

import os
from collections.abc import Collection, Container, Hashable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

from ...errors import fail
from ...events import Message, Reporter, silent
from .names_used import forget_use
from .record import ANIMATION, RECORD, TaskRecord, read_record
from .stated_layers import current_facts

if TYPE_CHECKING:
    from ssilk_usd.shots.layers import Layout

STAGE = "shot.usda"  # of a shot, with all its garments


def write_shot_stage(
    folder: Path,
    shot: str,
    report: Reporter = silent,
    *,
    needed: Container[str] = frozenset(),
    replaced: Collection[str] = (),
    facts: Mapping[str, object] | None = None,
) -> None:
    """Write the stage of a shot from the garments that are on disk now; warn of others that cannot be read, and of
    those that were refined or certified over what is not beneath them any more.

    Args:
        needed: garments that have to be in it.
        replaced: garments whose motion may be another than that of the shot before; others of their characters that
            follow another motion are told.
        facts: what the stage is to say, as `layer_facts` has it; what it says by default. What is not about the
            layers that are there is left out.

    Raises:
        SsilkError: a needed garment cannot be read, the garments have different units or axes, or the file cannot be
            written.
    """
    from ssilk_usd.shots.layers import Layout
    from ssilk_usd.shots.layers_stage import stage_facts, write_stage

    # Several processes may finish at once. Each writes its record, then the stage from all records that it finds, and
    # does so again until it finds what it wrote the stage from. The last to rename its stage therefore sees every
    # record that was there before, and none is lost. A lock would be no safer: flock does not reach across all shared
    # file systems, and the lock file of a process that was killed would stop everybody else. Where a process is
    # killed between the rename and the second look, the next bake of the shot, or the check of a job, puts it right.
    while True:
        found = finished(folder, shot)
        layouts = {Layout(folder, name, shot): wearer for name, wearer in _wearers(found).items()}
        levels = {name: record.level_of for name, record in found.items() if record and record.level_of}
        stage = Layout(folder, "", shot).stage
        told = current_facts(stage_facts(stage) if facts is None else facts, found)
        written = write_stage(layouts, needed, levels, told)
        if not layouts:
            stage.unlink(missing_ok=True)
        if finished(folder, shot) == found:
            break
    for text in written.unreadable.values():
        left = "the shot is without this garment, until it is baked again or taken out with 'ssilk remove'"
        report(Message(f"{text.rstrip('.')}; {left}", "warning"))
    for name in [name for name, record in found.items() if not record and name not in written.unreadable]:
        place = folder / "shots" / shot / name / RECORD
        kept = "the garment stays in the shot, but nothing tells what it was baked from"
        report(Message(f"{place}: it is damaged; {kept}; bake it again with --replace", "warning"))
    for name in [name for name, base in levels.items() if base not in found]:
        text = f"'{name}' is a level of '{levels[name]}', which is not in this shot; bake that one as well"
        report(Message(f"{folder / 'shots' / shot}: {text}", "warning"))
    for name, base in written.bodiless.items():
        text = f"the level '{name}' of '{base}' has no body, as others have; with it the shot shows none"
        report(Message(f"{folder / 'shots' / shot}: {text}; bake it again without --no-body", "warning"))
    if behind := _behind(found, replaced):
        text = f"{', '.join(behind)} follow another motion than {', '.join(replaced)}, with a body of their own"
        todo = "bake them again with this motion and --replace, or take them out with 'ssilk remove'"
        report(Message(f"{folder / 'shots' / shot}: {text}; {todo}", "warning"))
    for text in changed_in(found):
        report(Message(f"{folder / 'shots' / shot}: {text}", "warning"))
    for name, other in written.bodies.items():
        if name in written.uncovered:
            text = f"{shot}/{name}: the body comes with '{other}'; faces that this one covers are not hidden"
            report(Message(text, "warning"))


def _wearers(found: Mapping[str, TaskRecord | None]) -> dict[str, Hashable]:
    """Return who wears each garment of a shot.

    A record that is damaged names no motion. All garments of a shot share one, unless somebody replaced it, so such a
    garment is taken to be of the first character that is known.
    """
    first = next((record.wearer for record in found.values() if record), None)
    return {name: record.wearer if record else first for name, record in found.items()}


def _behind(found: Mapping[str, TaskRecord | None], replaced: Collection[str]) -> list[str]:
    """Return the garments with another motion than a `replaced` one, and with its stage and SkelRoot."""
    ours = [record for name in replaced if (record := found.get(name))]

    def is_behind(other: TaskRecord) -> bool:
        return any(
            other.wearer != one.wearer and other.root == one.root and other.inputs["stage"] == one.inputs["stage"]
            for one in ours
        )

    return [name for name, record in found.items() if name not in replaced and record and is_behind(record)]


def changed_in(found: Mapping[str, TaskRecord | None]) -> Iterator[str]:
    """Yield in words which garments were refined or certified over others than lie beneath them now.

    Args:
        found: records of a shot's garments, by name. What one damaged holds is not known.
    """
    for name, record in found.items():
        for inner, digest in (record.beneath if record else {}).items():
            made = "certified" if record and record.result.certificate else "refined"
            if inner not in found:
                yield f"'{name}' was {made} over '{inner}', which is not in this shot any more; bake it again"
            elif (other := found[inner]) and other.files.get(ANIMATION) != digest:
                yield f"'{name}' was {made} over '{inner}' as that was before; bake it again"


def is_stage(path: Path) -> bool:
    """Return whether a file is the stage of a shot in a folder of layers."""
    return path.name == STAGE and path.is_file() and any(finished(*place_of(path)))


def place_of(stage: Path) -> tuple[Path, str]:
    """Return the folder of layers that the stage of a shot lies in, and the name of the shot."""
    home = stage.absolute().parent
    return home.parent.parent, home.name


def layers_of(stage: Path) -> list[Path]:
    """Return the layers of the garments in the stage of a shot of layers; none for any other file."""
    if not is_stage(stage):
        return []
    return [stage.parent / name / ANIMATION for name, record in finished(*place_of(stage)).items() if record]


def need_no_folder(path: Path, allowed: str) -> None:
    """Raise `SsilkError` for a folder in place of a shot, and name a stage in it if it is one of layers."""
    if path.is_dir():
        stages = sorted(path.glob(f"shots/*/{STAGE}"))
        todo = f"name the stage of a shot, such as {stages[0]}" if stages else ""
        fail(str(path), "a folder, and no shot", allowed, todo)


def finished(folder: Path, shot: str) -> dict[str, TaskRecord | None]:
    """Return the records of the garments that are finished in a shot, by name; None for one that is damaged."""
    home = folder / "shots" / shot
    # Listed, because a client of a network file system may remember for a while that a single file was not there.
    folders = sorted(path for path in home.iterdir() if path.is_dir()) if home.is_dir() else []
    return {path.name: read_record(path) for path in folders if RECORD in os.listdir(path)}


def remove_layers(folder: Path, names: Sequence[str], report: Reporter = silent) -> list[str]:
    """Take garments out of shots: remove their layers, and write the stages of the shots again.

    Assets stay. The name of a garment that is in no shot any more is free for another model.

    Args:
        folder: of the layers.
        names: "shot/garment" each; both may be patterns, such as "*/cape".

    Returns:
        What was taken out, as "shot/garment".

    Raises:
        SsilkError: a name is that of no baked garment, or a file cannot be removed.
    """
    from ssilk_usd.shots.layers import Layout

    baked = sorted(f"{path.parent.parent.name}/{path.parent.name}" for path in _layers(folder))
    chosen: dict[str, Layout] = {}
    for name in names:
        matching = [one for one in baked if _matches(one, name)]
        if not matching:
            fail(f"{folder}", f"no garment is baked as '{name}'", _listed(baked), "name one as SHOT/GARMENT")
        for one in matching:
            shot, _, garment = one.partition("/")
            chosen[one] = Layout(folder, garment, shot)
    homes = [layout.animation.parent for layout in chosen.values()]
    for home in homes:  # without its record a garment is in no stage
        (home / RECORD).unlink(missing_ok=True)
    for shot in sorted({layout.shot for layout in chosen.values()}):
        write_shot_stage(folder, shot, report)
    for layout in chosen.values():  # no stage refers to them any more
        for path in (layout.animation, layout.points):
            path.unlink(missing_ok=True)
    for home in (*homes, *sorted({home.parent for home in homes})):
        if not any(home.iterdir()):
            home.rmdir()
    left = {path.parent.name for path in _layers(folder)}
    for garment in {layout.garment for layout in chosen.values()} - left:
        forget_use(folder, garment)
    return list(chosen)


def _layers(folder: Path) -> list[Path]:
    """Return a file of each baked garment in each shot, finished or not."""
    return [path for name in ("anim.usdc", RECORD) for path in folder.glob(f"shots/*/*/{name}")]


def _matches(name: str, pattern: str) -> bool:
    parts = pattern.split("/")
    return len(parts) == 2 and all(fnmatchcase(part, each) for part, each in zip(name.split("/"), parts))


def _listed(names: Sequence[str]) -> str:
    return f"there are {', '.join(dict.fromkeys(names[:5]))}" if names else "it holds no baked garment"
