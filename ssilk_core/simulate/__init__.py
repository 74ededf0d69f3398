# SPDX-License-Identifier: Apache-2.0
"""A reference simulator of garments on the very energy that networks are trained with."""

from .simulator import SimulatedFrame, SimulationOptions, Simulator, minimise, shots_of, simulate

__all__ = ["SimulatedFrame", "SimulationOptions", "Simulator", "minimise", "shots_of", "simulate"]
