# SPDX-License-Identifier: Apache-2.0
"""Joints above the one that carries the body: the same character moves the same, whichever joint comes first."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.authoring.preflight.motion import joint_jumps, root_jumps
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, model_file, save_model
from ssilk_core.network.descriptors import descriptor_joints, pose_features
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.rollout import garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.physics.simulate import SimulationOptions, simulate
from ssilk_core.physics.simulate.newton import SolverOptions
from ssilk_core.quality.stress.drives import ProceduralMotion, about, rotate_character
from ssilk_core.scene.assets import Motion, Scene, Skeleton, SkinWeights
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.scene.kinematics import (
    deform,
    first_place,
    invert_rigid,
    local_transforms,
    matrix_from_quaternion,
    motion_transforms,
    quaternion_from_matrix,
    rigid,
    split_at_cuts,
)
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.perturb import perturb_motions
from ssilk_core.training.recombine import limb_joints

ABOVE = rigid(
    Rotation.from_euler("xyz", [[0, 40, 10], [20, 0, -30], [5, 6, 7]], degrees=True).as_matrix(),
    np.array([[3.0, 0.2, -1], [0.5, 0.5, 0.5], [0, 1, 0]]),
)
STILL = len(ABOVE)  # two joints above the hips, and a target of inverse kinematics beside them


def with_still_joints(scene: Scene) -> Scene:
    """The same character with joints that stand still above its hips and beside them."""

    def shifted(skin: SkinWeights) -> SkinWeights:
        return SkinWeights(skin.path, skin.indices + STILL, skin.weights)

    old = scene.character.skeleton
    names = ("root", "root/offset", "root/ik", *(f"root/offset/{name}" for name in old.joint_names))
    parents = np.array([-1, 0, 0, *np.where(old.parents < 0, 1, old.parents + STILL)])
    binds = np.concatenate([ABOVE, old.bind_transforms])
    skeleton = Skeleton("/toy", names, parents, binds, local_transforms(binds, parents), STILL)
    bodies = tuple(replace(body, skin=shifted(body.skin)) for body in scene.character.bodies)
    rig = replace(scene.rig, parents=np.asarray(scene.rig.parents) + STILL, skin=shifted(scene.rig.skin))
    garment = replace(scene.garment, skin=shifted(scene.lbs_skin))
    return Scene(replace(scene.character, skeleton=skeleton, bodies=bodies), garment, rig)


def beneath(motion: Motion) -> Motion:
    """The same motion in the world, of a character whose joints above the hips stand still."""
    hips = rigid(matrix_from_quaternion(motion.rotations[:, 0]), motion.translations[:, 0])
    local = invert_rigid(ABOVE[1]) @ hips
    still = local_transforms(ABOVE, np.array([-1, 0, 0]))
    turns = np.broadcast_to(quaternion_from_matrix(still[:, :3, :3]), (motion.frame_count, STILL, 4))
    places = np.broadcast_to(still[:, :3, 3], (motion.frame_count, STILL, 3))
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    rotations[:, 0], translations[:, 0] = quaternion_from_matrix(local[:, :3, :3]), local[:, :3, 3]
    return replace(
        motion,
        rotations=np.concatenate([turns, rotations], axis=1),
        translations=np.concatenate([places, translations], axis=1),
    )


def running(toy_motion, scene: Scene, frames: int, speed: float = 4.0) -> Motion:
    """A motion that also travels, at a speed [m/s]."""
    motion = toy_motion(scene, frames)
    translations = motion.translations.copy()
    translations[:, 0, 0] += speed * np.arange(frames) / motion.fps
    return replace(motion, translations=translations)


def same_network(model: GarmentModel, scene: Scene) -> GarmentModel:
    """A network's parameters on the character with more joints."""
    joints = descriptor_joints(scene.character.skeleton, np.isin(np.arange(6), model.joints + STILL))
    other = GarmentModel(scene, model.config, joints)
    other.load_state_dict(model.state_dict())
    return other.eval()


def test_the_toys_are_the_same_in_the_world(scene, toy_motion):
    motion, other = running(toy_motion, scene, 5), with_still_joints(scene)
    world = motion_transforms(beneath(motion), other.character.skeleton.parents)
    plain = motion_transforms(motion, scene.character.skeleton.parents)
    np.testing.assert_allclose(world[:, STILL:], plain, atol=1e-12)
    np.testing.assert_allclose(
        first_place(beneath(motion), other.character.skeleton), motion.translations[0, 0], atol=1e-12
    )


@pytest.mark.parametrize("kind", ["relative", "absolute"])
def test_a_network_sees_the_same(scene, toy_motion, kind):
    motion, other = running(toy_motion, scene, 8), with_still_joints(scene)
    joints = descriptor_joints(other.character.skeleton, [False] * 5 + [True])
    assert joints.tolist() == [3, 4, 5]
    plain = pose_features(motion, scene.character.skeleton, np.arange(3), kind=kind)
    found = pose_features(beneath(motion), other.character.skeleton, joints, kind=kind)
    for name in ("static", "dynamic", "down", "earlier"):
        np.testing.assert_allclose(getattr(found, name), getattr(plain, name), atol=1e-9, err_msg=name)


def test_what_hangs_above_the_hub_is_seen_from_it(scene, toy_motion):
    other = with_still_joints(scene).character.skeleton
    joints = descriptor_joints(other, [True, False, True, False, False, True])
    assert joints.tolist() == [0, 2, 3, 4, 5]
    motion = beneath(toy_motion(scene, 4))
    features = pose_features(motion, other, joints)
    world = motion_transforms(motion, other.parents)[..., :3, :3]
    root = np.swapaxes(world[:, 3], -1, -2) @ world[:, 0]
    np.testing.assert_allclose(features.static[:, :6], np.swapaxes(root[..., :2], -1, -2).reshape(4, 6), atol=1e-12)
    turned = ProceduralMotion(motion.fps, motion.frame_count, lambda _: (motion.rotations, motion.translations))
    rotations, translations = rotate_character(turned, other, about((0, 1, 0), angle=0.8)).at(np.zeros(4))
    moved = pose_features(replace(motion, rotations=rotations, translations=translations), other, joints)
    np.testing.assert_allclose(moved.static, features.static, atol=1e-9)
    centre = motion_transforms(motion, other.parents)[:, 3, :3, 3]
    again = motion_transforms(replace(motion, rotations=rotations, translations=translations), other.parents)
    np.testing.assert_allclose(again[:, 3, :3, 3], centre, atol=1e-9)  # it turns where it is


def test_a_rollout_is_the_same_in_torch_and_in_numpy(scene, toy_model, toy_motion, tmp_path):
    plain, motion = toy_model(scene).eval(), running(toy_motion, scene, 20)
    other = same_network(plain, with_still_joints(scene))
    for pose, found in zip(garment_poses(plain, motion, 30.0), garment_poses(other, beneath(motion), 30.0)):
        expected = deform(plain.deformer(), motion, pose)
        np.testing.assert_allclose(deform(other.deformer(), beneath(motion), found), expected, atol=2e-5)
    save_model(tmp_path / "model.safetensors", model_file(other, FABRICS["silk"], {}))
    file = load_model(tmp_path / "model.safetensors")
    assert file.scene.character.skeleton.hub == STILL
    playback = Player(file).play(beneath(motion))
    at = np.stack([playback.vertices(frame) for frame in range(20)])
    np.testing.assert_allclose(at, expected, atol=5e-5)


def test_the_air_moves_along_with_a_runner(scene, toy_motion):
    """Cloth of a runner whose first joint stands still felt a headwind of the runner's own speed."""
    options = SimulationOptions(fps=30, quasi_static_solver=SolverOptions(tolerance=1e-4, iterations=300))
    fabric = Fabric("toy", bending=1e-4, margin=0.01, drag=2.0)
    motion = running(toy_motion, scene, 6)
    (plain,) = simulate(scene, fabric, [motion], options)
    (found,) = simulate(with_still_joints(scene), fabric, [beneath(motion)], options)
    np.testing.assert_allclose(found, plain, atol=1e-4)


def test_a_bank_is_the_same(scene, toy_motion):
    motion, other = running(toy_motion, scene, 10), with_still_joints(scene).character.skeleton
    cpu = torch.device("cpu")
    plain = build_bank([motion], scene.character.skeleton, np.arange(3), 30.0, cpu)
    found = build_bank([beneath(motion)], other, np.arange(3, 6), 30.0, cpu)
    torch.testing.assert_close(found.root, plain.root)
    torch.testing.assert_close(found.character(torch.arange(10))[STILL:], plain.character(torch.arange(10)))
    torch.testing.assert_close(found.dynamic, plain.dynamic)


def test_cuts_are_those_of_the_body(scene, toy_motion):
    motion, other = toy_motion(scene, 20), with_still_joints(scene).character.skeleton
    moved = motion.translations.copy()
    moved[12:, 0] += [5.0, 0, 0]
    jumped = beneath(replace(motion, translations=moved))
    assert [span.frame_count for span in split_at_cuts(jumped, other)] == [12, 8]
    assert "by up to 5 m" in next(iter(root_jumps(jumped, other))).found
    assert not list(joint_jumps(jumped, other))
    rotations = beneath(motion).rotations.copy()
    rotations[12:, 0] = [0, 0, 1, 0]  # of a joint that the hips hang from, far away
    turned = replace(beneath(motion), rotations=rotations)
    assert [span.frame_count for span in split_at_cuts(turned, other)] == [12, 8]


def test_augmentations_leave_the_body_on_its_way(scene, toy_motion):
    other, motion = with_still_joints(scene).character.skeleton, beneath(running(toy_motion, scene, 20))
    assert not any(3 in limb for limb in limb_joints(other))
    (found,) = perturb_motions([motion], other, 1, 0, 0.0)
    np.testing.assert_allclose(found.rotations[:, [0, 1, 3]], motion.rotations[:, [0, 1, 3]], atol=1e-12)


def test_a_hub_must_be_a_joint(scene):
    with pytest.raises(SsilkError, match="joint 7 carries the body; joints are 0 to 2"):
        replace(scene.character.skeleton, hub=7)
