# SPDX-License-Identifier: Apache-2.0
"""Refinement of a network's rollout on the training energy, frame by frame."""

from .refiner import FrameChange, RefinedFrame, RefinementMeans, RefineOptions, Refiner

__all__ = ["FrameChange", "RefineOptions", "RefinedFrame", "RefinementMeans", "Refiner"]
