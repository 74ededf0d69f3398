# SPDX-License-Identifier: Apache-2.0
"""Rollouts refined by the simulator's solver, as joints and blendshapes or as points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, tee
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from ...devices import select_device
from ...errors import SsilkError, VerificationError, fail
from ...events import Countdown, Message, Reporter, silent
from ...network.settings import STRONGEST_PULL
from ...physics.constants import GRAVITY
from ...scene.assets import Deformer, Floats, Motion
from ...scene.cycles import led
from ...scene.held_parts import shares_of_proxies
from ...scene.kinematics import deform, lbs_deformer, lbs_poses
from .beneath import GarmentsBeneath
from .computed_frames import Refinement
from .direction import Direction, free_stretches
from .result import RefinementSummary, ShotShapes, Verification
from .rollout import BakeRollout
from .world import tell_surrounded

if TYPE_CHECKING:
    from ...physics.refine import FrameChange, Refiner
    from ...scene.decomposition import Decomposition

# Rounding points to float32 may raise the energy of a frame: by this near the origin [J], ...
ROUNDING_ENERGY = 1e-6
# ... and far from it as if each vertex were held by a spring stiffer than any fabric [N/m].
ROUNDING_STIFFNESS = 1e3


def refined(
    rollout: BakeRollout,
    report: Reporter = silent,
    *,
    add_shapes: bool = False,
    beneath: Mapping[str, Path] | None = None,
) -> BakeRollout:
    """Return a rollout with its refined frames, or the rollout itself where its request asks for none.

    Where joints are written, its deformer gets the shot's own blendshapes. Points that these cannot reach are written
    as points.

    Args:
        add_shapes: to those of the model, instead of in their place: assets are the same for all shots.
        beneath: files of garments that it is worn over in this shot, by their names. They stay as they are.

    Raises:
        SsilkError: a number of iterations that is not allowed, a certificate for points that joints cannot reach, or
            a garment beneath has other frames.
    """
    if rollout.refinement is not None:
        return rollout
    if not rollout.request.refine:
        sight = None if rollout.request.lbs else rollout.sight
        tell_surrounded(rollout.around, sight, rollout.fabric.drag, report)
        if sight and (words := _too_strong(rollout.source)):
            report(Message(f"{rollout.request.motion}: {words}", "warning"))
        return rollout
    from ...physics.refine import RefinementMeans

    below = GarmentsBeneath(beneath, rollout.request.samples_per_frame) if beneath else None
    if below:
        report(Message(f"the solver keeps the garment off {', '.join(below.files)} beneath it"))
    means, points = RefinementMeans(), []
    for frame in _refined_frames(rollout, report, below):
        points.append(frame.points)
        means.changes += [frame.change] if frame.change else []
    if rollout.request.writes_points:
        found = _summary(rollout.request.refine, means.figures(), None)
        return replace(rollout, refinement=Refinement(tuple(points), (), found, rollout.deformer, below))
    try:
        shot = _decomposed(rollout, points, add_shapes)
    except SsilkError as error:  # what the solver made is kept
        if rollout.request.certify:
            misfit = f"refined frames do not fit joints and blendshapes ({str(error).removesuffix('.')})"
            fail("--certify", misfit, "what a certificate moves is put on these", "leave --certify out")
        report(Message(f"{error} They are written as points.", "warning"))
        as_points = replace(rollout, request=replace(rollout.request, refined_output="points"))
        found = _summary(rollout.request.refine, means.figures(), None)
        return replace(as_points, refinement=Refinement(tuple(points), (), found, rollout.deformer, below))
    found = _summary(rollout.request.refine, means.figures(), ShotShapes.of(shot))
    refinement = Refinement(tuple(points), shot.poses, found, rollout.deformer, below)
    return replace(rollout, deformer=shot.deformer, refinement=refinement)


def refined_points(
    rollout: BakeRollout, report: Reporter = silent, below: GarmentsBeneath | None = None
) -> Iterator[Floats]:
    """Yield the refined vertices of each frame in the world [m], shape (V, 3), over garments beneath."""
    return (frame.points for frame in _refined_frames(rollout, report, below))


@dataclass(frozen=True, eq=False)
class _Frame:
    """Vertices of a frame in the world [m], shape (V, 3), and what the solver changed; None where it is held."""

    points: Floats
    change: FrameChange | None


class _Solve:
    """Solves for stretches of what is played, over garments beneath it, which lack the first `left_out` frames."""

    def __init__(self, played: BakeRollout, below: GarmentsBeneath | None, left_out: int, report: Reporter) -> None:
        self.played, self.report = played, report
        self._below, self._left_out = below, left_out
        if below:
            below.need_frames(played.motion.frame_count - left_out)

    def frames(self, first: int, stop: int) -> Iterator[_Frame]:
        """Yield frames that the solver refines, from its start in the first of them on."""
        played, motion = self.played, self.played.motion
        if stop - first == motion.frame_count:
            part, network = _led(played)
        else:  # what is cut out is normalised again, which changes its last digits
            part, network = motion.clip(first, stop), islice(played.network_vertices(), first, stop)
        world = played.around.over(part).read(self.report)
        more = part.frame_count - (stop - first)
        frames = _refiner(played, self._below).frames(part, network, world, self._beneath(first, stop, more))
        for frame in islice(frames, more, None):
            yield _Frame(frame.points, frame.change)

    def changes(self, judged: Iterator[Floats], network: Iterator[Floats], motion: Motion) -> Iterator[FrameChange]:
        """Yield the changes of all frames that an earlier bake refined, led up to as `_led` leads up to them."""
        count = self.played.motion.frame_count
        more = motion.frame_count - count
        world = self.played.around.over(motion).read(silent)
        beneath = self._beneath(0, count, more)
        refiner = _refiner(self.played, self._below)
        return islice(refiner.changes(motion, network, judged, world, beneath), more, None)

    def _beneath(self, first: int, stop: int, more: int) -> Iterator[list[Floats]]:
        """Yield the garments beneath in frames of what is played; in a loop in the one that leads up to it, too."""
        below, left_out, loop = self._below, self._left_out, self.played.loop
        if below is None:
            return
        if more and loop:
            yield [loop.cycle.back(points) for points in below.each(loop.period - 1)]
        if first < left_out:
            lead = self.played.motion.clip(0, left_out + 1)
            yield from islice(below.led_up_to(self.played.deformer.scene, lead), first, min(stop, left_out))
        for frame in range(max(first, left_out), stop):
            yield below.each(frame - left_out)


def _refined_frames(rollout: BakeRollout, report: Reporter, below: GarmentsBeneath | None) -> Iterator[_Frame]:
    left_out, played = 0, rollout
    if rollout.request.feedback:  # the cloth is on its way when the shot begins
        left_out, played = rollout.lead, rollout.with_lead()
        report(Message("the solver puts the garment to rest first, which takes as long as many frames"))
    told, count = Countdown(played.motion.frame_count, report), played.motion.frame_count
    direction, rows = played.direction, slice(played.lead, played.lead + count)
    solve = _Solve(played, below, left_out, report)
    if direction is not None and direction.parts is not None:
        frames = _frames_in_part(solve, direction, rows)
    elif direction is not None and (direction.free[rows] < 1).any():
        frames = _directed_frames(solve, direction.free[rows])
    else:
        frames = solve.frames(0, count)
    for number, frame in enumerate(frames):
        told()
        if number >= left_out:
            yield frame


def _directed_frames(solve: _Solve, free: Floats) -> Iterator[_Frame]:
    """Yield frames between linear blend skinning and refined ones; the solver starts anew where the network does.

    Args:
        free: share of the refined ones, shape (F,).
    """
    stretches, played = free_stretches(free), solve.played
    if not stretches:
        _refuse_held(played)
    deformer, motion = lbs_deformer(played.deformer.scene), played.motion
    done = 0
    for first, stop in [*stretches, (len(free), len(free))]:
        yield from (_Frame(points, None) for points in _skinned(deformer, motion, done, first))
        solved = solve.frames(first, stop) if first < stop else ()
        for share, points, frame in zip(free[first:stop], _skinned(deformer, motion, first, stop), solved):
            yield _Frame(points + share * (frame.points - points), frame.change)
        done = stop


def _frames_in_part(solve: _Solve, direction: Direction, rows: slice) -> Iterator[_Frame]:
    """Yield frames between refined ones and those of the network, where proxies are held each by itself."""
    assert direction.parts is not None
    stretches, done, played = free_stretches(direction.moves[rows]), 0, solve.played
    if not stretches:
        _refuse_held(played)
    free = direction.free[rows, None] * direction.parts.free[rows]
    follow, held = shares_of_proxies(played.deformer), played.network_vertices()
    for first, stop in [*stretches, (len(free), len(free))]:
        yield from (_Frame(points, None) for points in islice(held, first - done))
        solved = solve.frames(first, stop) if first < stop else ()
        for share, points, frame in zip(free[first:stop] @ follow.T, islice(held, stop - first), solved):
            yield _Frame(points + share[:, None] * (frame.points - points), frame.change)
        done = stop


def _refuse_held(played: BakeRollout) -> NoReturn:
    found, allowed = "the garment is held in all frames", "--refine solves for cloth that moves freely"
    fail(played.request.motion, found, allowed, "leave --refine out, or key ssilk:free")


def _skinned(deformer: Deformer, motion: Motion, first: int, stop: int) -> Iterator[Floats]:
    """Yield the vertices of frames under linear blend skinning in the world [m], shape (V, 3)."""
    for pose in lbs_poses(stop - first):
        yield from deform(deformer, motion.clip(first, stop), pose)


def _led(played: BakeRollout) -> tuple[Motion, Iterator[Floats]]:
    """Return the motion and the network's vertices, in a loop with the frame that leads up to them: the drag of the
    first one looks back on it."""
    loop, motion, network = played.loop, played.motion, played.network_vertices()
    if loop is None:
        return motion, network
    own = list(network)
    before = loop.cycle.back(own[loop.period - 1])
    return led(motion, played.deformer.scene.character.skeleton, loop.cycle, loop.period), chain([before], own)


def _decomposed(rollout: BakeRollout, points: Sequence[Floats], add_shapes: bool) -> Decomposition:
    """Return refined vertices as joints and blendshapes, found from the network's own poses."""
    from ...scene.decomposition import decompose

    deformer = rollout.deformer
    if not add_shapes:
        deformer = replace(deformer, shapes=deformer.shapes[:0])
    poses = list(rollout.network_poses())
    return decompose(deformer, rollout.motion, points, poses, device=select_device(rollout.request.device))


def _too_strong(motion: Motion) -> str:
    """Return the words where cloth is pulled by more than networks are trained with; empty where it is not."""
    if motion.gravity is None:
        return ""
    strongest, known = float(np.linalg.norm(motion.gravity, axis=1).max()) / GRAVITY, 1 + STRONGEST_PULL
    if strongest <= known:
        return ""
    return f"gravity and wind pull with up to {strongest:.1f} g; networks are trained up to {known:g} g"


def _refiner(rollout: BakeRollout, below: GarmentsBeneath | None) -> Refiner:
    from ...physics.refine import RefineOptions, Refiner

    request = rollout.request
    options = RefineOptions(iterations=request.refine, feedback=request.feedback)
    device = select_device(request.device)
    surfaces = below.surfaces if below else ()
    scene, fps = rollout.deformer.scene, rollout.motion.fps
    return Refiner(scene, rollout.fabric, options, fps=fps, beneath=surfaces, device=device)


def _summary(iterations: int, means: dict[str, float], shapes: ShotShapes | None) -> RefinementSummary:
    return RefinementSummary(
        iterations=iterations,
        energy_before_j=means["energy before [J]"],
        energy_j=means["energy [J]"],
        inside_before=means["inside the body before"],
        inside=means["inside the body"],
        moved_m=means["moved [m]"],
        shapes=shapes,
    )


def verify_energies(
    rollout: BakeRollout, points: Iterable[Floats], below: GarmentsBeneath | None, report: Reporter
) -> Verification:
    """Check points [m], shape (V, 3) each, that an earlier bake refined, without refining them again.

    The last digits of a refinement depend on the machine, and the solver amplifies them. On any machine, no frame
    may have more energy than the network's state, with inertia as it was refined with.

    Raises:
        VerificationError: a frame has more.
    """
    energies, (judged, measured) = [], tee(points)
    told = Countdown(rollout.motion.frame_count, report)
    motion, network = _led(rollout)
    more = motion.frame_count - rollout.motion.frame_count
    if more:
        network, again = tee(network)
        judged = chain(islice(again, more), judged)
    changes = _Solve(rollout, below, 0, silent).changes(iter(judged), iter(network), motion)
    for frame, (change, vertices) in enumerate(zip(changes, measured)):
        spacing = float(np.finfo(np.float32).eps) * np.abs(vertices).max()
        rounding = ROUNDING_ENERGY + len(vertices) * ROUNDING_STIFFNESS * spacing**2
        if not change.after <= change.before + rounding:
            raise VerificationError(
                f"{rollout.request.motion}: refined frame {frame} has an energy of {change.after:.6g} J; at most "
                f"the {change.before:.6g} J of the network's state is allowed."
            )
        energies.append(change.after)
        told()
    return Verification(frames=len(energies), mean_energy_j=float(np.mean(energies)))
