# SPDX-License-Identifier: Apache-2.0
"""Motions made in code, for the demo: each begins and ends in the same stand, so that they can follow one another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..errors import fail_unknown
from ..scene.assets import Floats, Motion, Skeleton
from ..scene.kinematics import (
    invert_rigid,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_matrix,
    rigid,
)
from .motions_biped import Biped, Track
from .motions_cartwheel import cartwheel
from .motions_curves import FPS
from .motions_gait import RUN, WALK, Gait, locomotion
from .motions_gestures import gesture, idle
from .motions_jump import jump
from .motions_spin import spin

Dice = np.random.Generator


def build_motion(name: str, skeleton: Skeleton, *, seed: int = 0) -> Motion:
    """Return one of `MOTIONS` for a two-legged skeleton, at 30 frames per second, 3 to 8 s long.

    Args:
        seed: 0 is the motion as designed; any other number varies its speed, size and side.

    Raises:
        SsilkError: there is no motion of that name, or the skeleton lacks the joints of a biped.
    """
    if name not in MAKERS:
        fail_unknown(f"motion '{name}'", "no such motion is made in code", name, MOTIONS)
    biped = Biped(skeleton)
    dice = np.random.default_rng(seed)
    track = MAKERS[name](biped, dice if seed else None)
    if seed % 2:
        track = mirrored(track)
    return biped.solve(name if seed == 0 else f"{name}_{seed}", track)


def training_motions(skeleton: Skeleton) -> list[Motion]:
    """Return the clips that a draft trains on: variants of every motion, and gestures, about 80 s in all."""
    variants = (
        ("idle", 0),
        ("walk", 0),
        ("walk", 1),
        ("walk", 2),
        ("turn_and_stop", 1),
        ("turn_and_stop", 2),
        ("run", 1),
    )
    acts = ("run", 2), ("jump", 1), ("jump", 2), ("spin", 0), ("spin", 1), ("cartwheel", 0), ("cartwheel", 1)
    biped = Biped(skeleton)
    gestures = [biped.solve(name, gesture(biped, **parts)) for name, parts in GESTURES.items()]
    return [build_motion(name, skeleton, seed=seed) for name, seed in variants + acts] + gestures


def demo_shot(skeleton: Skeleton) -> Motion:
    """Return the shot of the demo: stand, walk, turn, a small jump, and a stand in which cloth can settle."""
    biped = Biped(skeleton)
    walk = biped.solve("walk", locomotion(biped, replace(WALK, rate=1.0), 2.5, (0.4, 1.9, np.radians(-115))))
    leap = biped.solve("jump", jump(biped, height=0.16, forward=0.2))
    still = biped.solve("idle", idle(biped, 1.6))
    walk, leap = walk.clip(0, walk.frame_count - 15), leap.clip(6, leap.frame_count - 12)
    return chain("demo_shot", skeleton, walk, leap, still)


def chain(name: str, skeleton: Skeleton, *motions: Motion) -> Motion:
    """Return motions of a biped one after the other, each moved so that it begins where the last one ended.

    The hips are moved: joints above them stand still.
    """
    hips = Biped(skeleton).index["Hips"]
    rotations, translations = [motions[0].rotations], [motions[0].translations]
    for motion in motions[1:]:
        end = local(rotations[-1], translations[-1], -1, hips)
        start = local(motion.rotations, motion.translations, 0, hips)
        turn, place = motion.rotations.copy(), motion.translations.copy()
        move = end @ invert_rigid(start)
        turn[:, hips] = multiply_quaternions(quaternion_from_matrix(move[:3, :3]), turn[:, hips])
        if np.dot(turn[0, hips], rotations[-1][-1, hips]) < 0:
            turn[:, hips] *= -1
        place[:, hips] = place[:, hips] @ move[:3, :3].T + move[:3, 3]
        rotations.append(turn[1:])
        translations.append(place[1:])
    return Motion(name, FPS, np.concatenate(rotations), np.concatenate(translations))


def local(rotations: Floats, translations: Floats, frame: int, joint: int) -> Floats:
    """Return the transform of a joint to its parent in one frame, (4, 4)."""
    return rigid(matrix_from_quaternion(rotations[frame, joint]), translations[frame, joint])


def mirrored(track: Track) -> Track:
    """Return a track with left and right exchanged."""
    flip = np.array([-1.0, 1.0, 1.0])
    back = np.array([1.0, -1.0, -1.0])  # of pitch, yaw and roll
    swapped = {name: getattr(track, name)[:, ::-1] for name in ("arms", "grip", "toes")}
    return Track(
        hips=track.hips * flip,
        pelvis=track.pelvis * np.outer(flip, flip),
        spine=track.spine * back,
        head=track.head * back,
        wrists=track.wrists[:, ::-1] * flip,
        ankles=track.ankles[:, ::-1] * flip,
        feet=track.feet[:, ::-1] * np.outer(flip, flip),
        **swapped,
    )


def vary(dice: Dice | None, low: float, high: float) -> float:
    """Return a factor between `low` and `high`, or 1 for the motion as designed."""
    return 1.0 if dice is None else float(dice.uniform(low, high))


def varied(gait: Gait, dice: Dice | None) -> Gait:
    """Return a gait of another speed and swing."""
    pace = vary(dice, 0.82, 1.12)
    return replace(
        gait,
        stride=gait.stride * pace,
        rate=gait.rate * pace * vary(dice, 0.95, 1.05),
        swing=gait.swing * vary(dice, 0.7, 1.3),
    )


def make_turn(biped: Biped, dice: Dice | None) -> Track:
    """Return a walk that turns about and stops."""
    angle = np.pi * vary(dice, 0.45, 1.05)
    return locomotion(biped, varied(WALK, dice), 3.5, (1.0, 2.6, angle))


def make_walk(biped: Biped, dice: Dice | None) -> Track:
    """Return a walk, straight on or, when varied, in a gentle bend."""
    bend = 0.0 if dice is None else float(dice.uniform(-0.9, 0.9))
    return locomotion(biped, varied(WALK, dice), 3.0, (0.3, 2.2, bend))


MAKERS: dict[str, Callable[[Biped, Dice | None], Track]] = {
    "idle": lambda biped, dice: idle(biped, 4.0),
    "walk": make_walk,
    "run": lambda biped, dice: locomotion(biped, varied(RUN, dice), 4.0),
    "turn_and_stop": make_turn,
    "jump": lambda biped, dice: jump(biped, height=0.28 * vary(dice, 0.5, 1.1), forward=0.35 * vary(dice, 0.0, 1.8)),
    "spin": lambda biped, dice: spin(biped, turns=2 if dice is None else 1, rate=1.05 * vary(dice, 0.75, 1.05)),
    "cartwheel": lambda biped, dice: cartwheel(biped),
}
MOTIONS = tuple(MAKERS)

# Keys of gestures: time [s], then what `gesture` says.
GESTURES: dict[str, dict] = {
    "reach_up": {
        "seconds": 4.2,
        "spine": ((1.5, (-14, 0, 0)), (2.6, (-10, 14, 6))),
        "head": ((1.5, (-22, 0, 0)), (2.6, (-18, 10, 0))),
        "left": ((1.4, (150, 10, 0, 12)), (2.6, (160, 14, 0, 6))),
        "right": ((1.6, (140, 10, 0, 20)), (2.6, (40, 20, 0, 40))),
    },
    "bend": {
        "seconds": 4.2,
        "hips": ((1.7, (0, -0.10, -0.12)),),
        "pelvis": ((1.7, (42, 0, 0)),),
        "spine": ((1.7, (48, 0, 0)), (2.4, (34, 10, 0))),
        "head": ((1.7, (-18, 0, 0)),),
        "left": ((1.7, (72, 6, 0, 12)), (2.6, (46, 14, 0, 30))),
        "right": ((1.7, (78, 6, 0, 12)), (2.4, (66, 10, 0, 26))),
    },
    "arms_out": {
        "seconds": 4.6,
        "spine": ((1.2, (-5, 0, 0)), (2.2, (-5, 28, 0)), (3.2, (-5, -28, 0))),
        "left": ((1.2, (0, 78, 0, -6)), (2.2, (20, 95, 0, 10)), (3.2, (0, 72, 0, -6))),
        "right": ((1.2, (0, 78, 0, -6)), (2.2, (0, 72, 0, -6)), (3.2, (20, 95, 0, 10))),
    },
    "sway": {
        "seconds": 5.0,
        "hips": (
            (1.2, (0.09, -0.02, 0)),
            (2.1, (-0.09, -0.02, 0)),
            (3.0, (0.09, -0.02, 0)),
            (3.9, (-0.07, -0.01, 0)),
        ),
        "spine": ((1.2, (0, 10, 12)), (2.1, (0, -10, -12)), (3.0, (0, 10, 12)), (3.9, (0, -8, -9))),
        "left": ((1.2, (25, 18, 0, 20)), (2.1, (-18, 8, 0, 6)), (3.0, (25, 18, 0, 20))),
        "right": ((1.2, (-18, 8, 0, 6)), (2.1, (25, 18, 0, 20)), (3.0, (-18, 8, 0, 6))),
    },
    "twist": {
        "seconds": 4.4,
        "hips": ((1.0, (0, -0.06, -0.01)), (3.4, (0, -0.06, -0.01))),
        "pelvis": ((1.1, (6, 24, 0)), (2.1, (6, -24, 0)), (3.0, (6, 22, 0))),
        "spine": ((1.1, (4, 36, 0)), (2.1, (4, -36, 0)), (3.0, (4, 34, 0))),
        "left": ((1.1, (-20, 40, 0, 30)), (2.1, (35, 30, 0, 40)), (3.0, (-20, 40, 0, 30))),
        "right": ((1.1, (35, 30, 0, 40)), (2.1, (-20, 40, 0, 30)), (3.0, (35, 30, 0, 40))),
    },
    "squat": {
        "seconds": 4.0,
        "hips": ((1.6, (0, -0.30, -0.10)),),
        "pelvis": ((1.6, (26, 0, 0)),),
        "spine": ((1.6, (22, 0, 0)),),
        "head": ((1.6, (-28, 0, 0)),),
        "left": ((1.6, (82, 6, 0, 4)),),
        "right": ((1.6, (82, 6, 0, 4)),),
    },
}
