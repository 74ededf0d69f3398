# SPDX-License-Identifier: Apache-2.0
"""A model on a character whose joints come in another order, as from another program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.delivery.bake.character import in_order_of
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Body, Character, Mesh, Skeleton, SkinWeights
from ssilk_core.scene.kinematics import local_transforms

TREE = {"Hips": -1, "Hips/Left": 0, "Hips/Right": 0, "Hips/Left/Hand": 1, "Hips/Right/Hand": 2}
DEPTH_FIRST = ("Hips", "Hips/Right", "Hips/Right/Hand", "Hips/Left", "Hips/Left/Hand")


def skeleton(names: tuple[str, ...], parents: dict[str, int] = TREE) -> Skeleton:
    """The tree's joints in an order; a joint's bind place is told by its place in the tree."""
    every = list(parents)
    binds = np.tile(np.eye(4), (len(names), 1, 1))
    binds[:, 0, 3] = [every.index(name) for name in names]
    above = np.array([parents[name] for name in names])
    above = np.array([-1 if parent < 0 else names.index(every[parent]) for parent in above])
    return Skeleton("/Hero/Rig", names, above, binds, local_transforms(binds, above))


def character(names: tuple[str, ...]) -> Character:
    """A triangle whose vertices follow the joints 1, 3 and 4 of the tree."""
    mesh = Mesh("/Hero/Body", np.eye(3), np.array([[0, 1, 2]]), np.array([3]), np.array([0, 1, 2]), None)
    followed = [[names.index(list(TREE)[joint])] for joint in (1, 3, 4)]
    skin = SkinWeights("/Hero/Body", np.array(followed), np.ones((3, 1)))
    return Character("/Hero", skeleton(names), (Body(mesh, skin),))


def test_joints_are_found_by_name_in_any_order():
    trained = skeleton(tuple(TREE))
    found = in_order_of(trained, character(DEPTH_FIRST))
    np.testing.assert_array_equal(found.skeleton.bind_transforms, trained.bind_transforms)
    assert found.skeleton.joint_names == trained.joint_names
    assert found.bodies[0].skin.indices[:, 0].tolist() == [1, 3, 4]


def test_paths_above_a_joint_may_be_others():
    trained, leaves = skeleton(("Hips", "Hips/Left")), ("Hips", "Left")
    other = replace(trained, joint_names=leaves)
    found = in_order_of(trained, Character("/Hero", other, ())).skeleton
    assert found.joint_names == trained.joint_names


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (DEPTH_FIRST[:-1], "1 of the model's joints are missing .Hips/Left/Hand."),
        ((*DEPTH_FIRST, "Tail"), "1 of its joints are not the model's .Tail."),
    ],
)
def test_other_joints_are_named(names, says):
    parents = {**TREE, "Tail": 0}
    with pytest.raises(SsilkError, match=says):
        in_order_of(skeleton(tuple(TREE)), Character("/Hero", skeleton(names, parents), ()))


def test_a_joint_with_another_parent_is_named():
    trained, names = skeleton(("Hips", "Hips/Left", "Hips/Right")), ("Hips", "Left", "Right")
    other = replace(trained, joint_names=names, parents=np.array([-1, 0, 1]))
    with pytest.raises(SsilkError, match="joint 'Right' has another parent"):
        in_order_of(trained, Character("/Hero", other, ()))


def test_a_joint_bound_elsewhere_is_named_whatever_the_order():
    found = character(DEPTH_FIRST)
    binds = found.skeleton.bind_transforms.copy()
    binds[2, 1, 3] += 0.5
    moved = replace(found, skeleton=replace(found.skeleton, bind_transforms=binds))
    with pytest.raises(SsilkError, match=r"is bound 0\.5 m from where"):
        in_order_of(skeleton(tuple(TREE)), moved)
