# SPDX-License-Identifier: Apache-2.0
"""The reference simulator: implicit Euler on the training energy, several shots at once.

A shot starts with the quasi-static state of its first pose, to which the garment is carried from the bind pose, and
with the velocity of linear blend skinning, so that a character that starts walking does not leave its garment behind.
Each step is solved relative to the character's root, where single precision is finest; between steps positions are
kept in world space, in float64.

A step in which a limb moves further than it is thick takes it through the cloth, and no minimisation leads back. Such
steps do not converge. They are taken again in shorter ones, each with the body where it is then. In these cloth is
pushed off the limbs that were through it at the end of the last one (`collision.pierced`): which limbs are changes
from one position to the next, and the energy jumps with it. A shorter step that takes another limb through the cloth
is split once more.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...events import Countdown, Message, Reporter, silent
from ...scene.assets import Floats, Motion, Scene, ShotWorld, Skeleton
from ...scene.fabrics import Fabric
from ...scene.kinematics import bind_pose, slerp
from ..collision import limb_axes
from ..collision.inner_cloth import InnerSurface
from ..collision.pierced import PiercedCloth, PiercedOutfit
from ..self_contact import ClothNeighbours
from ..world.surroundings import Surroundings
from .characters import CharacterPoser, MotionSpan, PosedCharacters, join_spans, split_into_spans
from .cubature import Cubature, sampled_potential
from .history import StepHistory
from .incremental_potential import IncrementalPotential, StepInputs
from .newton import Search, Solution, minimise_from
from .options import PRECISIONS, SimulationOptions
from .outfit import OutfitPotential, WornGarment
from .over_cloth import OverPotential
from .scheduler import Asked, Course, Scheduler
from .wind import carried_by_air, pushed_by_wind

WAY = 8, 10  # poses from the bind pose to one in which cloth comes to rest, and iterations for each but the last
WAY_APART = 16, 20  # where cloth does not pass through cloth: legs that go further at once press a hem through itself
PARTS, SPLITS = 4, 2  # shorter steps for one that does not converge, and how often these are split themselves


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One frame of one shot.

    Attributes:
        shot, number: index of the shot, and of the frame in it.
        points: garment vertices in world space [m], float64, shape (V, 3).
        energy: the incremental potential [J], with heights relative to the character's root.
        residual, iterations, fixed: see `newton.Solution`, for the last step of the frame. Where that was taken in
            shorter ones, energy and fixed vertices are those of the last of these, the residual is the largest, and
            iterations are all.
    """

    shot: int
    number: int
    points: Floats
    energy: float
    residual: float
    iterations: int
    fixed: int


@dataclass(frozen=True, eq=False)
class Stepped:
    """A step of one shot that was solved.

    Attributes:
        shot, step: their numbers.
        past, state: before and after it, of this shot alone.
        solution: of this shot, relative to its root.
    """

    shot: int
    step: int
    past: StepHistory
    state: StepHistory
    solution: Solution


PosesAt = Callable[[Sequence[tuple[int, int]]], PosedCharacters]
"""Returns the characters at the ends of steps, each given by the numbers of its shot and step."""


class Simulator:
    """Simulates one garment, or an outfit, for any motions of the character.

    Where garments are worn over it, all are one system, and positions (V, 3) are those of the first garment, then
    those of the others. They never pass through each other; `SimulationOptions.self_contact` says whether one passes
    through itself.
    """

    def __init__(
        self,
        scene: Scene,
        fabric: Fabric,
        options: SimulationOptions | None = None,
        *,
        over: Sequence[WornGarment] = (),
        beneath: Sequence[InnerSurface] = (),
        device: torch.device | str = "cpu",
        report: Reporter = silent,
    ) -> None:
        """Prepare the energies of garments; `report` hears when shots start, with their quasi-static states.

        Args:
            over: garments that are worn with the scene's, outer ones last.
            beneath: garments that the scene's lies over, which others move: its potential meets them where the
                inputs of a step say where they are. The simulator's own steps do not.
        """
        self.report = report
        self.options, device = options or SimulationOptions(), torch.device(device)
        dtype = PRECISIONS[self.options.precision]
        scenes = [scene, *(each.scene for each in over)]
        self.potential: IncrementalPotential
        self._offsets: Tensor | None = None
        if over:
            worn = [WornGarment(scene, fabric), *over]
            outfit = OutfitPotential(worn, own=self.options.self_contact, device=device, dtype=dtype)
            self.potential, limbs, self._offsets = outfit, outfit.limbs, outfit.offsets
        else:
            common: dict[str, Any] = {"device": device, "dtype": dtype}
            self.potential = (
                OverPotential(scene, fabric, beneath, **common)
                if beneath
                else IncrementalPotential(scene, fabric, **common)
            )
            limbs = limb_axes(scene)
        self.poser = CharacterPoser(scenes, limbs, device, dtype)
        self.gravity = torch.tensor(self.options.gravity, dtype=dtype, device=device)[:, None]
        self.dt, self.splits = 1 / (self.options.fps * self.options.substeps), SPLITS

    def sampled(self, scene: Scene, cubature: Cubature) -> Simulator:
        """Return a simulator of the same scene on the elements of a cubature, whose vertices alone it moves."""
        part = copy.copy(self)
        part.potential = sampled_potential(self.potential, scene, cubature)
        part.poser = self.poser.only(cubature.vertices)
        return part

    def frames(
        self, motions: Sequence[Motion], worlds: Sequence[ShotWorld | None] | None = None
    ) -> Iterator[SimulatedFrame]:
        """Yield all frames of all shots, in order within a shot; a batch of shots advances in parallel.

        Args:
            worlds: what surrounds the character in each shot; nothing by default.
        """
        options, surroundings = self.options, self.surroundings(worlds)
        cut = (options.fps, options.substeps, options.sequence)
        skeleton = self.poser.skeleton
        spans = [
            span for shot, motion in enumerate(motions) for span in split_into_spans(motion, skeleton, shot, *cut)
        ]
        spans.sort(key=lambda span: -span.motion.frame_count)
        for start in range(0, len(spans), options.batch):
            yield from self._simulate_spans(spans[start : start + options.batch], surroundings)

    def surroundings(self, worlds: Sequence[ShotWorld | None] | None) -> Surroundings | None:
        """Return the worlds of shots, prepared; None where nothing surrounds any character."""
        if worlds is None or all(world is None or world.is_usual for world in worlds):
            return None
        for world in worlds:
            for _, fabric in self.potential.garments if world and world.air else ():
                if not fabric.drag:
                    found, allowed = (
                        f"wind, and the fabric '{fabric.name}' has no drag",
                        "air moves cloth by its drag",
                    )
                    fail("wind", found, allowed, "give --material drag=0.3, or leave the wind out")
        return Surroundings(worlds, np.array(self.options.gravity))

    def _simulate_spans(
        self, spans: Sequence[MotionSpan], surroundings: Surroundings | None
    ) -> Iterator[SimulatedFrame]:
        """Yield the frames of spans."""
        past, solution = self._first(spans, surroundings)
        for span, state, found in zip(spans, past.split(), solution.split()):
            yield _frame(span, 0, state, found)

        def poses_at(places: Sequence[tuple[int, int]]) -> PosedCharacters:
            at = [(spans[shot], step) for shot, step in places]
            poses = self.poser.poses_at([(span.motion, step) for span, step in at])
            return _surrounded(poses, surroundings, at)

        courses = [range(1, span.motion.frame_count) for span in spans]
        for each in self.carry_on(past.split(), courses, poses_at):
            if each.step % self.options.substeps == 0:
                frame = each.step // self.options.substeps
                yield _frame(spans[each.shot], frame, each.state, each.solution)

    def carry_on(
        self,
        past: Iterable[StepHistory],
        steps: Sequence[range],
        poses_at: PosesAt,
    ) -> Iterator[Stepped]:
        """Yield what comes after states, however these came about: the steps of a shot in order, and each shot's as
        soon as they are solved. `SimulationOptions.batch` shots are under way at once.

        Args:
            past: of each shot alone, which is taken when the shot begins.
            steps: the numbers of the steps that each takes.
        """
        scheduler: Scheduler[tuple[StepHistory, Solution]] = Scheduler()
        left, later = [iter(each) for each in steps], enumerate(past)
        ready: list[tuple[int, StepHistory]] = []
        taken: dict[int, tuple[int, StepHistory]] = {}
        while True:
            begun = [(shot, step, last) for shot, last in ready if (step := next(left[shot], None)) is not None]
            while len(begun) + len(scheduler) < self.options.batch and (new := next(later, None)):
                shot, last = new
                begun += [(shot, step, last) for step in islice(left[shot], 1)]
            if not begun and not len(scheduler):
                return
            poses = poses_at([(shot, step) for shot, step, _ in begun]).split() if begun else []
            for (shot, step, last), at in zip(begun, poses):
                taken[shot] = step, last
                scheduler.begin(shot, self._stepped(last, at))
            ready = []
            for shot, (state, solution) in scheduler.run():
                step, last = taken.pop(shot)
                yield Stepped(shot, step, last, state, solution)
                ready.append((shot, state))

    def _stepped(self, past: StepHistory, poses: PosedCharacters) -> Course[tuple[StepHistory, Solution]]:
        """Return the state of one shot after that of the past, and its solution."""
        solution, before = (yield Asked(self.dt, self.search, past, poses)), past.last
        if self.splits and past.matrices is not None and poses.world is None:  # no world is posed in between
            stuck = ~(solution.residual <= self.options.solver.tolerance)
            if past.pierced and (now := self._pierced(solution.x, poses)):
                stuck |= ((now.radius > 0) & (past.pierced.radius == 0)).any(0)
            if bool(stuck):
                part, found = yield from self._in_parts(past, poses)
                assert part.before is not None
                solution, before = counted(found, [solution, found]), part.before
        return self._history(solution, poses, before), solution

    def _in_parts(self, past: StepHistory, poses: PosedCharacters) -> Course[tuple[StepHistory, Solution]]:
        """Return what `_stepped` does by way of `PARTS` shorter steps."""
        shorter = copy.copy(self)
        shorter.dt, shorter.splits = self.dt / PARTS, self.splits - 1
        assert past.matrices is not None
        solutions, between = [], partial(self.poser.between, past.root, past.matrices, poses, moves=past.moves)
        if past.before is not None:
            past = replace(past, before=past.last - (past.last - past.before) / PARTS)
        if past.friction is not None:  # what sticks creeps less far in a shorter step
            past = replace(past, friction=replace(past.friction, creep=past.friction.creep / PARTS))
        at = between(0.0)
        for share in np.arange(1, PARTS + 1) / PARTS:
            past = replace(past, pierced=self._pierced(past.local, at))
            at = poses if share == 1 else between(share)
            past, found = yield from shorter._stepped(past, at)
            solutions.append(found)
        assert past.before is not None
        found = replace(found, residual=torch.stack([each.residual for each in solutions]).amax(0))
        return replace(past, before=past.last - PARTS * (past.last - past.before)), counted(found, solutions)

    def _pierced(self, x: Tensor, poses: PosedCharacters) -> PiercedCloth | PiercedOutfit | None:
        return self.potential.pierced(x, poses.body)

    def _history(self, solution: Solution, poses: PosedCharacters, before: Tensor | None) -> StepHistory:
        """Return what the next step needs of a solution, with the world positions (V, 3, N) before it."""
        friction = self.potential.friction(solution.x, poses.body, solution.neighbours, self.dt, poses.world)
        world = solution.x.double() + poses.root
        known = solution.neighbours, friction, poses.matrices
        return StepHistory(world, before, poses.root, poses.lbs, *known, moves=poses.moves)

    def _first(self, spans: Sequence[MotionSpan], surroundings: Surroundings | None) -> tuple[StepHistory, Solution]:
        """Return the states that spans start with, and report: on a processor they can take minutes."""
        count, iterations = self._way
        most = self.options.quasi_static_solver.iterations + (count - 1) * iterations
        self.report(Message(f"cloth comes to rest in the first pose, in {most} iterations at most"))
        rotations, translations = (
            np.stack([getattr(span.motion, name)[0] for span in spans]) for name in ("rotations", "translations")
        )
        poses, solution = self.at_rest(
            rotations,
            translations,
            Countdown(most, self.report),
            lambda poses: _surrounded(poses, surroundings, [(span, 0) for span in spans]),
            self.poser.moves((span.motion, slice(0, 1)) for span in spans),
        )
        return self._history(solution, poses, None), solution

    def at_rest(
        self,
        rotations: Floats,
        translations: Floats,
        advanced: Callable[[], object] = lambda: None,
        surrounded: Callable[[PosedCharacters], PosedCharacters] = lambda poses: poses,
        moves: Tensor | None = None,
    ) -> tuple[PosedCharacters, Solution]:
        """Return poses with their quasi-static states, to which the garment is carried from the bind pose.

        Linear blend skinning alone puts cloth through raised arms and through itself, and no minimisation leads out.

        Args:
            rotations, translations: of the joints, local, shapes (N, J, 4) and (N, J, 3).
            advanced: called after each iteration.
            surrounded: puts what surrounds the characters around the last poses; on the way there nothing does.
            moves: of the bodies' vertices in the last poses, as `PosedCharacters` has them.
        """
        turned, placed = bind_pose(self.poser.skeleton)
        poses = self.poser.pose(np.broadcast_to(turned, rotations.shape), np.broadcast_to(placed, translations.shape))
        x, last = poses.lbs, self.options.quasi_static_solver
        if self._offsets is not None:
            x = self.apply_pins(x + self._offsets, poses)
        known: ClothNeighbours | None = None
        count, iterations = self._way
        for share in np.arange(1, count + 1) / count:
            lbs = poses.lbs
            moved = None if moves is None else float(share) * moves
            turns, places = slerp(turned, rotations, share), (1 - share) * placed + share * translations
            poses = self.poser.pose(turns, places, moved)
            poses = surrounded(poses) if share == 1 else poses
            x, inputs = self._carried(x, x + poses.lbs - lbs, self.inputs(poses, None), known)
            solver = last if share == 1 else replace(last, iterations=min(iterations, last.iterations))
            solution = minimise_from(self.potential, self.apply_pins(x, poses), inputs, solver, advanced)
            x, known = solution.x, solution.neighbours
        return poses, solution

    def _carried(
        self, x: Tensor, target: Tensor, inputs: StepInputs, known: ClothNeighbours | None
    ) -> tuple[Tensor, StepInputs]:
        """Return a target (V, 3, N), or how far the garment comes towards it past itself, and the inputs there."""
        return self.potential.approach(x, target, inputs, known) if self._apart else (target, inputs)

    @property
    def _apart(self) -> bool:
        """Whether cloth does not pass through cloth."""
        return self.options.self_contact or len(self.potential.garments) > 1

    @property
    def _way(self) -> tuple[int, int]:
        return WAY_APART if self._apart else WAY

    def quasi_static(self, poses: PosedCharacters, start: Tensor) -> Solution:
        """Return the quasi-static states of poses, minimised from `start` (V, 3, N), relative to the roots."""
        return minimise_from(self.potential, start, self.inputs(poses, None), self.options.quasi_static_solver)

    def inputs(
        self, poses: PosedCharacters, past: StepHistory | None, dt: float | Tensor | None = None
    ) -> StepInputs:
        """Return the inputs of a step after `past`, or of a quasi-static state without it, relative to the roots.

        Args:
            dt: length of the step [s], or that of each, shape (N,); the simulator's own by default.
        """
        world = poses.world
        gravity = self.gravity.expand(3, poses.root.shape[-1]) if world is None else world.gravity
        met = world if world and world.has_colliders else None
        if past is None:
            if world is not None:
                gravity = gravity + pushed_by_wind(self.potential.garments, world, poses.lbs)
            return StepInputs(poses.body, gravity, skinned=poses.lbs, world=met)
        shift = poses.root - past.root
        predicted = past.follow_lbs(poses) if past.before is None else past.local + (past.last - past.before - shift)
        friction = past.friction and past.friction.after(poses.body.points, world)
        limbs = poses.body.limbs
        pierced = past.pierced.on(limbs) if past.pierced and limbs else None
        advected = past.local if world is None else carried_by_air(world, past, poses.root, self.dt)
        dt = self.dt if dt is None else dt.to(past.lbs.dtype) if isinstance(dt, Tensor) else dt
        own = predicted.to(past.lbs.dtype), advected, dt, poses.lbs
        return StepInputs(poses.body, gravity, *own, friction=friction, pierced=pierced, world=met)

    def search(self, poses: PosedCharacters, past: StepHistory, numbers: Sequence[int], dt: float | Tensor) -> Search:
        """Return the search for the states one step after `past`, relative to the roots, by numbers of N shots.

        Args:
            dt: as in `inputs`.
        """
        inputs = self.inputs(poses, past, dt)
        start = self.potential.best_start(self.starts(poses, past, inputs), inputs)
        x, inputs = self._carried(past.local, start, inputs, past.neighbours)
        return Search(self.potential, self.apply_pins(x, poses), inputs, self.options.solver, numbers)

    def starts(self, poses: PosedCharacters, past: StepHistory, inputs: StepInputs) -> list[Tensor]:
        """Return states (V, 3, N) that a step after `past` may start from: predicted, still, and with the body."""
        assert inputs.predicted is not None
        return [self.apply_pins(x, poses) for x in (inputs.predicted, past.local, past.follow_lbs(poses))]

    def solve(self, start: Tensor, inputs: StepInputs) -> Solution:
        """Return the minima of one step, from `start` (V, 3, N)."""
        return minimise_from(self.potential, start, inputs, self.options.solver)

    def apply_pins(self, x: Tensor, poses: PosedCharacters) -> Tensor:
        """Return positions (V, 3, N) with all vertices but the free ones set to linear blend skinning."""
        free = self.potential.free
        return poses.lbs.index_copy(0, free, x[free].to(poses.lbs.dtype))


def counted(found: Solution, parts: Sequence[Solution]) -> Solution:
    """Return a solution with the iterations of all its parts."""
    iterations, cg_iterations = (
        torch.stack([getattr(each, name) for each in parts]).sum(0) for name in ("iterations", "cg_iterations")
    )
    return replace(found, iterations=iterations, cg_iterations=cg_iterations)


def _surrounded(
    poses: PosedCharacters, surroundings: Surroundings | None, at: Sequence[tuple[MotionSpan, int]]
) -> PosedCharacters:
    """Return the poses of spans, each at a step, with what surrounds them."""
    if surroundings is None:
        return poses
    places = [(span.shot, float(span.seconds[step])) for span, step in at]
    return replace(poses, world=surroundings.around(places, poses.root, poses.lbs))


def _frame(span: MotionSpan, frame: int, state: StepHistory, solution: Solution) -> SimulatedFrame:
    """Return a frame of a span, of its state and solution alone."""
    points, reached = state.last[..., 0].cpu().numpy(), (float(solution.energy), float(solution.residual))
    counts = int(solution.iterations), int(solution.fixed)
    return SimulatedFrame(span.shot, span.first + frame, points, *reached, *counts)


def simulate(
    scene: Scene,
    fabric: Fabric,
    motions: Sequence[Motion],
    options: SimulationOptions | None = None,
    *,
    worlds: Sequence[ShotWorld | None] | None = None,
    device: torch.device | str = "cpu",
    report: Reporter = silent,
) -> list[Floats]:
    """Return the garment's vertices over each motion, at `options.fps`, in world space [m], each (frames, V, 3).

    Raises:
        SsilkError: no motion, no body, or a state whose energy is not finite.
    """
    if not motions:
        fail("simulation", "no motion given", "at least one is needed")
    simulator = Simulator(scene, fabric, options, device=device, report=report)
    counts = [shot.frame_count for shot in shots_of(motions, scene.character.skeleton, simulator.options)]
    points = [np.zeros((count, scene.garment.mesh.vertex_count, 3)) for count in counts]
    told = Countdown(sum(counts), report)
    for frame in simulator.frames(motions, worlds):
        points[frame.shot][frame.number] = frame.points
        told()
    return points


def shots_of(motions: Sequence[Motion], skeleton: Skeleton, options: SimulationOptions) -> list[Motion]:
    """Return the motions sampled at the frames of their simulated shots."""
    spans = [split_into_spans(motion, skeleton, 0, options.fps, options.substeps) for motion in motions]
    return [join_spans(motion, parts) for motion, parts in zip(motions, spans)]


def quasi_static_states(
    scene: Scene,
    fabric: Fabric,
    motion: Motion,
    options: SimulationOptions | None = None,
    *,
    device: torch.device | str = "cpu",
) -> Floats:
    """Return the quasi-static garment of each pose of a motion, in world space [m], shape (F, V, 3)."""
    simulator = Simulator(scene, fabric, options, device=device)
    poses, solution = simulator.at_rest(motion.rotations, motion.translations)
    return (solution.x.double() + poses.root).permute(2, 0, 1).cpu().numpy()
