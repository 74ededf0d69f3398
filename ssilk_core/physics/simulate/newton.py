# SPDX-License-Identifier: Apache-2.0
"""Newton's method with conjugate gradients, for many frames at once.

Each iteration solves the linear system to a tenth of the residual; a backtracking line search with Armijo's condition
follows. Distances to the body are recomputed for every state, also in the line search. The energy of a frame
therefore never rises.

Far from the minimum the Hessian is projected to be positive semi-definite. Near it the exact Hessian of the membrane
is tried, because cloth that is about to buckle converges much faster with it. If it leads to a short step, the frame
uses the projected Hessian for some iterations.

Where a body intersects itself, the nearest surface changes sides and the energy jumps. The gradient does not show
that, and one vertex at such a jump would stop its whole garment. When only a short step lowers the energy, the
vertices whose energy rises more than predicted are fixed and the others move on. Once these have converged, all fixed
vertices are released, once.

Where cloth may not pass through cloth, each step is cut short before it does, vertex by vertex (`self_contact`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...errors import fail
from ..collision import SmoothedDistance
from ..self_contact import ClothContacts, ClothNeighbours
from .incremental_potential import IncrementalPotential, StepInputs

ARMIJO = 1e-4  # required decrease relative to the slope
MAX_BACKTRACKS = 12
REDUCTION = 0.1  # of the residual by each linear solve
MAX_DISPLACEMENT = 0.1  # of a vertex in one step, relative to the garment's size: a bound on inexact solutions
SHORT_STEP = 0.25  # step length from which on obstructing vertices are fixed
YIELDING = 1e-3  # [m] by which any two layers may come nearer in a step: what presses hard yields a little
DOWNHILL = 0.1  # of the predicted decrease that slowed vertices must keep
OBSTRUCTING = 0.1  # share of the predicted decrease that an obstructing vertex consumes
EXACT_HESSIAN_BELOW = 2.0  # [g] of residual
MISLED_BELOW = 0.25  # a shorter step means that the exact Hessian misled the frame
COOLDOWN = 4  # iterations without the exact Hessian after that


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """When a frame counts as converged.

    Attributes:
        tolerance: bound of the residual, the RMS acceleration that the gradient would give the free mass, in units of
            g. Inertia makes the Hessian at least m/dt^2, so the distance to the minimum is at most tolerance g dt^2,
            0.1 mm for the default at 30 frames per second, and the energy above the minimum at most
            m (tolerance g dt)^2 / 2, 1e-6 J.
        iterations: maximum number of Newton iterations.
        cg_iterations: maximum number of conjugate gradient iterations in each.
    """

    tolerance: float = 1e-2
    iterations: int = 100
    cg_iterations: int = 200

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < float("inf"):
            fail("solver", f"tolerance = {self.tolerance}", "it must be positive")
        for name in ("iterations", "cg_iterations"):
            if not getattr(self, name) > 0:
                fail("solver", f"{name} = {getattr(self, name)}", "at least 1 is needed")


@dataclass(frozen=True, eq=False)
class Solution:
    """Minima of N frames.

    Attributes:
        x: positions [m], shape (V, 3, N).
        energy: at x [J], shape (N,).
        residual: as in `SolverOptions.tolerance`, over vertices that are not fixed, shape (N,).
        iterations: Newton iterations, shape (N,).
        fixed: number of fixed vertices, shape (N,).
        cg_iterations: conjugate gradient iterations, each for all active frames.
        neighbours: which cloth may touch which at x, where inputs say so.
    """

    x: Tensor
    energy: Tensor
    residual: Tensor
    iterations: Tensor
    fixed: Tensor
    cg_iterations: int
    neighbours: ClothNeighbours | None = None

    def replace_frames(self, frames: Tensor, other: Solution) -> Solution:
        """Return the solution with frames (M,), in ascending order, from another; iterations are those of both."""
        x, energy, residual, fixed = (
            getattr(self, name).index_copy(-1, frames, getattr(other, name))
            for name in ("x", "energy", "residual", "fixed")
        )
        neighbours, iterations = self.neighbours, self.iterations.index_add(-1, frames, other.iterations)
        if neighbours and other.neighbours:
            neighbours = neighbours.replace_frames(frames, other.neighbours)
        count = self.cg_iterations + other.cg_iterations
        return Solution(x, energy, residual, iterations, fixed, count, neighbours)


@dataclass(frozen=True, eq=False)
class State:
    """Positions of N frames with their distances and energies.

    Attributes:
        x: positions [m], shape (V, 3, N).
        body_distance: their distances to the body.
        energy: [J], shape (N,).
        neighbours: which cloth may touch which around them, where inputs say so.
    """

    x: Tensor
    body_distance: SmoothedDistance | None
    energy: Tensor
    neighbours: ClothNeighbours | None = None

    @classmethod
    def at(cls, potential: IncrementalPotential, x: Tensor, inputs: StepInputs) -> State:
        """Return the state of positions (V, 3, N)."""
        body_distance = potential.body_distance(x, inputs)
        return cls(x, body_distance, potential.energy(x, inputs, body_distance), inputs.neighbours)

    def tensors(self) -> list[Tensor]:
        """Return all tensors but those of the neighbours, frames last."""
        return [self.x, self.energy, *(self.body_distance.tensors() if self.body_distance else [])]

    def select(self, frames: Tensor) -> State:
        """Return the state of the frames with indices (M,)."""
        return State(
            self.x[..., frames],
            self.body_distance and self.body_distance.select(frames),
            self.energy[frames],
            self.neighbours and self.neighbours.select(frames),
        )

    def replace_frames(self, frames: Tensor, other: State) -> State:
        """Return the state with frames (M,) replaced by those of another state."""
        x, energy, *body_distance = (
            own.index_copy(-1, frames, new) for own, new in zip(self.tensors(), other.tensors(), strict=True)
        )
        neighbours = self.neighbours
        if neighbours and other.neighbours:
            neighbours = neighbours.replace_frames(frames, other.neighbours)
        return State(x, SmoothedDistance(*body_distance) if body_distance else None, energy, neighbours)


@torch.no_grad()
def minimise_from(
    potential: IncrementalPotential,
    start: Tensor,
    inputs: StepInputs,
    options: SolverOptions,
    advanced: Callable[[], object] = lambda: None,
) -> Solution:
    """Minimise the energy of each frame over the free vertices; no frame ends higher than it starts.

    Args:
        start: initial positions, with pinned vertices in place, shape (V, 3, N).
        advanced: called after each iteration.

    Raises:
        SsilkError: the energy of the start is not finite.
    """
    search = _Search(potential, start, inputs, options)
    for _ in range(options.iterations):
        if not search.drop_finished():
            break
        search.advance()
        advanced()
    return search.ended()


def need_finite(first: State) -> None:
    """Raise `SsilkError` where a frame's first state has no finite energy."""
    bad = int((~first.energy.isfinite()).sum())
    if bad != 0:
        fail(
            "simulation",
            f"the first state of {bad} of {len(first.energy)} frames has no finite energy",
            "positions, body and time step must be finite",
            "look for NaN in stage and motion",
        )


class _Search:
    """The search of `minimise_from`: the active frames, and the best state of every frame.

    Attributes:
        fixed: fixed vertices, shape (V, N).
        cooldown: remaining iterations without the exact Hessian, shape (N,).
        released: frames whose fixed vertices have been released, shape (N,).
        left: which cloth may touch which in frames that are looked at no more, each with the indices of its frames.
    """

    gradient: Tensor
    residual: Tensor

    def __init__(
        self, potential: IncrementalPotential, start: Tensor, inputs: StepInputs, options: SolverOptions
    ) -> None:
        self.potential, self.options = potential, options
        self.inputs = potential.with_contacts(start, inputs)
        self.state = State.at(potential, start, self.inputs)
        need_finite(self.state)
        energy = self.state.energy
        self.active = torch.arange(len(energy), device=start.device)
        self.moving = torch.ones_like(energy, dtype=torch.bool)
        self.fixed = torch.zeros_like(start[:, 0], dtype=torch.bool)
        self.cooldown, self.released = torch.zeros_like(self.active), torch.zeros_like(self.moving)
        self.left: list[tuple[Tensor, ClothNeighbours]] = []
        self._evaluate()
        iterations = torch.zeros_like(self.active)
        found = start.clone(), energy.clone(), self.residual.clone()
        self.solution = Solution(*found, iterations, iterations.clone(), 0)

    def drop_finished(self) -> bool:
        """Drop frames that have converged or that no step improves; return whether any remains."""
        self._release_fixed()
        keeps = self.moving & (self.residual > self.options.tolerance)
        kept = keeps.nonzero()[:, 0]
        self._leave((~keeps).nonzero()[:, 0])
        if 0 < len(kept) < len(self.active):
            self.state, self.inputs = self.state.select(kept), self.inputs.select(kept)
            for name in ("gradient", "fixed", "active", "residual", "cooldown", "released"):
                setattr(self, name, getattr(self, name)[..., kept])
        return len(kept) > 0

    def advance(self) -> None:
        """Make one step."""
        potential, inputs, gradient = self.potential, self.inputs, self.gradient
        exact_hessian = (self.residual < EXACT_HESSIAN_BELOW) & (self.cooldown <= 0)
        step, count = newton_step(
            potential, self.state, inputs, gradient, self.options.cg_iterations, self.fixed, exact_hessian
        )
        if inputs.contacts is not None:
            step = self._without_passing(inputs.contacts, step)
        self.state, length, obstructing = line_search(potential, self.state, inputs, gradient, step)
        misled = exact_hessian & (length < MISLED_BELOW)
        self.cooldown = torch.where(misled, COOLDOWN, self.cooldown - 1)
        new = obstructing & ~self.fixed & ~misled
        self.fixed |= new
        self.moving = (length > 0) | new.any(0) | misled
        self._evaluate()
        self._record()
        found = self.solution
        found.iterations[self.active] += 1
        self.solution = replace(found, cg_iterations=found.cg_iterations + count)

    def _without_passing(self, contacts: ClothContacts, step: Tensor) -> Tensor:
        """Return a step in which cloth does not pass through cloth: slower at some vertices, or in whole frames."""
        slowed = contacts.without_passing(self.state.x, step, YIELDING)
        steep = (self.gradient * slowed).sum((0, 1)) < DOWNHILL * (self.gradient * step).sum((0, 1))
        return torch.where(steep, slowed, contacts.allowed(self.state.x, step, YIELDING).amin(0) * step)

    def ended(self) -> Solution:
        """Return the solution after the last step."""
        if self.inputs.neighbours is None:
            return self.solution
        if sum(len(frames) for frames, _ in self.left) < len(self.solution.energy):
            self._leave(torch.arange(len(self.active), device=self.active.device))
        return replace(self.solution, neighbours=ClothNeighbours.joined(self.left))

    def _leave(self, frames: Tensor) -> None:
        """Keep which cloth may touch which in active frames that are looked at no more."""
        if self.inputs.neighbours is not None and len(frames):
            self.left.append((self.active[frames], self.inputs.neighbours.select(frames)))

    def _release_fixed(self) -> None:
        """Release the fixed vertices of frames whose other vertices have converged, once."""
        again = (self.residual <= self.options.tolerance) & ~self.released & self.fixed.any(0)
        if bool(again.any()):
            self.fixed &= ~again
            self.released |= again
            self._evaluate()
            self._record()

    def _evaluate(self) -> None:
        """Evaluate contacts of cloth with cloth, gradient and residual of the current states."""
        if self.inputs.neighbours is not None:
            around = replace(self.inputs, neighbours=self.state.neighbours)
            self.inputs = self.potential.with_contacts(self.state.x, around, moved=True)
        gradient = self.potential.gradient(self.state.x, self.inputs, self.state.body_distance)
        self.gradient = gradient.masked_fill(self.fixed[:, None], 0)
        self.residual = self.potential.residual(self.gradient)

    def _record(self) -> None:
        """Record the current states of the active frames."""
        found, rows = self.solution, self.active
        found.x[..., rows], found.energy[rows] = self.state.x, self.state.energy
        found.residual[rows], found.fixed[rows] = self.residual, self.fixed.sum(0)


def newton_step(
    potential: IncrementalPotential,
    state: State,
    inputs: StepInputs,
    gradient: Tensor,
    cg_iterations: int,
    fixed: Tensor | None = None,
    exact_hessian: Tensor | None = None,
    reduction: float = REDUCTION,
) -> tuple[Tensor, int]:
    """Return a direction (V, 3, N), zero at pinned and `fixed` (V, N) vertices, and the iterations of the solve.

    It is a descent direction, except possibly in frames that use the `exact_hessian` (N,). The linear system is
    solved until its residual has fallen to `reduction`.
    """
    right = -gradient[potential.free].float()
    z, count = potential.hessian(state.x, inputs, state.body_distance, fixed, exact_hessian).solve(
        right, reduction, cg_iterations
    )
    step = torch.zeros_like(state.x)
    step[potential.free] = z.to(step.dtype)
    if fixed is not None:
        step = step.masked_fill(fixed[:, None], 0)
    longest = step.norm(dim=1).amax(0).clamp_min(torch.finfo(step.dtype).tiny)
    return step * (MAX_DISPLACEMENT * potential.size / longest).clamp(max=1), count


def line_search(
    potential: IncrementalPotential, state: State, inputs: StepInputs, gradient: Tensor, step: Tensor
) -> tuple[State, Tensor, Tensor]:
    """Backtrack from a full step until the energy of each frame meets Armijo's condition.

    Returns:
        The states, the accepted step lengths (N,), 0 for frames that stay, and the vertices that obstruct longer
        steps where the length is small (V, N).
    """
    slope = (gradient * step).sum((0, 1))
    found, left, length = state, (slope < 0).nonzero()[:, 0], 1.0
    lengths, obstructing = torch.zeros_like(slope), torch.zeros_like(step[:, 0], dtype=torch.bool)
    for _ in range(MAX_BACKTRACKS):
        if not len(left):
            break
        x = (state.x + length * step)[..., left]
        trial = State.at(potential, x, potential.with_contacts(x, inputs.select(left)))
        fallen = trial.energy <= (state.energy + ARMIJO * length * slope)[left]
        rows = fallen.nonzero()[:, 0]
        if len(rows):
            found = found.replace_frames(left[rows], trial.select(rows))
            lengths[left[rows]] = length
        if length <= SHORT_STEP:
            cost = excess_collision(potential, state.select(left), trial, length * step[..., left])
            obstructing[:, left] |= (cost > OBSTRUCTING * length * slope[left].abs()) & ~fallen
        left, length = left[~fallen], length / 2
    return found, lengths, obstructing


def excess_collision(potential: IncrementalPotential, state: State, trial: State, moved: Tensor) -> Tensor:
    """Return by how much the collision energy in a trial exceeds its second-order prediction [J], (V, N).

    That of a sample is distributed to those of its corners that are free.
    """
    if state.body_distance is None:
        return torch.zeros_like(moved[:, 0])
    positions = potential.cloth.positions
    expected = potential.collision_at(state.body_distance.expected(positions(trial.x), positions(moved)))
    excess = (potential.collision(trial.x, trial.body_distance) - expected).clamp_min(0)
    found = torch.zeros_like(moved[:, 0])
    found[potential.free] = potential.cloth.to_vertices(excess[:, None])[potential.free, 0]
    return found
