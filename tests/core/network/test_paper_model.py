# SPDX-License-Identifier: Apache-2.0
"""The paper's own model: each of its parts against a plain loop, and all players against one another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, model_file, save_model
from ssilk_core.network.descriptors import pose_features, six_d
from ssilk_core.network.feedback import feedback_size
from ssilk_core.network.model.batch import BatchPlayer, motion_inputs
from ssilk_core.network.model.descriptors import motion_descriptors, turned_vectors
from ssilk_core.network.model.export import INPUTS, FrameNetwork, export_onnx
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.parameters import descriptor_sizes, parameter_shapes
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.network.settings import FREE_ACTIVATION, ModelConfig
from ssilk_core.scene.assets import Motion
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import (
    deform,
    matrix_from_quaternion,
    motion_transforms,
    quaternion_from_matrix,
)

PAPER = {
    "scheme": "verlet",
    "descriptors": "absolute",
    "tanh": False,
    "latent_bound": 0.0,
    "max_latent_step": 0.0,
    "feedback_points": 0,
    "feedback_proxies": True,
}
KINDS = {
    "paper": {},
    "proxies that move": {"translations": True},
    "points beside proxies": {"feedback_points": 5, "translations": True},
    "bounded": {"latent_bound": 0.3, "max_latent_step": 0.05, "tanh": True},
    "blind": {"feedback_proxies": False, "widths": (16, 12)},
}
FRAMES = 150  # more than two blocks of the numpy player


@pytest.fixture(scope="module")
def calm(scene, toy_model):
    """Networks of `KINDS` that are not chaotic, so that rounding in another order stays rounding."""

    def build(kind: str) -> GarmentModel:
        model = toy_model(scene, scale=0.1, **PAPER | KINDS[kind]).eval()
        with torch.no_grad():
            model.integrator.beta.mul_(0.6)
            model.integrator.alpha.fill_(0.9)
        return model

    return build


@pytest.fixture(scope="module", params=KINDS)
def model(request, calm) -> GarmentModel:
    return calm(request.param)


def moved(motion: Motion, turn: np.ndarray) -> Motion:
    """The motion turned as a whole about the origin of the world."""
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    rotations[:, 0] = quaternion_from_matrix(turn @ matrix_from_quaternion(rotations[:, 0]))
    translations[:, 0] = translations[:, 0] @ turn.T
    return replace(motion, rotations=rotations, translations=translations)


def reference(model: GarmentModel, motion: Motion) -> np.ndarray:
    """Latents frame by frame in double precision, written from the paper alone: Eqs. 1 to 3 and its Figure 2."""
    scene, config, joints = model.scene, model.config, model.joints
    skeleton = scene.character.skeleton
    parameters = {name: value.double().numpy() for name, value in model.state_dict().items()}
    world = motion_transforms(motion, skeleton.parents)

    def mlp(name: str, values: np.ndarray) -> np.ndarray:
        count = len(config.widths) + 1
        for layer in range(count):
            values = parameters[f"{name}.{2 * layer}.weight"] @ values + parameters[f"{name}.{2 * layer}.bias"]
            if layer < count - 1:
                values = values / (1 + np.exp(-values))
        return values

    def static(frame: int) -> np.ndarray:
        """6D local rotations, and the direction of gravity in the frame of each joint."""
        local = [matrix_from_quaternion(motion.rotations[frame, j]) for j in joints if skeleton.parents[j] >= 0]
        down = [world[frame, joint, :3, :3].T @ [0.0, -1.0, 0.0] for joint in joints]
        return np.concatenate([*(matrix[:, :2].T.ravel() for matrix in local), *down])

    def dynamic(frame: int) -> np.ndarray:
        past = [frame, frame - 1, frame - 2]
        local = [static(at)[: 6 * (len(joints) - 1)] for at in past[1:]]
        down = [static(at)[6 * (len(joints) - 1) :] for at in past[1:]]
        root = [world[at, 0] for at in past]
        turned = [matrix[:3, :2].T.ravel() for matrix in root]
        return np.concatenate([static(frame), *down, *local, *turned, *(matrix[:3, 3] for matrix in root)])

    def proxies(z: np.ndarray) -> np.ndarray:
        """Rotations in 6D by Gram-Schmidt less the identity, and displacements in decimetres."""
        found = []
        outputs = mlp("output", z)[config.shapes :]
        for row in outputs.reshape(model.decoder.proxy_count, -1):
            x, y = row[:3] + [1, 0, 0], row[3:6] + [0, 1, 0]
            x = x / np.linalg.norm(x)
            y = y - x * (x @ y)
            away, reach = row[6:], 10 * scene.garment.mesh.diagonal  # no proxy goes further
            away = away * reach / max(reach, np.linalg.norm(away))
            found += [*(x - [1, 0, 0]), *(y / np.linalg.norm(y) - [0, 1, 0]), *away]
        return np.array(found)

    z = [mlp("initialiser", static(frame)) for frame in range(2)]
    for frame in range(2, motion.frame_count):
        forward = parameters["integrator.alpha"] * z[-1] + parameters["integrator.beta"] * (z[-1] - z[-2])
        seen = [proxies(z[-2]), proxies(z[-1])] if config.feedback_proxies else []
        z.append(forward + mlp("stepper", np.concatenate([forward, z[-1], dynamic(frame), *seen])))
    return np.array(z)


@pytest.mark.parametrize("kind", ["paper", "proxies that move", "blind"])
def test_the_recurrence_is_the_papers(scene, toy_model, toy_motion, kind):
    model, motion = toy_model(scene, scale=0.1, **PAPER | KINDS[kind]).eval(), toy_motion(scene, 12)
    expected = reference(model, motion)
    player = Player(model_file(model, FABRICS["paper"], {}))
    found = player.play(motion).rolled_spans[0].states(motion.frame_count)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.ptp(expected, axis=0).max() > 0.05
    weights = next(garment_poses(model, motion, motion.fps)).weights[:, : model.config.shapes]
    outputs = model.output(torch.tensor(expected).float())[:, : model.config.shapes].detach().numpy()
    np.testing.assert_allclose((2 * weights - 1) * FREE_ACTIVATION, outputs, atol=1e-4)


def test_the_numpy_player_gives_the_networks_vertices_in_any_block(model, scene, toy_motion):
    motion = toy_motion(scene, FRAMES)
    playback = Player(model_file(model, FABRICS["paper"], {})).play(motion)
    found = np.stack([playback.vertices(frame) for frame in range(FRAMES)])
    expected = np.concatenate([decode(model, motion, pose) for pose in garment_poses(model, motion, motion.fps)])
    np.testing.assert_allclose(found, expected, atol=2e-5)
    backwards = Player(model_file(model, FABRICS["paper"], {})).play(motion)
    assert (np.stack([backwards.vertices(frame) for frame in reversed(range(FRAMES))])[::-1] == found).all()


def test_a_rollout_in_short_chunks_and_a_batch_are_the_same(model, scene, toy_motion):
    motion = toy_motion(scene, 30)
    whole, cut = (list(garment_poses(model, motion, motion.fps, chunk)) for chunk in (256, 7))
    weights = np.concatenate([pose.weights for pose in cut])
    np.testing.assert_allclose(weights, whole[0].weights, atol=1e-5)
    shots = motion_inputs(model, [motion])
    outputs = torch.cat([output.clone() for output in BatchPlayer(model, shots, vertices=False).play(shots)])
    activation = model.decoder.activations(outputs)[0].T / model.config.activation_range
    np.testing.assert_allclose((activation + 1) / 2, whole[0].weights[:, :-1], atol=1e-5)


def test_a_file_holds_what_the_decoder_gives(model, scene, toy_motion, tmp_path):
    motion = toy_motion(scene, 20)
    (pose,) = garment_poses(model, motion, motion.fps)
    assert ((pose.weights >= 0) & (pose.weights <= 1)).all()
    np.testing.assert_allclose(deform(model.deformer(), motion, pose), decode(model, motion, pose), atol=2e-5)
    save_model(tmp_path / "paper.safetensors", model_file(model, FABRICS["paper"], {}))
    read = load_model(tmp_path / "paper.safetensors")
    assert read.config == model.config
    np.testing.assert_allclose(Player(read).deformer().shapes, model.deformer().shapes, atol=1e-9)
    found = {name: value.shape for name, value in read.parameters.items()}
    assert parameter_shapes(scene, model.config, model.joints) == found


@pytest.mark.parametrize("kind", ["paper", pytest.param("points beside proxies", marks=pytest.mark.slow)])
def test_an_engine_plays_the_graph_alike(calm, scene, toy_motion, tmp_path, kind):
    """The paper's own graph is played as PyTorch's: the one with points has its operations, and exports take long."""
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: the extra 'dev' brings it")
    model, motion = calm(kind), toy_motion(scene, 20)
    network, names = FrameNetwork(model), list(INPUTS)
    if model.feedback.count:
        export_onnx(model, tmp_path / "paper.onnx")
        session = onnxruntime.InferenceSession(tmp_path / "paper.onnx", providers=["CPUExecutionProvider"])
        names = [each.name for each in session.get_inputs()]
        assert session.get_inputs()[0].shape[1] == network.state_size
    assert ("matrices" in names) == (model.feedback.count > 0)

    def step(given: dict[str, np.ndarray]) -> list[np.ndarray]:
        if model.feedback.count:
            return session.run(None, given)
        return [each.numpy() for each in network(**{name: torch.as_tensor(value) for name, value in given.items()})]

    shots, static = motion_inputs(model, [motion]), descriptor_sizes(scene, model.joints, model.config)[0]
    before = now = np.zeros((1, network.state_size), np.float32)
    weights = []
    for frame, pose in enumerate(shots.pose.numpy()):
        given = {"before": before, "now": now, "static": pose[:, :static], "rates": pose[:, static:]}
        body = {"matrices": np.moveaxis(shots.character[frame].numpy(), -1, 0), "bend": shots.bend[frame].numpy().T}
        given |= {name: value for name, value in body.items() if name in names}
        with torch.no_grad():
            state, found, *_ = step(given | {"begins": np.full((1, 1), frame < 2)})
        before, now = now, state
        weights.append(found[0])
    (expected,) = garment_poses(model, motion, motion.fps)
    np.testing.assert_allclose(weights, expected.weights, atol=2e-5)
    assert np.ptp(weights, axis=0).max() > 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_turning_a_motion_is_turning_gravity_and_what_is_seen_of_the_world(scene, toy_motion, seed):
    """Static descriptors under a turned gravity, and vectors by `turned_vectors`, are those of the turned motion."""
    skeleton, joints, motion = scene.character.skeleton, np.arange(3), toy_motion(scene, 9)
    turn = Rotation.random(random_state=seed).as_matrix()
    features = pose_features(motion, skeleton, joints, kind="absolute")
    there = motion_descriptors(pose_features(moved(motion, turn), skeleton, joints, kind="absolute"), torch.zeros(1))
    direction = torch.tensor(np.tile(turn.T @ [0.0, -1, 0], (9, 1)))
    heading = torch.tensor(np.tile(turn.T @ [1.0, 0, 0], (9, 1)))
    found = turned_vectors(torch.tensor(features.dynamic), direction, 3 * heading + 0.7 * direction)
    torch.testing.assert_close(found.float(), there[1][:, -found.shape[1] :], rtol=1e-4, atol=1e-5)
    here = motion_descriptors(features, torch.zeros(1))[1][:, -found.shape[1] :]
    assert (found - here)[:, -27:].abs().max() > 0.1


def test_the_first_frames_repeat_the_first(scene, toy_motion):
    motion = toy_motion(scene, 5)
    features = pose_features(motion, scene.character.skeleton, np.arange(3), kind="absolute")
    np.testing.assert_array_equal(features.dynamic[0, :24], np.tile(features.static[0], 2))
    np.testing.assert_array_equal(features.earlier[1, :3], features.down[0])
    np.testing.assert_array_equal(features.earlier[1, 3:], features.down[0])
    root = motion_transforms(motion, scene.character.skeleton.parents)[:, 0]
    np.testing.assert_allclose(features.dynamic[2, 24:42], six_d(root[[2, 1, 0], :3, :3]).ravel())
    np.testing.assert_allclose(features.dynamic[2, 42:], root[[2, 1, 0], :3, 3].ravel())


def test_activations_end_where_a_file_does(scene, toy_model):
    """Within the range they are the outputs of D themselves."""
    decoder = toy_model(scene, **PAPER).decoder
    given = torch.tensor([[-50.0, -3.0, 7.5, 40.0]])
    output = torch.cat([given, torch.zeros(1, decoder.output_count - 4)], dim=1)
    assert decoder.activations(output)[0].T.tolist() == [[-FREE_ACTIVATION, -3.0, 7.5, FREE_ACTIVATION]]


def test_a_scheme_whose_garments_rest_takes_neither(scene):
    for options, found in ({"descriptors": "absolute"}, "absolute"), ({"feedback_proxies": True}, "feedback"):
        with pytest.raises(SsilkError, match=f"{found}.*'spring_verlet'.*scheme=verlet"):
            ModelConfig(**options)
    with pytest.raises(SsilkError, match=r"'absolut'.*absolute"):
        ModelConfig(descriptors="absolut")
    assert feedback_size(scene, ModelConfig(**PAPER | {"scheme": "quasi_static"})) == 0


def test_no_proxy_goes_that_the_stepper_sees(calm, scene):
    from ssilk_core.quality.reduction.files import with_weights

    weights, seen, blind = (
        np.full((len(scene.classes), 5), 0.2),
        *(model_file(calm(kind), FABRICS["paper"], {}) for kind in ("paper", "blind")),
    )
    with pytest.raises(SsilkError, match="stepper sees its proxies; none of them can go; keep all joints"):
        with_weights(seen, weights, [4])
    assert with_weights(blind, weights, [4]).scene.rig.proxy_count == scene.rig.proxy_count - 1
    assert with_weights(seen, weights, []).scene.rig.proxy_count == scene.rig.proxy_count
