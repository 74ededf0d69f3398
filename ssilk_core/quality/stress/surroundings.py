# SPDX-License-Identifier: Apache-2.0
"""Winds, gravity and props around a character: what its network feels of them, and whether cloth heeds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...network.runtime.garment import NumpyGarment
from ...network.runtime.sight import seen_proximity
from ...physics.world.felt import felt_gravity
from ...scene.assets import LOOSE, Air, Collider, Floats, Motion, Scene, ShotWorld
from ...scene.kinematics import hub_places
from .drives import ProceduralMotion
from .outcome import DoesNotApply
from .subject import StressSubject
from .worlds import garment_size

WINDWARD = np.array([1.0, 0.0, 0.0])
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
PERIOD, LAST = 4.0, 0.5  # [s] after which a prop comes again, and before that in which cloth has forgotten it
INSIDE = 5e-3  # [m]

Wind = Callable[[Floats], Floats]  # times [s] (N,) to velocities [m/s] (N, 3)


def steady(speed: float) -> Wind:
    """Return an even wind [m/s]."""
    return lambda times: np.tile(speed * WINDWARD, (len(times), 1))


def switched(speed: float) -> Wind:
    """Return a wind [m/s] that begins or ends within one frame, each second."""
    return lambda times: np.outer(times % 2.0 >= 1.0, speed * WINDWARD)


def windy(motion: Motion, wind: Wind, gusts: float) -> ShotWorld:
    """Return a wind with gusts [m/s] over a motion.

    Raises:
        SsilkError: it is faster than any wind may be.
    """
    times = np.arange(motion.frame_count) / motion.fps
    return ShotWorld(motion.fps, air=Air(wind(times), np.array([gusts])))


def surrounded(subject: StressSubject, drive: ProceduralMotion, world: ShotWorld) -> ProceduralMotion:
    """Return a motion with what the network feels and sees of a world.

    Raises:
        DoesNotApply: it knows nothing of that.
    """
    config, motion = subject.file.config, drive.motion()
    if world.colliders and not config.proximity_points:
        raise DoesNotApply("the network sees no colliders")
    if not world.colliders and config.descriptors != "relative":
        raise DoesNotApply("the network feels no wind or gravity but the usual")
    if world.air and not subject.fabric.drag:
        raise DoesNotApply("the fabric has no drag, by which wind moves cloth")
    gravity = felt_gravity(world, motion, subject.scene, subject.fabric)
    proximity = seen_proximity(world, motion, NumpyGarment(subject.file))
    felt = {"gravity": gravity, "proximity": proximity}
    return replace(drive, felt={name: values for name, values in felt.items() if values is not None})


@dataclass(frozen=True, eq=False)
class Prop:
    """A box along the axes of the world.

    Attributes:
        roots: where the root of the character is in each frame [m], shape (F, 3).
        places: of its middle relative to that [m], shape (F, 3).
        half: its half extents [m], shape (3,).
        present: whether cloth meets it, shape (F,).
    """

    roots: Floats
    places: Floats
    half: Floats
    present: NDArray[np.bool_]

    def world(self, fps: float) -> ShotWorld:
        """Return a world that holds it alone."""
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * self.half
        faces = np.array([half for a, b, c, d in QUADS for half in ((a, b, c), (a, c, d))])
        placements = np.tile(np.eye(4), (len(self.places), 1, 1))
        placements[:, :3, 3] = self.roots + self.places
        return ShotWorld(fps, (Collider("a box", faces, corners[None], placements, self.present),))

    def share_inside(self, points: Floats) -> float:
        """Return the mean share of points relative to the root (F, V, 3) that are inside while it is there."""
        depth = (self.half - np.abs(points - self.places[:, None])).min(axis=2)
        return float((depth > INSIDE)[self.present].mean()) if self.present.any() else 0.0


PropOver = Callable[[Scene, Motion, Floats], Prop]


def passing(speed: float) -> PropOver:
    """Return what makes a prop that passes through the body at a speed [m/s], once in a `PERIOD`."""

    def over(scene: Scene, motion: Motion, cloth: Floats) -> Prop:
        times, every = _course(motion)
        places = np.outer(speed * (times % every - every / 2), WINDWARD)
        half = garment_size(scene) * np.array([0.1, 0.5, 0.3])
        return Prop(roots(scene, motion), places, half, np.ones(len(times), dtype=bool))

    return over


def appearing(scene: Scene, motion: Motion, cloth: Floats) -> Prop:
    """Return a prop that appears in one frame about the lowest loose cloth, where that is then, in the second quarter
    of each `PERIOD`; it goes along with the body, and is gone in one frame."""
    times, every = _course(motion)
    rows, points = np.flatnonzero(scene.classes == LOOSE), scene.garment.mesh.points
    if not len(rows):
        raise DoesNotApply("no cloth is loose")
    lowest = cloth[:, rows[points[rows, 1].argsort()[: max(1, len(rows) // 10)]]].mean(axis=1)
    quarter, then = times % every // (every / 4), times // every * every + every / 4
    began = np.searchsorted(times, then).clip(max=len(times) - 1)
    return Prop(roots(scene, motion), lowest[began], np.full(3, 0.15 * garment_size(scene)), quarter == 1)


def _course(motion: Motion) -> tuple[Floats, float]:
    """Return the times of frames (F,) and a period [s], which is that of a short motion."""
    return np.arange(motion.frame_count) / motion.fps, min(PERIOD, motion.frame_count / motion.fps)


def roots(scene: Scene, motion: Motion) -> Floats:
    """Return where the root of a character is in each frame [m], shape (F, 3)."""
    return hub_places(scene.character.skeleton, motion.rotations, motion.translations)
