# SPDX-License-Identifier: Apache-2.0
"""Loops: a cycle is played round after round until the garment repeats, and one round of that is written.

A garment that starts at rest needs some rounds to forget it. Where two successive rounds begin with the same state,
within `REPEATED`, the first of them is taken. Where none do, as with cloth that is thrown about or a round that is no
whole number of the network's steps, the one whose end comes nearest to its beginning is.

The last frames of a round are then blended into those that led up to its own beginning, in the round before. So the
last one flows into the first, with its position and its velocity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from ...errors import fail
from ...scene.assets import Floats, GarmentPose, Motion, ShotWorld, Skeleton
from ...scene.cycles import LEAST_FRAMES, Cycle, find_cycle, rounds
from ...scene.kinematics import slerp, split_at_cuts
from .request import BakeRequest
from .result import LoopSummary

MOST_ROUNDS = 16
REPEATED = 5e-4  # [m] between the same vertex at the beginnings of two rounds, in two frames
BLENDED = 0.5  # [s] before the end, at most half of a round
LARGEST_GAP = 0.03  # of the garment's diagonal, by which a joint may miss where it began
LARGEST_SEAM = 5.0  # [mm] above which a bake warns
LARGEST_MISS = 15.0  # [mm] likewise, at the joints of a round without the repeated frame: captured ones miss by 10
LARGEST_TURN = np.radians(1)  # of a round whose world has a direction

Decode = Callable[[GarmentPose], Floats]


@dataclass(frozen=True, eq=False)
class Loop:
    """How a shot repeats.

    Attributes:
        cycle: of the character's motion as it was read.
        period: samples of the shot in a round.
        motion: many rounds as the network is rolled over them, at the rate that the motion was read at.
    """

    cycle: Cycle
    period: int
    motion: Motion

    @property
    def samples(self) -> int:
        """Samples to roll: `MOST_ROUNDS`, and the first two of the next."""
        return self.period * MOST_ROUNDS + 2

    def tiled(self, values: Floats) -> Floats:
        """Return values of the shot's samples (N, ...) for all samples to roll."""
        return values[np.arange(self.samples) % self.period]


def find_loop(request: BakeRequest, source: Motion, shot: Motion, skeleton: Skeleton, size: float) -> Loop:
    """Return how a shot repeats.

    Args:
        source: the motion as it was read, at its own rate, with the frames of the shot among others.
        shot: the same at the shot's samples.
        size: the garment's diagonal [m].

    Raises:
        SsilkError: it is no cycle, or the shot has no whole number of samples in a round.
    """
    name, rate = request.motion, source.fps / shot.fps
    first = shot.start * rate - source.start
    frames = (shot.frame_count - 1) * rate
    if max(abs(first - round(first)), abs(frames - round(frames))) > 1e-3:
        if request.fps and abs(first - round(first)) <= 1e-3:
            last = source.frame_count - 1 - round(first)
            _refuse_rate(request, min(int(np.floor(frames + rate - 1e-3)), last), source.fps)
        code = shot.start / request.samples_per_frame
        found = f"its frames from time code {code:g} on are between those of the motion"
        fail(name, found, "a loop begins and ends at frames of the motion", "give --range, or leave --fps out")
    own = source.clip(round(first), round(first + frames) + 1)
    if own.frame_count < LEAST_FRAMES:
        fail(name, f"{own.frame_count} frames", f"a loop has at least {LEAST_FRAMES}", "give --range")
    if len(split_at_cuts(own, skeleton)) > 1:
        fail(name, "its root jumps", "a loop has no cuts", "give --range, or leave --loop out")
    cycle = find_cycle(own, skeleton, size)
    if not cycle.gap <= LARGEST_GAP * size:
        found = f"it is no cycle: its end is up to {1000 * cycle.gap:.0f} mm from its beginning, at the joints"
        allowed = f"{1000 * LARGEST_GAP * size:.0f} mm are allowed, wherever the root has gone"
        fail(name, found, allowed, "give --range FIRST-LAST of one cycle, or leave --loop out")
    period = cycle.frames / rate
    if abs(period - round(period)) > 1e-3 or shot.frame_count != round(period) + cycle.closed:
        found = f"a round of {cycle.frames} frames takes {period:.4g} samples; the shot has {shot.frame_count}"
        todo = "let the last frame show the pose of the first, or leave --fps and --samples-per-frame out"
        fail(name, found, "a loop needs all samples of its round", todo)
    return Loop(cycle, round(period), rounds(own, skeleton, cycle, MOST_ROUNDS + 1))


def _refuse_rate(request: BakeRequest, frames: int, fps: float) -> NoReturn:
    """Raise `SsilkError` for a rate at which a round of so many frames, at `fps`, does not end on a sample."""
    assert request.fps is not None
    taken = frames / fps * request.fps * request.samples_per_frame
    whole = [count / frames * fps / request.samples_per_frame for count in (int(taken), int(taken) + 1) if count]
    found = (
        f"{request.fps:g} frames per second, at which {frames} frames of {request.motion} take {taken:.5g} samples"
    )
    rates = " or ".join(f"{rate:.6g}" for rate in whole)
    fail("--fps", found, "a loop ends on a sample, where it begins again", f"give --fps {rates}, or leave it out")


def need_alone(request: BakeRequest) -> None:
    """Raise `SsilkError` where a loop is asked for together with what it does not go with."""
    name = "--loop" if request.loop else f"{request.motion}: ssilk:loop"
    if request.feedback:
        found, allowed = "a loop that the solver carries on", "it does not come back to where it began"
        fail(name, found, allowed, "leave --feedback and --quality hero out: --refine N alone refines a loop")
    if request.handles:
        fail(name, "a loop with handles", "what comes before and after it is the round itself", "leave --handles out")
    if request.pre_roll:
        fail(name, "a loop with a run-up", "the rounds before are its run-up", "leave --pre-roll out")


def need_constant(request: BakeRequest, world: ShotWorld, cycle: Cycle) -> None:
    """Raise `SsilkError` where wind or gravity are not the same in each round."""
    allowed = "in a loop each round feels the same"
    blown = world.air is not None and (np.linalg.norm(world.air.velocity, axis=1).max() > 0)
    if world.air is not None and world.air.gusts.max() > 0:
        fail(request.motion, "gusts", allowed, "leave them out: --gusts 0")
    changing = [
        name
        for name, values in (("wind", world.air.velocity if world.air else None), ("gravity", world.gravity))
        if values is not None and np.ptp(values, axis=0).max() > 1e-6
    ]
    if changing:
        fail(request.motion, f"{changing[0]} that changes", allowed, f"give --{changing[0]} X,Y,Z")
    leans = world.gravity is not None and np.abs(world.gravity[:, [0, 2]]).max() > 1e-6
    if (blown or leans) and abs(cycle.angle) > LARGEST_TURN:
        what = "wind" if blown else "gravity to the side"
        found = f"a round turns by {np.degrees(cycle.angle):.0f} degrees in {what}, which comes from elsewhere then"
        fail(request.motion, found, allowed, "leave --loop out")


def need_same_colliders(request: BakeRequest, seen: Floats, cycle: Cycle) -> None:
    """Raise `SsilkError` where the network sees colliders otherwise at the end of a round.

    Args:
        seen: what it sees at the frames of the motion (`network.proximity.proximity_vectors`), shape (F, M, 3).
    """
    ends = seen[-1] if cycle.closed else 2 * seen[-1] - seen[-2]
    apart = np.linalg.norm(ends @ cycle.turn - seen[0], axis=-1)
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=-1).max(axis=0)
    if (apart > 0.1 + steps).any():
        found = "colliders are elsewhere at the end of the round than at its beginning, as seen from the garment"
        fail(request.motion, found, "in a loop each round meets the same", "leave the prop or --loop out")


@dataclass(frozen=True, eq=False)
class LoopedPoses:
    """The round that is written.

    Attributes:
        pose: of the shot's samples, from 0 on.
        first: of the first round, which starts at rest, and of the first sample after it.
        begins: sample at which the round begins, of those that were rolled.
        rounds: that were played until then.
        apart: distance between the beginnings of this round and the next, of the vertex that is farthest off in two
            frames [m].
    """

    pose: GarmentPose
    first: GarmentPose
    begins: int
    rounds: int
    apart: float

    @property
    def repeats(self) -> bool:
        """Whether the next round begins with the same state."""
        return self.apart <= REPEATED


def looped(rolled: Iterable[GarmentPose], loop: Loop, count: int, fps: float, decode: Decode) -> LoopedPoses:
    """Return the round that repeats best, closed.

    Args:
        rolled: poses of `loop.samples`, some at a time; no more of them are asked for than it takes.
        count: samples of the shot.
        fps: of its samples [1/s].
        decode: takes the poses of its first two samples, and returns vertices (2, V, 3).
    """
    period, parts, done = loop.period, list[GarmentPose](), 0
    poses, apart = iter(rolled), list[float]()
    before: Floats | None = None
    for number in range(MOST_ROUNDS + 1):
        start = number * period
        while done < start + 2 and (part := next(poses, None)) is not None:
            parts.append(part)
            done += part.frame_count
        parts = [GarmentPose.joined(parts)]
        points = decode(replace(parts[0].part(slice(start, start + 2)), start=0))
        if before is not None:
            apart.append(float(np.linalg.norm(points - before, axis=-1).max()))
            if number > 1 and apart[-1] <= REPEATED:
                break
        before = points
    chosen = 1 + int(np.argmin(apart[1:]))
    whole, begin = parts[0], chosen * period
    own = whole.part(slice(begin, begin + count))
    length = min(max(round(BLENDED * fps), 1), period // 2)
    share = ((np.arange(count) - (period - length)) / length).clip(0, 1)
    share *= share * (3 - 2 * share)
    closed = _mixed(own, whole.part(slice(begin - period, begin - period + count)), share)
    return LoopedPoses(closed, whole.part(slice(0, period + 1)), begin, chosen + 1, apart[chosen])


def _mixed(pose: GarmentPose, other: GarmentPose, share: Floats) -> GarmentPose:
    """Return poses from 0 on, with a share (F,) of another's."""
    part = share[:, None]
    moved = None
    if pose.translations is not None and other.translations is not None:
        moved = pose.translations + part[..., None] * (other.translations - pose.translations)
    weights = pose.weights + part * (other.weights - pose.weights)
    return GarmentPose(0, slerp(pose.rotations, other.rotations, part), weights, moved)


@dataclass(frozen=True)
class LoopSeam:
    """How the end of a round meets its beginning.

    Attributes:
        apart: distance of the vertex that misses its place most [m].
        jump: RMS change of the vertices' velocity there [m/s].
    """

    apart: float
    jump: float


def seam(cycle: Cycle, begin: Sequence[Floats], end: Sequence[Floats], fps: float) -> LoopSeam:
    """Return how vertices meet at the seam, as the last frames lead to it.

    Args:
        begin: those of the first three samples of a round [m], shape (V, 3) each.
        end: those of its last two.
    """
    before, last = (cycle.back(points) for points in end)
    first, second, third = begin
    if cycle.closed:
        apart, jump = last - first, (second - first) - (last - before)
    else:
        apart = (6 * first - 4 * second + third - 4 * last + before) / 3  # as in `find_cycle`
        jump = second - 2 * first + last
    return LoopSeam(float(np.linalg.norm(apart, axis=-1).max()), fps * _rms(jump))


def summary(
    found: LoopedPoses, loop: Loop, frames: Iterable[Floats], rest: Sequence[Floats], fps: float
) -> LoopSummary:
    """Return what a loop says of itself.

    Args:
        frames: vertices of the samples that are written [m], shape (V, 3) each.
        rest: those of a round that starts at rest: of its first three samples, then its last two.
        fps: of the samples [1/s].
    """
    kept, jumps = list[Floats](), list[float]()
    first = list[Floats]()
    for points in frames:
        if len(first) < 3:
            first.append(points)
        kept = [*kept[-2:], points]
        if len(kept) == 3:
            jumps.append(fps * _rms(kept[0] - 2 * kept[1] + kept[2]))
    at_rest = seam(loop.cycle, rest[:3], rest[3:], fps)
    written = seam(loop.cycle, first, kept[-2:], fps)
    return LoopSummary(
        samples=loop.period,
        closed=loop.cycle.closed,
        rounds=found.rounds,
        repeats=found.repeats,
        blended_mm=1000 * found.apart,
        seam_at_rest_mm=1000 * at_rest.apart,
        seam_mm=1000 * written.apart,
        body_mm=1000 * loop.cycle.gap,
        jump_at_rest=at_rest.jump,
        jump=written.jump,
        usual_jump=float(np.mean(jumps)),
        largest_jump=max(jumps),
        travel_m=loop.cycle.travel(first[0].mean(axis=0)),
        turn_degrees=float(np.degrees(loop.cycle.angle)),
    )


def seam_words(found: LoopSummary) -> str:
    """Return the words for a seam that shows; empty where none does."""
    if not found.closed:
        if found.body_mm <= LARGEST_MISS:
            return ""
        miss = f"the frames at its end lead up to {found.body_mm:.0f} mm past its beginning at the joints"
        return f"{miss}, and none shows the pose of the first: where the loop skips, add the frames that it lacks"
    if found.seam_mm <= LARGEST_SEAM:
        return ""
    why = f"the end of the motion misses its beginning by up to {found.body_mm:.0f} mm at the joints"
    return f"the last frame is up to {found.seam_mm:.0f} mm off the first; {why}: close the cycle, and bake it again"


def _rms(vectors: Floats) -> float:
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))
