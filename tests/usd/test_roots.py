# SPDX-License-Identifier: Apache-2.0
"""Skeletons whose limbs have roots of their own, as deforming bones of control rigs have, in whatever order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import ssilk_usd
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.reading.character import read_character

from ssilk_core.authoring.preflight.fit import carried_by_no_joint
from ssilk_core.scene.assets import carrying_joint, is_carried_by

DEMO = Path(ssilk_usd.__file__).parent / "stages" / "demo_body.usdc"


def matrices(found: np.ndarray) -> Vt.Matrix4dArray:
    return Vt.Matrix4dArray([Gf.Matrix4d(*each.reshape(-1).tolist()) for each in found])


def reordered(order: np.ndarray | None, cut: tuple[str, ...]) -> Usd.Stage:
    """Return the demo's body with joints in another order, and cut from their parents where their names begin so."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(Sdf.Layer.FindOrOpen(str(DEMO)))
    stage = Usd.Stage.Open(layer)
    skeleton = next(UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton))
    old, binds = list(skeleton.GetJointsAttr().Get()), np.array(skeleton.GetBindTransformsAttr().Get())
    order = np.arange(len(old)) if order is None else order
    paths = []
    for path in (old[index] for index in order):
        parts = path.split("/")
        first = max(index for index, part in enumerate(parts) if index == 0 or part.startswith(cut))
        paths.append("/".join(parts[first:]))
    parents = UsdSkel.Topology(paths).GetParentIndices()
    binds = binds[order]
    local = [bind @ (np.linalg.inv(binds[above]) if above >= 0 else np.eye(4)) for bind, above in zip(binds, parents)]
    skeleton.GetJointsAttr().Set(paths)
    skeleton.GetBindTransformsAttr().Set(matrices(binds))
    skeleton.GetRestTransformsAttr().Set(matrices(np.array(local)))
    for prim in stage.Traverse():
        indices = UsdSkel.BindingAPI(prim).GetJointIndicesAttr()
        if prim.IsA(UsdGeom.Mesh) and indices and indices.HasAuthoredValue():
            indices.Set(Vt.IntArray.FromNumpy(np.argsort(order)[np.array(indices.Get())].astype(np.int32)))
    return stage


def joint_count() -> int:
    return read_character(str(DEMO)).skeleton.joint_count


@pytest.mark.parametrize("order", ["as it was", "backwards", "shuffled"])
def test_without_any_parents_the_joint_in_the_middle_carries_the_body(order):
    count = joint_count()
    orders = {
        "as it was": None,
        "backwards": np.arange(count)[::-1],
        "shuffled": np.random.default_rng(3).permutation(count),
    }
    character = read_character(reordered(orders[order], ("",)))
    assert (character.skeleton.parents < 0).all()
    assert character.skeleton.joint_names[character.skeleton.hub] == "Spine"
    (finding,) = carried_by_no_joint(character)
    assert finding.count > count / 2 and "Spine is taken to" in finding.found


def test_limbs_with_carried_by_no_joint_leave_the_torso_to_carry_the_body():
    character = read_character(reordered(None, ("LeftUpLeg", "RightUpLeg", "LeftArm", "RightArm")))
    assert np.count_nonzero(character.skeleton.parents < 0) == 5
    assert character.skeleton.joint_names[character.skeleton.hub] == "Hips"
    (finding,) = carried_by_no_joint(character)
    legs_and_arms = {character.skeleton.joint_names[joint].split("/")[0] for joint in finding.indices}
    assert legs_and_arms == {"LeftUpLeg", "RightUpLeg", "LeftArm", "RightArm"}


@pytest.mark.parametrize("cut", [("",), ("LeftUpLeg", "RightUpLeg", "LeftArm", "RightArm", "Spine")])
def test_a_still_joint_above_limbs_with_roots_of_their_own_carries_no_body(cut):
    """Captures are flattened beneath one joint, and control rigs export pelvis and spine beside each other."""
    stage = reordered(None, cut)
    carried = read_character(stage).skeleton
    skeleton = next(UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton))
    skeleton.GetJointsAttr().Set(["root", *(f"root/{path}" for path in skeleton.GetJointsAttr().Get())])
    for attribute in (skeleton.GetBindTransformsAttr(), skeleton.GetRestTransformsAttr()):
        attribute.Set([Gf.Matrix4d(1), *attribute.Get()])
    for prim in stage.Traverse():
        indices = UsdSkel.BindingAPI(prim).GetJointIndicesAttr()
        if prim.IsA(UsdGeom.Mesh) and indices and indices.HasAuthoredValue():
            shifted = np.array(indices.Get()) + 1
            shifted[0] = 0  # painted by accident
            indices.Set(Vt.IntArray.FromNumpy(shifted))
    character = read_character(stage)
    assert character.skeleton.joint_names[character.skeleton.hub] == f"root/{carried.joint_names[carried.hub]}"
    assert len(list(carried_by_no_joint(character))) == 1


def test_a_body_that_hangs_from_one_root_is_no_finding():
    assert not list(carried_by_no_joint(read_character(str(DEMO))))


MAKEHUMAN = ("root", "root/thigh_L", "root/thigh_L/foot_L", "root/thigh_R", "root/thigh_R/foot_R", "root/spine",
             "root/spine/head")  # fmt: skip


@pytest.mark.parametrize(("height", "hub"), [(0.9, "root"), (0.0, "root/spine")])
def test_a_joint_without_skin_carries_the_limbs_that_begin_at_it(height, hub):
    """MakeHuman's root moves no skin: thighs and spine begin a few centimetres from it."""
    places = np.array(
        [(0.0, 0, 0), (0.05, 0.9, 0), (0.1, 0.1, 0), (-0.05, 0.9, 0), (-0.1, 0.1, 0), (0, 0.95, 0), (0, 1.7, 0)]
    )
    places[0, 1] = height
    moved = [np.array([0.0, 1, 1, 1, 1, 2, 2])]
    assert MAKEHUMAN[carrying_joint(moved, np.array(UsdSkel.Topology(MAKEHUMAN).GetParentIndices()), places)] == hub


STILL = ("root", "root/pelvis", "root/pelvis/chest", "root/bow", "root/bow/top", "root/bow/bottom")


@pytest.mark.parametrize("backwards", [False, True])
def test_beneath_a_still_root_the_largest_of_several_bodies_is_carried(backwards):
    """An archer whose bow bends beside the hips, as horse and rider do: air that stood with the root were wind."""
    paths = STILL[:1] + (STILL[3:] + STILL[1:3] if backwards else STILL[1:])
    parents = np.array(UsdSkel.Topology(paths).GetParentIndices())
    archer, bow = (np.array([float(path in bodies) for path in paths]) for bodies in (STILL[1:3], STILL[3:]))
    hub = carrying_joint([2.0 * bow, 5.0 * archer], parents, np.zeros((6, 3)))
    assert paths[hub] == "root/pelvis"
    assert not is_carried_by([2.0 * bow, 5.0 * archer], parents, hub)
    whole = archer + np.array([float(path == "root") for path in paths])  # the root moves cloth itself
    assert carrying_joint([2.0 * bow, 5.0 * whole], parents, np.zeros((6, 3))) == 0
