# SPDX-License-Identifier: Apache-2.0
"""What the stepper sees of the cloth: against a plain loop in double precision, and its symmetries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.network.feedback import LIMIT, UNIT, bends, feedback_size, feedback_vertices
from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.scene.assets import PINNED, Motion
from ssilk_core.scene.kinematics import motion_transforms, multiply_quaternions


def body_of(model: GarmentModel, motion: Motion) -> BodyFrames:
    skeleton = model.scene.character.skeleton
    return BodyFrames.of(motion_transforms(motion, skeleton.parents), skeleton, next(model.parameters()))


def states(count: int) -> torch.Tensor:
    return 0.5 * torch.randn(count, 1, 8, generator=torch.Generator().manual_seed(4))


def test_the_vertices_are_spread_over_the_cloth_that_moves(scene, toy_model):
    config = replace(toy_model(scene).config, feedback_points=5)
    found, points = feedback_vertices(scene, config), scene.garment.mesh.points
    free = np.flatnonzero(scene.classes != PINNED)
    assert len(set(found)) == 5 and set(found) <= set(free)
    assert points[found[0], 1] == points[free, 1].min()
    apart = np.linalg.norm(points[found][:, None] - points[found], axis=2) + np.eye(5)
    within = np.linalg.norm(points[free][:, None] - points[found], axis=2).min(axis=1)
    assert apart.min() >= within.max()  # each is at least as far from the others as any vertex is from its nearest
    assert feedback_size(scene, config) == 15


def test_no_more_vertices_are_seen_than_can_move_and_none_without_a_stepper(scene, toy_model):
    config, free = toy_model(scene).config, int((scene.classes != PINNED).sum())
    assert len(feedback_vertices(scene, replace(config, feedback_points=10_000))) == free
    assert feedback_size(scene, replace(config, feedback_points=10_000)) == 3 * free
    still = replace(config, scheme="quasi_static")
    assert len(feedback_vertices(scene, still)) == feedback_size(scene, still) == 0


@torch.no_grad()
def test_what_is_seen_is_free_flight_less_the_course_of_the_latents(scene, toy_model, toy_motion):
    model = toy_model(scene).double()
    motion, z = toy_motion(scene, 3), states(2).double()
    seen = model.seen_from(*z, body_of(model, motion))[0]
    skeleton = scene.character.skeleton
    world = motion_transforms(motion, skeleton.parents)
    matrices = torch.tensor((world @ np.linalg.inv(skeleton.bind_transforms))[:, :, :3])[..., None]

    def points(output: torch.Tensor, frame: int) -> torch.Tensor:
        return model.decoder.vertices(output, matrices[frame])[model.feedback.points.rows, :, 0]

    outputs = [model.output(state) for state in z]
    away = 2 * points(outputs[1], 1) - points(outputs[0], 0) - points(2 * outputs[1] - outputs[0], 2)
    turn = torch.tensor(world[2, 0, :3, :3] @ np.linalg.inv(skeleton.bind_transforms[0, :3, :3]))
    own = (away @ turn).flatten()
    torch.testing.assert_close(seen, LIMIT * torch.tanh(own / (LIMIT * UNIT)), rtol=1e-4, atol=1e-5)
    assert own.abs().max() > 0.1 * UNIT


@torch.no_grad()
def test_free_flight_comes_no_deeper_into_colliders_than_points_were(scene, toy_model, toy_motion):
    """A wall at each of the first points, between where it was and where it would fly, or behind, or nowhere."""
    stopped, skeleton = 4, scene.character.skeleton
    model = toy_model(scene, proximity_points=stopped).double()
    motion, z = toy_motion(scene, 3), states(2).double()
    world = motion_transforms(motion, skeleton.parents)
    roots, plain = world[:, skeleton.hub, :3, 3], model.body_frames(motion, world)
    before, now = (model.decoded(state, plain[at : at + 1]).points[..., 0].numpy() for at, state in enumerate(z))
    flight = 2 * (now + roots[1]) - (before + roots[0])  # in the world
    way = (flight - now - roots[1])[:stopped]
    length = np.linalg.norm(way, axis=1)
    assert length.min() > 1e-3
    toward = way / length[:, None]
    # The share of its way after which each point meets its wall; it is behind the third one, and the fourth has none.
    share = np.array([0.0, 0.7, -0.5, 0.0])
    place = ((now + roots[1])[:stopped] * toward).sum(axis=1) + share * length  # of the walls, along the way
    away = -toward * (np.arange(stopped) < 3)[:, None]

    def near(root: np.ndarray) -> np.ndarray:
        height = np.where(np.arange(stopped) < 3, (toward @ root) - place, -1.0)
        return np.concatenate([away, np.zeros((stopped, 1)), height[:, None]], axis=1)

    met = replace(motion, proximity=np.stack([near(root) for root in roots]))
    seen = model.seen_from(*z, model.body_frames(met, world))[0]
    free = model.seen_from(*z, plain)[0]
    pushed = np.array([1.0, 0.3, 1.0, 0.0]) * length  # the third comes no deeper than it was
    turn = world[2, skeleton.hub, :3, :3] @ np.linalg.inv(skeleton.bind_transforms[skeleton.hub, :3, :3])
    more = UNIT * LIMIT * (torch.atanh(seen / LIMIT) - torch.atanh(free / LIMIT)).reshape(-1, 3).numpy()
    np.testing.assert_allclose(more[:stopped], (pushed[:, None] * away) @ turn, atol=2e-5)
    assert not more[stopped:].any()
    still = replace(
        toy_motion(scene, 3).picked(np.zeros(3, dtype=int)), proximity=met.proximity[:1].repeat(3, axis=0)
    )
    frames = model.body_frames(still, motion_transforms(still, skeleton.parents))
    assert model.seen_from(z[0], z[0], frames).abs().max() < 1e-9  # nothing moves, deep in walls or not


@torch.no_grad()
def test_position_heading_and_a_steady_velocity_do_not_show(scene, toy_model, toy_motion):
    model = toy_model(scene)
    motion, z = toy_motion(scene, 3), states(2)
    seen = model.seen_from(*z, body_of(model, motion))
    turn = Rotation.from_euler("y", 1.1)
    quaternion = np.roll(turn.as_quat(), 1)
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    rotations[:, 0] = multiply_quaternions(np.tile(quaternion, (3, 1)), rotations[:, 0])
    drift = np.arange(3)[:, None] * [0.4, 0.1, -0.3] + [300.0, 2.0, -500.0]
    translations[:, 0] = turn.apply(translations[:, 0]) + drift
    moved = model.seen_from(*z, body_of(model, Motion("/moved", motion.fps, rotations, translations)))
    torch.testing.assert_close(moved, seen, rtol=1e-3, atol=1e-4)
    assert seen.abs().max() > 0.1


@torch.no_grad()
def test_a_garment_at_rest_on_a_body_at_rest_shows_nothing(scene, toy_model, toy_motion):
    model, held = toy_model(scene), toy_motion(scene, 1)
    still = Motion("/held", held.fps, np.repeat(held.rotations, 3, 0), np.repeat(held.translations, 3, 0))
    z = states(1)[0]
    assert model.seen_from(z, z, body_of(model, still)).abs().max() < 1e-4


def test_bends_are_second_differences():
    time = np.arange(5)[:, None] * [1.0, 2.0, 3.0]
    np.testing.assert_allclose(bends(time**2)[2:], np.tile([2.0, 8.0, 18.0], (3, 1)))
    assert (bends(time**2)[:2] == 0).all()


@torch.no_grad()
@pytest.mark.parametrize("translations", [False, True])
def test_a_held_pose_stays_at_its_quasi_static_state_for_ten_seconds(scene, toy_model, toy_motion, translations):
    """Also where states lie beyond half of their bound, which is smooth for P alone."""
    model, held = toy_model(scene, latent_bound=1.0, translations=translations), toy_motion(scene, 1)
    count = 300
    rest = model.initial(torch.randn(1, model.initialiser[0].in_features, generator=torch.Generator().manual_seed(0)))
    assert 0.5 < rest.abs().max() <= 1
    pose = torch.zeros(count, 1, model.stepper[0].in_features - 24 - 3 * model.feedback.count)
    still = Motion(
        "/held", held.fps, np.repeat(held.rotations, count + 2, 0), np.repeat(held.translations, count + 2, 0)
    )
    rolled = model.roll([rest, rest], rest.expand(count, 1, -1), pose, body_of(model, still))
    matrices = body_of(model, still).matrices[0]
    first, last = model.vertices(rolled[0], matrices), model.vertices(rolled[-1], matrices)
    assert (last - first).norm(dim=1).max() < 1e-4
