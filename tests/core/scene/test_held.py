# SPDX-License-Identifier: Apache-2.0
"""Proxies that hold a garment where linear blend skinning has it, and what lies between two poses."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.scene.assets import GarmentPose, SkinWeights
from ssilk_core.scene.decomposition import PoseFitter
from ssilk_core.scene.held import HeldGarment
from ssilk_core.scene.kinematics import deform, lbs_deformer, lbs_poses


@pytest.fixture(scope="module")
def deformer(scene, toy_model):
    """A garment with trained weights that are others than those of its linear blend skinning, and blendshapes."""
    found, rng = toy_model(scene, shapes=3).deformer(), np.random.default_rng(3)
    dense = found.skin.dense(len(scene.joint_names))
    dense *= rng.uniform(0.5, 1.5, dense.shape)
    skin = SkinWeights.from_dense(found.skin.path, dense / dense.sum(axis=1, keepdims=True))
    free = 0.02 * rng.normal(size=(3, scene.garment.mesh.vertex_count, 3))
    return replace(found, skin=skin, shapes=np.concatenate([free, -0.5 * free.sum(axis=0, keepdims=True)]))


def skinned(scene, motion) -> np.ndarray:
    plain = lbs_deformer(scene)
    return np.concatenate([deform(plain, motion, pose) for pose in lbs_poses(motion.frame_count)])


def rms(points) -> np.ndarray:
    return np.sqrt((points**2).sum(axis=-1).mean(axis=-1))


def test_proxies_hold_a_garment_nearly_as_well_as_they_can(scene, deformer, toy_motion):
    motion = toy_motion(scene, 12, speed=3)
    held = HeldGarment(deformer)
    pose, off = held.pose(motion)
    wanted = skinned(scene, motion)
    np.testing.assert_allclose(off, rms(deform(deformer, motion, pose) - wanted), rtol=1e-9)  # few vertices: all
    rest = np.tile(held.places, (12, 1, 1))
    still = GarmentPose(0, np.tile(pose.rotations[:1] * 0 + [1, 0, 0, 0], (12, 1, 1)), pose.weights, rest)
    fitter = PoseFitter(
        deformer,
        np.ones(wanted.shape[1]),
        vertices=np.arange(wanted.shape[1]),
        lower=held.weights,
        upper=held.weights,
    )
    best = fitter.fit_block(motion, still, wanted).rms
    assert off.max() < 0.5 * rms(deform(deformer, motion, still) - wanted).max()
    assert (off < best + 1e-3).all(), (off, best)


def test_shapes_leave_a_garment_that_was_cut_down_at_rest(scene, deformer):
    """The mean of a reduced model's shapes is taken back as far as they reach."""
    shapes = deformer.shapes.copy()
    shapes[-1] += 0.2 * shapes[0] - 0.1 * shapes[1]
    held = HeldGarment(replace(deformer, shapes=shapes))
    assert np.abs(np.tensordot(held.weights, shapes, axes=1)).max() < 1e-7
    assert held.weights == pytest.approx([0.3, 0.6, 0.5, 1.0])


def test_between_held_and_free_rotations_take_the_shorter_way(deformer, scene, toy_motion):
    held = HeldGarment(deformer)
    start, _ = held.pose(toy_motion(scene, 3))
    free = GarmentPose(5, -start.rotations, 0 * start.weights + 1, None)
    found = held.blended(start, free, np.array([0.0, 0.25, 1.0]))
    assert found.start == 5
    np.testing.assert_allclose(np.abs((found.rotations * start.rotations).sum(-1)), 1, atol=1e-12)
    np.testing.assert_allclose(found.weights[:, 0], [0.5, 0.625, 1], rtol=1e-6)
    np.testing.assert_allclose(found.translations[2], held.places)
    np.testing.assert_allclose(found.translations[0], start.translations[0])


def test_it_needs_numpy_alone():
    code = "import sys, ssilk_core.scene.held; print({'torch', 'pxr', 'scipy'} & sys.modules.keys())"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "set()"
