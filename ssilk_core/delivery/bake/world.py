# SPDX-License-Identifier: Apache-2.0
"""What surrounds a character in its shot: as its stages say, or as it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from math import inf, isfinite
from typing import TYPE_CHECKING

from ...errors import fail
from ...events import Event, Message, Reporter
from ...files import split_location
from ...scene.assets import Collider, Motion, Scene, ShotWorld

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


class ShotSurroundings:
    """What surrounds the character of a garment in its shot, found and read where it is first asked for.

    Args:
        source: of the motion, "file[:/Prim/Path]".
        stage: the character's file.
        motion: at whose frames the character is surrounded.
        asked: what is asked for in place of what stages say.
    """

    def __init__(self, source: str, stage: str, scene: Scene, motion: Motion, asked: AskedWorld | None) -> None:
        self.source, self.motion = source, motion
        self._stage, self._scene, self._asked = stage, scene, asked
        self._events: list[Event] = []
        self._told: set[str] = set()

    def over(self, motion: Motion) -> ShotSurroundings:
        """Return the same at the frames of another motion of the shot; what was told once is not told again."""
        other = ShotSurroundings(self.source, self._stage, self._scene, motion, self._asked)
        other._told = self._told
        return other

    @cached_property
    def found(self) -> FoundWorld:
        """What there is, of which no shape is read.

        Raises:
            SsilkError: as `ssilk_usd.reading.world.find_world`.
        """
        from ssilk_usd.reading.world import find_world

        garment = split_location(self._scene.garment.mesh.path)[1]
        return find_world(
            self.source,
            self._stage,
            self._scene.character,
            self.motion,
            self._asked,
            garment=garment,
            report=self._keep,
        )

    def read(self, report: Reporter) -> ShotWorld | None:
        """Return what a solver meets, and report it; None where nothing surrounds the character.

        Raises:
            SsilkError: as `found`, or a collider cannot be one.
        """
        world = self._without_own_shapes(self.found.read())
        if world and world.colliders:
            self._events.append(Message(f"{_file_of(world.colliders)}: cloth meets {listed(world.colliders)}"))
        self.tell(report)
        return world

    @cached_property
    def seen(self) -> ShotWorld | None:
        """What can be met, without colliders that cannot be read; None where nothing surrounds the character.

        Raises:
            SsilkError: as `found`.
        """
        return self._without_own_shapes(self.found.read(lenient=self._keep))

    @property
    def colliders(self) -> tuple[Collider, ...]:
        """Those of `seen`."""
        return self.seen.colliders if self.seen else ()

    @property
    def pull(self) -> ShotWorld:
        """Gravity and wind alone, for which no shape is read."""
        return ShotWorld(self.found.fps, (), self.found.gravity, self.found.air)

    def _keep(self, event: Event) -> None:
        self._events.append(event)

    def tell(self, report: Reporter) -> None:
        """Report what was found out so far, each thing once."""
        for event in self._events:
            if str(event) not in self._told:
                self._told.add(str(event))
                report(event)
        self._events.clear()

    def _without_own_shapes(self, world: ShotWorld | None) -> ShotWorld | None:
        """Return a world without the shapes that stand for the character's own body, unless they were asked for."""
        if world is None or not (world.colliders and self._scene.character.bodies) or find_spec("igl") is None:
            return world  # networks that see none are baked without libigl, too
        from ...physics.world.own_shapes import OwnShapes

        shapes, asked = OwnShapes.of(self._scene, self.motion), self.found.asked
        own = [each for each in world.colliders if each.path not in asked and shapes.has(each)]
        if not own:
            return world
        why = "inside the character's body in each frame, as shapes of its own physics are"
        text = f"cloth does not meet {listed(own)}, {why}; --collider names what it shall meet nevertheless"
        self._events.append(Message(f"{_file_of(own)}: {text}"))
        return replace(world, colliders=tuple(each for each in world.colliders if each not in own))


def listed(colliders: Sequence[Collider]) -> str:
    """Return the paths of colliders in their stage, the first few of many."""
    paths = [each.name for each in colliders]
    return f"{', '.join(paths[:4])}{f' and {len(paths) - 4} more' if len(paths) > 4 else ''}"


def _file_of(colliders: Sequence[Collider]) -> str:
    return split_location(colliders[0].path)[0]


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


def tell_surrounded(around: ShotSurroundings, sight: Sight | None, drag: float, report: Reporter) -> None:
    """Report what a network sees of the colliders around its character, and warn of what it misses.

    Colliders that cannot be read are told in any case: they are not counted either.

    Args:
        sight: None of linear blend skinning, of which nobody expects to see anything.
        drag: of the garment's fabric, by which air moves it.
    """
    world = around.seen
    around.tell(report)
    if world is None or sight is None:
        return
    there = {"colliders": bool(world.colliders), "wind": bool(world.air), "its gravity": world.gravity is not None}
    sees = {"colliders": sight.colliders, "wind": sight.pull and drag > 0, "its gravity": sight.pull}
    parts = [part for part, is_there in there.items() if is_there]
    missed = [part for part in parts if not sees[part]]
    if world.colliders and sight.colliders:
        report(Message(f"{around.source}: the network sees {listed(world.colliders)}"))
    told = [UNSEEN.format(sight.who, " and ".join(missed))] if missed else []
    if not sight.strength and {"wind", "its gravity"} & (set(parts) - set(missed)):
        told.append(STILL)
    if told:
        report(Message(f"{around.source}: {'; '.join(told)}", "warning"))


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
