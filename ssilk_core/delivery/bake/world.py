# SPDX-License-Identifier: Apache-2.0
"""What surrounds a character in its shot: as its stages say, or as it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import TYPE_CHECKING

from ...errors import fail
from ...events import Reporter, silent
from ...files import split_location
from ...scene.assets import Motion, Scene, ShotWorld

if TYPE_CHECKING:
    from ssilk_usd.reading.world import AskedWorld, FoundWorld

    from ...network.checkpoint import ModelFile

Vector = tuple[float, float, float]

GUSTS = "RMS[,SIZE[,SEED]]"
UNSEEN = "{} does not see {}: it plays without; --refine N or --quality hero solve for it"
STILL = (
    "the network was trained in still air: it knows where wind and gravity pull, but not how cloth swings under more"
)


def asked_world(
    colliders: Sequence[str], wind: str | None, gusts: str | None, gravity: str | None
) -> AskedWorld | None:
    """Return what options ask for; None where they ask for nothing.

    Raises:
        SsilkError: as `parse_world`.
    """
    from ssilk_usd.reading.world import AskedWorld

    if not colliders and wind is gusts is gravity is None:
        return None
    return AskedWorld(tuple(colliders), *parse_world(wind, gusts, gravity))


def parse_world(
    wind: str | None, gusts: str | None, gravity: str | None
) -> tuple[Vector | None, tuple[float, float, int] | None, Vector | None]:
    """Return wind, gusts and gravity as numbers, None where an option is.

    Raises:
        SsilkError: an option is no vector, or gusts are not as `GUSTS`.
    """
    blown, pull = (
        None if text is None else _vector(name, text) for name, text in (("--wind", wind), ("--gravity", gravity))
    )
    return blown, None if gusts is None else _gusts(gusts), pull


def world_of(
    source: str,
    stage: str,
    scene: Scene,
    motion: Motion,
    asked: AskedWorld | None,
    report: Reporter = silent,
    *,
    colliders: bool = True,
) -> ShotWorld | None:
    """Return what surrounds a character at each frame of its motion; None where nothing does."""
    return _found(source, stage, scene, motion, asked, report, colliders=colliders).read(report)


def _found(
    source: str,
    stage: str,
    scene: Scene,
    motion: Motion,
    asked: AskedWorld | None,
    report: Reporter,
    *,
    colliders: bool = True,
) -> FoundWorld:
    """Return what `ssilk_usd.reading.world.find_world` finds around the character of a scene."""
    from ssilk_usd.reading.world import find_world

    garment = split_location(scene.garment.mesh.path)[1]
    return find_world(
        source, stage, scene.character, motion, asked, garment=garment, colliders=colliders, report=report
    )


@dataclass(frozen=True)
class Sight:
    """What is known of the world around a character where its garment plays.

    Attributes:
        who: knows it, in words.
        pull: whether it sees gravity and wind; absolute descriptors name the axes of the world.
        strength: whether it was trained under others than the usual gravity.
        colliders: whether it sees them.
    """

    who: str
    pull: bool
    strength: bool
    colliders: bool

    @classmethod
    def of(cls, file: ModelFile, *, solved: bool = False) -> Sight:
        """Return that of a trained network, or of the solver in its latents, which meets no colliders."""
        blown = file.provenance.get("train", {}).get("wind_fraction", 0) > 0
        who, sees = "the network", file.config.proximity_points > 0
        if solved:
            who, sees = "the solver in latents", False
        return cls(who, file.config.descriptors == "relative", blown, sees)


def unseen(
    source: str,
    stage: str,
    scene: Scene,
    motion: Motion,
    asked: AskedWorld | None,
    report: Reporter,
    *,
    sight: Sight,
    drag: float,
) -> str:
    """Return what a network misses of the world around its character, in words; empty where that is nothing.

    No shape of a collider is read for it.

    Args:
        drag: of the garment's fabric, by which air moves it.
    """
    found = _found(source, stage, scene, motion, asked, report)
    sees = {"colliders": sight.colliders, "wind": sight.pull and drag > 0, "its gravity": sight.pull}
    missed = [part for part in found.parts if not sees.get(part, False)]
    told = [UNSEEN.format(sight.who, " and ".join(missed))] if missed else []
    if not sight.strength and {"wind", "its gravity"} & (set(found.parts) - set(missed)):
        told.append(STILL)
    return "; ".join(told)


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def _vector(option: str, text: str) -> Vector:
    numbers = _numbers(text)
    if len(numbers) != 3 or not all(map(isfinite, numbers)):
        fail(option, f"'{text}'", "X,Y,Z is needed, such as 0,0,5 or -5,0,0")
    x, y, z = numbers
    return x, y, z


def _gusts(text: str) -> tuple[float, float, int]:
    numbers = _numbers(text)
    speed, size, seed = (numbers + [0.0, 2.0, 0.0][len(numbers) :])[:3]
    if not 1 <= len(numbers) <= 3 or not (speed >= 0 and 0 < size < inf and seed in range(2**32)):
        allowed = f"{GUSTS} is needed: m/s, metres and a whole number, such as 3 or 3,1.5,7"
        fail("--gusts", f"'{text}'", allowed)
    return speed, size, int(seed)
