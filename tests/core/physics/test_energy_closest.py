# SPDX-License-Identifier: Apache-2.0
"""The nearest point of a whole surface against libigl's, and against the search that training uses."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics.collision import PosedBody, closest_point, distance, nearest_planes
from ssilk_core.physics.collision.closest_point import all_pairs, blocked_pairs, closest_on_faces, triangle_patches
from ssilk_core.physics.collision.one_ring import triangle_rings

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def slab(width: float = 1.0) -> trimesh.Trimesh:
    """A flat box whose large triangles have their corners far from most of their points."""
    return trimesh.creation.box((width, 0.1, 0.3)).subdivide()


def body_of(*meshes: trimesh.Trimesh) -> PosedBody:
    """The same triangles in several frames, one mesh for each, as simulating sees them."""
    points = np.stack([mesh.vertices for mesh in meshes], axis=-1)
    normals = np.stack([mesh.vertex_normals for mesh in meshes], axis=-1)
    rings, faces = triangle_rings(meshes[0].faces, len(points)), np.array(meshes[0].faces)
    tensors = [torch.as_tensor(values, dtype=torch.float32, device=DEVICE) for values in (points, normals)]
    tables = [torch.as_tensor(values, device=DEVICE) for values in (rings, faces)]
    return PosedBody(*tensors, rings=tables[0], faces=tables[1])


def scattered(count: int, frames: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return (torch.rand(count, 3, frames, generator=generator) - 0.5) * torch.tensor([1.2, 0.4, 0.5])[:, None]


@pytest.mark.parametrize("scores", [1 << 25, 1])  # all frames at once, and one after another
def test_the_nearest_point_is_that_of_the_whole_surface(monkeypatch, scores) -> None:
    monkeypatch.setattr(closest_point, "MAX_PAIRS", scores)
    meshes, x = (slab(), slab(1.1), slab(0.9)), scattered(150, 3)
    body = body_of(*meshes)
    reach = torch.full_like(x[:, 0], 2.0)
    row, frame, corners, weights = closest_on_faces(x.to(DEVICE), reach.to(DEVICE), body.points, body.faces)
    assert len(row) == 450  # each query once
    points = (body.points[corners, :, frame] * weights[..., None]).sum(0)
    distance = (x.to(DEVICE)[row, :, frame] - points).norm(dim=1).cpu()
    for n, mesh in enumerate(meshes):
        squared, _, _ = igl.point_mesh_squared_distance(x[:, :, n].double().numpy(), mesh.vertices, mesh.faces)
        own = (frame == n).cpu()
        np.testing.assert_allclose(distance[own][row[own].cpu().argsort()], np.sqrt(squared), atol=1e-6)


def test_only_what_is_asked_for_is_sought() -> None:
    x, body = scattered(40, 1).to(DEVICE), body_of(slab())
    reach = torch.full_like(x[:, 0], 2.0)
    reach[10:] = -1
    row, *_ = closest_on_faces(x, reach, body.points, body.faces)
    assert sorted(row.tolist()) == list(range(10))


@pytest.mark.parametrize("search", [all_pairs, blocked_pairs])
@pytest.mark.parametrize("count", [1, 64, 150])  # less than a block of queries, a whole one, and padded ones
def test_no_pair_within_reach_is_missed_and_few_others_are_found(search, count) -> None:
    x, body = scattered(count, 3), body_of(slab(), slab(1.1), slab(0.9))
    reach = 0.3 * torch.rand(3, count, generator=torch.Generator().manual_seed(1)).T - 0.02  # some ask for nothing
    x[0, :, 1], reach[0, 1] = torch.nan, -1
    found = search(x, reach, body.points.cpu(), body.faces.cpu())
    corners = body.points.cpu().double()[body.faces.cpu()]
    centre = corners.mean(1)
    gap = (x.double()[:, None] - centre).norm(dim=2) - (corners - centre[:, None]).norm(dim=2).amax(1)
    gap = gap.nan_to_num(torch.inf)
    pairs = torch.zeros_like(gap, dtype=torch.int64)
    pairs.index_put_((found[0], found[2], found[1]), torch.tensor(1), accumulate=True)
    asked = (reach >= 0)[:, None]
    assert pairs.max() == 1 and (pairs[asked & (gap < reach[:, None] - 1e-5)] == 1).all()
    assert not pairs[~asked | (gap > reach[:, None] + 1e-4)].any()


def distances(x: torch.Tensor, body: PosedBody) -> torch.Tensor:
    normal, offset = nearest_planes(x, body)
    return (normal * x).sum(1) - offset


def test_near_the_surface_it_is_the_distance_of_libigl_and_close_to_that_of_training() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    body = body_of(ball)
    x = scattered(4000, 1) * torch.tensor([0.4, 1.2, 1.0])[:, None]
    x = x[(x.norm(dim=1) - 0.2).abs()[:, 0] < 0.05]
    found = distances(x.to(DEVICE), body).cpu()
    expected, *_ = igl.signed_distance(x[..., 0].double().numpy(), ball.vertices, ball.faces)
    np.testing.assert_allclose(found[:, 0], expected, atol=2e-6)
    trained = distances(x.to(DEVICE), replace(body, faces=None)).cpu()
    torch.testing.assert_close(found, trained, rtol=0.01, atol=1e-5)


def test_planes_held_still_are_the_true_gradient_of_the_distance() -> None:
    body, step = body_of(slab()), 1e-3
    x = scattered(300, 1).to(DEVICE)
    x = x[(distances(x, body).abs() < 0.07).all(dim=1)]
    moves = step * torch.eye(3, device=DEVICE)[:, None, :, None]
    rates = [(distances(x + move, body) - distances(x - move, body)) / (2 * step) for move in moves]
    away = (torch.stack(rates, dim=1) - nearest_planes(x, body)[0]).norm(dim=1)
    assert away.median() < 1e-3 and away.quantile(0.9) < 0.1  # the others lie within a step of a crease's two sides


def test_far_cloth_is_inside_only_where_it_is() -> None:
    """The tangent planes of a coarse ball's vertices extend beyond it, and cut through all that is around it."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.3)  # edges of 16 to 19 cm
    body, x = body_of(ball), scattered(4000, 1)
    x = x / x.norm(dim=1, keepdim=True) * torch.linspace(0.06, 1.2, 4000)[:, None, None]
    expected, *_ = igl.signed_distance(x[..., 0].double().numpy(), ball.vertices, ball.faces)
    expected = torch.tensor(expected[:, None], dtype=torch.float32)
    found = distances(x.to(DEVICE), body).cpu()
    assert ((found < 0) == (expected < 0)).all()
    near = expected < 0.02  # a vertex is nowhere further than 12 cm from the surface that far out
    torch.testing.assert_close(found[near], expected[near], rtol=0, atol=3e-6)
    assert (found[~near] > 0.019).all()


def sheet() -> trimesh.Trimesh:
    """A square of 40 cm in the plane y = 0, in quads of 5 cm."""
    points, faces = np.mgrid[0:0.4:9j, 0:0.4:9j].reshape(2, -1), []
    for i in range(8):
        for j in range(8):
            a = 9 * i + j
            faces += [[a, a + 1, a + 10], [a, a + 10, a + 9]]
    return trimesh.Trimesh(np.stack([points[0], np.zeros(81), points[1]], axis=1), faces, process=False)


def test_no_border_of_an_open_body_is_its_inside() -> None:
    """Cloth beside a sheet and a little behind it is not as deep as it is far away."""
    body = body_of(sheet())
    up = float(body.normals[0, 1, 0])
    x = torch.tensor([[0.2, -0.1 * up, 0.2], [0.6, -0.02 * up, 0.2], [0.44, -0.001 * up, 0.2]])[:, :, None]
    found = distances(x.to(DEVICE), body).cpu()[:, 0]
    np.testing.assert_allclose(found, [-0.1, np.hypot(0.2, 0.02), np.hypot(0.04, 0.001)], atol=1e-6)


def test_a_vertex_without_triangles_is_no_surface() -> None:
    """Where a body is cut, vertices may be left over; nothing lies inside them."""
    body, x = body_of(sheet()), torch.tensor([[1.0, -0.05, 1.0], [1.0, -0.2, 1.0]])[:, :, None]
    left, up = torch.tensor([[[1.0], [0.0], [1.0]]]), torch.tensor([[[0.0], [1.0], [0.0]]])
    body = replace(
        body,
        points=torch.cat([body.points, left.to(DEVICE)]),
        normals=torch.cat([body.normals, up.to(DEVICE)]),
        patches=torch.as_tensor(triangle_patches(np.array(sheet().vertices), np.array(sheet().faces)), device=DEVICE),
    )
    for normal, offset in (nearest_planes(x.to(DEVICE), body), distance._by_kernels(x.to(DEVICE), body, None)):
        np.testing.assert_allclose(((normal * x.to(DEVICE)).sum(1) - offset).cpu()[:, 0], [0.05, 0.2], atol=1e-6)


@pytest.mark.parametrize("shape", ["ball", "sheet"])
def test_the_kernel_tells_the_inside_of_far_cloth_as_its_reference_does(shape) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.3) if shape == "ball" else sheet()
    body, x = body_of(mesh), scattered(300, 1)
    x = x + torch.tensor([[0.4], [0.0], [0.2]]) if shape == "sheet" else x
    patches = torch.as_tensor(triangle_patches(np.array(mesh.vertices), np.array(mesh.faces)), device=DEVICE)
    normal, offset = distance._by_kernels(x.to(DEVICE), replace(body, patches=patches), None)
    expected = distances(x.to(DEVICE), body)
    assert (expected < -0.08).any() and (expected > 0.08).any()
    torch.testing.assert_close((normal * x.to(DEVICE)).sum(1) - offset, expected, rtol=0, atol=1e-5)


def test_the_distance_to_a_closed_body_does_not_jump() -> None:
    """Along any path it changes as the held plane says, so that forces which follow that plane add no energy."""
    body, step = body_of(trimesh.creation.icosphere(subdivisions=1, radius=0.3)), 1e-3
    start, way = scattered(400, 1).chunk(2)
    start = start / start.norm(dim=1, keepdim=True) * torch.linspace(0.16, 0.9, 200)[:, None, None]
    path = start + step * way / way.norm(dim=1, keepdim=True) * torch.arange(200)
    normal, offset = (values.cpu() for values in nearest_planes(path.to(DEVICE), still_for(body, 200)))
    height = (normal * path).sum(1) - offset
    held = (normal[..., :-1] * path[..., 1:]).sum(1) - offset[..., :-1]
    reach = 0.02  # contact begins nearer than this
    assert ((height[:, 1:].clamp_max(reach) - held.clamp_max(reach)).abs() < 2.1 * step).all()


def still_for(body: PosedBody, frames: int) -> PosedBody:
    """Return a body that does not move for so many frames."""
    return replace(
        body, **{name: getattr(body, name).expand(-1, -1, frames).contiguous() for name in ("points", "normals")}
    )


def test_the_kernel_finds_what_its_reference_does() -> None:
    meshes = [slab(), slab(1.1)]
    body, x = body_of(*meshes), scattered(90, 2).to(DEVICE)
    patches = torch.as_tensor(triangle_patches(meshes[0].vertices, np.array(meshes[0].faces)), device=DEVICE)
    on_device = replace(body, patches=patches)
    (normal, offset), expected = distance._by_kernels(x, on_device, None), nearest_planes(x, body)
    torch.testing.assert_close((normal * x).sum(1) - offset, distances(x, body), rtol=0, atol=1e-6)
    rounding = (normal - expected[0]) * distances(x, body)[:, None]  # directions turn by it over the distance
    assert rounding.abs().max() < 3e-6  # [m]; the reference is that of loops, in single precision, too


def test_the_distance_has_no_seams() -> None:
    # Two blades 3 cm apart with corners at different places: towards the coarse one's middle, the nearest vertex is
    # one of the other's.
    fine = trimesh.creation.box((0.2, 0.01, 0.2)).subdivide().subdivide().apply_translation([0, 0.03, 0])
    coarse = trimesh.creation.box((0.4, 0.01, 0.2)).apply_translation([0, -0.005, 0])
    body = body_of(trimesh.util.concatenate([fine, coarse]))
    along = torch.linspace(-0.19, 0.19, 800)
    x = torch.stack([along, torch.full_like(along, 0.005), 0.3 * along], dim=1)[..., None].to(DEVICE)
    found, trained = distances(x, body)[:, 0], distances(x, replace(body, faces=None))[:, 0]
    assert found.diff().abs().max() < 1e-4 < 1e-3 < trained.diff().abs().max()
