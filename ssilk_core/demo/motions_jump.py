# SPDX-License-Identifier: Apache-2.0
"""A jump from both feet; between take-off and landing the pelvis flies as gravity says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..physics.constants import GRAVITY
from ..scene.assets import Floats
from .motions_biped import Biped, Track
from .motions_curves import about, bump, clock, ease, keyframes, ramp

START, CROUCH, TAKE_OFF = 0.3, 0.85, 1.12  # seconds: the crouch begins, is deepest, the feet take off
TIPTOE_RISE = 0.055  # the pelvis is this much higher at take-off than standing [m], for an adult of 1.62 m


@dataclass(frozen=True)
class JumpTiming:
    """A jump's size in the measures of its figure [m], and the times [s] that follow from it."""

    height: float
    forward: float
    scale: float

    @property
    def speed(self) -> float:
        """Upward speed at take-off [m/s]."""
        return float(np.sqrt(2 * GRAVITY * self.height))

    @property
    def land(self) -> float:
        """When the feet touch down."""
        return TAKE_OFF + 2 * self.speed / GRAVITY

    @property
    def deep(self) -> float:
        """When the landing is deepest."""
        return self.land + 0.30

    @property
    def done(self) -> float:
        """When the figure stands again."""
        return self.land + 1.05


def jump(biped: Biped, *, height: float = 0.28, forward: float = 0.35) -> Track:
    """Return a jump.

    Args:
        height: rise of the pelvis after take-off, for an adult of 1.62 m [m].
        forward: way to the landing [m].
    """
    leap = JumpTiming(height * biped.scale, forward * biped.scale, biped.scale)
    time = clock(leap.done + 0.5)
    still = biped.stand(len(time))
    crouch = keyframes(
        time,
        (START, 0.0),
        (CROUCH, 1.0),
        (TAKE_OFF + 0.05, 0.0),
        (leap.land - 0.05, 0.1),
        (leap.deep, 0.8),
        (leap.done, 0.0),
    )
    back = 0.07 * biped.scale * crouch
    hips = still.hips + np.stack([0 * time, rise(leap, time), forward_offset(leap, time) - back], axis=-1)
    lean = np.stack([crouch, 0 * time, 0 * time], axis=-1)
    track = replace(
        still, hips=hips, pelvis=about(0, np.radians(30) * crouch), spine=np.radians(22) * lean,
        head=np.radians(-30) * lean, arms=still.arms + arms(leap, time),
    )  # fmt: skip
    return with_feet(biped, leap, time, track)


def rise(leap: JumpTiming, time: Floats) -> Floats:
    """Return the height of the pelvis over its stand [m]; on the ground quintic, to join the flight smoothly."""
    from scipy.interpolate import BPoly

    tip, low, deep = TIPTOE_RISE * leap.scale, -0.24 * leap.scale, -0.20 * leap.scale
    at = [START, CROUCH, TAKE_OFF, leap.land, leap.deep, leap.done]
    states = [
        (0, 0, 0),
        (low, 0, 14),
        (tip, leap.speed, -GRAVITY),
        (tip, -leap.speed, -GRAVITY),
        (deep, 0, 10),
        (0, 0, 0),
    ]
    return BPoly.from_derivatives(at, states)(np.clip(time, START, leap.done))


def forward_offset(leap: JumpTiming, time: Floats) -> Floats:
    """Return the way forward [m]: gaining speed until take-off, steady in flight, slowing after the landing."""
    start, stop = TAKE_OFF - CROUCH, leap.deep - leap.land
    gone = start * ramp((time - CROUCH) / start) - stop * ramp((time - leap.land) / stop)
    return leap.forward * gone / (start / 2 + leap.land - TAKE_OFF + stop / 2)


def arms(leap: JumpTiming, time: Floats) -> Floats:
    """Return what the arms add to hanging, (F, 1, 4): back in the crouch, up in the flight, out for balance."""
    swing = keyframes(
        time,
        (START, 0.0),
        (CROUCH, -48.0),
        (TAKE_OFF + 0.08, 125.0),
        (leap.deep - 0.1, 18.0),
        (leap.done, 0.0),
    )
    lift = keyframes(time, (CROUCH, 0.0), (TAKE_OFF + 0.1, 12.0), (leap.land, 35.0), (leap.done, 0.0))
    bend = keyframes(time, (START, 0.0), (CROUCH, 14.0), (TAKE_OFF + 0.1, 30.0), (leap.done, 0.0))
    return np.radians(np.stack([swing, lift, 0 * time, bend], axis=-1))[:, None]


def with_feet(biped: Biped, leap: JumpTiming, time: Floats, track: Track) -> Track:
    """Return the track with its feet: rolling off over the ball, hanging under the pelvis, landing on the ball."""
    land = leap.land
    pitch = np.radians(
        keyframes(time, (TAKE_OFF - 0.2, 0.0), (TAKE_OFF + 0.1, 55.0), (land - 0.12, 22.0), (land + 0.1, 0.0))
    )
    feet = about(0, np.stack([pitch, pitch], axis=1))
    ground = biped.stance() + np.zeros((len(time), 1, 1))
    ground[..., 2] += leap.forward * ease((time - TAKE_OFF) / (land - TAKE_OFF))[:, None]
    ankles = biped.ankle(feet, ground)
    leg = track.hips[0, 1] - biped.at("LeftFoot")[1]
    free = track.hips[:, 1] - 0.94 * leg - ankles[:, 0, 1]
    share = bump((time - TAKE_OFF + 0.03) / (land - TAKE_OFF + 0.06)) ** (1 / 3)
    ankles[..., 1] += np.maximum(share * free, 0.0)[:, None]
    toes = pitch * (1 - ease((time - TAKE_OFF) / 0.12))
    return replace(track, feet=feet, ankles=ankles, toes=np.stack([toes, toes], axis=1))
