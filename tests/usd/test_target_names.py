# SPDX-License-Identifier: Apache-2.0
"""Joints whose paths differ and whose last names do not: each gets a name of its own where a target needs it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel
from ssilk_usd.shots.play import Shot
from ssilk_usd.shots.shot import write_shot
from ssilk_usd.units import StageUnits

from ssilk_core.delivery.targets import TARGETS, fit, joint_names
from ssilk_core.scene.assets import (
    Body,
    Character,
    Deformer,
    Garment,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.kinematics import deform, lbs_poses

LONG = "a_name_that_is_so_long_that_applications_cut_it_at_sixty_three_bytes"
ALIKE = ("Hips", "Hips/L", "Hips/L/Arm", "Hips/R", "Hips/R/Arm", "Hips/R/Arm/Arm_2")
CUT = ("Hips", "Hips/L", f"Hips/L/{LONG}_left", "Hips/R", f"Hips/R/{LONG}_right", f"Hips/R/{LONG}_right/Arm")


def arms(names: tuple[str, ...]) -> Deformer:
    """A strip from hand to hand, each row of points on one joint, two of whose arms are named alike."""
    places = np.array([[0, 1, 0], [0.2, 1.4, 0], [0.6, 1.4, 0], [-0.2, 1.4, 0], [-0.6, 1.4, 0], [-0.9, 1.4, 0]])
    parents = np.array([-1, 0, 1, 0, 3, 4])
    bind = np.tile(np.eye(4), (6, 1, 1))
    bind[:, :3, 3] = places
    rest = bind.copy()
    rest[1:, :3, 3] -= places[parents[1:]]
    skeleton = Skeleton("hero.usda:/Hero/Rig", names, parents, bind, rest)
    order = [5, 4, 3, 0, 1, 2]
    points = np.repeat(places[order], 2, axis=0) + np.tile([[0, 0, 0], [0, 0.1, 0]], (6, 1))
    faces = np.concatenate([[[2 * i, 2 * i + 2, 2 * i + 1], [2 * i + 1, 2 * i + 2, 2 * i + 3]] for i in range(5)])
    mesh = Mesh("hero.usda:/Hero/Shirt", points, faces, np.full(10, 3), faces.reshape(-1), None)
    skin = SkinWeights(mesh.path, np.repeat(order, 2)[:, None], np.ones((12, 1)))
    character = Character("hero.usda:/Hero", skeleton, (Body(replace(mesh, path="hero.usda:/Hero/Body"), skin),))
    rig = ProxyRig(mesh.path, (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    scene = Scene(character, Garment(mesh, skin, np.ones(12, dtype=int)), rig)
    return Deformer(scene, skin, np.zeros((0, 12, 3)))


def waving(skeleton: Skeleton) -> Motion:
    turns = np.linspace(0, 1.2, 6)[:, None] * np.array([0, 0, 0.5, 0, -0.8, 0.3])
    rotations = np.stack([np.cos(turns / 2), 0 * turns, 0 * turns, np.sin(turns / 2)], axis=-1)
    return Motion("wave", 30.0, rotations, np.tile(skeleton.rest_transforms[:, :3, 3], (6, 1, 1)))


@pytest.mark.parametrize("names", [ALIKE, CUT])
def test_blender_gets_joints_with_names_of_their_own_that_move_the_same(names, tmp_path):
    deformer = arms(names)
    motion = waving(deformer.scene.character.skeleton)
    right = next(iter([deform(deformer, motion, pose) for pose in lbs_poses(motion.frame_count)]))
    fitted = fit(deformer, TARGETS["blender"])
    path = tmp_path / "shot.usda"
    write_shot(path, fitted, motion, lbs_poses(motion.frame_count), units=StageUnits(1.0, "Z"))
    stage = Usd.Stage.Open(str(path))
    skeleton = next(UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton))
    leaves = [joint.rpartition("/")[2].encode()[:63] for joint in skeleton.GetJointsAttr().Get()]
    assert len(set(leaves)) == len(leaves)
    parents = UsdSkel.Topology(skeleton.GetJointsAttr().Get()).GetParentIndices()
    assert list(parents) == deformer.scene.parents.tolist()
    shot = Shot(str(path))
    for frame, code in enumerate(shot.frame_times):
        np.testing.assert_allclose(shot.garment_points(code), right[frame], atol=1e-5)
    assert [mesh.GetName() for mesh in stage.Traverse() if mesh.IsA(UsdGeom.Mesh)] == ["Shirt", "Body"]


def test_what_is_renamed_is_told_by_name():
    names = joint_names(arms(ALIKE).scene, TARGETS["blender"])
    assert names.renamed == (("Arm", "Arm_3"),)
    assert str(names) == "1 joints share the last part of their path with others: 'Arm' becomes 'Arm_3'"


@pytest.mark.parametrize("target", ["usd", "game4"])
def test_targets_that_read_whole_paths_keep_them(target):
    deformer = arms(ALIKE)
    assert fit(deformer, TARGETS[target]).scene.joint_names == deformer.scene.joint_names
