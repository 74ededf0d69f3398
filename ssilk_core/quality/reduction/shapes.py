# SPDX-License-Identifier: Apache-2.0
"""Fewer blendshapes: principal components of the displacements that activations predict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats

RIDGE = 1e-3  # of the mean variance of activations: keeps few frames from being learnt by heart
MIN_RELATIVE_SHARE = 1e-14  # of the largest share: modes with less are rounding
REACH = 4  # times the largest value of a mode in any frame: activations are held there


@dataclass(frozen=True, eq=False)
class Modes:
    """Displacements predicted from activations a as mean + sum_i field_i (reading_i (a - middle)), largest first.

    Attributes:
        mean: shape (V, 3) [m]; middle: mean activations, shape (K,).
        fields: shape (V, 3, K) [m]; readings: shape (K, K); the activation of each field has a variance of one.
        shares: reduction of the mean squared displacement by each field, weighted by mass, shape (K,) [m2].
        total: mean squared displacement about the mean [m2].
        reached: largest absolute value of reading_i a in any frame, shape (K,).
    """

    mean: Floats
    middle: Floats
    fields: Floats
    readings: Floats
    shares: Floats
    total: float
    reached: Floats

    def error(self, count: int) -> float:
        """Return the RMS displacement that the first `count` fields miss [m]."""
        return float(np.sqrt(max(0.0, self.total - self.shares[:count].sum())))


def modes(shapes: NDArray, more: NDArray, activations: NDArray, mass: Floats) -> Modes:
    """Find modes of the displacements shapes a + more, predicted from the activations a.

    Ridge regression predicts `more`, which no shapes produce, from the activations. Principal components of both
    together are then the best of their number [Eckart, Young 1936]; they are exact where `more` is zero.

    Args:
        shapes: (V, 3, K) [m]; more: of the vertices in F frames, shape (V, 3, F) [m].
        activations: shape (K, F); mass: of the vertices as shares of the whole garment's, shape (V,).
    """
    frames, weight = activations.shape[1], np.repeat(mass, 3)
    middle, beyond = activations.mean(axis=1, dtype=np.float64), more.mean(axis=2, dtype=np.float64)
    centred = activations - middle[:, None]
    variance = centred @ centred.T / frames
    rest = (more - beyond[:, :, None]).reshape(-1, frames)
    given, along = shapes.reshape(len(weight), -1).astype(np.float64), rest @ centred.T / frames
    ridge = RIDGE * np.trace(variance) / max(len(variance), 1) + 1e-30
    linear = given + along @ np.linalg.inv(variance + ridge * np.eye(len(variance)))
    fields, readings = _components(linear, variance, weight)
    together = given @ variance + along  # covariance of displacements and activations
    shares = np.einsum("v,vk,vk->k", weight, fields, 2 * together @ readings.T - fields)
    total = float(
        weight @ (np.einsum("vk,vk->v", given, together + along) + np.einsum("vf,vf->v", rest, rest) / frames)
    )
    mean = shapes @ middle + beyond
    reached = np.abs(readings @ activations).max(axis=1, initial=0)
    return Modes(mean, middle, fields.reshape(*mean.shape, -1), readings, shares, total, reached)


def _components(linear: Floats, variance: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return fields (3 V, K) and readings (K, K) of displacements `linear` a, the most important first."""
    values, directions = np.linalg.eigh(variance)
    spread = directions * np.sqrt(values.clip(min=0))
    scaled = linear @ spread
    shares, turn = np.linalg.eigh(scaled.T @ (weight[:, None] * scaled))
    fields, shares = scaled @ turn[:, ::-1], shares[::-1]
    kept = shares > MIN_RELATIVE_SHARE * shares.max(initial=0)
    inverse = np.divide(1, shares, out=np.zeros_like(shares), where=kept)
    return fields * kept, inverse[:, None] * (fields.T @ (weight[:, None] * linear))


@dataclass(frozen=True, eq=False)
class Basis:
    """Blendshapes in the form of a model file: displacement = offset + shapes clip(readout a), which is in [-1, 1].

    Attributes:
        offset: shape (V, 3) [m]; shapes: (V, 3, R) [m]; readout: shape (R, K).
    """

    offset: Floats
    shapes: Floats
    readout: Floats


def basis(found: Modes, count: int, readout: Floats) -> Basis:
    """Return the first `count` modes as blendshapes, an activation of one being `REACH` times what was seen.

    A row of `combined` adds up to what a mode is where all activations are at an end of their range at once. That is
    some hundred times what occurs. Shapes of that size are tens of metres long and cancel each other, and single
    precision, in which readers add them up, then misses their sum by more than a verification allows.

    Args:
        readout: map from the network's activations to those of the modes, shape (K, K').
    """
    fields, readings = found.fields[:, :, :count], found.readings[:count]
    offset = found.mean - fields @ (readings @ found.middle)
    combined = readings @ readout
    largest = np.minimum(np.abs(combined).sum(axis=1), REACH * found.reached[:count]) + 1e-30
    return Basis(offset, fields * largest, combined / largest[:, None])
