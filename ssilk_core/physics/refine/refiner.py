# SPDX-License-Identifier: Apache-2.0
"""Refine a rollout: iterations of the reference solver in each frame, starting from the network's state.

Each frame minimises the incremental potential of the simulator, implicit Euler on the training energy. Every
iteration lowers it. Cloth is then lifted off skin that still shows (`clearing`), as far as the frame's energy stays
below the network's. Inertia m/(2 dt^2) |x - target|^2 holds each frame x

- without feedback, where the network has it (a proximal step); drag looks back on the network's last frame. Going on
  from the network's two last frames doubles the jitter of loose cloth: 2 x' - x'' has up to three times the jitter of
  x. Frames do not depend on earlier refinements: many are refined at once, any part of a shot can be refined by
  itself, and errors do not accumulate.
- with feedback, to the course 2 x' - x'' of the two previous refined frames as they were before they were lifted, one
  frame after the other; several shots can advance at once. Each starts from the network's state, from that plus the
  last correction, or as a step of the simulator does, whichever has least energy: the network's course may differ
  from that of the refined cloth. What pressed in the refined frame before rubs (`simulate.friction`). With enough
  iterations this is the simulator.

Without feedback there is no friction: what slips is told by the frame before, which the solver does not have.

Garments beneath it are met where they are in each frame, and stay there (`simulate.over_cloth`).

The first frame of a shot, and after a cut, is quasi-static with feedback, and solved as the simulator does: the shot
goes on from it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...scene.assets import Floats, Motion, Scene, ShotWorld
from ...scene.fabrics import Fabric
from ...scene.kinematics import split_at_cuts
from ..collision.inner_cloth import InnerSurface, PosedBeneath
from ..simulate import SimulationOptions, Simulator
from ..simulate.characters import PosedCharacters
from ..simulate.friction import Friction
from ..simulate.history import StepHistory
from ..simulate.incremental_potential import StepInputs
from ..simulate.newton import SolverOptions, State, minimise_from, need_finite
from ..simulate.over_cloth import OverPotential
from ..world.surroundings import Surroundings
from .clearing import SkinClearing

QUASI_STATIC_ITERATIONS = SimulationOptions().quasi_static_solver.iterations


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How much a shot is refined.

    Attributes:
        iterations: maximum number of Newton iterations in each frame; those of the first one with feedback are not
            limited so.
        feedback: inertia follows the refined frames before, in place of holding a frame where the network has it.
        batch: frames refined at once; one with feedback.
        tolerance: see `SolverOptions`.
    """

    iterations: int
    feedback: bool = False
    batch: int = 16
    tolerance: float = SolverOptions.tolerance

    def __post_init__(self) -> None:
        if not self.batch > 0:
            fail("refinement", f"batch = {self.batch}", "at least 1 is needed")
        if not 0 < self.iterations <= 10_000:
            fail("refinement", f"{self.iterations} iterations", "1 to 10000 are allowed")

    @property
    def solver(self) -> SolverOptions:
        return SolverOptions(iterations=self.iterations, tolerance=self.tolerance)

    @property
    def first_solver(self) -> SolverOptions:
        """Options for the first frame of a shot."""
        if not self.feedback:
            return self.solver
        return SolverOptions(iterations=max(self.iterations, QUASI_STATIC_ITERATIONS), tolerance=self.tolerance)


@dataclass(frozen=True)
class FrameChange:
    """The change of one frame by refinement.

    Attributes:
        before, after: energy of the network's state and of the refined one [J]; without feedback that of inertia is
            zero before, and after it that of the step away from the network's state.
        inside_before, inside_after: share of the vertices inside the part of the body that they can touch
            (`collision.contacts`).
        moved: RMS displacement, weighted by mass [m].
        residual: RMS acceleration of the free mass by the remaining force [g], fixed vertices included.
    """

    before: float
    after: float
    inside_before: float
    inside_after: float
    moved: float
    residual: float


@dataclass(frozen=True, eq=False)
class RefinedFrame:
    """One frame of a shot: garment vertices in world space [m], float64, shape (V, 3), and its change."""

    points: Floats
    change: FrameChange


@dataclass(frozen=True, eq=False)
class _Tail:
    """Previous states of N shots for the next frames.

    Attributes:
        last: positions in the last frame in world space, shape (V, 3, N).
        before: the same one frame earlier, with feedback; None where there is none.
        root, lbs: root and garment under linear blend skinning in the last frame, shapes (3, N) and (V, 3, N).
        correction: displacement of the last frame by refinement, shape (V, 3, N).
        friction: of what presses in the last frame, with feedback; None without, and for cloth without friction.
    """

    last: Tensor
    before: Tensor | None
    root: Tensor
    lbs: Tensor
    correction: Tensor
    friction: Friction | None = None

    def first(self, count: int) -> _Tail:
        """Return those of the first shots."""
        before = None if self.before is None else self.before[..., :count]
        last, root, lbs = (values[..., :count] for values in (self.last, self.root, self.lbs))
        friction = self.friction and self.friction.select(torch.arange(count, device=last.device))
        return _Tail(last, before, root, lbs, self.correction[..., :count], friction)


class Refiner:
    """Refines shots of one garment.

    Args:
        scene: with the character's body.
        fps: of the shots.
        beneath: garments that it is worn over, which others move.
        device: where everything runs.
    """

    def __init__(
        self,
        scene: Scene,
        fabric: Fabric,
        options: RefineOptions,
        *,
        fps: float,
        beneath: Sequence[InnerSurface] = (),
        device: torch.device | str = "cpu",
    ) -> None:
        self.options = options
        settings = SimulationOptions(fps=fps, solver=options.solver)
        self.simulator = Simulator(scene, fabric, settings, beneath=beneath, device=device)
        self.potential = self.simulator.potential
        self.clearing = SkinClearing(scene, self.potential)

    def frames(
        self,
        motion: Motion,
        network: Iterable[Floats],
        world: ShotWorld | None = None,
        beneath: Iterable[Sequence[Floats]] = (),
    ) -> Iterator[RefinedFrame]:
        """Yield the refined frames of a shot.

        Args:
            motion: the character's, at the shot's frames.
            network: garment vertices of each frame in world space [m], shape (V, 3).
            world: what surrounds the character, from the motion's first frame on.
            beneath: vertices of the garments beneath in each frame in world space [m], shape (W, 3) each.

        Raises:
            SsilkError: the motion is at another rate, or a frame is not finite.
        """
        yield from self._spans(motion, iter(network), None, world, iter(beneath))

    def changes(
        self,
        motion: Motion,
        network: Iterable[Floats],
        refined: Iterable[Floats],
        world: ShotWorld | None = None,
        beneath: Iterable[Sequence[Floats]] = (),
    ) -> Iterator[FrameChange]:
        """Yield the changes of a shot that has been refined; arguments as for `frames`."""
        for frame in self._spans(motion, iter(network), iter(refined), world, iter(beneath)):
            yield frame.change

    @torch.no_grad()
    def _spans(
        self,
        motion: Motion,
        network: Iterator[Floats],
        refined_points: Iterator[Floats] | None,
        world: ShotWorld | None,
        beneath: Iterator[Sequence[Floats]],
    ) -> Iterator[RefinedFrame]:
        fps = self.simulator.options.fps
        if not abs(motion.fps - fps) < 1e-6:
            fail(motion.path, f"{motion.fps:g} frames per second", f"{fps:g} is needed")
        surroundings, first = self.simulator.surroundings([world]), 0
        for span in split_at_cuts(motion, self.simulator.poser.skeleton):
            yield from self._span(span, network, refined_points, surroundings, first, beneath)
            first += span.frame_count

    def _span(
        self,
        span: Motion,
        network: Iterator[Floats],
        refined_points: Iterator[Floats] | None,
        surroundings: Surroundings | None,
        first: int,
        beneath: Iterator[Sequence[Floats]],
    ) -> Iterator[RefinedFrame]:
        """Yield the frames of a motion without cuts, whose first is one of the shot's."""
        tail: _Tail | None = None
        for start, stop in _blocks(span.frame_count, 1 if self.options.feedback else self.options.batch):
            world = self._next_frames(network, stop - start)
            moves = self.simulator.poser.moves([(span, slice(start, stop))])
            poses = self.simulator.poser.pose(span.rotations[start:stop], span.translations[start:stop], moves)
            if surroundings is not None:
                places = [(0, (first + frame) / span.fps) for frame in range(start, stop)]
                poses = replace(poses, world=surroundings.around(places, poses.root, poses.lbs))
            given = None if refined_points is None else self._next_frames(refined_points, stop - start)
            below = self._beneath(beneath, stop - start, poses.root)
            frames, tail = self._refined(tail, world, poses, given, below)
            yield from frames

    @torch.no_grad()
    def shots_at_once(
        self, motions: Sequence[Motion], networks: Sequence[Iterable[Floats]]
    ) -> Iterator[list[RefinedFrame]]:
        """Yield each frame of several shots with feedback: of the first of them, those that have not ended.

        Args:
            motions: at the rate of the refinement, without cuts, by decreasing length.
            networks: garment vertices of each frame of each shot in world space [m], shape (V, 3).

        Raises:
            SsilkError: the refinement has no feedback, whose frames need no order, or the shots are not in theirs.
        """
        counts = [motion.frame_count for motion in motions]
        if not self.options.feedback or counts != sorted(counts, reverse=True):
            found = f"shots of {counts} frames, {'with' if self.options.feedback else 'without'} feedback"
            fail("refinement", found, "shots are refined at once with feedback, the longest first")
        tail, points = None, [iter(network) for network in networks]
        for number in range(motions[0].frame_count):
            running = [motion for motion in motions if motion.frame_count > number]
            world = torch.cat([self._next_frames(each, 1) for each in points[: len(running)]], dim=-1)
            rotations, translations = (
                np.stack([getattr(motion, name)[number] for motion in running])
                for name in ("rotations", "translations")
            )
            moves = self.simulator.poser.moves((motion, slice(number, number + 1)) for motion in running)
            poses = self.simulator.poser.pose(rotations, translations, moves)
            frames, tail = self._refined(tail and tail.first(len(running)), world, poses, None, None)
            yield list(frames)

    def _refined(
        self,
        tail: _Tail | None,
        world: Tensor,
        poses: PosedCharacters,
        given: Tensor | None,
        beneath: PosedBeneath | None,
    ) -> tuple[Iterator[RefinedFrame], _Tail]:
        """Refine frames of a shot, or with feedback one of each of several; return them and what the next ones need.

        Args:
            world: the network's positions (V, 3, N); given: those after refinement, where they are known.
            beneath: the garments beneath, where there are any.
        """
        past = self._history(tail, world, poses)
        inputs = replace(self.simulator.inputs(poses, past), beneath=beneath)
        if not self.options.feedback:
            inputs = replace(inputs, predicted=(world - poses.root).to(self.potential.dtype))
        before = State.at(self.potential, self.simulator.apply_pins(world - poses.root, poses), inputs)
        if given is None:
            solved = self._refine(before, tail, past, world, poses, inputs)
            refined = self.clearing.lift(solved, inputs, before.energy).double() + poses.root
            seen = solved.double() + poses.root  # what is lifted has no speed
        else:
            seen = refined = given
        return self._describe(before, inputs, refined, poses.root), self._tail(tail, world, seen, poses)

    def _next_frames(self, vertices: Iterator[Floats], count: int) -> Tensor:
        """Return the next frames' positions (V, 3, N)."""
        points = np.stack(list(islice(vertices, count)), axis=-1)
        return torch.as_tensor(points, dtype=torch.float64, device=self.potential.free.device)

    def _beneath(self, frames: Iterator[Sequence[Floats]], count: int, root: Tensor) -> PosedBeneath | None:
        """Return the garments beneath in the next frames, relative to the roots (3, N); None where there are none."""
        if not isinstance(self.potential, OverPotential):
            return None
        each = [np.stack(points, axis=-1) for points in zip(*islice(frames, count), strict=True)]
        return self.potential.posed(each, root)

    def _refine(
        self,
        before: State,
        tail: _Tail | None,
        past: StepHistory | None,
        world: Tensor,
        poses: PosedCharacters,
        inputs: StepInputs,
    ) -> Tensor:
        """Return the solver's positions relative to the roots (V, 3, N)."""
        start, solver = before.x, self.options.solver if tail else self.options.first_solver
        if tail and past and self.options.feedback:
            need_finite(before)  # the best of several starts may be finite where it is not
            corrected = self.simulator.apply_pins(world + tail.correction - poses.root, poses)
            starts = [start, corrected, *self.simulator.starts(poses, past, inputs)]
            start = self.simulator.potential.best_start(starts, inputs)
        return minimise_from(self.potential, start, inputs, solver).x

    def _history(self, tail: _Tail | None, world: Tensor, poses: PosedCharacters) -> StepHistory | None:
        """Return the previous states of consecutive frames."""
        if tail is None:
            return None if self.options.feedback else StepHistory(world, None, poses.root, poses.lbs)
        if self.options.feedback:
            return StepHistory(tail.last, tail.before, tail.root, tail.lbs, friction=tail.friction)
        earlier = ((tail.last, world), (tail.root, poses.root), (tail.lbs, poses.lbs))
        last, root, lbs = (torch.cat([first, rest[..., :-1]], dim=-1) for first, rest in earlier)
        return StepHistory(last, None, root, lbs)

    def _tail(self, tail: _Tail | None, world: Tensor, refined: Tensor, poses: PosedCharacters) -> _Tail:
        """Return the previous states for the frames after these."""
        correction = refined - world
        if self.options.feedback:
            x, dt = (refined - poses.root).to(self.potential.dtype), self.simulator.dt
            friction = self.potential.friction(x, poses.body, None, dt, poses.world)
            return _Tail(refined, tail.last if tail else None, poses.root, poses.lbs, correction, friction)
        return _Tail(world[..., -1:], None, poses.root[:, -1:], poses.lbs[..., -1:], correction[..., -1:])

    def _describe(self, before: State, inputs: StepInputs, refined: Tensor, root: Tensor) -> Iterator[RefinedFrame]:
        """Yield frames with their changes."""
        mass = self.potential.mass
        after = State.at(self.potential, (refined - root).to(before.x.dtype), inputs)
        inside = [self.potential.inside(state.x, state.body_distance) for state in (before, after)]
        moved = ((mass * ((after.x - before.x) ** 2).sum(1)).sum(0) / mass.sum()).sqrt()
        residual = self.potential.residual(self.potential.gradient(after.x, inputs, after.body_distance))
        figures = torch.stack([before.energy, after.energy, *inside, moved, residual], dim=1).tolist()
        for points, values in zip(refined.permute(2, 0, 1).cpu().numpy(), figures):
            yield RefinedFrame(points, FrameChange(*values))


def _blocks(count: int, size: int) -> Iterator[tuple[int, int]]:
    """Yield the blocks of frames; the first one, which lacks a previous state, is refined by itself."""
    yield 0, 1
    yield from ((start, min(start + size, count)) for start in range(1, count, size))


@dataclass
class RefinementMeans:
    """Means over the refined frames of a shot."""

    changes: list[FrameChange] = field(default_factory=list)

    def figures(self) -> dict[str, float]:
        """Return mean energies [J], shares and distances [m]."""
        mean = {
            name: float(np.mean([getattr(each, name) for each in self.changes])) for name in vars(self.changes[0])
        }
        return {
            "energy before [J]": mean["before"],
            "energy [J]": mean["after"],
            "inside the body before": mean["inside_before"],
            "inside the body": mean["inside_after"],
            "moved [m]": float(np.mean([each.moved**2 for each in self.changes])) ** 0.5,
        }
