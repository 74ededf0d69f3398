# SPDX-License-Identifier: Apache-2.0
"""Measures of moving cloth, over all frames at once.

Positions have the shape (V, 3, N): vertices, coordinates, frames. Means over vertices are weighted by mass, so that
a finer mesh of the same garment measures the same.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

STRETCHES = (0.0, 4.0)  # range of the histogram of stretches; what is beyond counts at its end
BINS = 8000  # half a thousandth each


def derivative(x: Tensor, order: int, fps: float) -> Tensor:
    """Return the backward difference quotient of some order [m/s^order] of the last N - order frames."""
    return x.diff(n=order, dim=-1) * fps**order


def mean_square(vectors: Tensor, mass: Tensor) -> Tensor:
    """Return the mean over mass (V,) of squared lengths of vectors (V, 3, N), shape (N,)."""
    return mass @ vectors.square().sum(1) / mass.sum()


def kinetic_energy(x: Tensor, mass: Tensor, fps: float) -> Tensor:
    """Return the kinetic energy of mass (V,) [kg] at the last N - 1 frames [J], shape (N - 1,)."""
    return mass.sum() * mean_square(derivative(x, 1, fps), mass) / 2


def ratio(value: float, of: float) -> float:
    """Return a quotient; NaN of nothing, as where a character or a garment does not move."""
    return value / of if of else math.nan


def settling_time(speed: Tensor, calm: float, fps: float) -> Tensor:
    """Return the time from the first frame on after which a speed (..., N) stays at or under `calm` [s], shape (...).

    Infinite where the last frame is still faster.
    """
    number = torch.arange(1, speed.shape[-1] + 1, device=speed.device)
    after = torch.where(speed > calm, number, 0).amax(-1)
    return torch.where(after == speed.shape[-1], torch.inf, after / fps)


def principal_stretches(columns: Tensor) -> Tensor:
    """Return the singular values of deformation gradients, the larger first, shape (2, F, N).

    Args:
        columns: the first columns of all triangles, then the second ones, shape (2 F, 3, N).
    """
    u, v = columns.chunk(2)
    uu, vv, uv = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    middle, radius = (uu + vv) / 2, (((uu - vv) / 2) ** 2 + uv**2).sqrt()
    return torch.stack([middle + radius, (middle - radius).clamp_min(0)]).sqrt()


def stretch_histogram(stretch: Tensor) -> Tensor:
    """Return how many stretches of any shape fall into each of `BINS`; histograms of parts add up."""
    low, high = STRETCHES
    return torch.histc(stretch.float().clamp(low, high), BINS, low, high).double().cpu()


def histogram_quantiles(counts: Tensor, shares: tuple[float, ...]) -> list[float]:
    """Return quantiles from a histogram of `stretch_histogram`, at the middle of their bins."""
    low, high = STRETCHES
    total = counts.cumsum(0)
    place = torch.searchsorted(total, torch.tensor(shares, dtype=total.dtype) * total[-1]).clamp_max(BINS - 1)
    return (low + (place + 0.5) * (high - low) / BINS).tolist()


def pose_distance(poses: Tensor, seen: Tensor, joints: int, block: int = 1024) -> Tensor:
    """Return how far poses (N, D) are from the nearest of those seen (M, D), as an angle for each joint [rad], (N,).

    Descriptors hold three unit vectors for each of so many joints: two axes of its rotation, and gravity in its
    frame. Turning any of them by a small angle t, about axes of all directions, moves them by sqrt(2/3) t each.
    """
    nearest = [torch.cdist(part, seen).amin(1) for part in poses.split(block)]
    return torch.cat(nearest) / (2 * joints) ** 0.5
