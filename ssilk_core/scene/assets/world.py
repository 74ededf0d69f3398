# SPDX-License-Identifier: Apache-2.0
"""What a shot holds besides its character: meshes that cloth meets, air that moves, and gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...files import split_location
from .arrays import Floats, Ints, assign, frozen, need_finite
from .mesh import Mesh

RIGID_TOLERANCE = 1e-4
FASTEST = 100.0  # wind [m/s]
STRONGEST = 1000.0  # gravity [m/s2]


@dataclass(frozen=True, eq=False)
class Collider:
    """A mesh that cloth meets, over the F frames of a motion; an axis of length 1 holds what does not change.

    Attributes:
        path: source, for messages.
        faces: triangles, counter-clockwise from outside, shape (T, 3).
        points: in its own space [m], shape (F or 1, P, 3).
        placements: own space to the world, rigid, shape (F or 1, 4, 4).
        present: whether cloth meets it, shape (F or 1,).

    Raises:
        SsilkError: a shape or an index does not fit, a value is not finite, or a placement is not rigid.
    """

    path: str
    faces: Ints
    points: Floats
    placements: Floats
    present: NDArray

    def __post_init__(self) -> None:
        points, placements = frozen(self.points, np.float64), frozen(self.placements, np.float64)
        present = frozen(self.present, np.bool_)
        if not (points.ndim == 3 and points.shape[-1] == 3 and placements.ndim == 3 and present.ndim == 1):
            found = f"points of shape {points.shape}, placements of shape {placements.shape}"
            fail(self.path, found, "(frames, points, 3) and (frames, 4, 4) are needed")
        need_finite(points, self.path, "frames of points")
        need_finite(placements, self.path, "frames of placements")
        faces = Mesh(self.path, points[0], self.faces).faces
        turns = placements[:, :3, :3]
        if not np.abs(turns @ np.swapaxes(turns, -1, -2) - np.eye(3)).max() < RIGID_TOLERANCE:
            fail(self.path, "a placement that scales or shears", "placements are rigid")
        assign(self, faces=faces, points=points, placements=placements, present=present)

    def is_there(self, fps: float, seconds: float) -> bool:
        """Return whether cloth meets it at a time since the first frame."""
        frame = min(max(int(seconds * fps + 1e-6), 0), len(self.present) - 1)
        return bool(self.present[frame])

    @property
    def name(self) -> str:
        """Its path in its stage, or what else its source is called."""
        return split_location(self.path)[1] or self.path


@dataclass(frozen=True, eq=False)
class Air:
    """Air that moves relative to the world, over the F frames of a motion; an axis of length 1 does not change.

    Attributes:
        velocity: of the wind [m/s], shape (F or 1, 3).
        gusts: RMS speed of the turbulence that the wind carries along [m/s], shape (F or 1,).
        length: size of its largest eddies [m].
        seed: of its eddies.
        begins: time of the first frame [s], so that gusts are the same in whatever range of a shot.

    Raises:
        SsilkError: a value is not finite, a speed negative or above the fastest allowed, or the length not positive.
    """

    velocity: Floats
    gusts: Floats
    length: float = 2.0
    seed: int = 0
    begins: float = 0.0

    def __post_init__(self) -> None:
        velocity, gusts = frozen(self.velocity, np.float64), frozen(self.gusts, np.float64)
        if not (np.isfinite(velocity).all() and np.linalg.norm(velocity, axis=-1).max() <= FASTEST):
            fail("wind", f"{velocity[0].tolist()} m/s", f"finite speeds of at most {FASTEST:g} m/s are allowed")
        if not (np.isfinite(gusts).all() and gusts.min() >= 0 and gusts.max() <= FASTEST):
            fail("gusts", f"{gusts[0]:g} m/s", f"0 to {FASTEST:g} m/s are allowed")
        if not 0 < self.length < np.inf:
            fail("gusts", f"a length of {self.length:g} m", "it must be positive")
        assign(self, velocity=velocity, gusts=gusts)


@dataclass(frozen=True, eq=False)
class ShotWorld:
    """What surrounds a character in a shot; time runs from the first frame of its motion.

    Attributes:
        fps: frames per second of what changes [1/s].
        colliders: that cloth meets besides the body.
        gravity: acceleration [m/s2], shape (F or 1, 3), or None for the usual one.
        air: None for air that moves along with the character's root, as networks are trained with.
    """

    fps: float
    colliders: tuple[Collider, ...] = ()
    gravity: Floats | None = None
    air: Air | None = None

    def __post_init__(self) -> None:
        if self.gravity is not None:
            gravity = frozen(self.gravity, np.float64)
            if not (np.isfinite(gravity).all() and np.linalg.norm(gravity, axis=-1).max() <= STRONGEST):
                fail("gravity", f"{gravity[0].tolist()} m/s2", f"at most {STRONGEST:g} m/s2 are allowed")
            assign(self, gravity=gravity)

    @property
    def is_usual(self) -> bool:
        """Whether nothing differs from the empty space that networks are trained in."""
        return not self.colliders and self.gravity is None and self.air is None

    def between(self, values: np.ndarray, seconds: float) -> np.ndarray:
        """Return values (F or 1, ...) at a time, linear between frames and constant beyond them."""
        return interpolated(values, seconds, self.fps)


def interpolated(values: np.ndarray, seconds: float | Floats, fps: float) -> np.ndarray:
    """Return values (F or 1, ...) of frames at a time, or at times (N,): linear in between, constant beyond."""
    if isinstance(seconds, np.ndarray):
        at = (seconds * fps).clip(0.0, len(values) - 1.0)
        lows = at.astype(int)
        shares = (at - lows).reshape(-1, *[1] * (values.ndim - 1))
        return (1 - shares) * values[lows] + shares * values[np.minimum(lows + 1, len(values) - 1)]
    low, part = frame_at(seconds, fps, len(values))
    return values[low] if part == 0 else (1 - part) * values[low] + part * values[low + 1]


def frame_at(seconds: float, fps: float, count: int) -> tuple[int, float]:
    """Return the frame before a time, of so many, and the share of the way to the next; 0 beyond the ends."""
    at = min(max(seconds * fps, 0.0), count - 1.0)
    low = int(at)
    part = at - low
    return low, part if part >= 1e-9 else 0.0
