# SPDX-License-Identifier: Apache-2.0
"""As many blendshapes as a tolerance needs for offsets that change over the frames of a shot.

Principal components [Eckart, Young 1936] bring the RMS within its bound: of all vertices together, or where a long
shot makes that pay, of a few regions, each as often as it moves. What then leaves the bound of
single vertices lies in few places, so shapes of these places alone bring it back at little cost. Weights lie in
[0, 1], because importers clamp them: each weight runs over the range of its component, and one shape of constant
weight holds where the ranges begin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..assets import Floats, Ints

BASIS_FRAMES = 512  # that components are found from, at most; their Gram matrix takes 2 MB
FIRST_SHARE = 1.25  # of the tolerance that is left to local shapes, which lower the RMS too
SHARE = 0.97  # of the tolerance that components use; the rest is for what is left out of shapes as too small
# Of the RMS tolerance: the most by which R shapes may move a vertex and leave it out, times the square root of R.
NEGLIGIBLE = 0.3
TIGHTER = 0.7  # of the RMS at hand: the next bound where local shapes are too many
NEAR = 0.8  # of the largest distance: vertices that come so near to it are in a local shape
PAYS = 0.8  # of the bytes of shapes of all vertices: shapes of regions have to take less, because they have borders
OVERHEAD = 300  # bytes of a blendshape's prim
MAX_LOCAL = 64  # local shapes after which components are cheaper
MAX_LOCAL_OFFSETS = 2_000_000  # vertices times frames that a local search holds, 24 MB
POWER_STEPS = 30
ROUNDING = 1e-9  # [m] below which offsets are rounding


@dataclass(frozen=True)
class FitTolerance:
    """How far joints and blendshapes may be from the vertices that they stand for.

    Attributes:
        rms: RMS distance over all vertices and frames [m].
        largest: distance of any vertex in any frame [m].
    """

    rms: float = 1e-3
    largest: float = 5e-3


@dataclass(eq=False)
class OffsetShapes:
    """Blendshapes that are being found, and what they leave of the offsets.

    Attributes:
        left: offsets that no shape reproduces yet [m], shape (F, V, 3), float32; reduced in place.
        tolerance: to be met in the rest pose.
        regions: parts of the vertices, which get shapes of their own where these take far fewer bytes.
        shapes: offsets [m], shape (V, 3) each, float32.
        weights: in [0, 1], shape (F,) each, float32.
        constant: where the ranges of the weights begin [m], shape (V, 3).
    """

    left: Floats
    tolerance: FitTolerance
    regions: Sequence[Ints]
    shapes: list[Floats] = field(default_factory=list)
    weights: list[Floats] = field(default_factory=list)
    constant: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.constant = np.zeros(self.left.shape[1:])

    def find(self) -> None:
        """Add shapes until what is left is within the tolerance."""
        if self._rms() > self.tolerance.rms:
            self._add_components(FIRST_SHARE * self.tolerance.rms)
            self._add_local()  # which may bring the RMS down as well
        while not self._is_done():
            rms = self._rms()
            if rms > self.tolerance.rms:
                self._add_components(SHARE * self.tolerance.rms)
            elif not self._add_local():
                self._add_components(TIGHTER * rms)

    def all_shapes(self) -> tuple[Floats, Floats]:
        """Return shapes (K, V, 3) and weights (F, K), where any is needed; the last has a constant weight of one."""
        frames, vertices = self.left.shape[:2]
        if not self.shapes and not self.constant.any():
            return np.zeros((0, vertices, 3), np.float32), np.zeros((frames, 0), np.float32)
        shapes = np.stack([*self.shapes, self.constant.astype(np.float32)])
        return shapes, np.stack([*self.weights, np.ones(frames, np.float32)], axis=1)

    def _is_done(self) -> bool:
        return self._rms() <= self.tolerance.rms and bool((self._largest(0) <= self.tolerance.largest).all())

    def _rms(self) -> float:
        flat = self.left.reshape(len(self.left), -1)
        squares = sum(float(np.dot(row, row)) for row in flat)
        return float(np.sqrt(squares / (flat.size / 3)))

    def _largest(self, axis: int) -> Floats:
        """Return the largest distance of each vertex (axis 0) or frame (axis 1) [m]."""
        found = [np.einsum("vc,vc->v", frame, frame) for frame in self.left]
        reduce = np.maximum.reduce(found) if axis == 0 else np.array([row.max() for row in found])
        return np.sqrt(reduce)

    def _add_components(self, rms: float) -> None:
        """Add principal components until the RMS of the frames that they are found from is at most `rms` [m]."""
        negligible = 0.0 if self.shapes else NEGLIGIBLE * self.tolerance.rms
        chosen = self._basis_frames()
        sample = self.left[chosen].astype(np.float64)
        mean = sample.mean(axis=0)
        sample -= mean
        self.constant += mean
        self.left -= mean.astype(np.float32)
        whole = regional_components(sample, [np.arange(len(self.constant))], rms)
        parts = regional_components(sample, self.regions, rms)
        pays = _bytes(parts, len(self.left)) < PAYS * _bytes(whole, len(self.left))
        found = parts if pays else whole
        each = (len(self.regions) / len(found)) ** 0.5 if pays else len(found) ** -0.5
        for rows, component in found:
            self._add(component, rows, negligible * min(each, 1.0))

    def _basis_frames(self) -> Ints:
        """Return all frames; of many, as many evenly spread ones, and later those that are furthest off."""
        if len(self.left) <= BASIS_FRAMES or not self.shapes:
            return evenly(len(self.left), BASIS_FRAMES)
        return np.sort(np.argsort(-self._largest(1), kind="stable")[:BASIS_FRAMES])

    def _add(self, component: Floats, rows: Ints | None, negligible: float) -> None:
        """Add a shape (R, 3) of some or all vertices, weighted in each frame by least squares.

        Vertices that it moves by no more than `negligible` [m] are left out.
        """
        some = self.left if rows is None else self.left[:, rows]
        direction = (component / (component**2).sum()).reshape(-1).astype(np.float32)
        weights = (some.reshape(len(some), -1) @ direction).astype(np.float64)
        low, high = float(weights.min()), float(weights.max())
        stored = ((high - low) * component).astype(np.float32)
        kept = np.linalg.norm(stored, axis=1) > negligible
        if not kept.any():  # as where all frames are the same
            return
        rows, stored = (np.arange(len(kept)) if rows is None else rows)[kept], stored[kept]
        share = ((weights - low) / (high - low)).clip(0, 1).astype(np.float32)
        offset = low / (high - low)
        shape = np.zeros(self.constant.shape, np.float32)
        shape[rows] = stored
        self.shapes.append(shape)
        self.weights.append(share)
        self.constant[rows] += offset * stored
        for frame, weight in zip(self.left, share):
            frame[rows] -= np.float32(weight + offset) * stored

    def _add_local(self) -> bool:
        """Add shapes of the places that are too far off; return whether that was enough."""
        for _ in range(MAX_LOCAL):
            largest = self._largest(0)
            if not (largest > self.tolerance.largest).any():
                return True
            rows = np.flatnonzero(largest > NEAR * self.tolerance.largest)
            if len(rows) * len(self.left) > MAX_LOCAL_OFFSETS:
                return False
            self._add(local_component(self.left[:, rows], self.tolerance.largest), rows, 0.0)
        return False


def evenly(count: int, most: int) -> Ints:
    """Return all of `count` frames, or the most of them that are allowed, evenly spread."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def components(sample: Floats, tolerance: float, vertices: int) -> Sequence[Floats]:
    """Return as many principal components of centred offsets (N, 3 V) as leave an RMS within the tolerance [m].

    At least one, unless there is nothing; shape (3 V,) each, of unit length.
    """
    values, turn = np.linalg.eigh(sample @ sample.T)
    values, turn = values[::-1].clip(min=0), turn[:, ::-1]
    left = np.sqrt((values.sum() - np.cumsum(values)).clip(min=0) / (len(sample) * vertices))
    count = min(int(np.count_nonzero(left > tolerance)) + 1, int(np.count_nonzero(values > ROUNDING**2)))
    return [turn[:, index] @ sample / np.sqrt(values[index]) for index in range(count)]


def _bytes(found: Sequence[tuple[Ints, Floats]], frames: int) -> int:
    """Return what shapes of these components take."""
    return sum(_bytes_of(len(rows), frames) for rows, _ in found)


def _bytes_of(vertices: int, frames: int) -> int:
    return 12 * vertices + 4 * frames + OVERHEAD


def regional_components(sample: Floats, regions: Sequence[Ints], tolerance: float) -> list[tuple[Ints, Floats]]:
    """Return the principal components of regions that reduce the error of centred offsets (N, V, 3) most per byte.

    As many as leave an RMS within the tolerance [m], at least one unless there is nothing; the vertices of each, and
    its offsets of unit length, shape (R, 3).
    """
    squares = float((sample**2).sum())
    bound, offered = tolerance**2 * sample.shape[0] * sample.shape[1], []
    for number, rows in enumerate(regions):
        flat = sample[:, rows].reshape(len(sample), -1)
        values, turn = np.linalg.eigh(flat @ flat.T)
        cost = _bytes_of(len(rows), len(sample))
        for rank in range(1, 1 + int(np.count_nonzero(values > ROUNDING**2))):
            offered.append((values[-rank] / cost, number, float(values[-rank]), turn[:, -rank]))
    found: list[tuple[Ints, Floats]] = []
    for _, number, value, direction in sorted(offered, key=lambda each: -each[0]):
        if found and squares <= bound:
            break
        rows = regions[number]
        flat = sample[:, rows].reshape(len(sample), -1)
        found.append((rows, (direction @ flat / np.sqrt(value)).reshape(-1, 3)))
        squares -= value
    return found


def regions_of(points: Floats, count: int) -> list[Ints]:
    """Divide points (V, 3) among as many that are far apart, each to the nearest."""
    seeds = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(points - points[seeds[0]], axis=1)
    label = np.zeros(len(points), dtype=int)
    while len(seeds) < count and nearest.max() > 0:
        seeds.append(int(nearest.argmax()))
        away = np.linalg.norm(points - points[seeds[-1]], axis=1)
        label[away < nearest] = len(seeds) - 1
        nearest = np.minimum(nearest, away)
    return [np.flatnonzero(label == number) for number in range(len(seeds))]


def local_component(left: Floats, largest: float) -> Floats:
    """Return the component that matters most to the vertices and frames that are furthest off, shape (R, 3).

    The first singular vector of the offsets (F, R, 3), weighted by the largest distance of each vertex and frame, by
    power iteration from the worst frame.
    """
    distance = np.linalg.norm(left, axis=2)
    vertices = np.repeat(distance.max(axis=0) / largest, 3)
    frames = (distance.max(axis=1) / largest).clip(min=0.1)
    weighted = left.reshape(len(left), -1) * vertices * frames[:, None]
    vector = weighted[np.argmax(distance.max(axis=1))].astype(np.float64)
    for _ in range(POWER_STEPS):
        vector /= np.linalg.norm(vector)
        vector = (weighted @ vector) @ weighted
    return (vector / np.linalg.norm(vector) / vertices).reshape(-1, 3)
