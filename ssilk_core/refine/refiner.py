# SPDX-License-Identifier: Apache-2.0
"""Refine a rollout: some iterations of the reference solver in each frame, from where the network has the garment.

Each frame minimises what the simulator does, implicit Euler on the training energy. No step is taken that does not
lower it: a refined frame never has more energy than the network's, and less with every iteration more, until it is
solved. What inertia looks back on is a choice:

- without feedback, the network's two frames before. Frames do not depend on what was refined before them: many are
  refined at once, any stretch of a shot comes out alike by itself, and nothing can build up.
- with feedback, the refined frames before, one after the other; each starts from the network's state as it is or
  carrying the last correction, whichever has less energy. With iterations without end this is the simulator.

The first frame of a shot, and after a cut, is quasi-static with feedback; without, it looks back on itself at rest:
it alone would be free of inertia otherwise, and the next frame would jump back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from ..assets import Floats, Motion, Scene
from ..errors import fail
from ..fabrics import Fabric
from ..kinematics import split_at_cuts
from ..simulate import SimulationOptions, Simulator
from ..simulate.characters import PosedCharacters
from ..simulate.incremental_potential import StepInputs
from ..simulate.newton import SolverOptions, State, minimise_from
from ..simulate.simulator import StepHistory


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How much a shot is refined.

    Attributes:
        iterations: of Newton's method in each frame, at most; a frame within the tolerance stops earlier.
        feedback: look back on refined frames instead of the network's.
        batch: frames refined at once; with feedback it is one.
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


@dataclass(frozen=True)
class Change:
    """What refining did to one frame.

    Attributes:
        before, after: energy of the network's state and of the refined one, with the same past [J].
        inside_before, inside_after: share of the vertices inside what they meet of the body (`collision.contacts`).
        moved: RMS distance over the mass [m].
        residual: RMS acceleration that forces out of balance would give the free mass [g], held vertices included.
    """

    before: float
    after: float
    inside_before: float
    inside_after: float
    moved: float
    residual: float


@dataclass(frozen=True, eq=False)
class RefinedFrame:
    """One frame of a shot: garment vertices in the world [m], float64, shape (V, 3), and what was changed."""

    points: Floats
    change: Change


@dataclass(frozen=True, eq=False)
class _Tail:
    """What the next frames look back on: up to two frames of positions in the world (V, 3, 1 or 2), the last root and
    linearly skinned garment, and how far refining moved the last frame (V, 3, 1)."""

    world: Tensor
    root: Tensor
    lbs: Tensor
    correction: Tensor


class Refiner:
    """Refines shots of one garment.

    Args:
        scene: with the character's body.
        fps: of the shots.
        device: where everything runs.
    """

    def __init__(
        self, scene: Scene, fabric: Fabric, options: RefineOptions, *, fps: float, device: torch.device | str = "cpu"
    ) -> None:
        self.options = options
        self.simulator = Simulator(scene, fabric, SimulationOptions(fps=fps, solver=options.solver), device=device)
        self.potential = self.simulator.potential

    def frames(self, motion: Motion, network: Iterable[Floats]) -> Iterator[RefinedFrame]:
        """Yield the refined frames of a shot.

        Args:
            motion: the character's, at the shot's frames.
            network: garment vertices of each frame in the world [m], shape (V, 3).

        Raises:
            SsilkError: the motion is at another rate, or a frame is not finite.
        """
        yield from self._spans(motion, iter(network), None)

    def changes(self, motion: Motion, network: Iterable[Floats], refined: Iterable[Floats]) -> Iterator[Change]:
        """Yield what was changed in each frame of a shot that is refined already; arguments as for `frames`."""
        for frame in self._spans(motion, iter(network), iter(refined)):
            yield frame.change

    @torch.no_grad()
    def _spans(
        self, motion: Motion, network: Iterator[Floats], given: Iterator[Floats] | None
    ) -> Iterator[RefinedFrame]:
        fps = self.simulator.options.fps
        if not abs(motion.fps - fps) < 1e-6:
            fail(motion.path, f"{motion.fps:g} frames per second", f"{fps:g} is needed")
        for span in split_at_cuts(motion):
            yield from self._span(span, network, given)

    def _span(
        self, span: Motion, network: Iterator[Floats], given: Iterator[Floats] | None
    ) -> Iterator[RefinedFrame]:
        """Yield the frames of a motion without cuts."""
        tail: _Tail | None = None
        for start, stop in _blocks(span.frame_count, 1 if self.options.feedback else self.options.batch):
            world = self._taken(network, stop - start)
            poses = self.simulator.poser.pose(span.rotations[start:stop], span.translations[start:stop])
            inputs = self.simulator.inputs(poses, self._past(tail, world, poses))
            before = State.at(self.potential, self.simulator.apply_pins(world - poses.root, poses), inputs)
            if given is None:
                refined = self._refined(before, tail, world, poses, inputs) + poses.root
            else:
                refined = self._taken(given, stop - start)
            yield from self._reported(before, inputs, refined, poses.root)
            tail = self._tail(tail, world, refined, poses)

    def _taken(self, vertices: Iterator[Floats], count: int) -> Tensor:
        """Return the next frames' positions (V, 3, N)."""
        points = np.stack(list(islice(vertices, count)), axis=-1)
        return torch.as_tensor(points, dtype=torch.float64, device=self.potential.free.device)

    def _refined(
        self, before: State, tail: _Tail | None, world: Tensor, poses: PosedCharacters, inputs: StepInputs
    ) -> Tensor:
        """Return refined positions relative to the roots (V, 3, N)."""
        start = before.x
        if tail and self.options.feedback:
            corrected = self.simulator.apply_pins(world + tail.correction - poses.root, poses)
            start = self.simulator.best_start([start, corrected], inputs)
        return minimise_from(self.potential, start, inputs, self.options.solver).x.double()

    def _past(self, tail: _Tail | None, world: Tensor, poses: PosedCharacters) -> StepHistory | None:
        """Return what each of some consecutive frames looks back on."""
        if tail is None:
            return None if self.options.feedback else StepHistory(world, None, poses.root, poses.lbs)
        seen, count = torch.cat([tail.world, world[..., :-1]], dim=-1), world.shape[-1]
        before = seen[..., -count - 1 : -1] if seen.shape[-1] > count else None
        root = torch.cat([tail.root, poses.root[:, :-1]], dim=1)
        return StepHistory(seen[..., -count:], before, root, torch.cat([tail.lbs, poses.lbs[..., :-1]], dim=-1))

    def _tail(self, tail: _Tail | None, world: Tensor, refined: Tensor, poses: PosedCharacters) -> _Tail:
        """Return what the frames after these look back on."""
        kept = refined if self.options.feedback else world
        kept = kept if tail is None else torch.cat([tail.world, kept], dim=-1)
        return _Tail(kept[..., -2:], poses.root[:, -1:], poses.lbs[..., -1:], (refined - world)[..., -1:])

    def _reported(self, before: State, inputs: StepInputs, refined: Tensor, root: Tensor) -> Iterator[RefinedFrame]:
        """Yield frames with what was changed in them."""
        mass = self.potential.mass
        after = State.at(self.potential, (refined - root).to(before.x.dtype), inputs)
        inside = [
            (state.body_distance.distance(state.x) < 0).double().mean(0)
            if state.body_distance
            else torch.zeros_like(state.energy)
            for state in (before, after)
        ]
        moved = ((mass * ((after.x - before.x) ** 2).sum(1)).sum(0) / mass.sum()).sqrt()
        residual = self.potential.residual(self.potential.gradient(after.x, inputs, after.body_distance))
        figures = torch.stack([before.energy, after.energy, *inside, moved, residual], dim=1).tolist()
        for points, values in zip(refined.permute(2, 0, 1).cpu().numpy(), figures):
            yield RefinedFrame(points, Change(*values))


def _blocks(count: int, size: int) -> Iterator[tuple[int, int]]:
    """Yield the frames refined together: the first two, which have less of a past, each alone."""
    yield from ((frame, frame + 1) for frame in range(min(2, count)))
    yield from ((start, min(start + size, count)) for start in range(2, count, size))


@dataclass
class Summary:
    """Means over the refined frames of a shot, gathered as they come."""

    changes: list[Change] = field(default_factory=list)

    def figures(self) -> dict[str, float]:
        """Return figures to state: energies [J], shares, distances [m]."""
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
