# SPDX-License-Identifier: Apache-2.0
"""Tight cloth meets the patch of the body that it lies over, loose cloth the whole body, on every path."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics.collision import (
    CollisionBody,
    Contacts,
    Patches,
    PosedBody,
    distance,
    nearest_planes,
    nearest_vertex,
    signed_distance_to_planes,
)
from ssilk_core.physics.collision.one_ring import triangle_rings
from ssilk_core.physics.collision.patches import faces_around, patches_beneath
from ssilk_core.physics.samples import vertex_samples
from ssilk_core.scene.assets import LOOSE, PINNED, TIGHT, Body, Character, Mesh, Scene, SkinWeights

CPU = torch.device("cpu")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"  # on a CPU kernels run in Triton's interpreter
KERNELS = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="kernels need Triton")
RADIUS, LENGTH = 0.05, 0.6  # of a limb along z [m]
THIN = 0.008  # half the thickness along x of a plate, which tight cloth can go through and still meet [m]


def limb() -> trimesh.Trimesh:
    found = trimesh.creation.cylinder(radius=RADIUS, height=LENGTH, sections=16)
    return found.subdivide_to_size(0.03)


def plate() -> trimesh.Trimesh:
    return trimesh.creation.box((2 * THIN, 0.2, LENGTH)).subdivide_to_size(0.02)


def on_limb(
    scene: Scene, at: np.ndarray, kind: int, shape: trimesh.Trimesh | None = None
) -> tuple[Scene, CollisionBody]:
    """The scene with a limb or another body, moved by the first joint, and garment vertices `at` of one class."""
    shape = shape or limb()
    weights = np.ones((len(shape.vertices), 1))
    body = Body(
        Mesh("/limb", shape.vertices, shape.faces), SkinWeights("/limb", weights.astype(np.int32) * 0, weights)
    )
    points = np.resize(at, scene.garment.mesh.points.shape)
    garment = replace(
        scene.garment,
        mesh=replace(scene.garment.mesh, points=points),
        classes=np.full(len(points), kind, dtype=scene.classes.dtype),
    )
    character = Character("/limb", scene.character.skeleton, (body,))
    return replace(scene, character=character, garment=garment), CollisionBody(body, 3, device=CPU)


def still(body: CollisionBody, **options: bool) -> PosedBody:
    return body.pose(torch.eye(3, 4).expand(3, 3, 4)[..., None].contiguous(), **options)


@pytest.mark.parametrize("options", [{}, {"exact": True}, {"surface": False}])
@pytest.mark.parametrize("kind", [TIGHT, LOOSE])
def test_tight_cloth_that_went_almost_through_is_sent_back(scene, kind, options):
    """Pulled 12 mm into a plate of 16 mm, the far side is nearer; only what is loose goes there."""
    dressed, body = on_limb(scene, np.array([THIN + 0.005, 0, 0.01]), kind, plate())
    x = torch.tensor(dressed.garment.mesh.points, dtype=torch.float32)[..., None]
    pulled = x - torch.tensor([THIN + 0.009, 0, 0])[:, None]
    contacts = Contacts(dressed, vertex_samples(len(dressed.classes)), device=CPU)
    normal, offset = contacts.planes(pulled, still(body, **options))
    side = 1 if kind == TIGHT else -1
    assert (side * normal[:, 0] > 0.5).all()
    distance = signed_distance_to_planes(pulled, normal, offset)
    np.testing.assert_allclose(distance, -(THIN + side * 0.004), atol=1e-6)
    met, whole = contacts.distances(pulled, still(body, **options))
    assert torch.equal(met, distance)
    np.testing.assert_allclose(
        whole, signed_distance_to_planes(pulled, *nearest_planes(pulled, still(body, **options))), atol=1e-6
    )


def test_where_cloth_is_near_its_own_side_nothing_changes(scene):
    """Within reach of its patch a tight vertex meets what a loose one meets."""
    rng = np.random.default_rng(0)
    turn = rng.uniform(0, 2 * np.pi, 40)
    at = np.stack([(RADIUS + 0.004) * np.cos(turn), (RADIUS + 0.004) * np.sin(turn), rng.uniform(-0.2, 0.2, 40)], 1)
    dressed, body = on_limb(scene, at, TIGHT)
    x = torch.tensor(dressed.garment.mesh.points + 0.008 * rng.normal(size=dressed.garment.mesh.points.shape))
    x = x.float()[..., None]
    for options in ({}, {"exact": True}):
        posed = still(body, **options)
        found = Contacts(dressed, vertex_samples(len(dressed.classes)), device=CPU).planes(x, posed)
        expected = nearest_planes(x, posed if options else replace(posed, faces=None))
        distance = signed_distance_to_planes(x, *expected)
        np.testing.assert_allclose(signed_distance_to_planes(x, *found), distance, atol=1e-6)
        # Directions to the nearest point turn by rounding errors over the distance.
        away = (found[0] - expected[0]) * (distance.abs()[:, None] if options else 1)
        np.testing.assert_allclose(away, 0, atol=3e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rounded_distances_are_those_of_the_planes_that_tight_and_loose_cloth_meet(scene, dtype):
    """Pulled into the plate, every other vertex tight: each by its own side, to the two per cent of rounding."""
    dressed, body = on_limb(scene, np.array([THIN + 0.005, 0, 0.01]), TIGHT, plate())
    classes = np.where(np.arange(len(dressed.classes)) % 2, TIGHT, LOOSE).astype(dressed.classes.dtype)
    dressed = replace(dressed, garment=replace(dressed.garment, classes=classes))
    x = torch.tensor(dressed.garment.mesh.points, dtype=dtype)[..., None]
    pulled = x - torch.tensor([THIN + 0.009, 0, 0])[:, None].to(dtype)
    contacts, posed = Contacts(dressed, vertex_samples(len(dressed.classes)), device=CPU), still(body, exact=True)
    found, met = (
        contacts.smoothed(pulled, posed),
        signed_distance_to_planes(pulled.float(), *contacts.planes(pulled.float(), posed)),
    )
    assert found.normal.dtype == found.offset.dtype == dtype and found.curvature.dtype == torch.float32
    torch.testing.assert_close(found.distance(pulled).float(), met, rtol=0.03, atol=1e-6)
    assert (met[1::2] < -THIN).all() and (met[::2] > -THIN).all()
    pinned = replace(dressed, garment=replace(dressed.garment, classes=np.full_like(classes, PINNED)))
    nowhere = Contacts(pinned, vertex_samples(len(pinned.classes)), pinned=False, device=CPU).smoothed(pulled, posed)
    assert (nowhere.distance(pulled) > 1e5).all() and nowhere.curvature.abs().max() == 0


@pytest.mark.parametrize("options", [{}, {"exact": True}, {"surface": False}])
def test_tight_cloth_far_from_its_patch_touches_nothing(scene, options):
    """From 3 cm off a limb of 5 cm radius to its axis: outside and beyond `TIGHT_REACH` nothing pushes the cloth."""
    dressed, body = on_limb(scene, np.array([RADIUS + 0.005, 0, 0.0]), TIGHT)
    count = len(dressed.classes)
    heights = torch.linspace(0.03, -RADIUS, count)
    x = torch.zeros(count, 3, 1)
    x[:, 0, 0] = RADIUS + heights
    contacts, posed = Contacts(dressed, vertex_samples(count), device=CPU), still(body, **options)
    normal, offset = contacts.planes(x, posed)
    touched = signed_distance_to_planes(x, normal, offset)[:, 0] < 0
    slack = 0.003 if options.get("surface") is False else 0.001  # 16 sides, and vertices 3 cm apart
    inner = heights < -slack
    assert touched[inner & (heights > -(distance.TIGHT_REACH - slack))].all()
    assert not touched[(heights > slack) | (heights < -(distance.TIGHT_REACH + slack))].any()
    if options.get("exact"):
        smoothed = contacts.smoothed(x, posed)
        torch.testing.assert_close(smoothed.distance(x), signed_distance_to_planes(x, normal, offset), rtol=0.03,
                                   atol=1e-6)  # fmt: skip
        assert not smoothed.curvature[heights < -(distance.TIGHT_REACH + slack)].any()


def test_tight_cloth_touches_its_own_side_and_loose_cloth_what_is_nearest(scene):
    """Friction holds to the part of the body that pushes, also where another part is nearer."""
    side = np.array([[RADIUS + 0.002, 0, 0]])
    for kind, own in ((TIGHT, True), (LOOSE, False)):
        dressed, body = on_limb(scene, side, kind)
        contacts = Contacts(dressed, vertex_samples(len(dressed.classes)), device=CPU)
        posed = still(body, exact=True)
        x = torch.tensor([-RADIUS - 0.002, 0.0, 0.0]).expand(len(dressed.classes), 3)[..., None]
        reach = torch.full((len(x), 1), 3 * RADIUS)
        row, frame, corners, weights = contacts.touched(x, reach, posed)
        assert row.tolist() == list(range(len(x))) and not frame.any()
        found = (weights[:, :, None] * posed.points[corners, :, 0]).sum(0)
        assert bool((found[:, 0] > -0.5 * RADIUS).all()) is own


def test_pinned_cloth_meets_nothing_unless_it_is_measured(scene):
    dressed, body = on_limb(scene, np.array([0.0, 0, 0]), PINNED)
    x = torch.tensor(dressed.garment.mesh.points, dtype=torch.float32)[..., None]
    free, measured = (
        Contacts(dressed, vertex_samples(len(dressed.classes)), pinned=pinned, device=CPU) for pinned in (False, True)
    )
    assert (signed_distance_to_planes(x, *free.planes(x, still(body))) > 1e5).all()
    assert (measured.distances(x, still(body))[0] < 0).all()


def test_tight_cloth_far_from_the_body_may_meet_all_of_it(scene):
    """A patch says nothing of cloth that hangs a hand's breadth off: it has no side yet."""
    assert (
        patches_beneath(np.array([[RADIUS + 0.1, 0, 0]]), Mesh("/limb", *shape_of(limb())), np.arange(50))[0, 0] == 0
    )
    dressed, body = on_limb(scene, np.array([RADIUS + 0.1, 0, 0]), TIGHT)
    x = torch.tensor(dressed.garment.mesh.points, dtype=torch.float32)[..., None]
    pulled = x - torch.tensor([RADIUS + 0.12, 0, 0])[:, None]
    assert (
        Contacts(dressed, vertex_samples(len(dressed.classes)), device=CPU).planes(pulled, still(body))[0][:, 0]
        < -0.5
    ).all()


def shape_of(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.array(mesh.vertices), np.array(mesh.faces)


def test_a_patch_lies_around_its_point_faces_as_it_does_and_stays_on_its_limb():
    """Two limbs side by side, 2 cm apart: a patch never takes vertices of the other one."""
    other = limb()
    other.apply_translation([0, 2 * RADIUS + 0.02, 0])
    both = trimesh.util.concatenate([limb(), other])
    points = np.array([[RADIUS + 0.01, 0, 0.05], [0, RADIUS + 0.005, -0.1]])
    patches = patches_beneath(points, Mesh("/limbs", *shape_of(both)), np.arange(len(both.vertices)))
    extent = np.linalg.norm(np.ptp(both.vertices, axis=0)) / 12
    for point, (count, *row) in zip(points, patches):
        found = row[:count]
        assert len(set(found)) == count > 3 and set(row) == set(found)
        assert found[0] == np.linalg.norm(both.vertices - point, axis=1).argmin()
        assert max(found) < len(other.vertices)
        assert (both.vertex_normals[found] @ both.vertex_normals[found[0]] > 0).all()
        assert np.linalg.norm(both.vertices[found] - both.vertices[found[0]], axis=1).max() <= extent + 1e-9


def test_a_patch_goes_on_where_the_body_is_split():
    """At seams of texture coordinates every vertex stands twice, with no edge between."""
    shape = limb()
    half = shape.triangles_center[:, 2] > 0.05
    upper, lower = (shape.submesh([np.flatnonzero(part)], append=True) for part in (half, ~half))
    split = trimesh.util.concatenate([upper, lower])
    assert len(split.vertices) > len(shape.vertices)
    point = np.array([[RADIUS + 0.005, 0, 0.08]])
    (whole,), (found,) = (
        patches_beneath(point, Mesh("/limb", *shape_of(each)), np.arange(len(each.vertices)))
        for each in (shape, split)
    )
    places = [
        set(map(tuple, each.vertices[row[1 : 1 + row[0]]].round(6))) for each, row in ((shape, whole), (split, found))
    ]
    assert places[0] == places[1] and min(z for _, _, z in places[1]) < 0.04


def test_patches_count_the_chosen_vertices_alone():
    shape = limb()
    chosen = np.flatnonzero(shape.vertices[:, 2] > -0.05)
    body, point = Mesh("/limb", *shape_of(shape)), np.array([[RADIUS, 0, 0.1]])
    (count, *row) = patches_beneath(point, body, chosen)[0]
    (all_count, *all_row) = patches_beneath(point, body, np.arange(len(shape.vertices)))[0]
    assert set(chosen[row[:count]]) == set(all_row[:all_count]) & set(chosen)
    assert patches_beneath(point, body, np.zeros(0, dtype=int))[0, 0] == 0


def lists(rng: np.random.Generator, vertices: int, body: int) -> torch.Tensor:
    """Random lists of different lengths, filled up with their first entries."""
    table = np.zeros((vertices, 8), dtype=np.int32)
    for row in table:
        count = rng.integers(1, 8)
        found = rng.choice(body, count, replace=False)
        row[:] = [count, *found, *[found[0]] * (7 - count)]
    return torch.tensor(table)


def chosen_by_hand(x: np.ndarray, body: np.ndarray, table: np.ndarray) -> np.ndarray:
    found = np.zeros((len(x), x.shape[2]), dtype=int)
    for v, (count, *row) in enumerate(table):
        squares = ((x[v][None] - body[row[:count]]) ** 2).sum(1)
        found[v] = np.array(row)[squares.argmin(0)]
    return found


@pytest.mark.parametrize("scores", [1 << 27, 100])
def test_the_nearest_of_a_list_is_found_on_both_plain_paths(scores, monkeypatch):
    rng = np.random.default_rng(3)
    x, body = rng.normal(size=(33, 3, 5)), rng.normal(size=(20, 3, 5))
    table = lists(rng, 33, 20)
    expected = chosen_by_hand(x, body, table.numpy())
    np.testing.assert_array_equal(nearest_vertex.nearest_vertex(torch.tensor(x), torch.tensor(body), table), expected)
    monkeypatch.setattr(nearest_vertex, "MAX_SCORES", scores)
    monkeypatch.setattr(nearest_vertex, "_by_rows", nearest_vertex._by_products)
    np.testing.assert_array_equal(nearest_vertex.nearest_vertex(torch.tensor(x), torch.tensor(body), table), expected)


@KERNELS
def test_the_kernel_finds_the_nearest_of_a_list():
    from ssilk_core.physics.kernels.candidates import nearest_candidate_kernel

    rng = np.random.default_rng(4)
    x, body = rng.normal(size=(33, 3, 150)).astype(np.float32), rng.normal(size=(20, 3, 150)).astype(np.float32)
    table = lists(rng, 33, 20)
    found = nearest_candidate_kernel(*(v.to(DEVICE) for v in (torch.tensor(x), torch.tensor(body), table)))
    np.testing.assert_array_equal(found.cpu(), chosen_by_hand(x, body, table.numpy()))


@KERNELS
@pytest.mark.parametrize("surface", [True, False])
def test_kernels_find_the_planes_of_a_list_that_their_references_find(surface):
    rng = np.random.default_rng(5)
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    around = mesh.vertices + 0.003 * rng.normal(size=(3, *mesh.vertices.shape))
    points, normals = (torch.tensor(v, dtype=torch.float32) for v in (around.transpose(1, 2, 0), mesh.vertex_normals))
    rings = torch.as_tensor(triangle_rings(mesh.faces, 42)) if surface else None
    body = PosedBody(points, normals[:, :, None].expand(-1, -1, 3).contiguous(), rings)
    x = torch.tensor(mesh.sample(9, seed=1)[:, :, None] + 0.02 * rng.normal(size=(9, 3, 3)), dtype=torch.float32)
    table = lists(rng, 9, 42)
    patches = Patches(table, torch.zeros(0))
    expected = nearest_planes(x, body, patches=patches)
    assert not torch.allclose(expected[0], nearest_planes(x, body)[0])
    on_device = PosedBody(points.to(DEVICE), body.normals.to(DEVICE), None if rings is None else rings.to(DEVICE))
    for value, reference in zip(
        distance._by_kernels(x.to(DEVICE), on_device, None, Patches(table.to(DEVICE), patches.faces)), expected
    ):
        np.testing.assert_allclose(value.cpu(), reference, atol=2e-6)


def test_the_faces_around_a_patch_are_those_with_a_corner_in_it():
    shape = limb()
    rng, count = np.random.default_rng(6), len(shape.vertices)
    table = lists(rng, 9, count).numpy()
    found = faces_around(table, shape.faces, count)
    for (size, *row), faces in zip(table, found):
        assert set(faces) - {-1} == set(np.flatnonzero(np.isin(shape.faces, row[:size]).any(axis=1)))
    alone = faces_around(np.array([[1, count, count]]), shape.faces, count + 1)
    assert (alone == -1).all()


@pytest.mark.parametrize("options", [{}, {"exact": True}, {"surface": False}])
def test_without_patches_tight_cloth_meets_all_of_the_body(scene, options):
    dressed, body = on_limb(scene, np.array([THIN + 0.005, 0, 0.01]), TIGHT, plate())
    x = torch.tensor(dressed.garment.mesh.points, dtype=torch.float32)[..., None]
    pulled, posed = x - torch.tensor([THIN + 0.009, 0, 0])[:, None], still(body, **options)
    contacts = Contacts(dressed, vertex_samples(len(dressed.classes)), patches=False, device=CPU)
    for found, expected in zip(contacts.planes(pulled, posed), nearest_planes(pulled, posed)):
        torch.testing.assert_close(found, expected)
