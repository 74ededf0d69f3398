# SPDX-License-Identifier: Apache-2.0
"""The ONNX graph against the network: frame by frame, by another runtime, what a bake stores."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.cli import main
from ssilk_core.network.checkpoint import model_file, save_model
from ssilk_core.network.model.batch import motion_inputs
from ssilk_core.network.model.export import export_onnx
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.parameters import descriptor_sizes
from ssilk_core.network.proximity import proximity_reach, proximity_vertices
from ssilk_core.network.rollout import garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.sight import RestingPoints
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import TIGHT, ProxyRig, Scene
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import matrix_from_quaternion, motion_transforms

onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: the extra 'dev' brings it")

FRAMES, POINTS = 20, 5
NOTHING = [0.0, 0, 0, 1, -1]  # the proximity of a point that nothing is near


@pytest.fixture(scope="module")
def model(scene, toy_model):
    """Its proxies move, and it sees colliders: of all networks it has the most inputs and outputs."""
    return toy_model(scene, scale=0.1, translations=True, proximity_points=POINTS).eval()


@pytest.fixture(scope="module")
def exported(model, tmp_path_factory):
    """The graph as `ssilk export` writes it, and what that tells."""
    folder, told = tmp_path_factory.mktemp("export"), io.StringIO()
    save_model(folder / "toy.safetensors", model_file(model, FABRICS["silk"], {}))
    with redirect_stdout(told):
        assert main(["export", str(folder / "toy.safetensors"), "-o", str(folder / "toy.onnx"), "--json"]) == 0
    assert [path.name for path in sorted(folder.iterdir())] == ["toy.onnx", "toy.safetensors"]
    session = onnxruntime.InferenceSession(folder / "toy.onnx", providers=["CPUExecutionProvider"])
    return session, json.loads(told.getvalue().splitlines()[-1])["detail"]


def played(session, model, shots, near=None) -> list[np.ndarray]:
    """Play all shots at once; return weights (F, N, K + 1), rotations (F, N, P, 3, 3), translations (F, N, P, 3).

    Where the network sees colliders, `near` is their proximity (F, N, M, 5), and the points that see come last.
    """
    static = descriptor_sizes(model.scene, model.joints, model.config)[0]
    sizes = {each.name: each.shape[1] for each in session.get_inputs()}
    before = now = np.zeros((shots.pose.shape[1], sizes["before"]), np.float32)
    names = [each.name for each in session.get_outputs()]
    frames = []
    for frame, pose in enumerate(shots.pose.numpy()):
        begins = np.full((len(pose), 1), frame < 2)
        given = {
            "before": before,
            "now": now,
            "static": pose[:, model.proximity : static],
            "rates": pose[:, static:],
            "begins": begins,
        }
        if model.feedback.count:
            given["matrices"] = np.moveaxis(shots.character[frame].numpy(), -1, 0)
            given["bend"] = shots.bend[frame].numpy().T
        if near is not None:
            given["proximity"] = near[frame].astype(np.float32)
        state, *found = session.run(names, given)
        before, now = now, state
        frames.append(found)
    expected = ["state", "weights", "rotations", *["translations"] * model.config.translations]
    assert names == [*expected, *["resting"] * (near is not None)]
    return [np.array(values) for values in zip(*frames)]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_every_frame_is_what_a_shot_stores(exported, model, scene, toy_motion, count):
    motions = [toy_motion(scene, 2 * FRAMES).clip(4 * shot, 4 * shot + FRAMES) for shot in range(count)]
    near = np.tile(NOTHING, (FRAMES, count, POINTS, 1))
    weights, rotations, translations, _ = played(exported[0], model, motion_inputs(model, motions), near)
    for shot, motion in enumerate(motions):
        (expected,) = garment_poses(model, motion, motion.fps)
        np.testing.assert_allclose(weights[:, shot], expected.weights, atol=2e-5)
        np.testing.assert_allclose(rotations[:, shot], matrix_from_quaternion(expected.rotations), atol=2e-5)
        np.testing.assert_allclose(translations[:, shot], expected.translations, atol=2e-5)
    assert np.ptp(weights, axis=0).max() > 0.01


def test_a_tight_garment_without_proxies_or_stepper_is_exported(scene, toy_motion, tmp_path):
    garment = replace(scene.garment, classes=np.full(len(scene.classes), TIGHT))
    none = ProxyRig("/none", (), np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4)), scene.lbs_skin)
    tight = Scene(scene.character, garment, none)
    config = ModelConfig(latent=8, widths=(16,), shapes=4, scheme="quasi_static")
    model = GarmentModel(tight, config, np.arange(tight.character.skeleton.joint_count)).eval()
    with torch.no_grad():
        model.output[-1].weight.normal_(generator=torch.Generator().manual_seed(1))
    export_onnx(model, tmp_path / "tight.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "tight.onnx", providers=["CPUExecutionProvider"])
    motion = toy_motion(tight, FRAMES)
    weights, rotations = played(session, model, motion_inputs(model, [motion]))
    (expected,) = garment_poses(model, motion, motion.fps)
    np.testing.assert_allclose(weights[:, 0], expected.weights, atol=2e-5)
    assert rotations.shape == (FRAMES, 1, 0, 3, 3) and np.ptp(weights[..., :4], axis=0).max() > 0.01


@pytest.mark.slow
def test_what_goes_in_and_comes_out_is_told(exported, model):
    session, told = exported
    sizes = {each.name: each.shape[1] for each in session.get_inputs()}
    assert (sizes["static"], sizes["rates"]) == (told["static descriptors"], told["dynamic descriptors"])
    assert session.get_outputs()[1].shape[1] == told["weights"] == model.config.shapes + 1


@pytest.mark.slow
def test_colliders_are_seen_and_where_they_are_is_told(exported, model, scene, toy_motion):
    session, told = exported
    assert told["sees colliders at vertices"] == proximity_vertices(scene, model.config).tolist()
    assert told["sees colliders up to [m]"] == pytest.approx(proximity_reach(scene))
    plain = toy_motion(scene, FRAMES)
    dice = np.random.default_rng(4)
    away = dice.normal(size=(FRAMES, POINTS, 3))
    away /= np.linalg.norm(away, axis=2, keepdims=True)
    depth, plane = dice.uniform(-0.1, 0.1, (FRAMES, POINTS, 1)), dice.normal(size=(FRAMES, POINTS, 1))
    near, found = np.concatenate([away, depth, plane], axis=2), []
    nothing = np.tile(NOTHING, (FRAMES, POINTS, 1))
    for values in (nothing, near):
        motion = replace(plain, proximity=values)
        weights, *_, resting = played(session, model, motion_inputs(model, [motion]), values[:, None])
        found.append(weights[:, 0])
        (expected,) = garment_poses(model, motion, motion.fps)
        np.testing.assert_allclose(found[-1], expected.weights, atol=2e-5)
        joints = motion_transforms(plain, scene.character.skeleton.parents)
        own = RestingPoints(Player(model_file(model, FABRICS["silk"], {})))(plain, joints)
        roots = joints[:, scene.character.skeleton.hub, :3, 3]
        np.testing.assert_allclose(resting[:, 0] + roots[:, None], own, atol=1e-5)
    assert np.abs(found[0] - found[1]).max() > 1e-3


def test_other_suffixes_are_refused(tmp_path, capsys):
    (tmp_path / "toy.safetensors").touch()
    assert main(["export", str(tmp_path / "toy.safetensors"), "-o", str(tmp_path / "toy.bin")]) == 2
    assert "ends in '.bin'; ONNX files end in .onnx" in capsys.readouterr().err
