# SPDX-License-Identifier: Apache-2.0
"""A bake in an independent reader: tinyusdz reads the file, and numpy skins it as the documents of UsdSkel say."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tinyusdz
from ssilk_usd.shots.play import Shot
from ssilk_usd.writing.author import unique_names

from ssilk_core.cli import main

MICROMETRE = 1e-6


@pytest.fixture(scope="module")
def bake(toy, tmp_path_factory):
    folder = toy.copy(tmp_path_factory.mktemp("reader"))
    toy.write_clip(folder / "sway.usda", frames=8)
    words = ["--stage", "rigged.usda", "--motion", "sway.usda", "-o", "shot.usdc", "--no-verify"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["bake", "model.safetensors", *words]) == 0
    return folder / "shot.usdc"


def found(stage, kind: str) -> list:
    return [prim for prim in tinyusdz.traverse(stage) if prim.type_name == kind]


def array(prim, name: str) -> np.ndarray:
    return np.array(prim.get_attribute(name).value, dtype=np.float64)


def names(prim, name: str) -> list[str]:
    return json.loads(prim.get_attribute(name).value.to_string())


def rotation(quaternions: np.ndarray) -> np.ndarray:
    """Row-vector rotations (J, 3, 3) of quaternions stored as (x, y, z, w)."""
    x, y, z, w = quaternions.T
    columns = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
               2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
               2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]  # fmt: skip
    return np.stack(columns, axis=-1).reshape(-1, 3, 3)


def skinned(stage, mesh, frame: int) -> np.ndarray:
    """Blend shapes, then blend the joints' transforms, rows as vectors."""
    (animation,), (skeleton,) = found(stage, "SkelAnimation"), found(stage, "Skeleton")
    played = {name: np.array(animation.get_attribute_timesamples(name)[frame][1], dtype=np.float64)
              for name in ("rotations", "translations", "blendShapeWeights")}  # fmt: skip
    joints = names(skeleton, "joints")
    assert joints == names(animation, "joints")
    local = np.tile(np.eye(4), (len(joints), 1, 1))
    local[:, :3, :3], local[:, 3, :3] = rotation(played["rotations"]), played["translations"]
    world: dict[str, np.ndarray] = {}
    for joint, own in zip(joints, local):
        world[joint] = own @ world.get(joint.rpartition("/")[0], np.eye(4))
    binds = array(skeleton, "bindTransforms").reshape(-1, 4, 4)
    moved = np.stack([np.linalg.inv(bind) @ world[joint] for joint, bind in zip(joints, binds)])
    points = array(mesh, "points")
    shapes = {prim.name: prim for prim in mesh.children() if prim.type_name == "BlendShape"}
    for name, weight in zip(names(animation, "blendShapes"), played["blendShapeWeights"]):
        points[array(shapes[name], "pointIndices").astype(int)] += weight * array(shapes[name], "offsets")
    weights = array(mesh, "primvars:skel:jointWeights").reshape(len(points), -1)
    indices = array(mesh, "primvars:skel:jointIndices").astype(int).reshape(len(points), -1)
    blended = np.einsum("vk,vkab->vab", weights, moved[indices])
    placed = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return np.einsum("va,vab->vb", placed, blended)[:, :3]


def test_it_skins_the_garment_where_ours_does(bake):
    stage, shot = tinyusdz.load(str(bake)), Shot(bake)
    (garment,) = [mesh for mesh in shot.meshes if mesh.is_garment]
    (mesh,) = [prim for prim in found(stage, "Mesh") if prim.name == garment.name]
    assert len(shot.frame_times) == 8
    for frame, time in enumerate(shot.frame_times):
        assert np.abs(skinned(stage, mesh, frame) - shot.garment_points(time)).max() < MICROMETRE


def test_every_joint_has_a_name_of_its_own_and_a_scale(bake):
    stage = tinyusdz.load(str(bake))
    (animation,), (skeleton,) = found(stage, "SkelAnimation"), found(stage, "Skeleton")
    joints = names(skeleton, "joints")
    assert names(skeleton, "jointNames") == unique_names(joints)
    assert array(animation, "scales").shape == (len(joints), 3)


def test_names_are_numbered_where_several_joints_have_them():
    assert unique_names(["A", "A/B", "A/C", "A/C/B", "A/C/B_2"]) == ["A", "B", "C", "B_3", "B_2"]
