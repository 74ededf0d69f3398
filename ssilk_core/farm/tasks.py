# SPDX-License-Identifier: Apache-2.0
"""Tasks: one garment in one shot each, named so that no two write the same file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import fail


@dataclass(frozen=True, kw_only=True)
class BakeTask:
    """One garment in one shot.

    Attributes:
        garment: name of its prim and its folder.
        shot: name of its folder.
        model, stage, motion: the inputs; `motion` is "file[:/Prim/Path]".
        root: SkelRoot of the character, where the stage has several.
        fps: frames per second, or None for the motion's.
        samples: in each frame.
        pre_roll: how long the garment settles before the first frame [s].
        target: who receives it (see `ssilk_core.targets`).
        lbs: linear blend skinning instead of the network.
        body: write the character's body meshes as well.
        points: write a point cache as well.
        refine: iterations of the solver in each frame.
        feedback: refined frames look back on refined ones.
        refined: "points" or "joints", what refined frames become.
        verify: re-skin the written file and compare it.
        device: where the network runs.
    """

    garment: str
    shot: str
    model: str
    stage: str
    motion: str
    root: str | None = None
    fps: float | None = None
    samples: int = 1
    pre_roll: float = 0.0
    target: str = "usd"
    lbs: bool = False
    body: bool = True
    points: bool = False
    refine: int = 0
    feedback: bool = False
    refined: str = "points"
    verify: bool = True
    device: str = "cpu"

    @property
    def name(self) -> str:
        return f"{self.shot}/{self.garment}"


def plan(models: Sequence[tuple[str, str | None]], motions: Sequence[str], like: BakeTask) -> list[BakeTask]:
    """Return a task for each model over each motion, the tasks of a model together.

    Args:
        models: files, each with the SkelRoot of its character or None.
        motions: "file[:/Prim/Path]" each.
        like: a task with all that they share.

    Raises:
        SsilkError: two models or two motions would have one name.
    """
    garments = [identifier(f"{_leaf(root)}_{_stem(model)}" if root else _stem(model)) for model, root in models]
    shots = [re.sub(r"[^\w-]", "_", _stem(motion), flags=re.ASCII) for motion in motions]
    _need_unique(garments, "MODEL", "garments")
    _need_unique(shots, "--motion", "shots")
    tasks, dressed = [], set()
    for garment, (model, root) in zip(garments, models):
        body = like.body and root not in dressed  # a character wears its body once
        dressed.add(root)
        for shot, motion in zip(shots, motions):
            named = {"garment": garment, "shot": shot, "model": model, "root": root, "motion": motion, "body": body}
            tasks.append(BakeTask(**{**vars(like), **named}))
    return tasks


def identifier(text: str) -> str:
    """Return text as the name of a prim, and of a folder."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"\W", "_", text, flags=re.ASCII))


def _stem(location: str) -> str:
    file, _, prim = location.partition(":/")
    return Path(file).stem + (f"_{_leaf(prim)}" if prim else "")


def _leaf(path: str) -> str:
    return path.rstrip("/").rpartition("/")[2]


def _need_unique(names: Sequence[str], where: str, what: str) -> None:
    name, times = Counter(names).most_common(1)[0]
    if times != 1:
        fail(
            where,
            f"{times} {what} are named '{name}'",
            "files and folders are named by them",
            "rename one of the files",
        )
