# SPDX-License-Identifier: Apache-2.0
"""Distance to a body, its penalty, and the search for the nearest body vertex on every path."""

import importlib.util
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from ssilk_core.physics.collision import (
    CollisionBody,
    PosedBody,
    distance,
    nearest_planes,
    nearest_vertex,
    signed_distance,
)
from ssilk_core.physics.collision.one_ring import nearest_on_rings, triangle_rings
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.scene.assets import Body, Mesh, SkinWeights
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import skin_points
from ssilk_core.scene.mesh.blocks import compact_blocks

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"  # on a CPU kernels run in Triton's interpreter
KERNELS = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="kernels need Triton")


def plane() -> PosedBody:
    """The plane y = 0.5 as a lattice of vertices that face up."""
    x, z = np.mgrid[-1:1:21j, -1:1:21j].reshape(2, -1)
    points = torch.tensor(np.stack([x, np.full_like(x, 0.5), z], axis=1))[:, :, None]
    return PosedBody(points, torch.tensor([0.0, 1, 0]).double().expand(len(x), 3)[:, :, None])


def test_distance_to_a_plane_is_the_height_over_it():
    x = np.random.default_rng(0).uniform(-0.9, 0.9, size=(50, 3, 1)) * [[1], [0.03], [1]] + [[0], [0.5], [0]]
    x = torch.tensor(x, requires_grad=True)
    distance = signed_distance(x, plane())
    np.testing.assert_allclose(distance.detach(), x.detach()[:, 1] - 0.5, atol=1e-12)
    distance.sum().backward()
    np.testing.assert_allclose(x.grad[..., 0], np.tile([0, 1, 0], (50, 1)), atol=1e-12)


def test_distance_to_a_sphere_is_the_radius_short_of_its_facets():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    points = torch.tensor(ball.vertices.copy())[:, :, None]
    way = np.random.default_rng(1).normal(size=(200, 3))
    radius = np.linspace(0.25, 0.35, 200)
    x = torch.tensor(way / np.linalg.norm(way, axis=1, keepdims=True) * radius[:, None])[:, :, None]
    distance = signed_distance(x, PosedBody(points, points / 0.3))[:, 0].numpy()
    # The nearest_vertex vertex lies within half an edge (1 cm) of the foot: 1 - cos of that angle at most.
    np.testing.assert_allclose(distance, radius - 0.3, atol=0.35 * (1 - np.cos(0.015 / 0.3)))
    assert ((distance < 0) == (radius < 0.3))[np.abs(radius - 0.3) > 1e-3].all()


def test_the_papers_penalty_starts_at_the_margin_and_grows_with_the_square():
    distance = torch.tensor([[0.01, 0.004, 0.003, 0.0, -0.006]]).double()
    expected = 10 * np.array([0, 0, 1e-3, 4e-3, 10e-3]) ** 2
    np.testing.assert_allclose(ContactLaw.of(FABRICS["paper"]).energy(distance)[0], expected, atol=1e-18)


def test_a_garments_penalty_is_summed_over_vertices_for_each_frame(toy_grid):
    points, faces = toy_grid(4, 3)
    flat = np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1)
    energy = GarmentEnergy(
        Mesh("/sheet", flat, faces), replace(FABRICS["paper"], collision=50.0, margin=0.01), dtype=torch.float64
    )
    heights = np.array([0.52, 0.505, 0.48])
    x = torch.tensor(flat[:, :, None] + heights * np.array([[0], [1], [0]]))
    body = PosedBody(*(v.expand(-1, -1, 3) for v in (plane().points, plane().normals)))
    np.testing.assert_allclose(energy.collision(x, body), 12 * 50 * np.array([0, 0.005, 0.03]) ** 2, atol=1e-14)


def brute_force(x: np.ndarray, body: np.ndarray) -> np.ndarray:
    distance = ((x[:, None].astype(float) - body[None].astype(float)) ** 2).sum(2)
    return distance.argmin(1)


@pytest.mark.parametrize("vertices, body_vertices, frames", [(1, 1, 1), (137, 53, 4), (40, 1000, 7)])
@pytest.mark.parametrize("scores", [1, 1 << 27])
def test_nearest_vertex_matches_brute_force_on_both_paths(vertices, body_vertices, frames, scores, monkeypatch):
    rng = np.random.default_rng(vertices)
    # Far from the origin, as a character may stand: the search is centred on the body.
    x = (rng.normal(size=(vertices, 3, frames)) + 50).astype(np.float32)
    body = (rng.normal(size=(body_vertices, 3, frames)) + 50).astype(np.float32)
    expected = brute_force(x, body)
    found = nearest_vertex.nearest_vertex(torch.tensor(x), torch.tensor(body))
    assert found.dtype == torch.int64
    np.testing.assert_array_equal(found, expected)
    monkeypatch.setattr(nearest_vertex, "MAX_SCORES", scores)
    monkeypatch.setattr(nearest_vertex, "_by_rows", nearest_vertex._by_products)
    np.testing.assert_array_equal(nearest_vertex.nearest_vertex(torch.tensor(x), torch.tensor(body)), expected)


def twice_a_cube() -> tuple[np.ndarray, np.ndarray]:
    """A lattice (54, 3, 1) of which every vertex comes twice, and points (27, 3, 1) equally near to many of them.

    Whole numbers about a mean of zero leave no rounding, so that ties are exact.
    """
    cube = np.stack(np.meshgrid(*[[-2, 0, 2]] * 3, indexing="ij"), axis=-1).reshape(-1, 3, 1)
    return np.concatenate([cube, cube]).astype(np.float32), (cube / 2).astype(np.float32)


def test_ties_go_to_the_lower_index_on_both_paths(monkeypatch):
    body, x = twice_a_cube()
    expected = brute_force(x, body)
    assert (expected < 27).all()
    np.testing.assert_array_equal(nearest_vertex.nearest_vertex(torch.tensor(x), torch.tensor(body)), expected)
    monkeypatch.setattr(nearest_vertex, "_by_rows", nearest_vertex._by_products)
    np.testing.assert_array_equal(nearest_vertex.nearest_vertex(torch.tensor(x), torch.tensor(body)), expected)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 500])
def test_blocks_hold_every_point_once_and_are_compact(count):
    points = np.random.default_rng(count).uniform(size=(count, 3))
    blocks = compact_blocks(points, 32)
    assert blocks.shape == (-(-count // 32), 32) and blocks.dtype == np.int32
    flat = blocks.reshape(-1)
    np.testing.assert_array_equal(np.sort(flat[:count]), np.arange(count))
    assert (flat[count:] == flat[count - 1]).all()
    if count > 100:  # a cube of 32 in 500 points has sides of 0.4; blocks as points come span all
        sides = [np.ptp(points[block], axis=0).max() for block in blocks]
        assert np.mean(sides) < 0.6


def by_kernel(x: np.ndarray, body: np.ndarray, ordered: bool = True) -> np.ndarray:
    """The kernel's answer, with blocks and groups that are compact in the first frame, or as vertices come."""
    from ssilk_core.physics.kernels.nearest_vertex import nearest_vertex_kernel

    tables = [
        torch.as_tensor(compact_blocks(np.nan_to_num(points[..., 0]), size))
        if ordered
        else nearest_vertex.consecutive_blocks(len(points), size, torch.device("cpu"))
        for points, size in ((x, nearest_vertex.GARMENT_BLOCK), (body, nearest_vertex.BODY_GROUP))
    ]
    return nearest_vertex_kernel(*(torch.as_tensor(v).to(DEVICE) for v in (x, body, *tables))).cpu().numpy()


def excess(x: np.ndarray, body: np.ndarray, found: np.ndarray) -> float:
    """How much further than the nearest body vertex the found ones are at most, as a share of the largest number."""
    x, body = x.astype(float), body.astype(float)
    chosen = np.take_along_axis(body, found[:, None], axis=0)
    least = np.linalg.norm(x[:, None] - body[None], axis=2).min(1)
    return float((np.linalg.norm(x - chosen, axis=1) - least).max() / max(np.abs(x).max(), np.abs(body).max()))


@KERNELS
@pytest.mark.parametrize(
    "vertices, body_vertices, frames, ordered",
    [
        (1, 1, 1, True),
        (32, 8, 2, False),
        (33, 9, 3, True),
        (2, 3, 65, True),
        (140, 77, 1, True),
        (20, 513, 1, True),
        (20, 513, 1, False),
    ],
)
def test_the_kernel_finds_the_nearest_vertex(vertices, body_vertices, frames, ordered):
    rng = np.random.default_rng(2)
    x, body = (rng.normal(size=(n, 3, frames)).astype(np.float32) for n in (vertices, body_vertices))
    found = by_kernel(x, body, ordered)
    assert found.shape == (vertices, frames)
    np.testing.assert_array_equal(found, brute_force(x, body))


@KERNELS
@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("case", ["one point", "flat", "far", "huge", "far apart", "touching"])
def test_the_kernel_is_exact_where_boxes_say_little(case, ordered):
    rng = np.random.default_rng(6)
    x, body = rng.normal(size=(40, 3, 2)), rng.normal(size=(90, 3, 2))
    if case == "one point":
        body[:] = body[:1]
    elif case == "flat":
        body[:, 1] = 0
    elif case == "far":
        x += 1e4
    elif case == "huge":
        x, body = 1e6 * x, 1e6 * body
    elif case == "far apart":
        x[::2] += 100
    else:
        x = body[:40].copy()
    x, body = x.astype(np.float32), body.astype(np.float32)
    assert excess(x, body, by_kernel(x, body, ordered)) < 1e-6


@KERNELS
def test_of_equally_near_vertices_the_kernel_takes_the_first_in_its_table():
    body, x = twice_a_cube()
    expected = brute_force(x, body)
    np.testing.assert_array_equal(by_kernel(x, body, ordered=False), expected)
    order = compact_blocks(body[..., 0], nearest_vertex.BODY_GROUP).reshape(-1)
    np.testing.assert_array_equal(by_kernel(x, body), order[brute_force(x, body[order])])


@KERNELS
@pytest.mark.filterwarnings("ignore:All-NaN slice:RuntimeWarning")
@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_broken_vertex_finds_something_and_harms_no_other(broken):
    rng = np.random.default_rng(7)
    x, body = (rng.normal(size=(n, 3, 2)).astype(np.float32) for n in (40, 60))
    whole = np.ones(x[:, 0].shape, dtype=bool)
    whole[3], whole[17, 1] = False, False
    x[3], x[17, 2, 1] = broken, broken
    found = by_kernel(x, body)
    np.testing.assert_array_equal(found[whole], brute_force(np.nan_to_num(x), body)[whole])
    assert ((found >= 0) & (found < 60)).all()


@KERNELS
def test_the_kernel_finds_the_nearest_vertex_of_a_posed_body(scene, toy_motion):
    from ssilk_core.scene.kinematics import centred_matrices

    merged, skeleton, garment = scene.character.merged_body(), scene.character.skeleton, scene.garment.mesh
    matrices, _ = centred_matrices(toy_motion(scene, 3), skeleton)
    character = torch.tensor(matrices[:, :, :3].transpose(1, 2, 3, 0), dtype=torch.float32)
    body = CollisionBody(merged, skeleton.joint_count, device=torch.device("cpu")).pose(character)
    x = skin_points(garment.points, scene.lbs_skin, matrices).transpose(1, 2, 0).astype(np.float32)
    np.testing.assert_array_equal(np.unique(body.groups), np.arange(len(merged.mesh.points)))
    np.testing.assert_array_equal(by_kernel(x, body.points.numpy()), brute_force(x, body.points.numpy()))


def test_body_is_posed_as_skinning_says_and_normals_turn_along(scene, toy_motion):
    from ssilk_core.scene.kinematics import centred_matrices

    body, skeleton = scene.character.merged_body(), scene.character.skeleton
    matrices, _ = centred_matrices(toy_motion(scene, 5), skeleton)
    character = torch.tensor(matrices[:, :, :3].transpose(1, 2, 3, 0), dtype=torch.float32)
    chosen = np.arange(0, body.mesh.vertex_count, 3)
    posed = CollisionBody(body, 3, vertices=chosen, device=torch.device("cpu")).pose(character)
    expected = skin_points(body.mesh.points, body.skin, matrices)
    np.testing.assert_allclose(posed.points.permute(2, 0, 1), expected[:, chosen], atol=1e-5)
    normals = posed.normals.permute(2, 0, 1).numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    for frame in range(5):
        actual = trimesh.Trimesh(expected[frame], body.mesh.faces, process=False).vertex_normals[chosen]
        assert (normals[frame] * actual).sum(1).min() > 0.95


def test_a_rigidly_turned_body_has_exactly_turned_normals():
    ball = trimesh.creation.icosphere(subdivisions=1)
    body = Body(Mesh("/ball", ball.vertices, ball.faces), SkinWeights("/ball", np.zeros((42, 1)), np.ones((42, 1))))
    collider = CollisionBody(body, 1, device=torch.device("cpu"))
    turn = torch.tensor(Rotation.random(random_state=5).as_matrix(), dtype=torch.float32)
    posed = collider.pose(torch.cat([turn, torch.ones(3, 1)], dim=1)[None, ..., None])
    np.testing.assert_allclose(posed.normals[..., 0], collider.normals[..., 0] @ turn.T, atol=1e-6)


def surface_of(mesh: trimesh.Trimesh) -> PosedBody:
    """A posed body that is collided with on its triangles, with the mesh's own vertex normals."""
    rings = torch.tensor(triangle_rings(mesh.faces, len(mesh.vertices)))
    points, normals = (torch.tensor(v.copy())[:, :, None] for v in (mesh.vertices, mesh.vertex_normals))
    return PosedBody(points, normals, rings)


def ring_triangles(vertex: int, row: list[int]) -> list[list[int]]:
    """The two other corners of each triangle that a row of `triangle_rings` spans."""
    count, *walk = row
    assert set(walk[count:]) <= {vertex}
    return sorted(sorted(pair) for pair in pairwise(walk[:count]) if vertex not in pair)


@pytest.mark.parametrize("case", ["closed", "open", "torn", "turned", "crowded"])
def test_rings_hold_every_triangle_around_a_vertex(case, toy_grid):
    faces = trimesh.creation.icosphere(subdivisions=1).faces if case == "closed" else toy_grid(4, 4)[1]
    if case == "torn":
        faces = np.delete(faces, [2, 7, 8], axis=0)
    elif case == "turned":  # some triangles face the other way
        faces = np.where(np.arange(len(faces))[:, None] % 3 == 0, faces[:, ::-1], faces)
    elif case == "crowded":  # several triangles share an edge
        faces = np.concatenate([faces, [[0, 1, 9], [1, 0, 10], [5, 6, 0]]])
    count = faces.max() + 2  # one vertex without triangles
    for vertex, row in enumerate(triangle_rings(faces, count).tolist()):
        expected = sorted(sorted(set(face) - {vertex}) for face in faces.tolist() if vertex in face)
        assert ring_triangles(vertex, row) == expected


def test_a_closed_fan_is_one_walk():
    rings = triangle_rings(trimesh.creation.icosphere(subdivisions=1).faces, 42)
    np.testing.assert_array_equal(np.unique(rings[:, 0]), [6, 7])  # five or six neighbours, and the first again


def test_the_nearest_point_around_a_vertex_matches_brute_force():
    rng = np.random.default_rng(3)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    mesh.vertices += 0.02 * rng.normal(size=mesh.vertices.shape)
    x = rng.normal(size=(300, 3))
    x *= rng.uniform(0.2, 0.45, size=(300, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
    index = torch.tensor(brute_force(x, mesh.vertices))
    points = torch.tensor(mesh.vertices.T.copy())[:, :, None]
    rings = torch.tensor(triangle_rings(mesh.faces, len(mesh.vertices)))
    corners, weights = nearest_on_rings(torch.tensor(x.T), index, torch.zeros_like(index), points, rings)
    assert weights.min() > -1e-12
    np.testing.assert_allclose(weights.sum(0), 1)
    found = (mesh.vertices[corners] * weights.numpy()[..., None]).sum(0)
    for query, vertex, point in zip(x, index.tolist(), found):
        around = mesh.triangles[(mesh.faces == vertex).any(axis=1)]
        nearest_points = trimesh.triangles.closest_point(around, np.tile(query, (len(around), 1)))
        assert np.linalg.norm(query - point) == pytest.approx(np.linalg.norm(query - nearest_points, axis=1).min())


def test_distance_to_triangles_is_nearer_the_truth_than_to_vertices():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    way = np.random.default_rng(1).normal(size=(400, 3))
    radius = np.linspace(0.25, 0.35, 400)
    x = torch.tensor(way / np.linalg.norm(way, axis=1, keepdims=True) * radius[:, None])[:, :, None]
    body = surface_of(mesh)
    on_triangles, at_vertices = (
        signed_distance(x, found)[:, 0].numpy() for found in (body, PosedBody(body.points, body.normals))
    )
    nearest_points = trimesh.proximity.closest_point_naive(mesh, x[..., 0].numpy())[0]
    outside = np.where(radius > np.linalg.norm(nearest_points, axis=1), 1, -1)
    exact = outside * np.linalg.norm(x[..., 0].numpy() - nearest_points, axis=1)
    errors = [np.abs(found - exact).max() for found in (on_triangles, at_vertices)]
    assert errors[0] < 1e-3 < 2e-3 < errors[1]


def test_distance_far_from_the_surface_is_that_to_the_nearest_vertex():
    body, x = surface_of(trimesh.creation.icosphere(subdivisions=2, radius=0.3)), torch.full((1, 3, 1), 5.0).double()
    assert torch.equal(signed_distance(x, body), signed_distance(x, PosedBody(body.points, body.normals)))


def test_frames_of_a_moving_body_do_not_mix():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    still = surface_of(mesh)
    shift = torch.tensor([0.0, 0.5, -1.0]).double()
    moving = PosedBody(still.points + shift * torch.ones(1, 3, 1), still.normals.expand(-1, -1, 3), still.rings)
    x = torch.tensor(mesh.vertices[::7] * 1.05)[:, :, None]
    together = signed_distance(x + shift * torch.ones(1, 3, 1), moving)
    np.testing.assert_allclose(together, signed_distance(x, still).expand(-1, 3), atol=1e-12)


@KERNELS
@pytest.mark.parametrize("case", ["triangles", "open", "obtuse", "vertices"])
def test_kernels_find_the_planes_that_their_references_find(case, toy_grid):
    rng = np.random.default_rng(8)
    if case == "open":
        points, faces = toy_grid(5, 4)
        mesh = trimesh.Trimesh(points, faces, process=False)
    elif case == "obtuse":  # many points over the upper triangle are nearest to the lowest vertex, and its far edge
        points = [[0, 0, 0], [-0.1, 0.01, 0], [0.1, 0.01, 0], [0, 0.1, 0]]
        mesh = trimesh.Trimesh(points, [[0, 2, 1], [1, 2, 3]], process=False)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    mesh.apply_translation([0.5, 0.5, 0.5])
    around = mesh.vertices + 0.003 * rng.normal(size=(3, *mesh.vertices.shape))
    points, normals = (torch.tensor(v, dtype=torch.float32) for v in (around.transpose(1, 2, 0), mesh.vertex_normals))
    rings = None if case == "vertices" else torch.as_tensor(triangle_rings(mesh.faces, len(points)))
    body = PosedBody(points, normals[:, :, None].expand(-1, -1, 3), rings)
    x = torch.tensor(mesh.sample(7, seed=1)[:, :, None] + 0.02 * rng.normal(size=(7, 3, 3)), dtype=torch.float32)
    x[-1, :, 1] -= 0.4  # nothing but the nearest vertex counts this far away
    expected = nearest_planes(x, body)
    on_device = PosedBody(*(v if v is None else v.to(DEVICE) for v in (body.points, body.normals, body.rings)))
    found = distance._by_kernels(x.to(DEVICE), on_device, None)
    for value, reference in zip(found, expected):
        np.testing.assert_allclose(value.cpu(), reference, atol=2e-6)


@KERNELS
def test_kernels_answer_alike_each_time():
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    points, normals = (
        torch.tensor(v.copy(), dtype=torch.float32)[:, :, None] for v in (mesh.vertices, mesh.vertex_normals)
    )
    body = [v.to(DEVICE) for v in (points, normals, torch.as_tensor(triangle_rings(mesh.faces, 42)))]
    x = torch.tensor(mesh.sample(33, seed=2)[:, :, None], dtype=torch.float32, device=DEVICE)
    once, again = (distance._by_kernels(x, PosedBody(*body), None) for _ in range(2))
    assert torch.equal(once[0], again[0]) and torch.equal(once[1], again[1])
