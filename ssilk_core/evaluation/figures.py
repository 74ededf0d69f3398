# SPDX-License-Identifier: Apache-2.0
"""What an evaluation comes to: figures of one method on one split, in SI units."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Against:
    """A method beside the reference simulator, on the frames that both have.

    Attributes:
        frames: how many.
        total: of the simulator [J].
        excess: total over the simulator's [J].
        floats: gravity over the simulator's, as a share of m g L.
        position, velocity, acceleration: RMS errors over mass and frames [m], [m/s], [m/s2].
        jitter: RMS third derivative, relative to the simulator's.
    """

    frames: int
    total: float
    excess: float
    floats: float
    position: float
    velocity: float
    acceleration: float
    jitter: float


@dataclass(frozen=True, kw_only=True)
class PoseNovelty:
    """How far poses are from those trained on, and what that costs.

    Attributes:
        mean, high: angle for each joint to the nearest pose, its mean and 95 % quantile over frames [rad].
        familiar, unfamiliar: total of the nearest half of the frames, and of the furthest tenth [J].
    """

    mean: float
    high: float
    familiar: float
    unfamiliar: float


@dataclass(frozen=True, kw_only=True)
class Holds:
    """Poses held still after a stop; means over stops.

    Attributes:
        stops: how many.
        begun, kinetic: kinetic energy at the stop and at the end of the hold [J].
        settled: share of stops after which the garment becomes calm.
        settling: median time until it is calm for good [s]; infinite where fewer than half settle.
        distance: RMS from the method's own quasi-static state at the end [m]; `furthest`: of the worst stop.
        above: static energy above that state's at the end [J].
        floats: gravity above that state's at the end, as a share of m g L.
    """

    stops: int
    begun: float
    kinetic: float
    settled: float
    settling: float
    distance: float
    furthest: float
    above: float
    floats: float


@dataclass(frozen=True, kw_only=True)
class Hung:
    """Where garments were at the end of holds, beside the minimum of the static energy near there.

    Attributes:
        stops: how many.
        above: energy over the minimum's [J].
        floats, lbs: gravity over the minimum's, of the garment and of linear blend skinning, as shares of m g L.
        distance: RMS from the minimum [m].
        imbalance: what the solver left out of balance, at most [g].
    """

    stops: int
    above: float
    floats: float
    lbs: float
    distance: float
    imbalance: float


@dataclass(frozen=True, kw_only=True)
class Loops:
    """Clips looped seamlessly; the second loop, which no start disturbs, beside the last.

    Attributes:
        clips, frames: how many clips, each of at least so many frames.
        second, last: totals of these loops [J].
        drift: change from one to the other [J]; `most`: of the clip that changes most, signed.
        apart: RMS distance between both at equal phases [m].
    """

    clips: int
    frames: int
    second: float
    last: float
    drift: float
    most: float
    apart: float


@dataclass(frozen=True, kw_only=True)
class Figures:
    """One method on one split; means over all frames of all clips.

    Attributes:
        clips, frames: how many.
        total: the paper's L_tot [J], of `terms`; gravity is relative to linear blend skinning.
        collisions: share of vertices inside the body.
        clip_totals: smallest, median and largest total of a clip [J].
        lift: gravity relative to linear blend skinning, as a share of m g L: weight times height of the garment.
        kinetic: kinetic energy [J].
        motion: RMS distance to the method's own quasi-static state of each pose [m].
        jitter: RMS third derivative over mass and frames [m/s3]; `jitter_of_plain`: relative to linear blend
            skinning's.
        stretches: 50, 95 and 99 % quantiles and the largest of the larger principal stretch.
        truth, poses, holds, hung, loops: what else was asked for, where the method has it.
    """

    clips: int
    frames: int
    total: float
    terms: dict[str, float]
    collisions: float
    clip_totals: tuple[float, float, float]
    lift: float
    kinetic: float
    motion: float | None
    jitter: float
    jitter_of_lbs: float
    stretches: tuple[float, ...]
    truth: Against | None = None
    poses: PoseNovelty | None = None
    holds: Holds | None = None
    hung: Hung | None = None
    loops: Loops | None = None
