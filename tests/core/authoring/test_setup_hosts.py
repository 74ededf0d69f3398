# SPDX-License-Identifier: Apache-2.0
"""What lies on other islands of its garment: classes, weights and proxies of a dress with a button and a strap."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from ssilk_core.authoring.setup.hosts import Hosts
from ssilk_core.authoring.setup.prepare import prepare_scene
from ssilk_core.authoring.setup.rig import RigOptions, build_rig
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import LOOSE, PINNED, TIGHT, Body, Character, Garment, Mesh, Scene, Skeleton, SkinWeights
from ssilk_core.scene.kinematics import local_transforms, skin_points, skinning_matrices, world_transforms
from ssilk_core.scene.mesh.stitches import find_stitches
from ssilk_core.scene.mesh.topology import edges

COLUMNS, ROWS = 48, 25


def on_dress(angle: np.ndarray, height: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Points over a dress that is narrow above y = 0.6 and flares below."""
    radius = 0.115 + 0.5 * np.maximum(0.6 - height, 0) + above
    return np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=-1)


def cells(rows: int, columns: int, closed: bool = False) -> np.ndarray:
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0 : columns - (not closed)])
    right = (column + 1) % columns
    a, b, c, d = (r * columns + s for r in (row, row + 1) for s in (column, right))
    return np.concatenate([np.c_[a, c, b], np.c_[b, c, d]])


def part(low: float, high: float, left: float, right: float, rows: int, bulge: float = 0.0):
    """A piece of cloth a millimetre over the dress, and farther in its middle."""
    share, angle = np.meshgrid(np.linspace(0, 1, rows), np.linspace(left, right, 3), indexing="ij")
    above = 0.001 + bulge * np.sin(np.pi * share) ** 2
    return on_dress(angle.ravel(), (high + share * (low - high)).ravel(), above.ravel()), cells(rows, 3)


PARTS = {
    "button on the skirt": part(0.30, 0.32, 0.50, 0.56, 3),
    "patch on the waist": part(0.75, 0.80, 2.0, 2.3, 3),
    "strap": part(0.25, 0.45, -0.8, -0.75, 9, bulge=0.05),
}


def dress(*names: str) -> tuple[Mesh, list[np.ndarray]]:
    """The dress with some parts, and the vertices of each."""
    angle, height = np.meshgrid(np.arange(COLUMNS) * 2 * np.pi / COLUMNS, np.linspace(0.9, 0.15, ROWS))
    points, faces = [on_dress(angle.ravel(), height.ravel(), 0 * height.ravel())], [cells(ROWS, COLUMNS, True)]
    vertices, count = [], len(points[0])
    for name in names:
        points.append(PARTS[name][0])
        faces.append(PARTS[name][1] + count)
        vertices.append(np.arange(count, count + len(points[-1])))
        count += len(points[-1])
    return Mesh("/Dress", np.concatenate(points), np.concatenate(faces)), vertices


@pytest.fixture(scope="module")
def character() -> Character:
    trunk = trimesh.creation.cylinder(0.1, height=1.0, sections=48)
    trunk.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    trunk.apply_translation([0, 0.5, 0])
    trunk = trunk.subdivide().subdivide()
    lean = (trunk.vertices[:, 1:2] / 0.6 - 0.3).clip(0, 1)
    skin = SkinWeights("/Body", np.tile([0, 1], (len(lean), 1)), np.hstack([1 - lean, lean]))
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[1, 1, 3] = 0.5
    skeleton = Skeleton("/Rig", ("Low", "Low/High"), [-1, 0], bind, local_transforms(bind, np.array([-1, 0])))
    return Character("/C", skeleton, (Body(Mesh("/Body", trunk.vertices, trunk.faces), skin),))


@pytest.fixture(scope="module")
def prepared(character) -> tuple[Scene, list[np.ndarray]]:
    mesh, vertices = dress(*PARTS)
    return prepare_scene(character, Garment(mesh)), vertices


def under(mesh: Mesh, vertices: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (V, C) at the points of the dress under its vertices."""
    found = find_stitches(mesh)
    found = found.select(found.on_larger & np.isin(found.vertices, vertices))
    assert found.vertices.tolist() == vertices.tolist()
    return np.einsum("sk,skc->sc", found.shares, values[found.corners])


def test_parts_have_the_classes_of_what_they_lie_on(prepared):
    scene, (button, patch, strap) = prepared
    assert (scene.classes[button] == LOOSE).all() and (scene.classes[strap] == LOOSE).all()
    assert (scene.classes[patch] == TIGHT).all()  # by itself its top would be pinned
    assert np.bincount(scene.classes, minlength=3).min() > 40


def test_carried_parts_have_the_weights_of_the_points_under_them(prepared):
    scene, (button, patch, _) = prepared
    for skin in (scene.lbs_skin, scene.rig.skin):
        rows = skin.dense(len(scene.joint_names))
        for vertices in (button, patch):
            np.testing.assert_allclose(rows[vertices], under(scene.garment.mesh, vertices, rows), atol=5e-3)


def test_carried_parts_stay_on_their_host_where_it_bends(prepared):
    scene, parts = prepared
    turned = scene.character.skeleton.rest_transforms.copy()
    turned[1, :3, :3] = Rotation.from_euler("xyz", [50, 20, 0], degrees=True).as_matrix()
    skeleton, mesh = scene.character.skeleton, scene.garment.mesh
    matrices = skinning_matrices(world_transforms(turned[None], skeleton.parents), skeleton.bind_transforms)
    posed = skin_points(mesh.points, scene.lbs_skin, matrices)[0]
    assert np.abs(posed - mesh.points).max() > 0.05
    for vertices in parts[:2]:
        away = np.linalg.norm(posed[vertices] - under(mesh, vertices, posed), axis=1)
        assert away.max() < 0.0015  # a millimetre at rest


def test_the_weights_of_a_strap_lead_smoothly_into_its_host(prepared):
    scene, (_, _, strap) = prepared
    mesh, ends = scene.garment.mesh, strap[[0, 1, 2, -3, -2, -1]]
    for skin in (scene.lbs_skin, scene.rig.skin):
        rows = skin.dense(len(scene.joint_names))
        np.testing.assert_allclose(rows[ends], under(mesh, ends, rows), atol=0.01)
        low, high = edges(mesh.faces).T
        length = np.linalg.norm(mesh.points[low] - mesh.points[high], axis=1)
        rate = np.abs(rows[low] - rows[high]).sum(axis=1) / length
        assert rate[low >= strap[0]].max() < 2 * rate[low < strap[0]].max()


def test_a_button_costs_no_proxy_and_changes_nothing_else(character):
    plain, with_button = (
        prepare_scene(character, Garment(dress(*names)[0])) for names in ((), ("button on the skirt",))
    )
    count = plain.garment.mesh.vertex_count
    assert plain.rig.joint_names == with_button.rig.joint_names
    for name in ("lbs_skin", "rig"):
        mine, theirs = (getattr(getattr(s, name), "skin", getattr(s, name)) for s in (plain, with_button))
        joints = len(plain.joint_names)
        np.testing.assert_array_equal(mine.dense(joints), theirs.dense(joints)[:count])
    assert (plain.classes == with_button.classes[:count]).all()


def test_authored_classes_of_carried_parts_are_kept(character, prepared):
    scene, (button, patch, _) = prepared
    classes = scene.classes.copy()
    classes[button], classes[patch] = PINNED, LOOSE
    rig = build_rig(character, replace(scene.garment, classes=classes))
    joints = character.skeleton.joint_count
    rows, lbs = rig.skin.dense(joints + rig.proxy_count), scene.lbs_skin.dense(joints)
    np.testing.assert_allclose(rows[button][:, :joints], lbs[button], atol=1e-6)
    assert rig.proxy_count == scene.rig.proxy_count  # none on the patch, whose host is tight
    np.testing.assert_allclose(rows[patch][:, :joints], lbs[patch], atol=5e-3)


def test_what_lies_nowhere_still_fails(character):
    mesh, (button,) = dress("button on the skirt")
    off = mesh.points + np.where(np.arange(mesh.vertex_count) >= button[0], 0.02, 0)[:, None]
    with pytest.raises(SsilkError, match=r"1 of 2 islands .* rest nowhere on the body"):
        prepare_scene(character, Garment(replace(mesh, points=off)))


def test_what_is_carried_by_what_is_carried_follows_the_first_host():
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    parts = [sheet, 0.3 * sheet + [0.1, 0.1, 0.003], 0.1 * sheet + [0.15, 0.15, 0.006]]
    mesh = Mesh("/stack", np.concatenate(parts[::-1]), np.arange(9).reshape(3, 3))  # the smallest comes first
    hosts = Hosts.of(mesh)
    assert hosts.feet.vertices.tolist() == [3, 4, 5, 0, 1, 2]
    rows = np.where(np.arange(9)[:, None] >= 6, np.eye(3)[np.arange(9) % 3], [1.0, 0, 0])
    found = hosts.blend(rows)
    np.testing.assert_allclose(found[:, 1:], mesh.points[:, :2], atol=1e-12)
    assert hosts.carry(np.arange(9)).tolist() == [6] * 6 + [6, 7, 8]
    assert (hosts.joined_islands == 0).all()


def test_rig_options_reach_a_garment_of_parts(character):
    mesh, _ = dress("strap")
    scene = prepare_scene(character, Garment(mesh), rig_options=RigOptions(proxies=6))
    assert scene.rig.proxy_count == 6  # the strap is no piece of its own
