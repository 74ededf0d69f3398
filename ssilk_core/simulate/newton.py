# SPDX-License-Identifier: Apache-2.0
"""Projected Newton with conjugate gradients, many frames at once.

Each iteration solves with the positive Hessian to a tenth of the residual, then halves the step until the energy has
fallen enough. The nearest points of the body are found anew for every state, those of the line search included: the
energy of a frame never rises, and more iterations never end higher. In gradient and Hessian they hold still.

Between two parts of the body, or where these pass through each other, the nearest point jumps: the energy has a
crease or a step there, and no gradient tells. One vertex on it would keep its whole garment from moving on. Where no
step lowers the energy, the vertices whose energy rises at once as their planes do not tell are held for the rest of
the search, and the others go on; a frame that has none stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..errors import need
from .potential import Planes, Potential, Setting

SUFFICIENT = 1e-4  # share of the slope that a step has to gain
HALVINGS = 12
REDUCTION = 0.1  # of the residual by each linear solution
REACH = 0.1  # of the garment's size, by which a step moves a vertex at most: stiff systems are solved badly
SPOILING = 0.1  # share of the slope that a vertex on a crease takes away, from which on it is held


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
        imbalance: what `SolverOptions.tolerance` bounds, of vertices that are not held, shape (N,).
        iterations: of Newton's method, shape (N,).
        held: how many vertices are held, shape (N,).
        inner: iterations of conjugate gradients, each for all frames that were still at work.
    """

    x: Tensor
    energy: Tensor
    imbalance: Tensor
    iterations: Tensor
    held: Tensor
    inner: int


@dataclass(frozen=True, eq=False)
class State:
    """Where N frames are.

    Attributes:
        x: positions [m], shape (V, 3, N).
        planes: through the body points nearest to them.
        energy: [J], shape (N,).
    """

    x: Tensor
    planes: Planes | None
    energy: Tensor

    @classmethod
    def at(cls, potential: Potential, x: Tensor, setting: Setting) -> State:
        """Return the state of positions (V, 3, N)."""
        planes = potential.planes(x, setting)
        return cls(x, planes, potential.energy(x, setting, planes))

    def tensors(self) -> list[Tensor]:
        """Return all that it holds, frames last."""
        return [self.x, self.energy, *([self.planes.normal, self.planes.offset] if self.planes else [])]

    def picked(self, frames: Tensor) -> State:
        """Return the state of some of the frames, indices (M,)."""
        return State(self.x[..., frames], self.planes and self.planes.picked(frames), self.energy[frames])

    def replaced(self, frames: Tensor, other: State) -> State:
        """Return the state with some of the frames, indices (M,), from another."""
        x, energy, *planes = (
            own.index_copy(-1, frames, new) for own, new in zip(self.tensors(), other.tensors(), strict=True)
        )
        return State(x, Planes(*planes) if planes else None, energy)


@torch.no_grad()
def minimise_from(potential: Potential, start: Tensor, setting: Setting, options: SolverOptions) -> Solution:
    """Minimise the energy of each frame over the free vertices; no frame ends higher than it starts.

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
    return search.solution


class _Search:
    """Newton's method under way: the frames still at work, and where every frame has come to.

    Attributes:
        held: vertices that stay where they are, shape (V, N).
    """

    gradient: Tensor
    imbalance: Tensor

    def __init__(self, potential: Potential, start: Tensor, setting: Setting, options: SolverOptions) -> None:
        self.potential, self.options, self.setting = potential, options, setting
        self.state = State.at(potential, start, setting)
        energy = self.state.energy
        bad = int((~energy.isfinite()).sum())
        need(bad == 0, "simulation", f"the first state of {bad} of {len(energy)} frames has no finite energy",
             "positions, body and time step must be finite", "look for NaN in stage and motion")  # fmt: skip
        self.at_work = torch.arange(len(energy), device=start.device)
        self.moving = torch.ones_like(energy, dtype=torch.bool)
        self.held = torch.zeros_like(start[:, 0], dtype=torch.bool)
        self._look()
        iterations = torch.zeros_like(self.at_work)
        found = start.clone(), energy.clone(), self.imbalance.clone()
        self.solution = Solution(*found, iterations, iterations.clone(), 0)

    def narrowed(self) -> bool:
        """Leave out frames that are solved or that no step improves; return whether any is left."""
        kept = (self.moving & (self.imbalance > self.options.tolerance)).nonzero()[:, 0]
        if 0 < len(kept) < len(self.at_work):
            self.state, self.setting = self.state.picked(kept), self.setting.picked(kept)
            self.gradient, self.held = self.gradient[..., kept], self.held[:, kept]
            self.at_work = self.at_work[kept]
        return len(kept) > 0

    def advance(self) -> None:
        """Make one step."""
        potential, setting = self.potential, self.setting
        step, count = newton_step(potential, self.state, setting, self.gradient, self.options.inner, self.held)
        self.state, self.moving = line_search(potential, self.state, setting, self.gradient, step)
        self._hold((~self.moving).nonzero()[:, 0], step)
        self._look()
        self._keep(count)

    def _hold(self, stuck: Tensor, step: Tensor) -> None:
        """Hold what keeps frames from moving (their indices); those of which that frees the others go on."""
        if len(stuck) and self.state.planes:
            gradient, step = self.gradient[..., stuck], step[..., stuck]
            setting = self.setting.picked(stuck)
            found = spoiling(self.potential, self.state.picked(stuck), setting, gradient, step) & ~self.held[:, stuck]
            self.held[:, stuck] |= found
            self.moving[stuck] = found.any(0)

    def _look(self) -> None:
        """Find the forces out of balance in the states that the search stands at."""
        gradient = self.potential.gradient(self.state.x, self.setting, self.state.planes)
        self.gradient = gradient.masked_fill(self.held[:, None], 0)
        self.imbalance = self.potential.imbalance(self.gradient)

    def _keep(self, inner: int) -> None:
        """Write down where the frames at work have come to."""
        found, rows = self.solution, self.at_work
        found.x[..., rows], found.energy[rows] = self.state.x, self.state.energy
        found.imbalance[rows] = self.imbalance
        found.iterations[rows] += 1
        found.held[rows] = self.held.sum(0)
        self.solution = replace(found, inner=found.inner + inner)


def newton_step(
    potential: Potential, state: State, setting: Setting, gradient: Tensor, inner: int, held: Tensor | None = None
) -> tuple[Tensor, int]:
    """Return a direction of descent (V, 3, N), zero in pinned and `held` (V, N) vertices, and iterations it took."""
    right = -gradient[potential.free].float()
    z, count = potential.hessian(state.x, setting, state.planes, held).solve(right, REDUCTION, inner)
    step = torch.zeros_like(state.x)
    step[potential.free] = z.to(step.dtype)
    if held is not None:
        step = step.masked_fill(held[:, None], 0)
    longest = step.norm(dim=1).amax(0).clamp_min(torch.finfo(step.dtype).tiny)
    return step * (REACH * potential.size / longest).clamp(max=1), count


def line_search(
    potential: Potential, state: State, setting: Setting, gradient: Tensor, step: Tensor
) -> tuple[State, Tensor]:
    """Return where the largest of 1, 1/2, 1/4 ... of a step takes each frame so that its energy falls enough.

    A frame whose energy falls with none of them stays. Also returned: which frames have moved, shape (N,).
    """
    slope = (gradient * step).sum((0, 1))
    found, left, length = state, (slope < 0).nonzero()[:, 0], 1.0
    moved = slope < 0
    for _ in range(HALVINGS):
        if not len(left):
            break
        trial = State.at(potential, (state.x + length * step)[..., left], setting.picked(left))
        fallen = trial.energy <= (state.energy + SUFFICIENT * length * slope)[left]
        rows = fallen.nonzero()[:, 0]
        found = found.replaced(left[rows], trial.picked(rows))
        left, length = left[~fallen], length / 2
    moved[left] = False
    return found, moved


def spoiling(potential: Potential, state: State, setting: Setting, gradient: Tensor, step: Tensor) -> Tensor:
    """Return the vertices (V, N) whose collision, within the least step, costs much more than their planes tell."""
    least = 0.5 ** (HALVINGS - 1)
    slope = (gradient * step).sum((0, 1)).abs()
    x = state.x + least * step
    told, found = potential.collision(x, state.planes), potential.collision(x, potential.planes(x, setting))
    return found - told > SPOILING * least * slope
