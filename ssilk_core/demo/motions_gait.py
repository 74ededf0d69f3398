# SPDX-License-Identifier: Apache-2.0
"""Walking and running along a bent course, from a stand to a stand, each foot still while it carries."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..scene.assets import Floats
from .motions_biped import OUTWARD, Biped, Track
from .motions_curves import FPS, about, apply, bump, clock, ease, euler_rotations, keyframes, travel

STAND_BEFORE, STAND_AFTER = 0.3, 0.6  # seconds of standing around a clip
START_PHASE = -0.25  # phase at which both feet carry; at 0 the left one is in the middle of its stance


@dataclass(frozen=True)
class Gait:
    """A gait of a 1.62 m adult.

    Attributes:
        stride: way of one cycle of two steps [m]; `rate`: cycles per second.
        duty: share of the cycle that a foot carries; `lift`: height of its swing [m];
        width: distance of the feet from the middle [m];
        rise: of the body in mid-stance, negative where it sinks as in running [m]; `drop`: lower than standing [m];
        soft: cycles within which the body gets under way;
        lean: forward lean; `swing`: of the arms; `elbow`: bend; `push`: pitch of the heel at push-off [degrees].
    """

    stride: float
    rate: float
    duty: float
    lift: float
    width: float
    rise: float
    drop: float
    soft: float
    lean: float
    swing: float
    elbow: float
    push: float


WALK = Gait(1.12, 0.92, 0.62, 0.07, 0.065, 0.014, 0.022, 0.5, 3.0, 24.0, 22.0, 40.0)
RUN = Gait(1.95, 1.4, 0.34, 0.20, 0.05, -0.034, 0.045, 1.0, 11.0, 42.0, 85.0, 60.0)


def locomotion(biped: Biped, gait: Gait, cycles: float, *turns: tuple[float, float, float]) -> Track:
    """Return a clip of `cycles` (a multiple of a half) of a gait.

    Args:
        turns: (start, stop, angle): between these cycles the course bends to the left by `angle` [rad].
    """
    spell = 0.55 * gait.rate  # cycles it takes to reach the full rate
    seconds = (cycles + spell) / gait.rate
    time = clock(STAND_BEFORE + seconds + STAND_AFTER)
    gone = travel((time - STAND_BEFORE) * gait.rate, cycles + spell, spell)
    pace = ease((time - STAND_BEFORE) * gait.rate / spell) * ease((STAND_BEFORE + seconds - time) * gait.rate / spell)
    course = WalkPath(gait.stride * biped.scale, cycles - gait.soft, turns)
    phase = gone + START_PHASE
    body = carry(biped, gait, phase, pace, travel(gone, cycles, gait.soft), course)
    return step(biped, gait, phase, pace, course, body)


class WalkPath:
    """The line that a figure follows, by cycles gone."""

    def __init__(self, stride: float, cycles: float, turns: tuple[tuple[float, float, float], ...]) -> None:
        from scipy.integrate import cumulative_simpson
        from scipy.interpolate import CubicSpline

        self.cycles, self.turns = cycles, turns
        at = np.linspace(0, cycles, 801)
        heading = self.heading(at)
        speed = stride * np.stack([np.sin(heading), np.zeros_like(heading), np.cos(heading)], axis=-1)
        self.line = CubicSpline(at, cumulative_simpson(speed, x=at, axis=0, initial=0.0))

    def heading(self, gone: Floats) -> Floats:
        """Return the heading [rad], to the left of +z."""
        return sum(
            (keyframes(gone, (start, 0.0), (stop, angle)) for start, stop, angle in self.turns),
            np.zeros_like(gone),
        )

    def point(self, gone: Floats) -> Floats:
        """Return positions [m], shape (..., 3)."""
        return self.line(np.clip(gone, 0.0, self.cycles))


def carry(biped: Biped, gait: Gait, phase: Floats, pace: Floats, gone: Floats, course: WalkPath) -> Track:
    """Return pelvis, spine and arms of a gait: bob, sway, twist, and arms against the legs."""
    scale, still = biped.scale, biped.stand(len(phase))
    once, side = np.sin(2 * np.pi * phase), np.cos(2 * np.pi * phase)
    heading = course.heading(gone)
    bend = np.gradient(heading) * FPS  # people lean into a bend
    angles = np.stack([np.radians(gait.lean / 2) * pace, heading + np.radians(5) * pace * once,
                       -np.radians(2.5) * pace * side + 0.05 * bend], axis=-1)  # fmt: skip
    shift = 0.02 * scale * pace[:, None] * np.stack([side, 0 * side, 0 * side + 1], axis=-1)
    hips = still.hips + course.point(gone) + apply(about(1, heading), shift)
    hips[:, 1] += scale * pace * (gait.rise * np.cos(4 * np.pi * phase) - gait.drop)
    spine = np.stack(
        [np.radians(gait.lean / 2) * pace, -np.radians(11) * pace * once, np.radians(3) * pace * side], axis=-1
    )
    arms = still.arms.copy()
    arms[..., 0] += (
        np.radians(gait.swing) * (pace * once)[:, None] * OUTWARD - np.radians(0.1 * gait.elbow) * pace[:, None]
    )
    bent = np.radians(gait.elbow - 16) + np.radians(0.3 * gait.swing) * once[:, None] * OUTWARD
    arms[..., 3] += pace[:, None] * bent
    return replace(still, hips=hips, pelvis=euler_rotations(angles), spine=spine, head=-0.5 * spine, arms=arms)


def step(biped: Biped, gait: Gait, phase: Floats, pace: Floats, course: WalkPath, body: Track) -> Track:
    """Return a track with its feet: standing by turns, rolling off over the ball, swinging to the next stand."""
    sides = [foot(biped, gait, phase, pace, course, side) for side in range(2)]
    feet, toes, ground, heel, lift = (np.stack(values, axis=1) for values in zip(*sides))
    ankles = biped.ankle(feet, ground, heel=heel)
    ankles[..., 1] += lift
    return replace(body, feet=feet, toes=toes, ankles=ankles)


def foot(
    biped: Biped, gait: Gait, phase: Floats, pace: Floats, course: WalkPath, side: int
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return one foot's rotations, toe bends, ground points, shares of heel pivot and lifts."""
    centres = np.arange(-0.5 * side, course.cycles + gait.soft + 1e-6)
    last = course.cycles + gait.soft - 0.5
    inner = ease(np.minimum(centres, last - centres))  # 0 for the first and last stands
    half = 0.31 + inner * (gait.duty / 2 - 0.31)
    now = np.clip(np.searchsorted(centres - half, phase, side="right") - 1, 0, len(centres) - 1)
    then = np.minimum(now + 1, len(centres) - 1)
    leave, land = (centres + half)[now], np.where(then > now, (centres - half)[then], np.inf)
    air = np.where(np.isfinite(land), land - leave, 1.0)
    swing = np.where(then > now, (phase - leave) / air, 0.0)
    rolled = ease((phase - leave + 0.9 * half[now]) / (0.9 * half[now] + 0.2 * air))
    lowered = ease((swing - 0.12) / 0.7)
    struck = ease((swing - 0.5) / 0.5) + (1 - ease((phase - (centres - half)[now]) / (0.5 * half[now]))) * (now > 0)
    push, strike = np.radians(gait.push) * pace, np.radians(14) * pace
    pitch = push * rolled * (1 - lowered) * (then > now) - strike * struck
    moved = ease(swing)
    heading, ground = plants(biped, gait, course, centres, inner, side)
    yaw = heading[now] + moved * (heading[then] - heading[now])
    feet = about(1, yaw) @ about(0, pitch)
    toes = np.maximum(pitch, 0.0) * (1 - ease(swing / 0.5))
    heel = np.where(swing > 0, moved, 1.0 * (pitch < 0))
    place = ground[now] + moved[:, None] * (ground[then] - ground[now])
    return feet, toes, place, heel, gait.lift * biped.scale * (0.5 + 0.5 * pace) * bump(swing)


def plants(
    biped: Biped, gait: Gait, course: WalkPath, centres: Floats, inner: Floats, side: int
) -> tuple[Floats, Floats]:
    """Return heading and ground point of each stand of a foot."""
    at = np.clip(centres - START_PHASE - gait.soft / 2, 0.0, course.cycles)
    heading = course.heading(at)
    home = biped.stance()[side]
    width = (0.095 + inner * (gait.width - 0.095)) * biped.scale * OUTWARD[side]
    # The course is the line of the pelvis, so a bend turns the stand about the pelvis.
    pelvis = biped.at("Hips")[2]
    offset = np.stack([width, 0 * width, 0 * width + home[2] - pelvis], axis=-1)
    return heading, course.point(at) + (0.0, home[1], pelvis) + apply(about(1, heading), offset)
