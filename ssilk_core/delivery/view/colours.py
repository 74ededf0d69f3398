# SPDX-License-Identifier: Apache-2.0
"""Colours of skin, fabrics, what rides on them, and props."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats

BODY = np.array([0.72, 0.70, 0.68])
PROP = np.array([0.50, 0.55, 0.60])
METAL = np.array([0.83, 0.69, 0.32])
FABRICS = np.array([[0.72, 0.13, 0.17], [0.12, 0.42, 0.55], [0.90, 0.62, 0.18], [0.36, 0.28, 0.56]])


def fabric_colour(number: int) -> Floats:
    """Return the colour of the `number`-th garment of a picture, shape (3,)."""
    return FABRICS[number % len(FABRICS)]
