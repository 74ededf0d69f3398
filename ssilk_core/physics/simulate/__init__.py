# SPDX-License-Identifier: Apache-2.0
"""A reference simulator of garments that minimises the same energy as training."""

from .options import SimulationOptions
from .outfit import WornGarment
from .simulator import SimulatedFrame, Simulator, quasi_static_states, shots_of, simulate

__all__ = [
    "SimulatedFrame",
    "SimulationOptions",
    "Simulator",
    "WornGarment",
    "quasi_static_states",
    "shots_of",
    "simulate",
]
