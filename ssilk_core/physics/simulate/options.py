# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from ...errors import fail
from ..constants import GRAVITY
from .newton import SolverOptions

PRECISIONS = {"float64": torch.float64, "float32": torch.float32}
MAX_SUBSTEPS = 1000


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """Settings of a simulation.

    Attributes:
        fps: frames per second; the default is the rate of training.
        substeps: steps in each frame.
        batch: number of shots simulated in parallel.
        sequence: number of frames after which a shot restarts, for evaluation; sequences are simulated in parallel.
            None for whole shots.
        precision: "float64" or "float32", of positions, energies and forces; linear systems are always float32.
        gravity: acceleration [m/s2].
        self_contact: loose cloth does not pass through the garment (`physics.self_contact`).
        solver: settings for every step.
        quasi_static_solver: settings for quasi-static states, which converge more slowly without inertia.
    """

    fps: float = 30.0
    substeps: int = 1
    batch: int = 64
    sequence: int | None = None
    precision: str = "float64"
    gravity: tuple[float, float, float] = (0.0, -GRAVITY, 0.0)
    self_contact: bool = False
    solver: SolverOptions = field(default_factory=SolverOptions)
    quasi_static_solver: SolverOptions = field(default_factory=lambda: SolverOptions(iterations=150))

    def __post_init__(self) -> None:
        if not 0 < self.fps <= 10_000:
            fail("simulation", f"{self.fps:g} frames per second", "a positive rate is needed")
        if not 0 < self.substeps <= MAX_SUBSTEPS:
            fail("simulation", f"substeps = {self.substeps}", f"1 to {MAX_SUBSTEPS} are allowed")
        if not self.batch > 0:
            fail("simulation", f"batch = {self.batch}", "at least 1 is needed")
        if not (self.sequence is None or self.sequence >= 1):
            fail("simulation", f"sequences of {self.sequence} frames", "one at least is needed")
        if self.precision not in PRECISIONS:
            fail("simulation", f"precision '{self.precision}'", "it is float64 or float32")
        if not np.isfinite(self.gravity).all():
            fail("simulation", f"gravity {self.gravity}", "it must be finite")
