# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton over a model's latents on the simulator's incremental potential, for many frames at once.

Each frame minimises E(x(z)) over its latents z, within the bound of the model's states. An iteration solves

    (J'H_x J + D) s = -J' dE/dx

with the Jacobian J = dx/dz of the decoder (`free_decoder`) and the projected Hessian H_x of the simulator, tries a
few dampings D and lengths of s together, and takes the one with the least energy. Where none has less, the frame
stays, and the next iteration damps more. So no frame ever has more energy than the best of its starts. The result is
a latent: what a shot stores of it are joints and blendshapes of the model, and nothing is fitted.

On few elements (`elements`) E is their weighted sum, and the body is queried once before each iteration. No iteration
adds to that sum, with the body as it was found; between two iterations a new query may, and nothing bounds the energy
of the whole garment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ...physics.collision import SmoothedDistance
from ...physics.constants import GRAVITY
from ...physics.simulate.cubature import Cubature
from ...physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ..model.network import GarmentModel
from .free_decoder import DecodedPoints, FreeDecoder
from .normal_equations import NormalEquations, reduce_forces
from .options import LatentOptions

# Factors of a frame's damping, each of which is tried, and the length of the step. States curve: more damping often
# finds less energy than a shorter step.
TRIALS = ((1.0, 1.0), (0.1, 1.0), (10.0, 1.0), (100.0, 1.0), (100.0, 0.25))
DAMPINGS = tuple(dict.fromkeys(factor for factor, _ in TRIALS))  # each of which is solved for once
ADAPTED = 0.5  # the exponent of the best trial's factor, by which a frame's damping changes
TIGHTENED = 100.0  # the factor where no trial was good
DAMPING_RANGE = (1e-6, 1e9)
ALLOWANCE = 0.02  # [m] that sampled cloth may come nearer to the body in an iteration, and be seen
ROUNDING = 8  # units in the last place of an energy that are not told apart


@dataclass(frozen=True, eq=False)
class LatentSolution:
    """Minima of N frames.

    Attributes:
        z: latents, shape (N, m).
        x: positions of the potential's vertices [m], pinned ones under linear blend skinning, shape (V, 3, N).
        energy, start_energy: at x, and at the best of the starts [J], shape (N,).
        left: by how much the quadratic model says that the energy could still fall [J], shape (N,); with the forces
            at x, and the Jacobian and Hessian of the last iteration.
        step_left: how far the cloth may still move to the model's minimum, at most (RMS over the mass) [m], shape
            (N,): a step d promises at least m d^2 / (2 dt^2), its inertia alone.
        allowed: what may be left of a frame that has converged [J], shape (N,).
        failed: the last line search found nothing lower although there was more to gain, shape (N,).
        iterations: that moved the frame, shape (N,).
    """

    z: Tensor
    x: Tensor
    energy: Tensor
    start_energy: Tensor
    left: Tensor
    step_left: Tensor
    allowed: Tensor
    failed: Tensor
    iterations: Tensor

    @property
    def converged(self) -> Tensor:
        """Which frames have converged, shape (N,)."""
        return self.left <= self.allowed

    @property
    def left_share(self) -> Tensor:
        """What is left, of that and what was gained [1], shape (N,): zero at a minimum, one where nothing moved."""
        gained = (self.start_energy - self.energy).double().clamp_min(0)
        return self.left / (gained + self.left).clamp_min(torch.finfo(torch.float64).tiny)

    def where(self, chosen: Tensor, other: LatentSolution) -> LatentSolution:
        """Return the solution with the frames `chosen` (N,) of another one."""

        def pick(name: str) -> Tensor:
            own, new = getattr(self, name), getattr(other, name)
            return torch.where(chosen[:, None] if name == "z" else chosen, new, own)

        return LatentSolution(**{item.name: pick(item.name) for item in fields(self)})


@dataclass(frozen=True, eq=False)
class _State:
    """Latents (N, m), their positions (V, 3, N), the distances of these, and energies (N,)."""

    z: Tensor
    x: Tensor
    distance: SmoothedDistance | None
    energy: Tensor

    def select(self, frames: Tensor) -> _State:
        """Return the state of the frames with indices (M,)."""
        distance = self.distance and self.distance.select(frames)
        return _State(self.z[frames], self.x[..., frames], distance, self.energy[frames])

    def where(self, chosen: Tensor, other: _State) -> _State:
        """Return the state with the frames `chosen` (N,) of another one."""
        distance = self.distance
        if distance is not None and other.distance is not None:
            pairs = zip(distance.tensors(), other.distance.tensors())
            distance = SmoothedDistance(*(torch.where(chosen, new, old) for old, new in pairs))
        return _State(
            torch.where(chosen[:, None], other.z, self.z),
            torch.where(chosen, other.x, self.x),
            distance,
            torch.where(chosen, other.energy, self.energy),
        )


class LatentSolver:
    """Minimises the energy of frames over the latents of a model.

    Args:
        model: on the device to use.
        potential: of its garment, in the precision to use.
        cubature: on whose vertices the potential is; all by default.
    """

    def __init__(
        self,
        model: GarmentModel,
        potential: IncrementalPotential,
        options: LatentOptions,
        cubature: Cubature | None = None,
    ) -> None:
        self.potential, self.options, free = potential, options, potential.free
        self.sampled = cubature is not None
        if cubature is not None:
            free = torch.as_tensor(cubature.vertices, device=free.device)[free]
        self.decoder = FreeDecoder(model, free, potential.dtype)
        self.bound = model.config.latent_bound or torch.inf
        self.free_mass = potential.mass[potential.free, 0]

    def decode(self, z: Tensor, character: Tensor, inputs: StepInputs) -> Tensor:
        """Return positions (V, 3, N) of latents (N, m), with pinned vertices under linear blend skinning."""
        assert inputs.skinned is not None
        return inputs.skinned.index_copy(0, self.potential.free, self.decoder.positions(z, character))

    @torch.no_grad()
    def solve(
        self, starts: Sequence[Tensor], character: Tensor, inputs: StepInputs, iterations: int | None = None
    ) -> LatentSolution:
        """Minimise each frame from the start with the least energy.

        Args:
            starts: latents, each (N, m); it takes the least time where the first is the best.
            character: skinning matrices of the character's joints, in the coordinates of `inputs`, (J, 3, 4, N).
            inputs: of the energy, with the garment under linear blend skinning.
            iterations: those of the options by default.
        """
        search = _LatentSearch(self, self._best(starts, character, inputs), character, inputs)
        for _ in range(self.options.iterations if iterations is None else iterations):
            if not search.advance():
                break
        return search.solution()

    @torch.no_grad()
    def given(self, z: Tensor, character: Tensor, inputs: StepInputs) -> LatentSolution:
        """Return latents (N, m) as they are, as a solution that has not converged."""
        state = self._state(z, character, inputs)
        energy, none = state.energy, torch.zeros_like(state.energy, dtype=torch.long)
        left = torch.full_like(energy, torch.inf, dtype=torch.float64)
        failed = torch.zeros_like(none, dtype=torch.bool)
        return LatentSolution(z, state.x, energy, energy, left, left, torch.zeros_like(left), failed, none)

    def allowed(self, energy: Tensor, dt: float | Tensor) -> Tensor:
        """Return what may be left of frames that have converged [J], (N,); their `energy` resolves nothing finer."""
        resolved = ROUNDING * torch.finfo(energy.dtype).eps * energy.abs().double()
        tolerance = 0.5 * self.free_mass.sum().double() * (self.options.tolerance * GRAVITY * dt) ** 2
        return torch.maximum(resolved, tolerance)

    def equations(self, z: Tensor, character: Tensor, inputs: StepInputs) -> NormalEquations:
        """Return the quadratic model of the energy about latents (N, m)."""
        return self._model(self._state(z, character, inputs), character, inputs)[1]

    def _model(self, state: _State, character: Tensor, inputs: StepInputs) -> tuple[DecodedPoints, NormalEquations]:
        potential = self.potential
        decoded = self.decoder.linearise(state.z, character)
        gradient = potential.gradient(state.x, inputs, state.distance)[potential.free]
        hessian = potential.hessian(state.x, inputs, state.distance)
        return decoded, NormalEquations.of(decoded.jacobian, gradient, hessian, self.free_mass / inputs.dt**2)

    def _state(self, z: Tensor, character: Tensor, inputs: StepInputs, near: _State | None = None) -> _State:
        """Return the state of latents; one that is `near`, of the same frames, saves time."""
        return self._queried(z, self.decode(z, character, inputs), inputs, near)

    def _queried(self, z: Tensor, x: Tensor, inputs: StepInputs, near: _State | None = None) -> _State:
        """Return the state of latents whose positions are known."""
        potential = self.potential
        if self.sampled:
            distance = potential.body_distance(x, inputs, ALLOWANCE)
        elif near is None:
            distance = potential.body_distance(x, inputs)
        else:
            distance = potential.body_distance_nearby(x, inputs, near.distance, near.x)
        return self._with_energy(z, x, inputs, distance)

    def _on_planes(self, z: Tensor, character: Tensor, inputs: StepInputs, of: _State) -> _State:
        """Return the state of latents with the distances to the body's planes at another state, without a query."""
        return self._with_energy(z, self.decode(z, character, inputs), inputs, of.distance)

    def _with_energy(self, z: Tensor, x: Tensor, inputs: StepInputs, distance: SmoothedDistance | None) -> _State:
        energy = self.potential.energy(x, inputs, distance)
        return _State(z, x, distance, energy.nan_to_num(nan=torch.inf))

    def _best(self, starts: Sequence[Tensor], character: Tensor, inputs: StepInputs) -> _State:
        first, *others = (start.to(self.potential.dtype).clamp(-self.bound, self.bound) for start in starts)
        best = self._state(first, character, inputs)
        for z in others:
            state = self._on_planes(z, character, inputs, best)
            if not self.sampled:
                if not self.options.exact_contact and not bool((state.energy < best.energy).any()):
                    continue
                state = self._queried(z, state.x, inputs, best)
            best = best.where(state.energy < best.energy, state)
        return best


class _LatentSearch:
    """The search of `LatentSolver.solve`."""

    decoded: DecodedPoints
    model: NormalEquations

    def __init__(self, solver: LatentSolver, start: _State, character: Tensor, inputs: StepInputs) -> None:
        self.solver, self.state, self.start = solver, start, start
        self.character, self.inputs = character, inputs
        self.allowed = solver.allowed(start.energy, inputs.dt)
        self.damping = torch.full_like(start.energy, solver.options.damping, dtype=torch.float64)
        self.stale = True
        self.failed = torch.zeros_like(start.energy, dtype=torch.bool)
        self.iterations = torch.zeros_like(start.energy, dtype=torch.long)

    def advance(self) -> bool:
        """Make one step; return whether another may gain anything."""
        if self.stale:
            if self.solver.sampled and bool(self.iterations.any()):
                self.state = self.solver._queried(self.state.z, self.state.x, self.inputs)
            self.decoded, self.model = self.solver._model(self.state, self.character, self.inputs)
            self.stale = False
        factors = self.damping.new_tensor([factor for factor, _ in TRIALS])
        usual = torch.full_like(self.damping, self.solver.options.damping)
        dampings = self.damping.new_tensor(DAMPINGS)[:, None] * self.damping
        steps, promised = self.model.steps(torch.cat([dampings, usual[None]]), self._held(self.model.gradient))
        wanted = promised[-1] > self.allowed
        steps = torch.stack([steps[DAMPINGS.index(factor)] for factor, _ in TRIALS])
        if not bool(wanted.any()):
            return False
        found, trial = self._least(steps)
        lower = wanted & (found.energy < self.state.energy)
        if not (self.solver.options.exact_contact or self.solver.sampled):
            found = self.solver._queried(found.z, found.x, self.inputs, self.state)
            lower &= found.energy < self.state.energy
        self.state, self.stale = self.state.where(lower, found), bool(lower.any())
        self.failed, self.iterations = wanted & ~lower, self.iterations + lower
        change = torch.where(lower, factors[trial] ** ADAPTED, TIGHTENED)
        self.damping = torch.where(wanted, (self.damping * change).clamp(*DAMPING_RANGE), self.damping)
        return True

    def _least(self, steps: Tensor) -> tuple[_State, Tensor]:
        """Return the states of least energy among all trials of the steps (T, N, m), and which these are (N,)."""
        solver, frames, count = self.solver, len(self.state.z), len(TRIALS)
        lengths = steps.new_tensor([length for _, length in TRIALS])[:, None, None]
        z = (self.state.z + (lengths * steps).to(self.state.z.dtype)).clamp(-solver.bound, solver.bound)
        every = torch.arange(frames, device=z.device).repeat(count)
        character, z = self.character[..., every], z.flatten(0, 1)
        if solver.options.exact_contact and not solver.sampled:
            tried = solver._state(z, character, self.inputs.select(every), self.state.select(every))
        else:
            inputs = replace(self.inputs, body=None).select(every)
            tried = solver._on_planes(z, character, inputs, self.state.select(every))
        best = tried.energy.reshape(count, frames).argmin(0)
        return tried.select(best * frames + every[:frames]), best

    def _held(self, gradient: Tensor) -> Tensor:
        """Return which latents lie on the bound, with a force that presses them against it, shape (N, m)."""
        z, bound = self.state.z, self.solver.bound
        return ((z >= bound) & (gradient < 0)) | ((z <= -bound) & (gradient > 0))

    def solution(self) -> LatentSolution:
        """Return what was found."""
        potential, state = self.solver.potential, self.state
        model = self.model
        if self.stale:
            gradient = potential.gradient(state.x, self.inputs, state.distance)[potential.free]
            model = replace(model, gradient=reduce_forces(self.decoded.jacobian, gradient))
        damping = self.damping.new_full((1, len(state.z)), self.solver.options.damping)
        left = model.steps(damping, self._held(model.gradient))[1][0]
        return LatentSolution(
            z=state.z,
            x=state.x,
            energy=state.energy,
            start_energy=self.start.energy,
            left=left,
            step_left=(2 * left.clamp_min(0) / self.solver.free_mass.sum().double()).sqrt() * self.inputs.dt,
            allowed=self.allowed,
            failed=self.failed,
            iterations=self.iterations,
        )
