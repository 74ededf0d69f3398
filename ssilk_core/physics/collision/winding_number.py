# SPDX-License-Identifier: Apache-2.0
"""How often surfaces wind around points: what lies inside them, also where they have holes."""

from __future__ import annotations

import torch
from torch import Tensor

ENCLOSED = 0.5  # winding number from which on a point lies inside


def winding_number(corners: Tensor) -> Tensor:
    """Return how often surfaces wind around the origin, shape (M,), from the corners of triangles (M, F, 3, 3).

    The sum of the triangles' solid angles over 4 pi, each by van Oosterom and Strackee (1983):
    tan(angle / 2) = a . (b x c) / (|a||b||c| + (a . b)|c| + (b . c)|a| + (c . a)|b|).
    """
    a, b, c = corners.unbind(2)
    la, lb, lc = (each.norm(dim=-1) for each in (a, b, c))
    volume = (a * torch.linalg.cross(b, c)).sum(-1)
    rest = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return torch.atan2(volume, rest).sum(-1) / (2 * torch.pi)
