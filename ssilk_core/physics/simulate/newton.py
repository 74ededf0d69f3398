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

Where cloth may not pass through cloth, each step is cut to what is known of near cloth, and then short before cloth
meets, vertex by vertex (`self_contact`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...errors import fail
from .. import kernels
from ..collision import SmoothedDistance
from ..framed import Framed
from ..self_contact import ClothNeighbours
from .blocks import BlockMatrix
from .incremental_potential import IncrementalPotential, StepInputs

ARMIJO = 1e-4  # required decrease relative to the slope
LENGTHS = tuple(0.5**halved for halved in range(12))  # of steps that are tried
AT_ONCE = 128  # frames and lengths after the first that a GPU tries at once, which takes no longer than one
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
class Solution(Framed):
    """Minima of N frames.

    Attributes:
        x: positions [m], shape (V, 3, N).
        energy: at x [J], shape (N,).
        residual: as in `SolverOptions.tolerance`, over vertices that are not fixed, shape (N,).
        iterations: Newton iterations, shape (N,).
        fixed: number of fixed vertices, shape (N,).
        cg_iterations: conjugate gradient iterations that a frame took part in, shape (N,).
        neighbours: which cloth may touch which at x, where inputs say so.
    """

    x: Tensor
    energy: Tensor
    residual: Tensor
    iterations: Tensor
    fixed: Tensor
    cg_iterations: Tensor
    neighbours: ClothNeighbours | None = None


@dataclass(frozen=True, eq=False)
class State(Framed):
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
        if potential.replays(x, inputs):
            energy, *planes = potential.captured.state(x, inputs.alone)
            energy = sum((part.energy(x) for part in inputs.touching), energy)
            return cls(x, SmoothedDistance(*planes) if planes else None, energy, inputs.neighbours)
        body_distance = potential.body_distance(x, inputs)
        return cls(x, body_distance, potential.energy(x, inputs, body_distance), inputs.neighbours)

    def tensors(self) -> list[Tensor]:
        """Return all tensors but those of the neighbours, frames last."""
        return [self.x, self.energy, *(self.body_distance.tensors() if self.body_distance else [])]

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
    search = Search(potential, start, inputs, options)
    left = search.leave()
    while len(search):
        search.advance()
        advanced()
        left += search.leave()
    order = torch.cat([frames for frames, _ in left]).argsort()
    found = Solution.concatenated([replace(each, neighbours=None) for _, each in left]).select(order)
    known = [(frames, each.neighbours) for frames, each in left if each.neighbours]
    return replace(found, neighbours=ClothNeighbours.joined(known)) if known else found


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


@dataclass(frozen=True, eq=False)
class _Course(Framed):
    """How the search for the minima of N frames goes.

    Attributes:
        moving: whether the last step improved a frame, shape (N,).
        fixed: fixed vertices, shape (V, N).
        cooldown: remaining iterations without the exact Hessian, shape (N,).
        released: frames whose fixed vertices have been released, shape (N,).
        iterations, cg_iterations: as in `Solution`.
    """

    moving: Tensor
    fixed: Tensor
    cooldown: Tensor
    released: Tensor
    iterations: Tensor
    cg_iterations: Tensor


class Search:
    """The search for the minima of several frames, which leave it when they are found; others may join.

    Attributes:
        frames: numbers by which frames are known, shape (N,).

    Raises:
        SsilkError: the energy of a start is not finite.
    """

    gradient: Tensor
    residual: Tensor

    def __init__(
        self,
        potential: IncrementalPotential,
        start: Tensor,
        inputs: StepInputs,
        options: SolverOptions,
        numbers: Sequence[int] | None = None,
    ) -> None:
        """Evaluate the starts of frames, which have the numbers from 0 on unless others are given."""
        self.potential, self.options = potential, options
        self.frames = torch.tensor(range(start.shape[-1]) if numbers is None else numbers, device=start.device)
        self.inputs = potential.with_contacts(start, inputs)
        self.state = State.at(potential, start, self.inputs)
        need_finite(self.state)
        count = torch.zeros_like(self.state.energy, dtype=torch.long)
        self.course = _Course(
            moving=torch.ones_like(count, dtype=torch.bool),
            fixed=torch.zeros_like(start[:, 0], dtype=torch.bool),
            cooldown=count,
            released=torch.zeros_like(count, dtype=torch.bool),
            iterations=count,
            cg_iterations=count,
        )
        self._evaluate()

    def __len__(self) -> int:
        """The number of frames that are searched."""
        return len(self.frames)

    def join(self, other: Search) -> None:
        """Go on with the frames of another search of the same potential, after its own."""
        self.state = State.concatenated([self.state, other.state])
        self.inputs = StepInputs.concatenated([self.inputs, other.inputs])
        self.course = _Course.concatenated([self.course, other.course])
        for name in ("gradient", "residual", "frames"):
            setattr(self, name, torch.cat([getattr(self, name), getattr(other, name)], dim=-1))

    def leave(self) -> list[tuple[Tensor, Solution]]:
        """Let frames leave that have converged, that no step improves, or that had all their iterations.

        Returns:
            The numbers of those that left (M,), with their solution, if there are any.
        """
        may = self.course.iterations < self.options.iterations
        self._release_fixed(may)
        stays = may & self.course.moving & (self.residual > self.options.tolerance)
        leaving = (~stays).nonzero()[:, 0]
        if not len(leaving):
            return []
        left = self.frames[leaving], self._solution(leaving)
        kept = stays.nonzero()[:, 0]
        self.state, self.inputs = self.state.select(kept), self.inputs.select(kept)
        self.course = self.course.select(kept)
        for name in ("gradient", "residual", "frames"):
            setattr(self, name, getattr(self, name)[..., kept])
        return [left]

    def _solution(self, rows: Tensor) -> Solution:
        """Return what is found for frames in places (M,)."""
        x, energy, residual = self.state.x[..., rows], self.state.energy[rows], self.residual[rows]
        course, known = self.course.select(rows), self.inputs.neighbours
        counts = course.iterations, course.fixed.sum(0), course.cg_iterations
        return Solution(x, energy, residual, *counts, known and known.select(rows))

    def advance(self) -> None:
        """Make one step."""
        potential, inputs, gradient, course = self.potential, self.inputs, self.gradient, self.course
        exact_hessian = (self.residual < EXACT_HESSIAN_BELOW) & (course.cooldown <= 0)
        step, count = newton_step(
            potential, self.state, inputs, gradient, self.options.cg_iterations, course.fixed, exact_hessian
        )
        if inputs.neighbours is not None:
            step = self._without_passing(inputs.neighbours, step)
            inputs = self.inputs
        self.state, length, obstructing = line_search(potential, self.state, inputs, gradient, step)
        misled = exact_hessian & (length < MISLED_BELOW)
        new = obstructing & ~course.fixed & ~misled
        self.course = replace(
            course,
            moving=(length > 0) | new.any(0) | misled,
            fixed=course.fixed | new,
            cooldown=torch.where(misled, COOLDOWN, course.cooldown - 1),
            iterations=course.iterations + 1,
            cg_iterations=course.cg_iterations + count,
        )
        self._evaluate()

    def _without_passing(self, known: ClothNeighbours, step: Tensor) -> Tensor:
        """Return a step in which cloth does not pass through cloth: slower at some vertices, or in whole frames."""
        x, gradient = self.state.x, self.gradient
        known, step, contacts = self.potential.self_contact.ahead(step, known)
        self.inputs, self.state = replace(self.inputs, neighbours=known), replace(self.state, neighbours=known)
        slowed = contacts.without_passing(x, step, YIELDING)
        steep = (gradient * slowed).sum((0, 1)) < DOWNHILL * (gradient * step).sum((0, 1))
        return torch.where(steep, slowed, contacts.allowed(x, step, YIELDING).amin(0) * step)

    def _release_fixed(self, may: Tensor) -> None:
        """Release the fixed vertices of frames (N,) that may, and whose other vertices have converged, once."""
        course = self.course
        again = may & (self.residual <= self.options.tolerance) & ~course.released & course.fixed.any(0)
        if bool(again.any()):
            self.course = replace(course, fixed=course.fixed & ~again, released=course.released | again)
            self._evaluate()

    def _evaluate(self) -> None:
        """Evaluate contacts of cloth with cloth, gradient and residual of the current states."""
        if self.inputs.neighbours is not None:
            around = replace(self.inputs, neighbours=self.state.neighbours)
            self.inputs = self.potential.with_contacts(self.state.x, around, moved=True)
        x, inputs, distance = self.state.x, self.inputs, self.state.body_distance
        if self.potential.replays(x, inputs):
            (gradient,) = self.potential.captured.gradient(x, inputs.alone, distance)
            gradient = sum((part.gradient(x) for part in inputs.touching), gradient)
        else:
            gradient = self.potential.gradient(x, inputs, distance)
        self.gradient = gradient.masked_fill(self.course.fixed[:, None], 0)
        self.residual = self.potential.residual(self.gradient)


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
    x, others = state.x, (state.body_distance, fixed, exact_hessian)
    if potential.replays(x, inputs):
        touching = potential.touching_stiffness(x, inputs)
        added = None if touching is None else touching.diagonal
        blocks, inverse = potential.captured.hessian(x, inputs.alone, added, *others)
        matrix = BlockMatrix(potential.block_pattern, blocks, touching, inverse)
    else:
        matrix = potential.hessian(x, inputs, *others)
    z, count = matrix.solve(right, reduction, cg_iterations)
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
    found, left = state, (slope < 0).nonzero()[:, 0]
    lengths, obstructing = torch.zeros_like(slope), torch.zeros_like(step[:, 0], dtype=torch.bool)
    at_once, tried = kernels.available(slope.device) and inputs.neighbours is None, 0
    while len(left) and tried < len(LENGTHS):
        count = max(1, AT_ONCE // len(left)) if tried and at_once else 1
        several = LENGTHS[tried : tried + count]
        tried += count
        length, rows = slope.new_tensor(several).repeat_interleave(len(left)), left.repeat(len(several))
        moved = length * step[..., rows]
        x = state.x[..., rows] + moved
        around = StepInputs.concatenated([inputs.select(left)] * len(several))
        trial = State.at(potential, x, potential.with_contacts(x, around))
        fallen = trial.energy <= state.energy[rows] + ARMIJO * length * slope[rows]
        fallen = fallen.view(len(several), -1)
        done = fallen.any(0)
        columns = done.nonzero()[:, 0]
        if len(columns):
            longest = fallen.int().argmax(0)[columns] * len(left) + columns
            found = found.replace_frames(left[columns], trial.select(longest))
            lengths[left[columns]] = length[longest]
        if several[-1] <= SHORT_STEP:
            cost = excess_collision(potential, state.select(rows), trial, moved)
            longer = (fallen.cumsum(0) == 0).flatten() & (length <= SHORT_STEP)
            obstructs = (cost > OBSTRUCTING * length * slope[rows].abs()) & longer
            obstructing[:, left] |= obstructs.view(len(cost), len(several), -1).any(1)
        left = left[~done]
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
