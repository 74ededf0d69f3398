# SPDX-License-Identifier: Apache-2.0
"""As many blendshapes as a tolerance needs for offsets that change over the frames of a shot.

Principal components [Eckart, Young 1936], without the vertices to which they matter least, bring the RMS within its
bound. What then leaves the bound of single vertices lies in few places, so shapes of these places alone bring it back
at little cost. Weights lie in [0, 1], because importers clamp them: each weight runs over the range of its component,
and one shape of constant weight holds where the ranges begin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..assets import Floats, Ints

BASIS_FRAMES = 512  # that components are found from, at most; their Gram matrix takes 2 MB
SHARE = 0.97  # of the RMS tolerance: the bound of components that are added later, which few frames are found from
TIGHTER = 0.7  # of the RMS at hand: the next bound where local shapes are too many
NEAR = 0.8  # of the largest distance: vertices that come so near to it are in a local shape
VERTEX, WEIGHT, SHAPE = 12, 4, 300  # bytes of a vertex of a blendshape, of its weight in a frame, and of its prim
MAX_LOCAL = 64  # local shapes after which components are cheaper
MAX_LOCAL_OFFSETS = 2_000_000  # vertices times frames that a local search holds, 24 MB
POWER_STEPS = 30
ROUNDING = 1e-7  # [m] below which offsets are rounding


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
        shapes: offsets [m], shape (V, 3) each, float32.
        weights: in [0, 1], shape (F,) each, float32.
        constant: where the ranges of the weights begin [m], shape (V, 3).
    """

    left: Floats
    tolerance: FitTolerance
    shapes: list[Floats] = field(default_factory=list)
    weights: list[Floats] = field(default_factory=list)
    constant: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.constant = np.zeros(self.left.shape[1:])

    def find(self) -> None:
        """Add shapes until what is left is within the tolerance, or is rounding, of which no shape is made."""
        if self._rms() > self.tolerance.rms:
            chosen = evenly(len(self.left), BASIS_FRAMES)
            self._take_mean(chosen)
            self._add_components(self.tolerance.rms, chosen)
        count = -1
        while not self._is_done() and len(self.shapes) > count:
            rms, count = self._rms(), len(self.shapes)
            if rms > self.tolerance.rms:
                squares = np.array([np.dot(row, row) for row in self.left.reshape(len(self.left), -1)])
                self._add_components(SHARE * self.tolerance.rms, self._worst_frames(squares))
            elif not self._add_local():
                self._add_components(TIGHTER * rms, self._worst_frames(self._largest(1)))

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

    def _take_mean(self, chosen: Ints) -> None:
        """Put the mean of some frames into the shape of constant weight."""
        mean = self.left[chosen].mean(axis=0, dtype=np.float64)
        self.constant += mean
        self.left -= mean.astype(np.float32)

    def _add_components(self, rms: float, chosen: Ints) -> None:
        """Add principal components of some frames until the RMS of these is at most `rms` [m]."""
        found = sparse_components(self.left[chosen].astype(np.float64), rms, len(self.left))
        flat = found.reshape(len(found), self.constant.size)  # of no component where all frames are the same
        products = self.left.reshape(len(self.left), -1) @ flat.T.astype(np.float32)
        weights = np.linalg.lstsq(flat @ flat.T, products.T.astype(np.float64), rcond=None)[0]
        for component, each in zip(found, weights):
            self._add(component, each)

    def _worst_frames(self, error: Floats) -> Ints:
        """Return the frames with the largest error (F,), as many as components are found from."""
        return np.sort(np.argsort(-error, kind="stable")[:BASIS_FRAMES])

    def _add(self, component: Floats, weights: Floats) -> None:
        """Add a component [m], shape (V, 3), that has a weight in each frame, shape (F,)."""
        low, high = float(weights.min()), float(weights.max())
        stored = ((high - low) * component).astype(np.float32)
        rows = np.flatnonzero(stored.any(axis=1))
        if not len(rows):  # as where all frames are the same
            return
        share = ((weights - low) / (high - low)).clip(0, 1).astype(np.float32)
        offset = low / (high - low)
        self.shapes.append(stored)
        self.weights.append(share)
        self.constant[rows] += offset * stored[rows]
        for frame, weight in zip(self.left, share):
            frame[rows] -= np.float32(weight + offset) * stored[rows]

    def _add_local(self) -> bool:
        """Add shapes of the places that are too far off; return whether that was enough."""
        for _ in range(MAX_LOCAL):
            largest = self._largest(0)
            if not (largest > self.tolerance.largest).any():
                return True
            rows = np.flatnonzero(largest > NEAR * self.tolerance.largest)
            if len(rows) * len(self.left) > MAX_LOCAL_OFFSETS:
                return False
            some = self.left[:, rows]
            component = np.zeros(self.constant.shape)
            component[rows] = local = local_component(some, self.tolerance.largest)
            self._add(component, np.einsum("fvc,vc->f", some, local) / (local**2).sum())
        return False


def evenly(count: int, most: int) -> Ints:
    """Return all of `count` frames, or the most of them that are allowed, evenly spread."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def components(sample: Floats, tolerance: float, vertices: int) -> Sequence[Floats]:
    """Return as many principal components of offsets (N, 3 V) as leave an RMS within the tolerance [m].

    At least one, unless there is nothing; shape (3 V,) each, of unit length.
    """
    values, turn = _principal(sample)
    count = _needed(values, len(sample) * vertices * tolerance**2)
    return [turn[:, index] @ sample / np.sqrt(values[index]) for index in range(count)]


def _principal(sample: Floats) -> tuple[Floats, Floats]:
    """Return squared lengths of principal components of rows (N, D), largest first, and their weights (N, K)."""
    values, turn = np.linalg.eigh(sample @ sample.T)
    count = int(np.count_nonzero(values > ROUNDING**2 * sample.size))
    return values[::-1][:count], turn[:, ::-1][:, :count]


def _needed(values: Floats, squares: float) -> int:
    """Return how many components leave at most this sum of squares; all if none do."""
    left = values.sum() - np.cumsum(values)
    return min(int(np.count_nonzero(left > squares)) + 1, len(values))


def sparse_components(sample: Floats, rms: float, frames: int) -> Floats:
    """Return principal components of offsets (N, V, 3), each without some vertices, shape (K, V, 3).

    The squared error of what components leave out adds up, because their weights are orthogonal. So the vertices that
    add least are left out until the RMS reaches its bound [m]. More components than that needs let more vertices be
    left out of each: as many are taken as make the fewest bytes in a shot of so many frames.
    """
    flat, bound = sample.reshape(len(sample), -1), rms**2 * sample.shape[0] * sample.shape[1]
    values, turn = _principal(flat)
    least = _needed(values, bound)
    if not least:
        return np.zeros((0, *sample.shape[1:]))
    fields = (turn[:, : 2 * least].T @ flat).reshape(-1, *sample.shape[1:])
    squares, missed = (fields**2).sum(axis=-1), values.sum() - np.cumsum(values)
    found, fewest = fields[:least], np.inf
    for count in range(least, len(fields) + 1, max(least // 4, 1)):
        ranked = np.sort(squares[:count], axis=None)
        first = min(int(np.searchsorted(np.cumsum(ranked), bound - missed[count - 1])), len(ranked) - 1)
        size = VERTEX * (len(ranked) - first) + count * (WEIGHT * frames + SHAPE)
        if size < fewest:
            found, fewest = np.where((squares[:count] >= ranked[first])[..., None], fields[:count], 0), size
    return found[found.any(axis=(1, 2))]


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
