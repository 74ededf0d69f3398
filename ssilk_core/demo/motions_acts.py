# SPDX-License-Identifier: Apache-2.0
"""Single acts, from a stand to a stand: standing, gestures on the spot, jump, spin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssilk_core.assets import Floats
from ssilk_core.demo.motions_biped import Biped, Track
from ssilk_core.demo.motions_curves import about, apply, bump, clock, ease, keyed, ramp, travel, turned

GRAVITY = 9.81


def idle(biped: Biped, seconds: float) -> Track:
    """Return standing still: breath, and weight that shifts a little from foot to foot."""
    time = clock(seconds)
    still = biped.stand(len(time))
    there = ease(time / 0.8) * ease((seconds - time) / 0.8)
    shift, breath = there * np.sin(2 * np.pi * time / 3.3), there * np.sin(2 * np.pi * time / 2.6)
    zero = np.zeros_like(time)
    hips = still.hips + 0.012 * biped.scale * np.stack([shift, -0.15 * abs(there), zero], axis=-1)
    spine = np.stack([0.02 * breath, 0.03 * shift, 0.03 * shift], axis=-1)
    return replace(still, hips=hips, spine=spine, head=np.stack([-0.02 * breath, 0.12 * shift, zero], axis=-1))


def gesture(
    biped: Biped,
    seconds: float,
    *,
    hips: tuple = (),
    pelvis: tuple = (),
    spine: tuple = (),
    head: tuple = (),
    left: tuple = (),
    right: tuple = (),
) -> Track:
    """Return a gesture with both feet on the ground, from (time, value) keys at the extremes of each part.

    Values are added to the stand: `hips` (x, y, z) [m]; `pelvis`, `spine`, `head` (pitch, yaw, roll) and the arms
    `left`, `right` (swing, lift, twist, bend) in degrees. Before the first key and after the last it stands.
    """
    time = clock(seconds)
    still = biped.stand(len(time))
    rest = (0.35, seconds - 0.4)
    arms = np.stack([degrees(time, rest, left, 4), degrees(time, rest, right, 4)], axis=1)
    return replace(
        still,
        hips=still.hips + biped.scale * between(time, rest, hips, 3),
        pelvis=turned(degrees(time, rest, pelvis, 3)),
        spine=degrees(time, rest, spine, 3),
        head=degrees(time, rest, head, 3),
        arms=still.arms + arms,
    )


def between(time: Floats, rest: tuple[float, float], keys: tuple, size: int) -> Floats:
    """Return a curve through `keys` that is zero outside `rest`, shape (F, size)."""
    zero = np.zeros(size)
    return keyed(time, (rest[0], zero), *keys, (rest[1], zero))


def degrees(time: Floats, rest: tuple[float, float], keys: tuple, size: int) -> Floats:
    """Return `between` of keys in degrees as radians."""
    return np.radians(between(time, rest, keys, size))


def jump(biped: Biped, *, height: float = 0.28, forward: float = 0.35) -> Track:
    """Return a jump from both feet; the pelvis flies as gravity says.

    Args:
        height: rise of the pelvis after take-off [m].
        forward: way to the landing [m].
    """
    from scipy.interpolate import BPoly

    scale = biped.scale
    speed = np.sqrt(2 * GRAVITY * height * scale)
    flight = 2 * speed / GRAVITY
    low, off = 0.85, 1.12
    land = off + flight
    deep, done = land + 0.30, land + 1.05
    time = clock(done + 0.5)
    still = biped.stand(len(time))
    tip = 0.055 * scale  # the pelvis is this much higher on tiptoe than standing
    knots = [(0.3, 0, 0, 0), (low, -0.24 * scale, 0, 14), (off, tip, speed, -GRAVITY), (land, tip, -speed, -GRAVITY),
             (deep, -0.20 * scale, 0, 10), (done, 0, 0, 0)]  # fmt: skip
    rise = BPoly.from_derivatives([k[0] for k in knots], [k[1:] for k in knots])(np.clip(time, 0.3, done))
    crouch = keyed(time, (0.3, 0.0), (low, 1.0), (off + 0.05, 0.0), (land - 0.05, 0.1), (deep, 0.8), (done, 0.0))
    way = forward * scale * jump_way(time, low, off, land, deep)
    hips = still.hips + np.stack([0 * time, rise, way - 0.07 * scale * crouch], axis=-1)
    pitch = np.radians(keyed(time, (off - 0.2, 0.0), (off + 0.1, 55.0), (land - 0.12, 22.0), (land + 0.1, 0.0)))
    feet, ankles, toes = jump_feet(biped, time, (off, land), pitch, hips, forward * scale)
    swing = keyed(time, (0.3, 0.0), (low, -48.0), (off + 0.08, 125.0), (deep - 0.1, 18.0), (done, 0.0))
    lift = keyed(time, (low, 0.0), (off + 0.1, 12.0), (land, 35.0), (done, 0.0))
    bend = keyed(time, (0.3, 0.0), (low, 14.0), (off + 0.1, 30.0), (done, 0.0))
    arms = still.arms + np.radians(np.stack([swing, lift, 0 * time, bend], axis=-1))[:, None]
    lean = np.stack([crouch, 0 * time, 0 * time], axis=-1)
    return replace(
        still, hips=hips, pelvis=turned(np.radians(30) * lean), spine=np.radians(22) * lean,
        head=np.radians(-30) * lean, arms=arms, feet=feet, ankles=ankles, toes=toes,
    )  # fmt: skip


def jump_way(time: Floats, low: float, off: float, land: float, deep: float) -> Floats:
    """Return the share of the way gone: speeding up until take-off, steady in flight, slowing after landing."""
    start, stop = off - low, deep - land
    total = start / 2 + (land - off) + stop / 2
    gone = start * ramp_between(time, low, off) - stop * ramp_between(time, land, deep)
    return gone / total


def ramp_between(time: Floats, start: float, stop: float) -> Floats:
    """Return `ramp` stretched to begin at `start` and be of unit speed after `stop`."""
    return ramp((time - start) / (stop - start))


def jump_feet(
    biped: Biped, time: Floats, air: tuple[float, float], pitch: Floats, hips: Floats, forward: float
) -> tuple[Floats, Floats, Floats]:
    """Return feet, ankles and toe bends of a jump: on the ground, under the pelvis, on the ground."""
    off, land = air
    feet = about(0, np.stack([pitch, pitch], axis=1))
    home = biped.stance() + np.zeros((len(time), 1, 1))
    gone = ease((time - off) / (land - off))
    home[..., 2] += forward * gone[:, None]
    ankles = biped.ankle(feet, home)
    hang = biped.stand(1).hips[0, 1] - biped.at("LeftFoot")[1]
    free = hips[:, 1] - 0.94 * hang
    up = bump((time - off + 0.03) / (land - off + 0.06)) ** (1 / 3)
    ankles[..., 1] += np.maximum(up * (free - ankles[:, 0, 1]), 0.0)[:, None]
    flat = 1 - ease((time - off) / 0.12)
    return feet, ankles, np.stack([pitch * flat] * 2, axis=1)


def spin(biped: Biped, *, turns: int = 2, rate: float = 1.05) -> Track:
    """Return a pirouette to the left on the ball of the left foot; `rate` in turns per second."""
    scale = biped.scale
    wind, off = 0.85, 1.0
    spell = 0.45 * rate
    stop = off + (turns + spell) / rate
    done = stop + 0.75
    time = clock(done + 0.5)
    still = biped.stand(len(time))
    whole = 2 * np.pi * travel((time - off) * rate, turns + spell, spell)
    up = ease((time - off + 0.1) / 0.45) * ease((stop + 0.2 - time) / 0.5)
    sunk = keyed(time, (0.3, 0.0), (wind, 1.0), (off + 0.35, 0.0), (stop - 0.1, 0.0), (stop + 0.3, 0.8), (done, 0.0))
    twist = np.radians(keyed(time, (0.3, 0.0), (wind, -38.0), (off + 0.45, 8.0), (stop + 0.1, 12.0), (done, 0.0)))
    feet, ankles, toes = spin_feet(biped, time, whole, up)
    ball = biped.at("LeftToeBase") - biped.at("LeftFoot")
    centre = biped.stance()[0] + (0, 0, 0.75 * ball[2])
    home = still.hips[0]
    middle = np.array([home[0], 0, home[2]])
    axis = np.array([centre[0], 0, centre[2]])
    weight = ease((time - 0.4) / 0.6) * ease((done - 0.1 - time) / 0.6)
    hips = middle + weight[:, None] * (axis - middle)
    hips[:, 1] = home[1] + scale * (0.05 * up - 0.075 * sunk)
    zero = np.zeros_like(time)
    pelvis = turned(np.stack([zero, whole + 0.4 * twist, zero], axis=-1))
    spine = np.stack([0.08 * sunk, 0.6 * twist, zero], axis=-1)
    lift = keyed(time, (0.3, 0.0), (wind, 38.0), (off + 0.5, 62.0), (stop, 62.0), (done, 0.0))
    swing = keyed(time, (0.3, 0.0), (wind, 8.0), (off + 0.5, 32.0), (stop, 22.0), (done, 0.0))
    bend = keyed(time, (0.3, 0.0), (off + 0.5, 38.0), (stop, 20.0), (done, 0.0))
    arms = still.arms + np.radians(np.stack([swing, lift, zero, bend], axis=-1))[:, None]
    return replace(still, hips=hips, pelvis=pelvis, spine=spine, arms=arms, feet=feet, ankles=ankles, toes=toes)


def spin_feet(biped: Biped, time: Floats, whole: Floats, up: Floats) -> tuple[Floats, Floats, Floats]:
    """Return feet, ankles and toe bends of a pirouette: the left on its ball, the right drawn to the knee."""
    scale, home = biped.scale, biped.stance()
    ball = biped.at("LeftToeBase") - biped.at("LeftFoot")
    pitch = np.stack([np.radians(32) * up, np.radians(50) * up], axis=1)
    yaw = about(1, np.stack([whole, whole], axis=1))
    feet = yaw @ about(0, pitch)
    centre = home[0] + (0.0, 0.0, ball[2])
    ground = np.stack(
        [centre + apply(yaw[:, 0], (0, 0, -ball[2])), centre + apply(yaw[:, 1], home[1] - centre)], axis=1
    )
    ankles = biped.ankle(feet, ground)
    drawn = centre + apply(yaw[:, 1], np.array([-0.06, 0.36, -0.02]) * scale)
    ankles[:, 1] += up[:, None] * (drawn - ankles[:, 1])
    return feet, ankles, np.stack([pitch[:, 0], 0 * whole], axis=1)
