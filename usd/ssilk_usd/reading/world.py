# SPDX-License-Identifier: Apache-2.0
"""Read what surrounds a character in its shot: colliders, gravity and wind.

Gravity is that of UsdPhysics.Scene. The wind is an attribute of that prim, `ssilk:wind`, in the stage's axes and
units of length per second; `ssilk:gusts` is the RMS speed of its turbulence, likewise, `ssilk:gustLength` the size of
its largest eddies and `ssilk:gustSeed` chooses them. All but the last two may be keyed over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdPhysics

from ssilk_core.errors import fail
from ssilk_core.events import Reporter, silent
from ssilk_core.files import split_location
from ssilk_core.scene.assets import UP, Air, Character, Collider, Floats, Motion, ShotWorld

from ..names import GUST_LENGTH, GUST_SEED, GUSTS, WIND
from ..opening.stage import PRIMS, explains_damage, has_value, listed, location, open_stage, stage_name, value
from ..opening.times import change_times
from ..units import StageUnits
from .colliders import CollidingPrims, Wearer, find_colliding, met_prims, read_colliders
from .motion import find_animation

EARTH = 9.81  # [m/s2]
SAME = 1e-6  # of gravity, up to which it is the usual one
EDDIES = 2.0  # [m] of the largest, where a stage says no size


@dataclass(frozen=True)
class AskedWorld:
    """What is asked for in place of what stages say.

    Attributes:
        colliders: prims by path or name, besides those with UsdPhysics.CollisionAPI.
        wind: [m/s], in the axes of the shot's stage.
        gusts: RMS speed of turbulence [m/s], size of its largest eddies [m] and seed.
        gravity: acceleration [m/s2], likewise.
    """

    colliders: tuple[str, ...] = ()
    wind: tuple[float, float, float] | None = None
    gusts: tuple[float, float, int] | None = None
    gravity: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class FoundWorld:
    """What surrounds a character, of which no shape is read yet.

    Attributes:
        stage: that has the colliders, kept open for them.
        met: prims that collide, and when; codes: time codes of the motion's frames in their stage, shape (F,).
        fps: of the motion [1/s].
        gravity, air: as in `ShotWorld`.
        asked: paths of the colliders that were asked for by name.
    """

    stage: Usd.Stage
    met: tuple[tuple[Usd.Prim, NDArray[np.bool_]], ...]
    codes: Floats
    fps: float
    gravity: Floats | None
    air: Air | None
    asked: frozenset[str] = frozenset()

    @property
    def parts(self) -> tuple[str, ...]:
        """What there is, in words; empty where nothing surrounds the character."""
        parts = ("colliders", self.met), ("wind", self.air), ("its gravity", self.gravity is not None)
        return tuple(name for name, there in parts if there)

    def read(self, *, lenient: Reporter | None = None) -> ShotWorld | None:
        """Return it with its shapes; None where nothing surrounds the character.

        Args:
            lenient: is told of colliders that cannot be read, and these are left out.

        Raises:
            SsilkError: a collider cannot be one.
        """
        return _with_shapes(self, lenient) if self.parts else None


@explains_damage
def find_world(
    source: str,
    stage: str,
    character: Character,
    motion: Motion,
    asked: AskedWorld | None = None,
    *,
    garment: str | None = None,
    colliders: bool = True,
    report: Reporter = silent,
) -> FoundWorld:
    """Return what surrounds a character at each frame of its motion.

    Colliders are those of the shot, or of the character's stage where the shot has none; so is the PhysicsScene.

    Args:
        source: of the motion, "file[:/Prim/Path]".
        stage: the character's file.
        garment: path or name of the garment in it that is not marked as one.
        colliders: whether they are looked for, and not gravity and wind alone.

    Raises:
        SsilkError: a named collider is none, several PhysicsScenes say different things, or a value is out of range.
    """
    asked = asked or AskedWorld()
    file, prim = split_location(source)
    prim = prim or split_location(motion.path)[1]  # of a crowd's animations this character's
    shot, home = open_stage(file), open_stage(stage)
    _, placed = find_animation(shot, prim, None)
    stages = [shot] if shot.GetRootLayer() == home.GetRootLayer() else [shot, home]
    seconds = (motion.start + np.arange(motion.frame_count)) / motion.fps
    wearer = Wearer(character, placed, garment)
    there = find_colliding(stages, asked.colliders, wearer) if colliders else CollidingPrims(home)
    codes = seconds * there.stage.GetTimeCodesPerSecond()
    met = met_prims(there.prims, codes, report)
    scene = next((found for found in map(_scene, stages) if found), None)
    units = StageUnits.of(shot)
    if asked.gravity is not None:
        gravity: Floats | None = (units.rotation @ np.array(asked.gravity))[None]
    else:
        gravity = _gravity(scene, seconds) if scene else None
    if gravity is not None and np.abs(gravity + EARTH * UP).max() <= SAME * EARTH:
        gravity = None
    air = _air(scene, seconds, asked, units)
    by_name = frozenset(map(location, there.asked))
    return FoundWorld(there.stage, tuple(met), codes, motion.fps, gravity, air, by_name)


@explains_damage
def read_named(source: str, paths: Sequence[str], seconds: Floats) -> list[Collider]:
    """Return prims of a stage that were found to collide once, at times (F,) of its own [s].

    Raises:
        SsilkError: one is not there any more, or cannot be a collider.
    """
    stage = open_stage(source)
    prims = [stage.GetPrimAtPath(path) for path in paths]
    if gone := [path for path, prim in zip(paths, prims) if not prim]:
        fail(source, f"it has no {', '.join(gone[:3])} any more", "colliders stay where cloth met them")
    codes = seconds * stage.GetTimeCodesPerSecond()
    return read_colliders(met_prims(prims, codes, silent), codes)


@explains_damage
def _with_shapes(found: FoundWorld, lenient: Reporter | None) -> ShotWorld:
    """Return what was found with its shapes."""
    return ShotWorld(found.fps, tuple(read_colliders(found.met, found.codes, lenient)), found.gravity, found.air)


def _scene(stage: Usd.Stage) -> Usd.Prim | None:
    """Return the PhysicsScene of a stage; None without.

    Raises:
        SsilkError: there are several.
    """
    found = [prim for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS) if prim.IsA(UsdPhysics.Scene)]
    if len(found) > 1:
        what = f"{len(found)} PhysicsScenes: {listed(found)}"
        fail(stage_name(stage), what, "a shot has one gravity and one wind", "deactivate the others")
    return found[0] if found else None


def _keyed(prim: Usd.Prim, names: Sequence[str], seconds: Floats) -> list[Usd.TimeCode]:
    """Return the time codes at which attributes are read: those of all frames where one of them changes."""
    attributes = [prim.GetAttribute(name) for name in names if prim.HasAttribute(name)]
    second = prim.GetStage().GetTimeCodesPerSecond()
    varies = len(seconds) > 1 and bool(change_times(attributes))
    return [Usd.TimeCode(float(each * second)) for each in (seconds if varies else seconds[:1])]


def _gravity(prim: Usd.Prim, seconds: Floats) -> Floats:
    """Return the gravity that a PhysicsScene says [m/s2], shape (F or 1, 3)."""
    units, scene = StageUnits.of(prim.GetStage()), UsdPhysics.Scene(prim)
    direction, magnitude = scene.GetGravityDirectionAttr(), scene.GetGravityMagnitudeAttr()
    found = []
    for code in _keyed(prim, (direction.GetName(), magnitude.GetName()), seconds):
        toward, strength = np.array(direction.Get(code) or (0, 0, 0), dtype=float), magnitude.Get(code)
        length = float(np.linalg.norm(toward))
        down = units.rotation @ (toward / length) if length > 0 else -UP
        usual = strength is None or strength < 0  # also minus infinity, the default
        found.append(down * (EARTH if usual else strength * units.meters_per_unit))
    return np.stack(found)


def _air(scene: Usd.Prim | None, seconds: Floats, asked: AskedWorld, units: StageUnits) -> Air | None:
    said = scene if scene and any(has_value(scene, name) for name in (WIND, GUSTS)) else None
    if said is None and asked.wind is None and asked.gusts is None:
        return None
    velocity, gusts, length, seed = np.zeros((1, 3)), np.zeros(1), EDDIES, 0
    if said:
        own = StageUnits.of(said.GetStage())
        codes = _keyed(said, (WIND, GUSTS), seconds)
        velocity = own.points_to_core(_values(said, WIND, codes, (3,)))
        gusts = _values(said, GUSTS, codes, ()) * own.meters_per_unit
        length = float(_values(said, GUST_LENGTH, [Usd.TimeCode.EarliestTime()], ())[0]) * own.meters_per_unit
        length = length if has_value(said, GUST_LENGTH) else EDDIES
        seed = int(value(said, GUST_SEED) or 0)
    if asked.wind is not None:
        velocity = (units.rotation @ np.array(asked.wind))[None]
    if asked.gusts is not None:
        gusts, length, seed = np.array([asked.gusts[0]]), asked.gusts[1], asked.gusts[2]
    return Air(velocity, gusts, length, seed, begins=float(seconds[0]))


def _values(prim: Usd.Prim, name: str, codes: Sequence[Usd.TimeCode], shape: tuple[int, ...]) -> Floats:
    """Return the values of a custom attribute at time codes, zero where it has none; any type may be authored."""
    if not has_value(prim, name):
        return np.zeros((len(codes), *shape))
    found = [prim.GetAttribute(name).Get(code) for code in codes]
    try:
        values = np.array(found, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (len(codes), *shape):
        allowed = "a vector of three numbers is needed" if shape else "a number is needed"
        fail(f"{stage_name(prim.GetStage())}:{prim.GetPath()}", f"{name} is {str(found[0])[:40]}", allowed)
    return values
