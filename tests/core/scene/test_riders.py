# SPDX-License-Identifier: Apache-2.0
"""Where cloth carries a rider, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import (
    Character,
    Deformer,
    Garment,
    GarmentPose,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.kinematics import (
    combined_transforms,
    deform,
    matrix_from_quaternion,
    skin_points,
    skinning_matrices,
)
from ssilk_core.scene.riders import NAME_BYTES, Attachment, Rider, RiderJoints

SIDE = 21  # vertices along a square metre of cloth
DISC = np.array([[0.03 * np.cos(a), 0.03 * np.sin(a), 0.002] for a in np.arange(12) * np.pi / 6])


def sheet() -> Mesh:
    """A square metre of cloth in the plane z = 0, in squares of 50 mm."""
    u, v = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE))
    at = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (
        at[rows, columns].ravel() for rows in (slice(-1), slice(1, None)) for columns in (slice(-1), slice(1, None))
    )
    return Mesh("cloth", np.stack([u, v, 0 * u], -1).reshape(-1, 3), np.concatenate([np.c_[a, b, d], np.c_[a, d, c]]))


def disc(x: float, y: float) -> np.ndarray:
    return DISC + [x, y, 0]


ATTACHMENTS = {
    "a disc across triangles": lambda mesh: Attachment.beneath(disc(0.512, 0.533), mesh, "disc"),
    "a point": lambda mesh: Attachment.beneath(np.array([[0.31, 0.64, 0.01]]), mesh, "point"),
    "three vertices": lambda mesh: Attachment.to_vertices((30, 33, 120), mesh, "brooch"),
}


@pytest.fixture(params=ATTACHMENTS.values(), ids=ATTACHMENTS)
def attachment(request) -> Attachment:
    return request.param(sheet())


def test_a_plane_that_turns_takes_its_riders_along(attachment):
    rng, points = np.random.default_rng(1), sheet().points
    turns = rng.normal(size=(50, 4))
    turns = matrix_from_quaternion(turns / np.linalg.norm(turns, axis=1, keepdims=True))
    moves = rng.normal(size=(50, 3))
    posed = points @ turns.swapaxes(1, 2) + moves[:, None]
    found = attachment.transforms(points[attachment.vertices], posed[:, attachment.vertices])
    np.testing.assert_allclose(found[:, :3, :3], turns, atol=1e-12)
    np.testing.assert_allclose(found[:, :3, 3], moves, atol=1e-12)


def test_cloth_that_stretches_evenly_turns_no_rider_and_takes_its_place_along(attachment):
    rest = sheet().points[attachment.vertices]
    found = attachment.transforms(rest, (1.3 * rest)[None])[0]
    place = attachment.shares @ rest
    np.testing.assert_allclose(found[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found[:3, :3] @ place + found[:3, 3], 1.3 * place, atol=1e-12)


def test_on_cloth_rolled_to_a_cylinder_a_disc_stands_as_the_cylinder_does_beneath_its_middle():
    mesh, radius = sheet(), 0.4
    attachment = Attachment.beneath(disc(0.5, 0.5), mesh, "disc")
    x, y, _ = mesh.points.T
    rolled = np.stack([radius * np.sin((x - 0.5) / radius), y, radius * np.cos((x - 0.5) / radius)], -1)
    # The middle is at a vertex, around which the disc lies evenly.
    (moved,) = attachment.transforms(mesh.points[attachment.vertices], rolled[attachment.vertices][None])
    np.testing.assert_allclose(moved @ [0.5, 0.5, 0, 1], [0, 0.5, radius, 1], atol=1e-12)
    np.testing.assert_allclose(moved[:3, 2], [0, 0, 1], atol=1e-6)


def test_a_place_on_cloth_is_kept_whatever_the_cloth_does_and_riders_stay_rigid():
    mesh, rng = sheet(), np.random.default_rng(2)
    attachment = Attachment.beneath(disc(0.512, 0.533), mesh, "disc")
    posed = mesh.points + rng.normal(scale=0.02, size=(40, *mesh.points.shape))
    moved = attachment.transforms(mesh.points[attachment.vertices], posed[:, attachment.vertices])
    turned = moved[:, :3, :3]
    np.testing.assert_allclose(turned @ turned.swapaxes(1, 2), np.broadcast_to(np.eye(3), turned.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turned), 1, atol=1e-12)
    # The disc's middle is in the triangle (0.50, 0.50), (0.55, 0.55), (0.50, 0.55).
    corner = 10 * SIDE + 10
    corners = [corner, corner + SIDE + 1, corner + SIDE]
    shares = [1 - 0.033 / 0.05, 0.012 / 0.05, (0.033 - 0.012) / 0.05]
    wanted = np.einsum("n,fnc->fc", shares, posed[:, corners])
    place = np.array([0.512, 0.533, 0, 1])
    np.testing.assert_allclose((moved @ place)[:, :3], wanted, atol=1e-9)


def test_three_vertices_carry_as_blender_does_by_their_mean_the_first_edge_and_the_normal():
    mesh, rng = sheet(), np.random.default_rng(3)
    attachment = Attachment.to_vertices((30, 33, 120), mesh, "brooch")
    posed = rng.normal(size=(20, 3, 3))
    moved = attachment.transforms(mesh.points[attachment.vertices], posed)
    a, b, c = posed.swapaxes(0, 1)
    np.testing.assert_allclose((moved @ [*mesh.points[[30, 33, 120]].mean(0), 1])[:, :3], (a + b + c) / 3, atol=1e-12)
    along = (moved[:, :3, :3] @ [1, 0, 0]) - (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    up = np.cross(b - a, c - a)
    np.testing.assert_allclose(along, 0, atol=1e-12)  # 30 to 33 is the x axis at rest
    np.testing.assert_allclose(moved[:, :3, 2], up / np.linalg.norm(up, axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize(
    ("attach", "says"),
    [
        (lambda mesh: Attachment.beneath(disc(0.5, 0.5) + [0, 0, 0.12], mesh, "disc"), "122 mm away.* within 50 mm"),
        (lambda mesh: Attachment.to_vertices((0, 1, 2), mesh, "disc"), "lie in a line"),
        (lambda mesh: Attachment.to_vertices((0, 1, 441), mesh, "disc"), "from 0 to 440"),
        (lambda mesh: Attachment.to_vertices((0, 1, 1), mesh, "disc"), "three different vertices"),
        (lambda mesh: Attachment.to_vertices((0, 1), mesh, "disc"), "three different vertices"),
    ],
)
def test_what_nothing_can_carry_is_refused(attach, says):
    with pytest.raises(SsilkError, match=f"^disc: .*{says}"):
        attach(sheet())


def dressed(rng: np.random.Generator) -> Deformer:
    """The sheet on three joints and two proxies, with two blendshapes."""
    mesh = sheet()
    binds = np.tile(np.eye(4), (5, 1, 1))
    binds[:, :3, 3] = rng.normal(size=(5, 3))
    skeleton = Skeleton("skeleton", ("A", "A/B", "A/B/C"), np.array([-1, 0, 1]), binds[:3], binds[:3], 0)
    skin = SkinWeights("cloth", rng.integers(0, 5, (len(mesh.points), 3)), rng.random((len(mesh.points), 3)) + 0.01)
    rig = ProxyRig("cloth", ("A/B/P", "A/B/P/Button"), np.array([1, 3]), binds[3:], skin)
    own = SkinWeights.rigid("cloth", 0, mesh.vertex_count)
    garment = Garment(mesh, own, np.full(mesh.vertex_count, 2))
    scene = Scene(Character("hero", skeleton, ()), garment, rig)
    return Deformer(scene, skin, rng.normal(scale=0.05, size=(2, mesh.vertex_count, 3)))


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def test_joints_take_riders_where_the_cloth_is_and_leave_the_cloth():
    rng = np.random.default_rng(5)
    deformer, mesh = dressed(rng), sheet()
    motion = Motion("motion", 30.0, unit(rng, 9, 3), rng.normal(size=(9, 3, 3)))
    poses = [GarmentPose(0, unit(rng, 4, 2), rng.random((4, 2))), GarmentPose(4, unit(rng, 5, 2), rng.random((5, 2)))]
    button = Mesh("hero.usda:/Button", disc(0.512, 0.533), [[0, 4, 8]])
    riders = [
        Rider("hero.usda:/Button", name, (button,), Attachment.beneath(button.points, mesh, "button"))
        for name in ("Button", "Feather" * 20)
    ]
    joints = RiderJoints(deformer, riders)
    assert [name.rpartition("/")[2] for name in joints.names] == ["Button_2", ("Feather" * 20)[:NAME_BYTES]]
    assert joints.deformer.scene.joint_names[:5] == deformer.scene.joint_names
    for pose, own in zip(joints.poses(motion, poses), poses, strict=True):
        cloth = deform(deformer, motion, own)
        np.testing.assert_allclose(deform(joints.deformer, motion, pose), cloth, atol=1e-12)
        scene = joints.deformer.scene
        matrices = skinning_matrices(combined_transforms(joints.deformer, motion, pose), scene.bind_transforms)
        for number, body in enumerate(joints.bodies):
            expected = [list(joints.rider_points(each))[number][0] for each in cloth]
            np.testing.assert_allclose(skin_points(body.mesh.points, body.skin, matrices), expected, atol=1e-9)


def test_a_garment_without_riders_and_its_poses_are_themselves():
    rng = np.random.default_rng(5)
    deformer = dressed(rng)
    motion = Motion("motion", 30.0, unit(rng, 4, 3), rng.normal(size=(4, 3, 3)))
    poses = [GarmentPose(0, unit(rng, 4, 2), rng.random((4, 2)))]
    joints = RiderJoints(deformer, [])
    assert not joints and joints.deformer is deformer and joints.bodies == ()
    assert list(joints.poses(motion, poses)) == poses
