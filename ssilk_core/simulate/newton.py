# SPDX-License-Identifier: Apache-2.0
"""Newton's method with conjugate gradients, many frames at once.

Each iteration solves with the Hessian to a tenth of the residual, then halves the step until the energy has fallen
enough. The distances to the body are found anew for every state, those of the line search included: the energy of a
frame never rises, and more iterations never end higher. Far from balance the Hessian is made positive; near it the
membrane's own is tried, for cloth that is about to buckle gives way much faster under it, and left for some
iterations where it did not lead down.

Where parts of a body pass through each other, the nearest surface changes sides and the energy has a step: no
gradient tells. One vertex before it would keep its whole garment from moving on. Where only a small part of a step
lowers the energy, the vertices that cost more than they should in a larger one are held, and the others go on. Once
these are in balance, all are let go and tried once more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..energy.rounded import Rounded
from ..errors import fail
from .potential import Potential, Setting

SUFFICIENT = 1e-4  # share of the slope that a step has to gain
HALVINGS = 12
REDUCTION = 0.1  # of the residual by each linear solution
REACH = 0.1  # of the garment's size, by which a step moves a vertex at most: stiff systems are solved badly
CREEPING = 0.25  # of a step: where not even this is possible, what stands in the way is held
SPOILING = 0.1  # share of the fall expected that a vertex takes away, from which on it stands in the way
NEAR = 2.0  # [g] out of balance, from which on the whole Hessian is tried
GOOD = 0.25  # of a step: where less of one is possible, the whole Hessian has misled
PATIENCE = 4  # iterations without it from then on


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
        if not 0 < self.tolerance < float("inf"):
            fail("solver", f"tolerance = {self.tolerance}", "it must be positive")
        for name in ("iterations", "inner"):
            if not getattr(self, name) > 0:
                fail("solver", f"{name} = {getattr(self, name)}", "at least 1 is needed")


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
        met: their distances to the body.
        energy: [J], shape (N,).
    """

    x: Tensor
    met: Rounded | None
    energy: Tensor

    @classmethod
    def at(cls, potential: Potential, x: Tensor, setting: Setting) -> State:
        """Return the state of positions (V, 3, N)."""
        met = potential.met(x, setting)
        return cls(x, met, potential.energy(x, setting, met))

    def tensors(self) -> list[Tensor]:
        """Return all that it holds, frames last."""
        return [self.x, self.energy, *(self.met.tensors() if self.met else [])]

    def picked(self, frames: Tensor) -> State:
        """Return the state of some of the frames, indices (M,)."""
        return State(self.x[..., frames], self.met and self.met.picked(frames), self.energy[frames])

    def replaced(self, frames: Tensor, other: State) -> State:
        """Return the state with some of the frames, indices (M,), from another."""
        x, energy, *met = (
            own.index_copy(-1, frames, new) for own, new in zip(self.tensors(), other.tensors(), strict=True)
        )
        return State(x, Rounded(*met) if met else None, energy)


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
        waiting: iterations that frames go on without the whole Hessian, shape (N,).
        released: frames whose held vertices have been let go, shape (N,).
    """

    gradient: Tensor
    imbalance: Tensor

    def __init__(self, potential: Potential, start: Tensor, setting: Setting, options: SolverOptions) -> None:
        self.potential, self.options, self.setting = potential, options, setting
        self.state = State.at(potential, start, setting)
        energy = self.state.energy
        bad = int((~energy.isfinite()).sum())
        if bad != 0:
            fail(
                "simulation",
                f"the first state of {bad} of {len(energy)} frames has no finite energy",
                "positions, body and time step must be finite",
                "look for NaN in stage and motion",
            )
        self.at_work = torch.arange(len(energy), device=start.device)
        self.moving = torch.ones_like(energy, dtype=torch.bool)
        self.held = torch.zeros_like(start[:, 0], dtype=torch.bool)
        self.waiting, self.released = torch.zeros_like(self.at_work), torch.zeros_like(self.moving)
        self._look()
        iterations = torch.zeros_like(self.at_work)
        found = start.clone(), energy.clone(), self.imbalance.clone()
        self.solution = Solution(*found, iterations, iterations.clone(), 0)

    def narrowed(self) -> bool:
        """Leave out frames that are solved or that no step improves; return whether any is left."""
        self._release()
        kept = (self.moving & (self.imbalance > self.options.tolerance)).nonzero()[:, 0]
        if 0 < len(kept) < len(self.at_work):
            self.state, self.setting = self.state.picked(kept), self.setting.picked(kept)
            for name in ("gradient", "held", "at_work", "imbalance", "waiting", "released"):
                setattr(self, name, getattr(self, name)[..., kept])
        return len(kept) > 0

    def advance(self) -> None:
        """Make one step."""
        potential, setting, gradient = self.potential, self.setting, self.gradient
        whole = (self.imbalance < NEAR) & (self.waiting <= 0)
        step, count = newton_step(potential, self.state, setting, gradient, self.options.inner, self.held, whole)
        self.state, length, in_the_way = line_search(potential, self.state, setting, gradient, step)
        misled = whole & (length < GOOD)
        self.waiting = torch.where(misled, PATIENCE, self.waiting - 1)
        new = in_the_way & ~self.held & ~misled
        self.held |= new
        self.moving = (length > 0) | new.any(0) | misled
        self._look()
        self._write()
        found = self.solution
        found.iterations[self.at_work] += 1
        self.solution = replace(found, inner=found.inner + count)

    def _release(self) -> None:
        """Let go, once, of what frames hold that are in balance otherwise."""
        again = (self.imbalance <= self.options.tolerance) & ~self.released & self.held.any(0)
        if bool(again.any()):
            self.held &= ~again
            self.released |= again
            self._look()
            self._write()

    def _look(self) -> None:
        """Find the forces out of balance in the states that the search stands at."""
        gradient = self.potential.gradient(self.state.x, self.setting, self.state.met)
        self.gradient = gradient.masked_fill(self.held[:, None], 0)
        self.imbalance = self.potential.imbalance(self.gradient)

    def _write(self) -> None:
        """Write down where the frames at work have come to."""
        found, rows = self.solution, self.at_work
        found.x[..., rows], found.energy[rows] = self.state.x, self.state.energy
        found.imbalance[rows], found.held[rows] = self.imbalance, self.held.sum(0)


def newton_step(
    potential: Potential,
    state: State,
    setting: Setting,
    gradient: Tensor,
    inner: int,
    held: Tensor | None = None,
    whole: Tensor | None = None,
) -> tuple[Tensor, int]:
    """Return a direction (V, 3, N), zero in pinned and `held` (V, N) vertices, and the iterations it took.

    Along it the energy falls, but for frames (N,) whose `whole` Hessian is used: those may have no step at all.
    """
    right = -gradient[potential.free].float()
    z, count = potential.hessian(state.x, setting, state.met, held, whole).solve(right, REDUCTION, inner)
    step = torch.zeros_like(state.x)
    step[potential.free] = z.to(step.dtype)
    if held is not None:
        step = step.masked_fill(held[:, None], 0)
    longest = step.norm(dim=1).amax(0).clamp_min(torch.finfo(step.dtype).tiny)
    return step * (REACH * potential.size / longest).clamp(max=1), count


def line_search(
    potential: Potential, state: State, setting: Setting, gradient: Tensor, step: Tensor
) -> tuple[State, Tensor, Tensor]:
    """Return where the largest of 1, 1/2, 1/4 ... of a step takes each frame so that its energy falls enough.

    A frame whose energy falls with none of them stays. Also returned: which part of the step it was, 0 for those,
    shape (N,), and the vertices that stood in the way of more where it was little, shape (V, N).
    """
    slope = (gradient * step).sum((0, 1))
    found, left, length = state, (slope < 0).nonzero()[:, 0], 1.0
    lengths, in_the_way = torch.zeros_like(slope), torch.zeros_like(step[:, 0], dtype=torch.bool)
    for _ in range(HALVINGS):
        if not len(left):
            break
        trial = State.at(potential, (state.x + length * step)[..., left], setting.picked(left))
        fallen = trial.energy <= (state.energy + SUFFICIENT * length * slope)[left]
        rows = fallen.nonzero()[:, 0]
        if len(rows):
            found = found.replaced(left[rows], trial.picked(rows))
            lengths[left[rows]] = length
        if length <= CREEPING:
            cost = spoiling(potential, state.picked(left), trial, length * step[..., left])
            in_the_way[:, left] |= (cost > SPOILING * length * slope[left].abs()) & ~fallen
        left, length = left[~fallen], length / 2
    return found, lengths, in_the_way


def spoiling(potential: Potential, state: State, trial: State, moved: Tensor) -> Tensor:
    """Return what the collision of each vertex costs more in a trial than was to be expected [J], shape (V, N)."""
    if state.met is None:
        return torch.zeros_like(moved[:, 0])
    expected = potential.collision_at(state.met.expected(trial.x, moved))
    return potential.collision(trial.x, trial.met) - expected
