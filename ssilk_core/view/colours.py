# SPDX-License-Identifier: Apache-2.0
"""Colours: of skin and fabrics, of vertex classes, and of a scalar such as stretch or penetration."""

from __future__ import annotations

import numpy as np

from ..assets import Floats, Ints

BODY = np.array([0.72, 0.70, 0.68])
FABRICS = np.array([[0.72, 0.13, 0.17], [0.12, 0.42, 0.55], [0.90, 0.62, 0.18], [0.36, 0.28, 0.56]])
CLASSES = np.array([[0.08, 0.08, 0.09], [0.86, 0.18, 0.16], [0.20, 0.66, 0.30]])  # pinned, tight, loose
HEAT = np.array([[0.88, 0.89, 0.91], [0.98, 0.82, 0.30], [0.92, 0.36, 0.13], [0.50, 0.03, 0.16]])


def fabric_colour(number: int) -> Floats:
    """Return the colour of the `number`-th garment of a picture, shape (3,)."""
    return FABRICS[number % len(FABRICS)]


def class_colours(classes: Ints) -> Floats:
    """Return pinned black, tight red, loose green for PINNED, TIGHT, LOOSE, shape (V, 3)."""
    return CLASSES[np.asarray(classes)]


def heat_colours(values: Floats, limit: float) -> Floats:
    """Return pale grey at 0 or below, through yellow and orange, to dark red at `limit`, shape (V, 3)."""
    position = np.clip(np.asarray(values, dtype=np.float64) / limit, 0.0, 1.0)
    steps = np.linspace(0.0, 1.0, len(HEAT))
    return np.stack([np.interp(position, steps, channel) for channel in HEAT.T], axis=-1)
