# SPDX-License-Identifier: Apache-2.0
"""Names that USD allows, and bones found again among the joints of a model, without Blender."""

from __future__ import annotations

import numpy as np
import pytest

from blender_addon.arrays.joints import Joints, identifiers, joint_order, joint_paths
from blender_addon.arrays.renamed import TrainedJoints, known_as
from blender_addon.errors import SetupError
from ssilk_core.scene.assets import Body, Mesh, SkinWeights


def test_names_become_unique_identifiers():
    assert identifiers(["Arm.L", "Arm_L", "Ärmel", "", "2nd", "Skeleton"], ["Skeleton"]) == [
        "Arm_L", "Arm_L_2", "_rmel", "_", "_2nd", "Skeleton_2",
    ]  # fmt: skip


def test_joint_paths_spell_parents():
    assert joint_paths(["a:Hips", "Leg.L", "Leg_L"], [-1, 0, 1]) == ("a_Hips", "a_Hips/Leg_L", "a_Hips/Leg_L/Leg_L_2")


@pytest.fixture
def joints() -> Joints:
    """Two bones and two proxies, a metre apart."""
    binds = np.tile(np.eye(4), (4, 1, 1))
    binds[:, 1, 3] = range(4)
    return Joints(("Hips", "Über-Spine", "hem.1", "hem.2"), np.array([-1, 0, 1, 2]), binds, proxy_count=2)


def test_a_character_has_no_proxies(joints):
    skeleton = joints.skeleton("/Character/Skeleton")
    assert (joints.proxies, joints.character.names) == (("hem.1", "hem.2"), ("Hips", "Über-Spine"))
    assert skeleton.joint_names == ("Hips", "Hips/_ber_Spine")
    np.testing.assert_array_equal(skeleton.rest_transforms[1, :3, 3], (0, 1, 0))


def test_joints_are_found_again_in_another_order(joints):
    first, second, third, fourth = joints.paths
    assert joint_order(joints, [first, second, fourth, third]).tolist() == [0, 1, 3, 2]


def test_proxies_alone_may_be_missing_and_only_where_that_is_allowed(joints):
    first, second, third, fourth = joints.paths
    assert joint_order(joints, [first, second, fourth], fewer_proxies=True).tolist() == [0, 1, -1, 2]
    for names, fewer, odd in (
        ([first, second, third], False, "hem_2"),
        ([first, third, fourth], True, "_ber_Spine"),
        ([*joints.paths, "Hips/Tail"], True, "Tail"),
    ):
        with pytest.raises(SetupError, match=f"'{odd}' was added, removed, renamed or has another parent"):
            joint_order(joints, names, fewer_proxies=fewer)


def test_two_bones_are_not_one_joint(joints):
    """A bone is chosen to be what a new one beside it is called: the names alone are those of the training."""
    then = TrainedJoints(joints.paths[:2], joints.binds[:2])
    now = Joints(("Hips", "Back", "Über-Spine"), np.array([-1, 0, 0]), joints.binds[[0, 1, 1]])
    both = known_as(now, then, {"Back": "_ber_Spine"})
    assert both.paths == ("Hips", "Hips/_ber_Spine", "Hips/_ber_Spine")
    with pytest.raises(SetupError, match="'_ber_Spine' was added, removed, renamed or has another parent"):
        joint_order(both, then.names)


def test_the_joint_that_carries_the_bodies_is_the_hub(joints):
    """As readers of stages find it: a root above the hips may stand still."""

    def body(weights: list[list[float]], height: float = 1.0) -> Body:
        points = np.array([[0, 0, 0], [1, 0, 0], [0, height, 0]])
        return Body(Mesh("/Body", points, np.array([[0, 1, 2]])), SkinWeights.from_dense("/Body", np.array(weights)))

    moved, spread = body([[0, 1], [0, 1], [0, 1]]), body([[0.5, 0.5], [0, 1], [0, 1]])
    assert joints.skeleton("/").hub == 0
    assert joints.skeleton("/", [moved]).hub == 1
    assert joints.skeleton("/", [moved, spread]).hub == 0
    shadow = body([[1, 0], [1, 0], [1, 0]])
    assert joints.skeleton("/", [body([[0.01, 0.99], [0, 1], [0, 1]]), shadow]).hub == 1


def test_blender_symmetrizes_proxies(bpy):
    """The names that proxies of a symmetric garment have are those that Blender takes for two sides."""
    from ssilk_core.authoring.setup.mirror import LEFT, RIGHT

    rig = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    bone = rig.data.edit_bones.new(f"Cape_proxy_03{LEFT}")
    bone.head, bone.tail = (0.3, 0, 1), (0.35, 0, 0.8)
    bone.select = bone.select_head = bone.select_tail = True
    bpy.ops.armature.symmetrize()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert rig.data.bones[f"Cape_proxy_03{RIGHT}"].head_local[:] == pytest.approx((-0.3, 0, 1))
