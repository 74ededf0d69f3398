# SPDX-License-Identifier: Apache-2.0
"""Smaller models: no better ones of their size, and what they lose is what they say."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import minimize

from ssilk_core.demo.motions import demo_shot
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, model_file, network, save_model
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.quality.reduction import ModelSize, Reducer
from ssilk_core.quality.reduction.influences import InfluenceCandidates, fit_weights, measure_costs
from ssilk_core.quality.reduction.joints import candidate_joints, removal_order
from ssilk_core.quality.reduction.shapes import basis, modes
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import deform

VERTICES, FRAMES, GIVEN = 7, 60, 5
WHOLE = ModelSize(shapes=6, joints=2, influences=2)


def dice(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture
def mass() -> np.ndarray:
    heavy = dice().uniform(0.2, 2, VERTICES)
    return heavy / heavy.sum()


@pytest.fixture
def activations() -> np.ndarray:
    return np.tanh(dice(1).normal(size=(GIVEN, GIVEN)) @ dice(2).normal(size=(GIVEN, FRAMES)) + 0.4)


@pytest.fixture
def linear() -> np.ndarray:
    return dice(3).normal(size=(VERTICES, 3, GIVEN))


NOTHING = np.zeros((VERTICES, 3, FRAMES))


def weighted_rms(error: np.ndarray, mass: np.ndarray) -> float:
    return float(np.sqrt((mass @ (error**2).sum(1)).mean()))


def rebuilt(found, activations: np.ndarray) -> np.ndarray:
    return found.offset[:, :, None] + found.shapes @ (found.readout @ activations).clip(-1, 1)


@pytest.mark.parametrize("count", range(GIVEN + 1))
def test_shapes_lose_what_eckart_and_young_say_is_least(linear, activations, mass, count):
    found, wanted = modes(linear, NOTHING, activations, mass), linear @ activations
    centred = (wanted - wanted.mean(2, keepdims=True)) * np.sqrt(mass)[:, None, None]
    singular = np.linalg.svd(centred.reshape(-1, FRAMES) / np.sqrt(FRAMES), compute_uv=False)
    least = np.sqrt((singular[count:] ** 2).sum())
    smaller = basis(found, count, np.eye(GIVEN))
    assert found.error(count) == pytest.approx(least, abs=1e-7)
    assert weighted_rms(wanted - rebuilt(smaller, activations), mass) == pytest.approx(least, abs=1e-7)


def beyond_shapes(activations: np.ndarray) -> np.ndarray:
    return dice(4).normal(size=(VERTICES, 3, FRAMES)) + dice(5).normal(size=(VERTICES, 3, GIVEN)) @ activations**3


def test_no_other_linear_function_of_the_rank_follows_better(linear, activations, mass, monkeypatch):
    monkeypatch.setattr("ssilk_core.quality.reduction.shapes.RIDGE", 0.0)
    more = beyond_shapes(activations)
    found, wanted = modes(linear, more, activations, mass), linear @ activations + more
    centred = activations - activations.mean(1, keepdims=True)
    goal = ((wanted - wanted.mean(2, keepdims=True)) * np.sqrt(mass)[:, None, None]).reshape(-1, FRAMES)
    reading = dice(6).normal(size=(2, GIVEN))
    for _ in range(400):  # alternating least squares, which knows nothing of eigenvectors
        fields = goal @ np.linalg.pinv(reading @ centred)
        reading = np.linalg.pinv(fields) @ goal @ np.linalg.pinv(centred)
    left = np.sqrt(((goal - fields @ reading @ centred) ** 2).sum(0).mean())
    assert found.error(2) == pytest.approx(left, rel=1e-6)
    smaller = basis(found, 2, np.eye(GIVEN))
    assert weighted_rms(wanted - rebuilt(smaller, activations), mass) == pytest.approx(left, rel=1e-6)


@pytest.mark.parametrize("ridge", [1e-6, 1e-3, 1.0])
def test_what_is_missed_is_known_however_carefully_it_is_learnt(linear, activations, mass, ridge, monkeypatch):
    monkeypatch.setattr("ssilk_core.quality.reduction.shapes.RIDGE", ridge)
    more = beyond_shapes(activations)
    found = modes(linear, more, activations, mass)
    for count in range(GIVEN + 1):
        error = linear @ activations + more - rebuilt(basis(found, count, np.eye(GIVEN)), activations)
        assert found.error(count) == pytest.approx(weighted_rms(error, mass), rel=1e-6)


def test_activations_use_a_quarter_of_their_range_or_more(linear, activations, mass):
    smaller = basis(modes(linear, NOTHING, 0.01 * activations, mass), 3, np.eye(GIVEN))
    assert np.abs(smaller.readout @ (0.01 * activations)).max(axis=1) == pytest.approx(1 / 4)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * GIVEN)).reshape(GIVEN, -1)
    assert np.abs(smaller.readout @ corners).max() > 10


def test_no_range_is_wider_than_activations_can_fill(linear, activations, mass):
    smaller = basis(modes(linear, NOTHING, np.sign(activations), mass), 3, np.eye(GIVEN))
    assert (np.abs(smaller.readout).sum(axis=1) <= 1 + 1e-12).all()


def test_activations_that_never_vary_are_no_trouble(linear, activations, mass):
    still = np.repeat(activations[:, :1], FRAMES, axis=1)
    more = np.repeat(dice(7).normal(size=(VERTICES, 3, 1)), FRAMES, axis=2)
    found = modes(linear, more, still, mass)
    assert found.error(0) == pytest.approx(0, abs=1e-7)
    every = basis(found, GIVEN, np.eye(GIVEN))
    np.testing.assert_allclose(rebuilt(every, still), linear @ still + more, atol=1e-9)


def random_influences(count: int = 5, vertices: int = 40) -> InfluenceCandidates:
    root = dice(8).normal(size=(vertices, count, count + 2))
    weights = dice(9).dirichlet(np.ones(count), vertices)
    root -= (weights[:, :, None] * root).sum(1, keepdims=True)  # the weights that were lose nothing
    return InfluenceCandidates(np.tile(np.arange(count), (vertices, 1)), weights, root @ root.swapaxes(1, 2))


def best_by_search(cost: np.ndarray, most: int) -> float:
    """Return the least v^T H v over all supports, each by a general minimiser."""
    found = []
    for chosen in combinations(range(len(cost)), most):
        own = cost[np.ix_(chosen, chosen)]
        options = {"constraints": {"type": "eq", "fun": lambda v: v.sum() - 1}, "bounds": [(0, 1)] * most}
        start = np.full(most, 1 / most)
        found.append(
            minimize(lambda v, h=own: v @ h @ v, start, jac=lambda v, h=own: 2 * h @ v, tol=1e-12, **options)
        )
    return min(each.fun for each in found)


@pytest.mark.parametrize(("most", "worse"), [(5, 1e-6), (4, 1e-5), (3, 0.15), (1, 0.15)])
def test_weights_are_the_best_of_their_number_or_nearly(most, worse):
    influences = random_influences()
    weights = fit_weights(influences, np.ones((40, 5), dtype=bool), most)
    assert (weights >= 0).all() and ((weights > 0).sum(axis=1) <= most).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    least = np.array([best_by_search(cost, most) for cost in influences.costs])
    lost = influences.error(weights)
    assert (lost >= least - 1e-8).all()
    assert lost.sum() ** 0.5 <= (1 + worse) * least.sum() ** 0.5 + 1e-3
    if most == 5:
        np.testing.assert_allclose(weights, influences.weights, atol=1e-6)


def test_what_weights_cost_is_how_far_vertices_move():
    matrices, points = dice(10).normal(size=(4, 3, 4, 9)), dice(11).normal(size=(2, 3, 9))
    joints, weights = np.array([[0, 2, 3], [1, 3, 0]]), dice(12).dirichlet(np.ones(3), 2)
    influences = measure_costs(joints, weights, matrices, points)
    other = dice(13).dirichlet(np.ones(3), 2)

    def skinned(weights: np.ndarray) -> np.ndarray:
        whole = np.concatenate([points, np.ones((2, 1, 9))], axis=1)
        return np.einsum("vc,vcabf,vbf->vaf", weights, matrices[joints], whole)

    expected = ((skinned(other) - skinned(weights)) ** 2).sum(1).mean(1)
    np.testing.assert_allclose(influences.error(other), expected)


def test_candidates_are_the_joints_that_move_a_vertex_and_those_below(scene):
    weights = np.zeros((3, 5))
    weights[0, 4] = weights[1, 2] = 1
    weights[2, [0, 3]] = 0.5
    found = [set(row[row >= 0]) for row in candidate_joints(scene, weights)]
    assert found == [{1, 3, 4}, {2}, {0, 1, 3}]  # proxy 4 hangs from proxy 3, and that from joint 1


def test_only_ends_of_chains_are_taken_off(scene, toy_scene):
    joints = np.tile([1, 3, 4], (2, 1))
    useless_root = InfluenceCandidates(joints, np.tile([0.0, 0, 1], (2, 1)), np.tile(np.diag([9.0, 1, 0]), (2, 1, 1)))
    assert removal_order(scene, useless_root, np.ones(2)) == [4, 3]
    assert removal_order(toy_scene(shuffled=True), useless_root, np.ones(2)) == [3, 4]


@pytest.fixture(scope="module")
def file(scene, toy_model):
    model = toy_model(scene, scale=0.1, shapes=6, translations=True, feedback_points=0).eval()
    return model_file(model, FABRICS["silk"], {"seed": 3})


@pytest.fixture(scope="module")
def motion(scene, toy_motion):
    return toy_motion(scene, 90)


@pytest.fixture(scope="module")
def reducer(file, motion):
    return Reducer(file, [motion])


def vertices(file, motion) -> np.ndarray:
    playback = Player(file).play(motion)
    return np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])


SIZES = [
    ModelSize(shapes=3, joints=2, influences=2),
    ModelSize(shapes=6, joints=1, influences=2),
    ModelSize(shapes=6, joints=2, influences=1),
    ModelSize(shapes=2, joints=0, influences=2),
    ModelSize(shapes=0, joints=1, influences=1),
]


def test_a_model_that_keeps_all_is_the_whole_one(reducer, file):
    assert reducer.whole == WHOLE
    found = reducer.reduce(ModelSize(shapes=99, joints=99, influences=99))
    assert found.file is file and found.size == WHOLE and found.rms == found.largest == 0


def test_what_is_held_stays_with_all_that_it_hangs_from(reducer, file, motion):
    scene = reducer.scene
    last = scene.joint_names[reducer.order[0]]  # which goes first otherwise
    held = Reducer(file, [motion], held=[last])
    above = {name for name in scene.rig.joint_names if last == name or last.startswith(f"{name}/")}
    size = ModelSize(shapes=2, joints=0, influences=2)
    found = held.reduce(size)
    assert set(found.file.scene.rig.joint_names) == above
    assert found.size == held.allowed(size) == replace(size, joints=len(above))
    assert held.predict_error(size) == pytest.approx(held.predict_error(found.size))


def test_a_stepper_that_sees_the_smaller_cloth_goes_its_own_way_a_little(scene, toy_model, motion):
    """Its states are not quite the whole model's, of which the loss is told."""
    file = model_file(toy_model(scene, scale=0.1, shapes=6).eval(), FABRICS["silk"], {})
    found = Reducer(file, [motion]).reduce(ModelSize(shapes=3, joints=2, influences=2))
    away = np.linalg.norm(vertices(found.file, motion) - vertices(file, motion), axis=2)
    mass = Reducer(file, [motion]).mass
    assert found.rms == pytest.approx(np.sqrt((away**2 @ mass).mean()), rel=0.1)


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_what_a_model_says_it_loses_is_what_it_loses_in_play(reducer, file, motion, size):
    found = reducer.reduce(size)
    away = np.linalg.norm(vertices(found.file, motion) - vertices(file, motion), axis=2)
    assert found.rms == pytest.approx(np.sqrt((away**2 @ reducer.mass).mean()), rel=1e-3)
    assert found.largest == pytest.approx(away.max(), rel=1e-3)
    assert found.size == size
    assert found.file.config.shapes == size.shapes and found.file.scene.rig.proxy_count == size.joints


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_files_networks_and_shots_of_it_agree(reducer, motion, size, tmp_path):
    found = reducer.reduce(size).file
    save_model(tmp_path / "small.safetensors", found)
    read = load_model(tmp_path / "small.safetensors")
    model, expected = network(read), vertices(found, motion)
    poses = list(garment_poses(model, motion, motion.fps))
    assert [pose.weights.shape[1] for pose in poses] == [size.shapes + 1]
    assert (np.count_nonzero(model.deformer().skin.weights > 1e-6, axis=1) <= size.influences).all()
    np.testing.assert_allclose(np.concatenate([decode(model, motion, pose) for pose in poses]), expected, atol=1e-5)
    deformer = model.deformer()
    np.testing.assert_allclose(np.concatenate([deform(deformer, motion, p) for p in poses]), expected, atol=1e-5)
    mine = [pose.weights for pose in Player(read).play(motion).poses()]
    np.testing.assert_allclose(np.concatenate(mine), np.concatenate([pose.weights for pose in poses]), atol=1e-5)


def test_single_precision_adds_blendshapes_up_to_a_micrometre():
    """As readers do it; the shipped skirt's were tens of metres long, and missed their sum by ten."""
    whole = load_model(shipped_path("fringe_skirt"))
    shot = demo_shot(whole.scene.character.skeleton).clip(100, 160)
    file = Reducer(whole, [shot]).reduce(QUALITIES["game"].size).file
    shapes = network(file).deformer().shapes.astype(np.float32)
    for pose in Player(file).play(shot).poses():
        weights = pose.weights[::10].astype(np.float32)
        moved = np.zeros((len(weights), *shapes.shape[1:]), np.float32)
        for weight, shape in zip(weights.T, shapes):
            moved += weight[:, None, None] * shape
        exact = np.einsum("fk,kvc->fvc", weights.astype(float), shapes.astype(float), optimize=True)
        assert np.abs(moved - exact).max() < 1e-6


def test_activations_that_leave_their_range_are_held_there(reducer, motion):
    file = reducer.reduce(ModelSize(shapes=3, joints=2, influences=2)).file
    file = replace(file, parameters={**file.parameters, "decoder.readout": 8 * file.parameters["decoder.readout"]})
    weights = np.concatenate([pose.weights for pose in garment_poses(network(file), motion, motion.fps)])
    assert weights.min() == 0 or weights.max() == 1
    played = np.concatenate([pose.weights for pose in Player(file).play(motion).poses()])
    np.testing.assert_allclose(played, weights, atol=1e-5)
    decoded = [decode(network(file), motion, pose) for pose in garment_poses(network(file), motion, motion.fps)]
    np.testing.assert_allclose(vertices(file, motion), np.concatenate(decoded), atol=1e-5)


def test_blendshapes_predict_what_they_miss_before_skinning(file, motion):
    free = file.scene.classes != 0
    reducer = Reducer(file, [motion])
    for count in range(6):
        found = reducer.reduce(replace(WHOLE, shapes=count))
        small, whole = Player(found.file), reducer.player
        given = [reducer.seen.decode(player)[0] for player in (small, whole)]
        shapes = [player.file.parameters["decoder.shapes"] @ each for player, each in zip((small, whole), given)]
        error = shapes[0] + found.file.parameters["decoder.offset"][:, :, None] - shapes[1]
        assert reducer.predict_error(found.size) == pytest.approx(
            weighted_rms(error, reducer.mass[free]), rel=1e-3, abs=1e-6
        )


def test_blendshapes_make_up_for_joints_as_far_as_they_can(reducer):
    lost = [reducer.reduce(ModelSize(shapes=count, joints=1, influences=2)).rms for count in (0, 2, 6)]
    assert lost[0] > 1.05 * lost[1] > 1.05**2 * lost[2] > 0


def test_a_smaller_model_can_be_cut_again(reducer, motion):
    once = reducer.reduce(ModelSize(shapes=4, joints=1, influences=2)).file
    twice = Reducer(once, [motion]).reduce(ModelSize(shapes=2, joints=1, influences=2)).file
    assert twice.config.shapes == 2 and twice.config.activation_count == 6
    at_once = reducer.reduce(ModelSize(shapes=2, joints=1, influences=2)).file
    np.testing.assert_allclose(vertices(twice, motion), vertices(at_once, motion), atol=2e-3)


def test_garments_without_shapes_or_proxies_are_cut_too(toy_scene, toy_model, motion):
    for options, proxies in (({"shapes": 0}, 2), ({"shapes": 6}, 0)):
        scene = toy_scene(proxies=proxies)
        file = model_file(toy_model(scene, scale=0.1, feedback_points=0, **options).eval(), FABRICS["silk"], {})
        found = Reducer(file, [motion]).reduce(ModelSize(shapes=3, joints=1, influences=1))
        away = np.linalg.norm(vertices(found.file, motion) - vertices(file, motion), axis=2)
        assert 0 < away.max() == pytest.approx(found.largest, rel=1e-3)


def test_bad_sizes_and_no_motions_are_refused(file):
    with pytest.raises(SsilkError, match="influences = 0: too few to be kept; it is at least 1"):
        ModelSize(shapes=1, joints=1, influences=0)
    with pytest.raises(SsilkError, match="motions: none given"):
        Reducer(file, [])


def test_a_model_is_cut_to_what_it_does_in_the_wind_of_a_long_motion(file, motion):
    blown = replace(motion, gravity=np.tile([0, -9.81, 9.81], (motion.frame_count, 1)))
    still, seen = (Reducer(file, [each], frames=motion.frame_count // 3).seen for each in (motion, blown))
    assert seen.states.shape == still.states.shape and np.abs(seen.states - still.states).max() > 1e-3
