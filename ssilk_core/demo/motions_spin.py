# SPDX-License-Identifier: Apache-2.0
"""A pirouette to the left on the ball of the left foot, the other drawn to the knee."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..scene.assets import Floats
from .motions_biped import Biped, Track
from .motions_curves import about, apply, clock, ease, keyframes, travel

START, WIND_UP, TURN = 0.3, 0.85, 1.0  # seconds: the wind-up begins, is widest, the turn begins


@dataclass(frozen=True)
class SpinTiming:
    """How many turns, at how many a second, and when they end [s]."""

    turns: int
    rate: float

    @property
    def spell(self) -> float:
        """Turns within which the full rate is reached."""
        return 0.45 * self.rate

    @property
    def stop(self) -> float:
        """When the turn ends."""
        return TURN + (self.turns + self.spell) / self.rate

    @property
    def done(self) -> float:
        """When the figure stands again."""
        return self.stop + 0.75


def spin(biped: Biped, *, turns: int = 2, rate: float = 1.05) -> Track:
    """Return a pirouette of whole turns at a rate in turns per second."""
    whirl = SpinTiming(turns, rate)
    time = clock(whirl.done + 0.5)
    still = biped.stand(len(time))
    heading = 2 * np.pi * travel((time - TURN) * rate, turns + whirl.spell, whirl.spell)
    up = ease((time - TURN + 0.1) / 0.45) * ease((whirl.stop + 0.2 - time) / 0.5)
    sunk = keyframes(
        time, (START, 0.0), (WIND_UP, 1.0), (TURN + 0.35, 0.0), (whirl.stop - 0.1, 0.0), (whirl.stop + 0.3, 0.8),
        (whirl.done, 0.0),
    )  # fmt: skip
    twist = keyframes(
        time,
        (START, 0.0),
        (WIND_UP, -38.0),
        (TURN + 0.45, 8.0),
        (whirl.stop + 0.1, 12.0),
        (whirl.done, 0.0),
    )
    twist, zero = np.radians(twist), np.zeros_like(time)
    hips = over_ball(biped, whirl, time)
    hips[:, 1] += biped.scale * (0.05 * up - 0.075 * sunk)
    track = replace(
        still, hips=hips, pelvis=about(1, heading + 0.4 * twist),
        spine=np.stack([0.08 * sunk, 0.6 * twist, zero], axis=-1), arms=still.arms + arms(whirl, time),
    )  # fmt: skip
    return with_feet(biped, heading, up, track)


def over_ball(biped: Biped, whirl: SpinTiming, time: Floats) -> Floats:
    """Return the pelvis at standing height, moved over the ball of the left foot while it turns, (F, 3)."""
    home = biped.stand(1).hips[0]
    axis = biped.stance()[0] + 0.75 * ball_ahead(biped)
    axis[1] = home[1]
    there = ease((time - 0.4) / 0.6) * ease((whirl.done - 0.1 - time) / 0.6)
    return home + there[:, None] * (axis - home)


def ball_ahead(biped: Biped) -> Floats:
    """Return the way from ankle to ball of a foot along the ground [m], (3,)."""
    return (biped.at("LeftToeBase") - biped.at("LeftFoot")) * np.array([0.0, 0.0, 1.0])


def arms(whirl: SpinTiming, time: Floats) -> Floats:
    """Return what the arms add to hanging, (F, 1, 4): held out, a little before the chest."""
    lift = keyframes(
        time,
        (START, 0.0),
        (WIND_UP, 38.0),
        (TURN + 0.5, 62.0),
        (whirl.stop, 62.0),
        (whirl.done, 0.0),
    )
    swing = keyframes(
        time,
        (START, 0.0),
        (WIND_UP, 8.0),
        (TURN + 0.5, 32.0),
        (whirl.stop, 22.0),
        (whirl.done, 0.0),
    )
    bend = keyframes(time, (START, 0.0), (TURN + 0.5, 38.0), (whirl.stop, 20.0), (whirl.done, 0.0))
    return np.radians(np.stack([swing, lift, 0 * time, bend], axis=-1))[:, None]


def with_feet(biped: Biped, heading: Floats, up: Floats, track: Track) -> Track:
    """Return the track with its feet; `up` in [0, 1] is how far the left heel and the right foot are raised."""
    home, ahead, yaw = biped.stance(), ball_ahead(biped), about(1, heading)
    pitch = np.radians(np.stack([32 * up, 50 * up], axis=1))
    feet = yaw[:, None] @ about(0, pitch)
    axis = home[0] + ahead
    ground = np.stack([axis - apply(yaw, ahead), axis + apply(yaw, home[1] - axis)], axis=1)
    ankles = biped.ankle(feet, ground)
    drawn = axis + apply(yaw, np.array([-0.06, 0.36, -0.02]) * biped.scale)
    ankles[:, 1] += up[:, None] * (drawn - ankles[:, 1])
    return replace(track, feet=feet, ankles=ankles, toes=pitch * (1, 0))
