# SPDX-License-Identifier: Apache-2.0
"""Between a network and the simulator: a rollout refined on the training energy, frame by frame."""

from .fit import PoseFit, Refitter
from .refiner import Change, RefinedFrame, RefineOptions, Refiner, Summary

__all__ = ["Change", "PoseFit", "RefineOptions", "RefinedFrame", "Refiner", "Refitter", "Summary"]
