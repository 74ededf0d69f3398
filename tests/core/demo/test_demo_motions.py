# SPDX-License-Identifier: Apache-2.0
"""Motions made in code: smooth, planted, ballistic where they fly, and the same on any rig with the same names."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path

from ssilk_core.demo.motions import GESTURES, MOTIONS, build_motion, chain, demo_shot, mirrored, training_motions
from ssilk_core.demo.motions_biped import Biped
from ssilk_core.demo.motions_curves import bump, ease, keyframes, ramp, travel
from ssilk_core.demo.motions_gait import WALK, locomotion
from ssilk_core.errors import SsilkError
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Character, Motion, Skeleton

each_motion = pytest.mark.parametrize("name", [*MOTIONS, *GESTURES, "demo_shot"])


@cache
def character() -> Character:
    return read_character(demo_body_path())


def skeleton() -> Skeleton:
    return character().skeleton


@cache
def motion(name: str) -> Motion:
    if name == "demo_shot":
        return demo_shot(skeleton())
    if name in MOTIONS:
        return build_motion(name, skeleton())
    return next(clip for clip in training() if clip.path == name)


@cache
def training() -> tuple[Motion, ...]:
    return tuple(training_motions(skeleton()))


def world(clip: Motion, joint: str) -> np.ndarray:
    index = [name.rsplit("/", 1)[-1] for name in skeleton().joint_names].index(joint)
    return kinematics.motion_transforms(clip, skeleton().parents)[:, index]


def places(clip: Motion, joint: str) -> np.ndarray:
    return world(clip, joint)[:, :3, 3]


def turning(clip: Motion) -> np.ndarray:
    """Angular velocities of all joints [rad/s], shape (F - 1, J, 3)."""
    before = clip.rotations[:-1] * [1, -1, -1, -1]
    step = kinematics.multiply_quaternions(clip.rotations[1:], before)
    angle = 2 * np.arctan2(np.linalg.norm(step[..., 1:], axis=-1), step[..., 0])
    axis = step[..., 1:] / np.maximum(np.linalg.norm(step[..., 1:], axis=-1, keepdims=True), 1e-12)
    return angle[..., None] * axis * clip.fps


@each_motion
def test_is_smooth_and_of_one_sign(name: str) -> None:
    clip = motion(name)
    assert clip.fps == 30
    assert 3 <= clip.frame_count / clip.fps <= 8
    assert (np.sum(clip.rotations[1:] * clip.rotations[:-1], axis=-1) > 0.7).all()
    speed = turning(clip)
    # A runner's knee reaches about 1,000 degrees per second; what jumps in one frame would reach tens of thousands.
    assert np.degrees(np.linalg.norm(speed, axis=-1)).max() < 1300
    assert np.linalg.norm(np.diff(speed, axis=0), axis=-1).max() * clip.fps < 650
    assert np.linalg.norm(np.diff(clip.translations[:, 0], n=2, axis=0), axis=-1).max() * clip.fps**2 < 35


@each_motion
def test_joints_do_not_come_apart(name: str) -> None:
    rest = kinematics.local_transforms(skeleton().bind_transforms, skeleton().parents)[1:, :3, 3]
    assert np.abs(motion(name).translations[:, 1:] - rest).max() < 1e-12


@each_motion
def test_begins_and_ends_in_the_common_stand(name: str) -> None:
    clip, stand = motion(name), motion("idle")
    assert np.abs(np.diff(clip.rotations[:6], axis=0)).max() < 1e-3
    for frame in (0, -1):
        same = np.abs(np.sum(clip.rotations[frame, 1:] * stand.rotations[0, 1:], axis=-1))
        assert same.min() > 1 - 1e-7
        assert abs(world(clip, "Hips")[frame, 1, 3] - world(stand, "Hips")[0, 1, 3]) < 1e-4


@each_motion
def test_body_stays_above_the_ground(name: str) -> None:
    body = character().merged_body()
    moved = kinematics.motion_transforms(motion(name), skeleton().parents)[::3]
    matrices = kinematics.skinning_matrices(moved, skeleton().bind_transforms)
    assert kinematics.skin_points(body.mesh.points, body.skin, matrices)[..., 1].min() > -0.01


@pytest.mark.parametrize("name", ["walk", "run", "turn_and_stop", "squat", "bend", "idle", "demo_shot"])
def test_feet_that_carry_do_not_slip(name: str) -> None:
    for side in ("Left", "Right"):
        ball = places(motion(name), f"{side}ToeBase")
        rest = places(motion("idle"), f"{side}ToeBase")[0, 1]
        down = np.abs(ball[:, 1] - rest) < 1e-3
        both = down[1:] & down[:-1]
        assert both.sum() > 0.15 * len(ball)
        assert np.linalg.norm(np.diff(ball, axis=0)[both], axis=-1).max() < 4e-3


def test_walk_repeats_itself() -> None:
    period = 33
    gait = replace(WALK, rate=30 / period)
    clip = Biped(skeleton()).solve("walk", locomotion(Biped(skeleton()), gait, 7.0))
    early, late = clip.rotations[80:113], clip.rotations[80 + period : 113 + period]
    assert np.abs(early - late).max() < 1e-9
    way = np.diff(clip.translations[80 : 81 + 2 * period : period, 0], axis=0)
    assert np.allclose(way, [0, 0, gait.stride * Biped(skeleton()).scale], atol=1e-9)


def test_knees_bend_forward() -> None:
    for name in ("walk", "run", "jump", "squat"):
        clip = motion(name)
        thigh = places(clip, "LeftLeg") - places(clip, "LeftUpLeg")
        shin = places(clip, "LeftFoot") - places(clip, "LeftLeg")
        side = world(clip, "Hips")[:, :3, 0]
        assert np.sum(np.cross(thigh, shin) * side, axis=-1).min() > 0


def test_jump_flies_as_gravity_says() -> None:
    clip = motion("jump")
    rest = places(motion("idle"), "LeftToeBase")[0, 1]
    flying = np.flatnonzero(places(clip, "LeftToeBase")[:, 1] > rest + 0.03)
    assert len(flying) > 8
    height = places(clip, "Hips")[flying[0] + 1 : flying[-1], 1]
    assert np.allclose(np.diff(height, n=2) * clip.fps**2, -9.81, atol=1e-6)
    assert height.max() - places(clip, "Hips")[0, 1] > 0.25


def test_cartwheel_goes_once_over_its_hands() -> None:
    clip = motion("cartwheel")
    up = world(clip, "Hips")[:, :3, :3] @ world(clip, "Hips")[0, :3, :3].T @ [0.0, 1.0, 0.0]
    assert up[:, 1].min() < -0.99
    upside_down = int(up[:, 1].argmin())
    for side in ("Left", "Right"):
        assert places(clip, f"{side}Hand")[upside_down, 1] < 0.2
        assert places(clip, f"{side}Foot")[upside_down, 1] > 1.2
    assert np.abs(clip.rotations[-1, 0] + clip.rotations[0, 0]).max() < 1e-6, "one whole turn changes the sign"
    assert places(clip, "Hips")[-1, 0] > 2.0


@pytest.mark.parametrize(("name", "degrees"), [("turn_and_stop", 180), ("spin", 720), ("walk", 0)])
def test_heading(name: str, degrees: float) -> None:
    clip = motion(name)
    forward = world(clip, "Hips")[:, :3, :3] @ world(clip, "Hips")[0, :3, :3].T @ [0.0, 0.0, 1.0]
    heading = np.unwrap(np.arctan2(forward[:, 0], forward[:, 2]))
    assert np.degrees(heading[-1] - heading[0]) == pytest.approx(degrees, abs=0.1)


def test_run_leaves_the_ground() -> None:
    clip = motion("run")
    rest = places(motion("idle"), "LeftToeBase")[0, 1]
    lowest = np.minimum(places(clip, "LeftToeBase")[:, 1], places(clip, "RightToeBase")[:, 1])
    assert (lowest > rest + 0.02).sum() >= 6
    assert np.linalg.norm(np.diff(places(clip, "Hips"), axis=0), axis=-1).max() * clip.fps > 2.3


def test_seeds_vary_and_repeat() -> None:
    for name in ("walk", "jump", "spin"):
        one, again, other = (build_motion(name, skeleton(), seed=seed) for seed in (3, 3, 4))
        assert np.array_equal(one.rotations, again.rotations)
        assert one.rotations.shape != other.rotations.shape or np.abs(one.rotations - other.rotations).max() > 0.05


def test_mirrored_track_is_the_mirror_image() -> None:
    biped = Biped(skeleton())
    track = locomotion(biped, WALK, 2.0, (0.3, 1.2, 0.8))
    one, other = biped.solve("walk", track), biped.solve("mirrored", mirrored(track))
    for part in ("Hand", "Leg", "ToeBase"):
        left, right = places(one, f"Left{part}"), places(other, f"Right{part}")
        # The rig itself is symmetric to a tenth of a millimetre only.
        assert np.abs(left * [-1, 1, 1] - right).max() < 1e-3


def test_chained_clips_join_without_a_jump() -> None:
    joined = chain("both", skeleton(), motion("turn_and_stop"), motion("jump"))
    seam = motion("turn_and_stop").frame_count
    assert np.abs(np.diff(places(joined, "Head"), axis=0)[seam - 3 : seam + 3]).max() < 2e-3
    assert joined.frame_count == seam + motion("jump").frame_count - 1


def test_training_covers_every_motion_and_leaves_the_shot_out() -> None:
    clips = training()
    names = [clip.path for clip in clips]
    assert len(set(names)) == len(names)
    assert {name for name in MOTIONS if any(clip.startswith(name) for clip in names)} == set(MOTIONS)
    assert 12 <= len(clips) <= 20
    assert 60 <= sum(clip.frame_count / clip.fps for clip in clips) <= 95
    assert "demo_shot" not in names


def test_shot_ends_in_a_stand_of_a_second_and_a_half() -> None:
    clip = motion("demo_shot")
    assert 6 <= clip.frame_count / clip.fps <= 8
    assert np.linalg.norm(np.diff(places(clip, "Neck"), axis=0)[-45:], axis=-1).max() * clip.fps < 0.06


def test_joint_frames_of_the_rig_do_not_matter() -> None:
    dice = np.random.default_rng(0).normal(size=(skeleton().joint_count, 4))
    spun = kinematics.matrix_from_quaternion(dice / np.linalg.norm(dice, axis=1, keepdims=True))
    bind = skeleton().bind_transforms.copy()
    bind[:, :3, :3] = bind[:, :3, :3] @ spun
    other = replace(skeleton(), bind_transforms=bind)
    moved = kinematics.motion_transforms(build_motion("cartwheel", other), other.parents)
    usual = kinematics.motion_transforms(motion("cartwheel"), skeleton().parents)
    assert np.abs(moved @ np.linalg.inv(bind) - usual @ np.linalg.inv(skeleton().bind_transforms)).max() < 1e-9


def test_a_rig_without_legs_is_told_what_it_lacks() -> None:
    names = tuple(name.replace("LeftLeg", "Shin") for name in skeleton().joint_names)
    with pytest.raises(SsilkError, match="no joint named LeftLeg"):
        build_motion("walk", replace(skeleton(), joint_names=names))


def test_unknown_motion_names_the_choices() -> None:
    with pytest.raises(SsilkError, match="cartwheel"):
        build_motion("moonwalk", skeleton())


def test_curves_against_their_definitions() -> None:
    x = np.linspace(-0.5, 1.5, 20001)
    assert np.allclose(np.gradient(ramp(x), x), ease(x), atol=1e-4)
    assert np.abs(np.diff(ease(x), n=2)).max() < 1e-7  # no kink: 2nd derivative at most 10 / sqrt(3), steps of 1e-4
    assert (ease(0.0), ease(0.5), ease(1.0)) == (0.0, 0.5, 1.0)
    assert bump(0.5) == 1.0
    assert travel(10.0, 10.0, 2.0) == pytest.approx(8.0)
    assert travel(5.0, 10.0, 2.0) == pytest.approx(4.0)
    time = np.array([0.0, 1.0, 2.0, 3.0, 9.0])
    assert np.allclose(keyframes(time, (1.0, 5.0), (2.0, -1.0), (3.0, 2.0)), [5.0, 5.0, -1.0, 2.0, 2.0])


def below_a_still_root() -> Skeleton:
    """The demo's skeleton as game engines have it: the hips hang from a root that stands on the ground, turned."""
    own = skeleton()
    root = np.eye(4)
    root[:3, :3] = kinematics.matrix_from_quaternion(np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0]))
    parents = np.r_[-1, own.parents + 1]
    binds = np.concatenate([root[None], own.bind_transforms])
    names = ("root", *(f"root/{name}" for name in own.joint_names))
    return Skeleton("game", names, parents, binds, kinematics.local_transforms(binds, parents), hub=1)


@pytest.mark.parametrize("name", ["walk", "demo_shot"])
def test_a_joint_above_the_hips_stands_still_and_the_figure_moves_alike(name: str) -> None:
    game = below_a_still_root()
    clip = demo_shot(game) if name == "demo_shot" else build_motion(name, game)
    placed = kinematics.motion_transforms(clip, game.parents)
    assert np.ptp(placed[:, 0], axis=0).max() < 1e-9
    wanted = kinematics.motion_transforms(motion(name), skeleton().parents)
    np.testing.assert_allclose(placed[:, 1:], wanted, atol=1e-6)
