# SPDX-License-Identifier: Apache-2.0
"""Physics energies of a garment (paper, Section 3.5), one value per frame.

Positions have the shape (V, 3, N): vertices, coordinates, frames. Every term returns [J] per frame, shape (N,).
"""

from .garment import STATIC_TERMS, TERMS, GarmentEnergy

__all__ = ["STATIC_TERMS", "TERMS", "GarmentEnergy"]
