# SPDX-License-Identifier: Apache-2.0
"""Settings of the solver in latents."""

from __future__ import annotations

from dataclasses import dataclass

from ...errors import fail

MAX_ITERATIONS = 10_000


@dataclass(frozen=True, kw_only=True)
class LatentOptions:
    """How much a frame is solved.

    Attributes:
        iterations: Gauss-Newton iterations in each frame, at most.
        first_iterations: those of a shot's first frame, which has no inertia and begins at rest.
        tolerance: a frame has converged once the quadratic model of its energy promises no more than
            m (tolerance g dt)^2 / 2, for the garment's mass m and a step dt. Newton's method over the vertices stops
            there, too (`SolverOptions`).
        damping: relative to inertia: the damping is this times the mean over the latents of |dx/dz|^2 m / dt^2.
        sampled: sum the energy over few elements, which are chosen for the motions (`elements`), and query the
            distance to the body once before each iteration. No frame gains that energy, on the planes of its last
            query; the whole garment's is not looked at. Otherwise everything is that of the whole garment.
        exact_contact: query the distance to the body for each state that is tried. Otherwise states are tried on
            the planes of the state before, and only the one that is taken is queried. No frame of the whole garment
            gains energy either way.
    """

    iterations: int = 2
    first_iterations: int = 20
    tolerance: float = 1e-2
    damping: float = 0.1
    sampled: bool = False
    exact_contact: bool = False

    def __post_init__(self) -> None:
        for name in ("iterations", "first_iterations"):
            if not 0 < getattr(self, name) <= MAX_ITERATIONS:
                fail("latent solver", f"{name} = {getattr(self, name)}", f"1 to {MAX_ITERATIONS} are allowed")
        if not 0 <= self.tolerance < float("inf"):
            fail("latent solver", f"tolerance = {self.tolerance:g}", "it must not be negative")
        if not 0 < self.damping < float("inf"):
            fail("latent solver", f"damping = {self.damping:g}", "it must be positive")
