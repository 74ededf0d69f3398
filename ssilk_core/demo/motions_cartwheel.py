# SPDX-License-Identifier: Apache-2.0
"""A cartwheel to the left: foot, hand, hand, foot. Its second half mirrors the first in time and space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..scene.assets import Floats
from .motions_biped import OUTWARD, SIDE_NAMES, Biped, Track
from .motions_curves import about, apply, bump, clock, ease, keyframes

HANDSTAND = 1.7  # time of the handstand [s]
END = 2 * HANDSTAND
DISTANCE = 2.3  # [m], for an adult of 1.62 m
LEG_ANGLE = np.radians(46)  # of the legs in the air


def cartwheel(biped: Biped) -> Track:
    """Return the whole turn, about 4 s from stand to stand."""
    scale = biped.scale
    time = clock(END + 0.5)
    still = biped.stand(len(time))
    zero = np.zeros_like(time)
    whole = 2 * np.pi * ease((time - 0.66) / (END - 1.32))
    along = DISTANCE * ease((time - 0.45) / (END - 0.9))
    up = keyframes(time, (0.3, 0.0), (1.08, -0.13), (HANDSTAND, 0.13), (END - 1.08, -0.13), (END - 0.3, 0.0))
    hips = still.hips + scale * np.stack([along, up, zero], axis=-1)
    lead = np.radians(keyframes(time, (0.65, 0.0), (1.32, 30.0), (END - 1.32, -30.0), (END - 0.65, 0.0)))
    spine = np.stack([zero, zero, lead], axis=-1)
    raised = ease((time - 0.35) / 0.65) * ease((END - 0.35 - time) / 0.65)
    arms = still.arms + np.radians(raised[:, None, None] * np.array([8.0, 150.0, 0.0, -10.0]))
    feet, ankles = zip(*(foot(biped, time, hips, whole, side) for side in range(2)))
    wrists, grip = hands(biped, time)
    return replace(
        still, hips=hips, pelvis=about(2, -whole), spine=spine, head=-0.5 * spine, arms=arms, wrists=wrists,
        grip=grip, feet=np.stack(feet, axis=1), ankles=np.stack(ankles, axis=1),
    )  # fmt: skip


def foot(biped: Biped, time: Floats, hips: Floats, whole: Floats, side: int) -> tuple[Floats, Floats]:
    """Return rotations and ankle positions of one foot: on the ground, round overhead, on the ground."""
    leave, land = ((1.40, END - 0.95), (0.95, END - 1.40))[side]
    air = ease((time - leave) / 0.34) * ease((land - time) / 0.34)
    after = time > (leave + land) / 2
    ground = standing(biped, time, after, side)
    body = about(2, -whole)
    hip = hips + apply(body, biped.at(SIDE_NAMES[side] + "UpLeg") - biped.at("Hips"))
    # From the ground into the air and back the leg turns about its hip, in the frame of the body.
    leg = apply(np.swapaxes(body, -1, -2), ground - hip)
    angle, length = np.arctan2(leg[:, 0], -leg[:, 1]), np.hypot(leg[:, 0], leg[:, 1])
    angle = angle + air * (OUTWARD[side] * LEG_ANGLE - angle)
    length = length + air * (0.97 * biped.leg - length)
    leg = np.stack([length * np.sin(angle), -length * np.cos(angle), (1 - air) * leg[:, 2]], axis=-1)
    base = np.where(after, 2 * np.pi, 0.0)
    roll = base + air * (whole - OUTWARD[side] * LEG_ANGLE - base)
    return about(2, -roll) @ about(0, np.radians(45) * air), hip + apply(body, leg)


def standing(biped: Biped, time: Floats, after: NDArray[np.bool_], side: int) -> Floats:
    """Return ankle positions on the ground, (F, 3): the left foot steps out first, the right steps in last."""
    scale = biped.scale
    start, stop = ((0.42, 0.95), (END - 0.95, END - 0.42))[side]
    step = ease((time - start) / (stop - start))
    ankle = np.repeat(biped.stand(1).ankles[:, side], len(time), axis=0)
    out = np.where(after, 0.0, step) if side == 0 else np.where(after, step - 1, 0.0)
    ankle[:, 0] += scale * (DISTANCE * after + 0.36 * out)
    ankle[:, 1] += 0.06 * scale * bump((time - start) / (stop - start))
    return ankle


def hands(biped: Biped, time: Floats) -> tuple[Floats, Floats]:
    """Return where the wrists are held, (F, 2, 3), and how much, (F, 2): the left hand comes and goes first."""
    scale = biped.scale
    x = (DISTANCE / 2 - 0.2 * OUTWARD) * scale
    wrists = np.stack([x, np.full(2, biped.ground + 0.155 * scale), np.full(2, 0.03 * scale)], axis=-1)
    spells = ((1.18, END - 1.42), (1.42, END - 1.18))
    grip = [ease((time - start) / 0.22) * ease((stop - time) / 0.22) for start, stop in spells]
    return np.broadcast_to(wrists, (len(time), 2, 3)), np.stack(grip, axis=1)
