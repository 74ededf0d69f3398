# SPDX-License-Identifier: Apache-2.0
"""A solver in a model's own latents: between the network, which is fast, and the simulator, which is accurate.

Open `solver.py` first. Each frame minimises the simulator's energy over the latents of the decoder; what it finds is
stored as the network's frames are, as joints and blendshapes.
"""

from .memory import LatentMemory
from .options import LatentOptions
from .roller import LatentRoller, frames_to_solve
from .solver import LatentSolution, LatentSolver

__all__ = ["LatentMemory", "LatentOptions", "LatentRoller", "LatentSolution", "LatentSolver", "frames_to_solve"]
