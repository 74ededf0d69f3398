# SPDX-License-Identifier: Apache-2.0
"""Vertex trajectories as joints and blendshapes: fitted poses, and as many shapes of a shot as a tolerance needs."""

from .decompose import Decomposition, decompose
from .poses import PoseFit, PoseFitter
from .shapes import FitTolerance

__all__ = ["Decomposition", "FitTolerance", "PoseFit", "PoseFitter", "decompose"]
