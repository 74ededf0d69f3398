# SPDX-License-Identifier: Apache-2.0
"""Projected Newton with conjugate gradients, many frames at once.

Each iteration solves with the positive Hessian to a tenth of the residual, then halves the step until the energy has
fallen enough; the planes of the body hold still meanwhile, and are found anew before the next. The distance to the
nearest point of a mesh is not continuous, and a vertex pushed to and fro over a seam would never settle: after some
iterations, a vertex that the surface would jump towards stays before the seam, as if pinned, until the frame is
solved. Then all are released once more, for as long as that lowers the energy. Of all states on the way the one of
lowest energy is returned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..errors import need
from ..model.descriptors import GRAVITY
from .conjugate import inverse_blocks, solve
from .potential import Planes, Potential, Setting

SUFFICIENT = 1e-4  # share of the slope that a step has to gain
HALVINGS = 12
REDUCTION = 0.1  # of the residual by each linear solution
FALL = 1e-4  # [m]; states whose energies differ by less than such a fall of the garment count as equally low
FREE = 12  # iterations in which every vertex may cross seams, at first and after each release


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """When a frame counts as solved.

    Attributes:
        tolerance: RMS acceleration that forces out of balance would give the free mass, in units of g. As inertia
            alone makes the Hessian at least m/dt^2, it bounds the distance to the minimum by tolerance g dt^2: 0.1 mm
            for the default at 30 frames per second, and the energy above it by m (tolerance g dt)^2 / 2: 1e-6 J.
        iterations: of Newton's method, at most.
        inner: of conjugate gradients in each, at most.
    """

    tolerance: float = 1e-2
    iterations: int = 100
    inner: int = 200

    def __post_init__(self) -> None:
        need(0 < self.tolerance < float("inf"), "solver", f"tolerance = {self.tolerance}", "it must be positive")
        for name in ("iterations", "inner"):
            need(getattr(self, name) > 0, "solver", f"{name} = {getattr(self, name)}", "at least 1 is needed")


@dataclass(frozen=True, eq=False)
class Solution:
    """Minima of N frames.

    Attributes:
        x: positions [m], shape (V, 3, N).
        energy: with the nearest body points of x [J], shape (N,).
        imbalance: what `SolverOptions.tolerance` bounds, without the vertices that stay before a seam, shape (N,).
        iterations: of Newton's method, shape (N,).
        inner: iterations of conjugate gradients, each for all frames that were still at work.
    """

    x: Tensor
    energy: Tensor
    imbalance: Tensor
    iterations: Tensor
    inner: int


@torch.no_grad()
def minimise_from(potential: Potential, start: Tensor, setting: Setting, options: SolverOptions) -> Solution:
    """Minimise the energy of each frame over the free vertices.

    Args:
        start: first positions, pinned vertices where they stay, shape (V, 3, N).

    Raises:
        SsilkError: the energy of the start is not finite.
    """
    search = _Search(potential, start, setting, options)
    for _ in range(options.iterations):
        if not search.narrowed():
            break
        search.advance()
    return search.solution()


class _Search:
    """Newton's method under way: the frames still at work, and the best state of every frame so far."""

    energy: Tensor
    gradient: Tensor
    imbalance: Tensor

    def __init__(self, potential: Potential, start: Tensor, setting: Setting, options: SolverOptions) -> None:
        self.potential, self.options, self.setting = potential, options, setting
        self.x, self.planes, self.inner = start, potential.planes(start, setting), 0
        self.held = torch.zeros_like(start[:, 0], dtype=torch.bool)
        self._look()
        bad = int((~self.energy.isfinite()).sum())
        need(bad == 0, "simulation", f"the first state of {bad} of {len(self.energy)} frames has no finite energy",
             "positions, body and time step must be finite", "look for NaN in stage and motion")  # fmt: skip
        self.at_work = torch.arange(len(self.energy), device=start.device)
        self.moving = torch.ones_like(self.energy, dtype=torch.bool)
        self.best = Solution(
            start.clone(), self.energy.clone(), self.imbalance.clone(), torch.zeros_like(self.at_work), 0
        )
        self.lowest = self.energy.clone()
        self.since, self.mark = torch.zeros_like(self.at_work), torch.full_like(self.energy, torch.inf)
        self.alike = float(potential.mass[potential.free].sum()) * GRAVITY * FALL

    def narrowed(self) -> bool:
        """Leave out frames that are solved or cannot be improved; return whether any is left."""
        kept = ((self.moving & (self.imbalance > self.options.tolerance)) | self._released()).nonzero()[:, 0]
        if 0 < len(kept) < len(self.at_work):
            self.x, self.gradient, self.at_work = self.x[..., kept], self.gradient[..., kept], self.at_work[kept]
            self.setting, self.planes = self.setting.picked(kept), self.planes and self.planes.picked(kept)
            self.held, self.since, self.mark = self.held[:, kept], self.since[kept], self.mark[kept]
        return len(kept) > 0

    def _released(self) -> Tensor:
        """Let go of held vertices in solved frames that the last such time has helped; return which, (N,)."""
        solved = ~self.moving | (self.imbalance <= self.options.tolerance)
        again = solved & self.held.any(0) & (self.energy < self.mark - self.alike)
        if bool(again.any()):
            self.held &= ~again
            self.since.masked_fill_(again, 0)
            self.mark = torch.where(again, self.energy, self.mark)
            self._look()
        return again

    def advance(self) -> None:
        """Make one step."""
        potential, setting, x, planes = self.potential, self.setting, self.x, self.planes
        step, count = newton_step(potential, x, setting, planes, self.gradient, ~self.held, self.options.inner)
        length = line_search(potential, x, setting, planes, self.gradient, step)
        self.moving, self.inner = length > 0, self.inner + count
        self.x = x + length * step
        self.planes = potential.planes(self.x, setting)
        if planes and self.planes:
            jumps = planes.jumps(self.planes, self.x, x) & (self.since >= FREE)
            self.x, self.planes = torch.where(jumps[:, None], x, self.x), planes.mixed(self.planes, jumps)
            self.held |= jumps
        self.since += 1
        self._look()
        self._remember()

    def _look(self) -> None:
        """Evaluate the states that the search stands at."""
        state = self.x, self.setting, self.planes
        self.energy = self.potential.energy(*state)
        self.gradient = self.potential.gradient(*state).masked_fill(self.held[:, None], 0)
        self.imbalance = self.potential.imbalance(self.gradient)

    def _remember(self) -> None:
        """Keep the latest of the states whose energy is as low as any."""
        best, rows, energy = self.best, self.at_work, self.energy
        best.iterations[rows] += 1
        better = energy <= self.lowest[rows] + self.alike
        rows = rows[better]
        best.x[..., rows] = self.x[..., better]
        best.energy[rows], best.imbalance[rows] = energy[better], self.imbalance[better]
        self.lowest[rows] = torch.minimum(self.lowest[rows], best.energy[rows])

    def solution(self) -> Solution:
        """Return the best states."""
        return replace(self.best, inner=self.inner)


def newton_step(
    potential: Potential,
    x: Tensor,
    setting: Setting,
    planes: Planes | None,
    gradient: Tensor,
    moves: Tensor,
    inner: int,
) -> tuple[Tensor, int]:
    """Return a direction of descent (V, 3, N) and the iterations that it took.

    It is zero in pinned vertices and wherever `moves` (V, N) is false.
    """
    matrix = potential.hessian(x, setting, planes)
    inverse = inverse_blocks(matrix.diagonal)
    mask = moves[potential.free].T[..., None].float()
    right = -gradient[potential.free].permute(2, 0, 1).float() * mask
    z, count = solve(
        lambda v: (matrix @ v) * mask, lambda r: (inverse * r[..., None, :]).sum(-1), right, REDUCTION, inner
    )
    step = torch.zeros_like(x)
    step[potential.free] = z.permute(1, 2, 0).to(x.dtype)
    return step, count


def line_search(
    potential: Potential, x: Tensor, setting: Setting, planes: Planes | None, gradient: Tensor, step: Tensor
) -> Tensor:
    """Return the largest of 1, 1/2, 1/4 ... at which each frame's energy has fallen enough, else 0, shape (N,)."""
    energy, slope = potential.energy(x, setting, planes), (gradient * step).sum((0, 1))
    length, found = torch.ones_like(energy), torch.zeros_like(energy)
    for _ in range(HALVINGS):
        fallen = potential.energy(x + length * step, setting, planes) <= energy + SUFFICIENT * length * slope
        found = torch.where((found == 0) & fallen & (slope < 0), length, found)
        if bool((found > 0).all()):
            break
        length = length / 2
    return found
