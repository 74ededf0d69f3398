# SPDX-License-Identifier: Apache-2.0
"""The results of an evaluation: figures of one method on one split, in SI units.

Gravity excesses are differences of potential energy in units of m g L, the garment's weight times its rest height.
"""

from __future__ import annotations

from dataclasses import dataclass

from ...physics.intersections.figures import SelfIntersections
from ...physics.skin.figures import ShownSkin


@dataclass(frozen=True, kw_only=True)
class ReferenceErrors:
    """A method compared with the reference simulator, on the frames that both have.

    Attributes:
        frames: how many.
        reference_total: the simulator's total [J].
        total_excess: total above the simulator's [J].
        gravity_excess: gravity energy above the simulator's [m g L].
        position_error, velocity_error, acceleration_error: RMS over mass and frames [m], [m/s], [m/s2].
        jerk_ratio: RMS jerk relative to the simulator's.
    """

    frames: int
    reference_total: float
    total_excess: float
    gravity_excess: float
    position_error: float
    velocity_error: float
    acceleration_error: float
    jerk_ratio: float


@dataclass(frozen=True, kw_only=True)
class SolverErrors:
    """A method compared with the solver that starts from the method's own states.

    Attributes:
        windows, steps: how many windows were simulated, and single steps solved.
        lost: windows that are left out, because the method is not finite in them.
        step_energy: energy of a step above its minimum, from the method's own past [J].
        step_distance: RMS distance over mass and steps to that minimum [m].
        position_error: RMS distance over mass and windows to a simulation from the method's own first two states,
            after the frames of `solver_errors.AFTER` [m].
        median_position_error: the same of the median window [m].
        velocity_error, lbs_velocity_error: RMS difference of velocities in these windows, and that of linear blend
            skinning [m/s].
    """

    windows: int
    lost: int
    steps: int
    step_energy: float
    step_distance: float
    position_error: tuple[float, ...]
    median_position_error: tuple[float, ...]
    velocity_error: float
    lbs_velocity_error: float


@dataclass(frozen=True, kw_only=True)
class PoseNovelty:
    """How far poses are from the nearest training poses, and what that costs.

    Attributes:
        mean_distance, p95_distance: angle for each joint, its mean and 95th percentile over frames [rad].
        nearest_half_total, furthest_tenth_total: total of the nearest half of the frames, of the furthest tenth [J].
    """

    mean_distance: float
    p95_distance: float
    nearest_half_total: float
    furthest_tenth_total: float


@dataclass(frozen=True, kw_only=True)
class Settling:
    """What a garment does after its character stops; means over stops.

    The static state is the method's own for the final pose.

    Attributes:
        stops: how many.
        initial_kinetic_energy, final_kinetic_energy: at the stop, and at the end of the hold [J].
        settled_share: share of stops after which the garment comes to rest.
        settling_time: median time to rest [s]; infinite where fewer than half settle.
        static_distance: RMS distance to the static state at the end [m].
        max_static_distance: the largest of these over stops [m].
        static_energy_excess: static energy above that of the static state at the end [J].
        gravity_excess: gravity energy above that of the static state at the end [m g L].
    """

    stops: int
    initial_kinetic_energy: float
    final_kinetic_energy: float
    settled_share: float
    settling_time: float
    static_distance: float
    max_static_distance: float
    static_energy_excess: float
    gravity_excess: float


@dataclass(frozen=True, kw_only=True)
class MinimumErrors:
    """Garments at the end of holds, compared with a minimum of the static energy nearby; means over stops.

    Attributes:
        stops: how many.
        static_energy_excess: static energy above the minimum's [J].
        gravity_excess, lbs_gravity_excess: gravity energy above the minimum's, of the garment and of linear blend
            skinning [m g L].
        minimum_distance: RMS distance to the minimum [m].
        max_residual: largest residual that the solver left at a minimum [g].
    """

    stops: int
    static_energy_excess: float
    gravity_excess: float
    lbs_gravity_excess: float
    minimum_distance: float
    max_residual: float


@dataclass(frozen=True, kw_only=True)
class LoopDrift:
    """Seamlessly looped clips: the last loop compared with the second, which the start no longer disturbs.

    Attributes:
        clips, frames: how many clips, each of at least so many frames.
        second_loop_total, last_loop_total: mean totals of these loops [J].
        total_drift: change from one to the other [J].
        max_total_drift: of the clip that changes most, signed [J].
        loop_distance: RMS distance between both loops at equal phases [m].
    """

    clips: int
    frames: int
    second_loop_total: float
    last_loop_total: float
    total_drift: float
    max_total_drift: float
    loop_distance: float


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """Steps of a network, linearised about states of its own rollouts (`closed_loop`).

    Attributes:
        states: how many.
        median_radius, max_radius: spectral radius of the map from the two states before a step to those after it
            [1], its median and the largest; above one a disturbance grows.
    """

    states: int
    median_radius: float
    max_radius: float


@dataclass(frozen=True, kw_only=True)
class Figures:
    """One method on one split; means over all frames of all clips.

    Attributes:
        clips, frames: how many.
        total: the paper's L_tot [J], the sum of `terms`; gravity is relative to linear blend skinning.
        collisions: share of vertices inside the body.
        shown_skin: share of the covered skin that shows; None where the garment covers nothing.
        intersections: share of the triangles that intersect others of the garment.
        clip_totals: smallest, median and largest total of a clip [J].
        gravity_excess: gravity energy above that of linear blend skinning [m g L].
        kinetic_energy: [J].
        static_distance: RMS distance to the method's own static state of each pose [m].
        jerk: RMS jerk over mass and frames [m/s3]; `jerk_ratio`: relative to that of linear blend skinning.
        stretch_quantiles: 50, 95 and 99 % quantiles and the maximum of the larger principal stretch.
        reference, solver, pose_novelty, settling, minimum, loop_drift, closed_loop: what else was measured, where
            the method has it.
    """

    clips: int
    frames: int
    total: float
    terms: dict[str, float]
    collisions: float
    clip_totals: tuple[float, float, float]
    gravity_excess: float
    kinetic_energy: float
    static_distance: float | None
    jerk: float
    jerk_ratio: float
    stretch_quantiles: tuple[float, ...]
    intersections: SelfIntersections
    shown_skin: ShownSkin | None = None
    reference: ReferenceErrors | None = None
    solver: SolverErrors | None = None
    pose_novelty: PoseNovelty | None = None
    settling: Settling | None = None
    minimum: MinimumErrors | None = None
    loop_drift: LoopDrift | None = None
    closed_loop: ClosedLoop | None = None


@dataclass(frozen=True)
class ResultRow:
    """Figures of one method on one split."""

    garment: str
    method: str
    split: str
    figures: Figures
