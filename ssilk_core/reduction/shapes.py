# SPDX-License-Identifier: Apache-2.0
"""Fewer blendshapes: the best that any so many can do, by reduced-rank regression on the activations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats

LEAST = 1e-10  # of the largest variance: combinations of activations that vary less do not vary


@dataclass(frozen=True, eq=False)
class Modes:
    """What displacements follow of activations a, the most first: mean + sum_i field_i (reading_i (a - middle)).

    Attributes:
        mean: shape (V, 3) [m]; middle: mean activations, shape (K,).
        fields: shape (V, 3, R) [m]; readings: shape (R, K); each field's activation has a variance of one.
        shares: mean squares that each field accounts for, weighted by mass, shape (R,) [m2].
        rest: mean square that none accounts for [m2].
    """

    mean: Floats
    middle: Floats
    fields: Floats
    readings: Floats
    shares: Floats
    rest: float

    def lost(self, count: int) -> float:
        """Return the RMS displacement that the first `count` fields miss [m]."""
        return float(np.sqrt(self.rest + self.shares[count:].sum()))


def modes(displacements: NDArray, activations: NDArray, mass: Floats) -> Modes:
    """Find the linear functions of activations that follow displacements best, at every rank [Izenman 1975].

    With as many terms as asked for no other function of that rank leaves a smaller mean square, weighted by mass.
    Where displacements are linear in the activations this is their principal component analysis [Eckart, Young 1936].

    Args:
        displacements: of the vertices in F frames, shape (V, 3, F) [m].
        activations: shape (K, F); mass: of the vertices as shares of the whole garment's, shape (V,).
    """
    frames = activations.shape[1]
    mean, middle = displacements.mean(axis=2, dtype=np.float64), activations.mean(axis=1, dtype=np.float64)
    moved = (displacements - mean[:, :, None]).reshape(-1, frames)
    whitening = _whitening(activations - middle[:, None])
    white = whitening @ (activations - middle[:, None])
    followed = moved @ white.T / frames  # one column for each independent combination of activations
    weight = np.repeat(mass, 3)
    shares, turn = np.linalg.eigh(followed.T @ (weight[:, None] * followed))
    shares, turn = shares[::-1].clip(min=0), turn[:, ::-1]
    total = float(weight @ np.einsum("vf,vf->v", moved, moved)) / frames
    fields = (followed @ turn).reshape(*mean.shape, -1)
    return Modes(mean, middle, fields, turn.T @ whitening, shares, max(0.0, total - float(shares.sum())))


def _whitening(centred: Floats) -> Floats:
    """Return combinations (R, K) of centred values (K, F) that vary independently, each by one."""
    variances, directions = np.linalg.eigh(centred @ centred.T / centred.shape[1])
    kept = variances > LEAST * max(variances.max(initial=0), 1e-30)
    return directions[:, kept].T / np.sqrt(variances[kept])[:, None]


@dataclass(frozen=True, eq=False)
class Basis:
    """Blendshapes as a model file has them: displacement = offset + shapes (readout a).

    Attributes:
        offset: shape (V, 3) [m]; shapes: (V, 3, R) [m].
        readout: shape (R, K); the absolute values of a row sum to one, so that no activation leaves [-1, 1].
    """

    offset: Floats
    shapes: Floats
    readout: Floats


def basis(found: Modes, count: int, readout: Floats) -> Basis:
    """Return the first `count` modes as blendshapes.

    Args:
        readout: what the modes' activations are of those that the network gives, shape (K, K').
    """
    fields, readings = found.fields[:, :, :count], found.readings[:count]
    offset = found.mean - fields @ (readings @ found.middle)
    combined = readings @ readout
    largest = np.abs(combined).sum(axis=1)
    return Basis(offset, fields * largest, combined / largest[:, None])
