# SPDX-License-Identifier: GPL-3.0-or-later
"""Energies over iterations as a small picture; numpy alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

COLORS = np.array(
    [
        [0.90, 0.62, 0.00], [0.34, 0.71, 0.91], [0.00, 0.62, 0.45], [0.94, 0.89, 0.26], [0.84, 0.37, 0.00],
        [0.80, 0.47, 0.65],
    ]
)  # fmt: skip  # Okabe and Ito's, which all eyes tell apart
GROUND = (0.10, 0.10, 0.10, 1.0)
FINEST = 1e-3  # [J]; above, heights grow as logarithms do, below as they are
THICKNESS = 3  # pixels


def series(curve: Sequence[tuple[int, dict[str, float | None]]]) -> dict[str, np.ndarray]:
    """Return each term over a curve, (iteration, value) rows; values that are not finite are left out."""
    names = dict.fromkeys(name for _, terms in curve for name in terms)
    found = {name: [(done, terms[name]) for done, terms in curve if terms.get(name) is not None] for name in names}
    return {name: np.array(rows, dtype=float) for name, rows in found.items() if rows}


def picture(lines: Sequence[np.ndarray], size: int) -> np.ndarray:
    """Return lines, (x, y) rows with x rising, as an image of (size, size, 4), its lowest row first."""
    image = np.broadcast_to(GROUND, (size, size, 4)).copy()
    if not lines:
        return image
    every = np.concatenate(lines)
    left, right = every[:, 0].min(), every[:, 0].max()
    heights = np.arcsinh(every[:, 1] / FINEST)
    low, high = heights.min(), heights.max()
    for line, color in zip(lines, np.resize(COLORS, (len(lines), 3))):
        across = (line[:, 0] - left) / max(right - left, 1e-9) * (size - 1)
        rise = (np.arcsinh(line[:, 1] / FINEST) - low) / max(high - low, 1e-9) * (size - 1 - THICKNESS)
        first, last = round(across[0]), round(across[-1])
        rows = np.interp(np.arange(first, last + 1), across, rise).astype(int)
        _draw(image[:, first : last + 1], rows, color)
    return image


def _draw(image: np.ndarray, rows: np.ndarray, color: np.ndarray) -> None:
    """Draw a line that has one row in each column of an image, without gaps where it is steep."""
    following = np.append(rows[1:], rows[-1])
    for column, (low, high) in enumerate(zip(np.minimum(rows, following), np.maximum(rows, following))):
        image[low : high + THICKNESS, column, :3] = color
