# SPDX-License-Identifier: Apache-2.0
"""Evaluations on several bodies of a family: their motions, and the body that fares worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...scene.assets import Skeleton
from ...training.verdict import percent, share_below
from .figures import ResultRow

if TYPE_CHECKING:
    from ...network.checkpoint import ModelFile

LBS, SIMULATOR = "LBS", "simulator"


def base_of(file: ModelFile, body: Sequence[float] | None) -> tuple[Skeleton, float] | None:
    """Return what plays motions of a family's base on another body of it (`scene.family.motion_on`), as in training:
    the base's skeleton, and the body's ratio of heights. None for a model of one body, and for the base.

    Args:
        file: the model for the family.
        body: which of the family it lies on (`bodies.WornModel.member`).
    """
    if not (file.bodies and body):
        return None
    bodies = file.bodies.family.bodies
    return file.scene.character.skeleton, bodies.height_ratio(np.array(body[: bodies.size]))


@dataclass(frozen=True)
class WorstBody:
    """The body on which a method wins least over linear blend skinning.

    Attributes:
        garment, method, split: of the rows that were compared.
        body: its name.
        total, lbs: energies there [J].
    """

    garment: str
    method: str
    split: str
    body: str
    total: float
    lbs: float

    @property
    def place(self) -> str:
        """What was compared, in words."""
        return f"{self.garment}, {self.method}, {self.split}"

    @property
    def words(self) -> str:
        """How it fares, in words."""
        share = share_below(self.total, self.lbs)
        side = "below" if share >= 0 else "above"
        return f"{self.body}, {self.total:.4g} J, {percent(share)} {side} linear blend skinning"


def worst_bodies(rows: Sequence[ResultRow]) -> list[WorstBody]:
    """Return the worst body of each garment, method and split; none where rows are of one body.

    Args:
        rows: in which linear blend skinning comes before the methods that it is compared with: garments of one name
            may be of several rest shapes.
    """
    lbs = dict[tuple[str, str], float]()
    found: dict[tuple[str, str, str], WorstBody] = {}
    for row in rows:
        if row.method == LBS:
            lbs[row.garment, row.split] = row.figures.total
        body, _, garment = row.garment.rpartition("/")
        if not body or row.method in (LBS, SIMULATOR):
            continue
        key = (garment, row.method, row.split)
        one = WorstBody(*key, body, row.figures.total, lbs[row.garment, row.split])
        worst = found.get(key)
        if worst is None or share_below(one.total, one.lbs) < share_below(worst.total, worst.lbs):
            found[key] = one
    return list(found.values())
