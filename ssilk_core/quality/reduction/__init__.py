# SPDX-License-Identifier: Apache-2.0
"""Smaller models of a trained one, without training."""

from .reducer import ReducedModel, Reducer
from .size import ModelSize

__all__ = ["ModelSize", "ReducedModel", "Reducer"]
