# SPDX-License-Identifier: Apache-2.0
"""Distance to a body, its penalty, and the search for the nearest body vertex on every path."""

import importlib.util

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from ssilk_core.assets import Body, Mesh, SkinWeights
from ssilk_core.energy import GarmentEnergy, nearest
from ssilk_core.energy.collision import PosedBody, collision_energy, signed_distance
from ssilk_core.energy.surface_point import nearest_on_rings, triangle_rings
from ssilk_core.fabrics import Fabric
from ssilk_core.kinematics import skin_points
from ssilk_core.model.body import CollisionBody

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"  # on a CPU kernels run in Triton's interpreter
KERNELS = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="kernels need Triton")


def plane() -> PosedBody:
    """The plane y = 0.5 as a lattice of vertices that face up."""
    x, z = np.mgrid[-1:1:21j, -1:1:21j].reshape(2, -1)
    points = torch.tensor(np.stack([x, np.full_like(x, 0.5), z], axis=1))[:, :, None]
    return PosedBody(points, torch.tensor([0.0, 1, 0]).double().expand(len(x), 3)[:, :, None])


def test_distance_to_a_plane_is_the_height_over_it():
    x = torch.tensor(np.random.default_rng(0).uniform(-0.9, 0.9, size=(50, 3, 1)), requires_grad=True)
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
    # The nearest vertex lies within half an edge (1 cm) of the foot: 1 - cos of that angle at most.
    np.testing.assert_allclose(distance, radius - 0.3, atol=0.35 * (1 - np.cos(0.015 / 0.3)))
    assert ((distance < 0) == (radius < 0.3))[np.abs(radius - 0.3) > 1e-3].all()


def test_penalty_starts_at_the_margin_and_grows_with_the_square():
    distance = torch.tensor([[0.01, 0.004, 0.003, 0.0, -0.006]]).double()
    expected = 10 * np.array([0, 0, 1e-3, 4e-3, 10e-3]) ** 2
    np.testing.assert_allclose(collision_energy(distance, 10.0, 4e-3)[0], expected, atol=1e-18)


def test_a_garments_penalty_is_summed_over_vertices_for_each_frame(toy_grid):
    points, faces = toy_grid(4, 3)
    flat = np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1)
    energy = GarmentEnergy(Mesh("/sheet", flat, faces), Fabric("f", collision=50.0, margin=0.01), dtype=torch.float64)
    heights = np.array([0.52, 0.505, 0.48])
    x = torch.tensor(flat[:, :, None] + heights * np.array([[0], [1], [0]]))
    body = PosedBody(*(v.expand(-1, -1, 3) for v in (plane().points, plane().normals)))
    np.testing.assert_allclose(energy.collision(x, body), 12 * 50 * np.array([0, 0.005, 0.03]) ** 2, atol=1e-14)


def brute_force(x: np.ndarray, body: np.ndarray) -> np.ndarray:
    distance = ((x[:, None].astype(float) - body[None].astype(float)) ** 2).sum(2)
    return distance.argmin(1)


def sides(x: torch.Tensor, body: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The two factors as `nearest_vertex` hands them to a path."""
    captured = {}
    path, nearest._on_cpu = nearest._on_cpu, lambda left, right: captured.setdefault("sides", (left, right))
    try:
        nearest.nearest_vertex(x, body)
    finally:
        nearest._on_cpu = path
    return captured["sides"]


@pytest.mark.parametrize("vertices, body_vertices, frames", [(1, 1, 1), (137, 53, 4), (40, 1000, 7)])
@pytest.mark.parametrize("chunk", [1, 1 << 27])
def test_nearest_vertex_matches_brute_force_on_both_paths(vertices, body_vertices, frames, chunk, monkeypatch):
    rng = np.random.default_rng(vertices)
    # Far from the origin, as a character may stand: the search is centred on the body.
    x = (rng.normal(size=(vertices, 3, frames)) + 50).astype(np.float32)
    body = (rng.normal(size=(body_vertices, 3, frames)) + 50).astype(np.float32)
    expected = brute_force(x, body)
    found = nearest.nearest_vertex(torch.tensor(x), torch.tensor(body))
    assert found.dtype == torch.int64
    np.testing.assert_array_equal(found, expected)
    monkeypatch.setattr(nearest, "CHUNK", chunk)
    np.testing.assert_array_equal(nearest._by_products(*sides(torch.tensor(x), torch.tensor(body))), expected)


def test_ties_go_to_the_lower_index_on_both_paths():
    # Whole numbers about a mean of zero leave no rounding, so that ties are exact.
    cube = np.stack(np.meshgrid([-2, 0, 2], [-2, 0, 2], [-2, 0, 2], indexing="ij"), axis=-1).reshape(-1, 3)
    body = np.concatenate([cube, cube])[:, :, None].astype(np.float32)
    x = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:, :, None].astype(np.float32)
    expected = brute_force(x, body)
    assert (expected < 27).all()
    np.testing.assert_array_equal(nearest.nearest_vertex(torch.tensor(x), torch.tensor(body)), expected)
    np.testing.assert_array_equal(nearest._by_products(*sides(torch.tensor(x), torch.tensor(body))), expected)


@KERNELS
@pytest.mark.parametrize("vertices, body_vertices, frames", [(1, 1, 1), (300, 77, 5), (129, 4001, 3)])
def test_the_kernel_finds_what_the_cpu_finds(vertices, body_vertices, frames):
    from ssilk_core.kernels.nearest import nearest_kernel

    rng = np.random.default_rng(2)
    x, body = (torch.tensor(rng.normal(size=(n, 3, frames)), dtype=torch.float32) for n in (vertices, body_vertices))
    found = nearest_kernel(*(side.to(DEVICE) for side in sides(x, body))).cpu()
    excess = [
        np.linalg.norm(x[..., f] - body[found[:, f], :, f], axis=1)
        - np.linalg.norm(x[:, None, :, f] - body[None, ..., f], axis=2).min(1)
        for f in range(frames)
    ]
    assert np.max(excess) < 1e-5


def test_body_is_posed_as_skinning_says_and_normals_turn_along(scene, toy_motion):
    from ssilk_core.training.bank import centred_matrices

    body, skeleton = scene.character.merged_body(), scene.character.skeleton
    matrices, _ = centred_matrices(toy_motion(scene, 5), skeleton)
    character = torch.tensor(matrices[:, :, :3].transpose(1, 2, 3, 0), dtype=torch.float32)
    chosen = np.arange(0, body.mesh.vertex_count, 3)
    posed = CollisionBody(body, 3, vertices=chosen, device=torch.device("cpu")).posed(character)
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
    posed = collider.posed(torch.cat([turn, torch.ones(3, 1)], dim=1)[None, ..., None])
    np.testing.assert_allclose(posed.normals[..., 0], collider.normals[..., 0] @ turn.T, atol=1e-6)


def surface_of(mesh: trimesh.Trimesh) -> PosedBody:
    """A posed body that is collided with on its triangles, with the mesh's own vertex normals."""
    rings = torch.tensor(triangle_rings(mesh.faces, len(mesh.vertices)))
    points, normals = (torch.tensor(v.copy())[:, :, None] for v in (mesh.vertices, mesh.vertex_normals))
    return PosedBody(points, normals, rings)


def test_rings_hold_every_triangle_around_a_vertex():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    rings = triangle_rings(mesh.faces, 42)
    for vertex, ring in enumerate(rings):
        expected = sorted(sorted(set(face) - {vertex}) for face in mesh.faces.tolist() if vertex in face)
        assert sorted(sorted(pair) for pair in ring.tolist() if pair != [vertex, vertex]) == expected


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
