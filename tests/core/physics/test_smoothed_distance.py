# SPDX-License-Identifier: Apache-2.0
"""The rounded distance against closed forms, finite differences and the Euclidean one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.physics.collision import (
    Patches,
    PosedBody,
    closest_point,
    distance,
    nearest_planes,
    signed_distance_to_planes,
    smoothed_planes,
)
from ssilk_core.physics.collision.distance import SURFACE_EPSILON
from ssilk_core.physics.collision.smoothed_distance import SMOOTHING_EXPONENT

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def body_of(*meshes: trimesh.Trimesh) -> PosedBody:
    """The same triangles in several frames, one mesh for each."""
    points = np.stack([mesh.vertices for mesh in meshes], axis=-1)
    normals = np.stack([mesh.vertex_normals for mesh in meshes], axis=-1)
    points, normals = (torch.as_tensor(v.copy(), dtype=torch.float32, device=DEVICE) for v in (points, normals))
    return PosedBody(points, normals, faces=torch.as_tensor(np.array(meshes[0].faces), device=DEVICE))


def fold(angle: float, width: float = 0.06) -> trimesh.Trimesh:
    """Two walls that meet at z = 0 with so much air [rad] between them, about the plane x = 0."""
    half = 0.5 * angle
    left, right = (width * np.array([side * np.sin(half), 0, np.cos(half)]) for side in (-1, 1))
    corners = [np.array([0, y, 0]) + wall for y in (-0.05, 0.05) for wall in (0 * left, left, right)]
    return trimesh.Trimesh(corners, [[0, 3, 4], [0, 4, 1], [0, 2, 5], [0, 5, 3]], process=False)


def rounded(x: torch.Tensor, body: PosedBody) -> torch.Tensor:
    return smoothed_planes(x, body).distance(x)


def test_over_one_plane_it_is_the_distance() -> None:
    body = body_of(trimesh.creation.box((0.1, 0.02, 0.1)))
    height = torch.tensor([0.03, 0.004, 1e-3, 2e-5, 3e-6, -1e-3, -4e-3])
    x = torch.zeros(7, 3, 1)
    x[:, 0, 0], x[:, 1, 0], x[:, 2, 0] = 0.02, 0.01 + height, -0.01  # away from the diagonal, where two are as near
    found = smoothed_planes(x.to(DEVICE), body)
    torch.testing.assert_close(found.distance(x.to(DEVICE))[:, 0].cpu(), height, rtol=1e-5, atol=2e-8)
    expected = torch.tensor([0.0, 1.0, 0.0]).expand(7, 3)
    beyond = height.abs() > SURFACE_EPSILON
    torch.testing.assert_close(found.normal[..., 0].cpu()[beyond], expected[beyond], rtol=0, atol=1e-3)
    assert found.curvature.abs().max() < 1e-3


@pytest.mark.parametrize("angle", [0.5, 1.5, 2.6])
def test_between_two_walls_it_is_the_norm_of_their_distances(angle: float) -> None:
    body = body_of(fold(angle))
    x = torch.zeros(9, 3, 1)
    x[:, 0, 0], x[:, 1, 0], x[:, 2, 0] = 1e-3 * torch.linspace(-1, 1, 9), 0.01, 0.012
    wall = x[:, 2, 0] * np.sin(angle / 2) + torch.tensor([[-1.0], [1.0]]) * x[:, 0, 0] * np.cos(angle / 2)
    # Each wall has two triangles, of which the point is over one.
    expected = (wall.double() ** -SMOOTHING_EXPONENT).sum(0) ** (-1 / SMOOTHING_EXPONENT)
    torch.testing.assert_close(rounded(x.to(DEVICE), body)[:, 0].cpu(), expected.float(), rtol=1e-5, atol=0)
    middle = smoothed_planes(x.to(DEVICE), body).normal[4, :, 0].cpu()
    shorter = float(np.sin(angle / 2)) * 2 ** (-1 / SMOOTHING_EXPONENT)  # across the fold both walls count
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.0, shorter]), rtol=0, atol=1e-4)


def near(mesh: trimesh.Trimesh, reach: float, count: int = 600) -> torch.Tensor:
    generator = np.random.default_rng(4)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=4)
    away = generator.uniform(-reach, reach, (count, 1))
    return torch.as_tensor(points + away * mesh.face_normals[faces] + 0.3 * reach * generator.normal(size=(count, 3)))


def test_it_lies_little_below_the_euclidean_distance() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    body, x = body_of(ball), near(ball, 0.02)[..., None].float().to(DEVICE)
    exact, found = signed_distance_to_planes(x, *nearest_planes(x, body)), rounded(x, body)
    apart = (exact.abs() - found.abs()) / exact.abs()
    assert (exact.abs() > SURFACE_EPSILON).all() and torch.equal(exact > 0, found > 0)
    assert apart.min() > -2e-4 and 1e-3 < apart.max() < np.log(6) / SMOOTHING_EXPONENT + 1e-4


def in_the_fold(count: int) -> torch.Tensor:
    """Points about the middle of the air between two walls, where the distance is rounded."""
    x, generator = torch.zeros(count, 3, 1, dtype=torch.float64), torch.Generator().manual_seed(2)
    x[:, 2, 0] = 0.004 + 0.01 * torch.rand(count, generator=generator)
    x[:, 0, 0] = 0.02 * x[:, 2, 0] * torch.randn(count, generator=generator)
    x[:, 1, 0] = 0.01 * torch.randn(count, generator=generator)
    return x


def differences(x: torch.Tensor, body: PosedBody, step: float = 1e-6) -> tuple[torch.Tensor, torch.Tensor]:
    """First differences of the distance (V, 3) and of its gradient (V, 3, 3), in float64 on a processor."""
    moves = step * torch.eye(3, dtype=torch.float64)[:, None, :, None]
    sides = [(smoothed_planes(x + move, body), smoothed_planes(x - move, body)) for move in moves]
    first = [(up.distance(x + m) - down.distance(x - m)) / (2 * step) for m, (up, down) in zip(moves, sides)]
    second = [(up.normal - down.normal) / (2 * step) for up, down in sides]
    return torch.cat(first, dim=1), torch.cat(second, dim=2)


@pytest.mark.skipif(DEVICE.type != "cpu", reason="float64 is for processors")
def test_gradient_and_bend_are_the_derivatives() -> None:
    x, body = in_the_fold(300), body_of(fold(1.5))
    found = smoothed_planes(x, body)
    first, second = differences(x, body)
    torch.testing.assert_close(found.normal[..., 0], first, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        found.curvature[..., 0].double(), -second, rtol=2e-2, atol=0.05 * float(second.abs().max())
    )
    assert found.curvature[..., 0].norm(dim=(1, 2)).median() > 100


@pytest.mark.skipif(DEVICE.type != "cpu", reason="float64 is for processors")
def test_small_moves_are_expected_to_second_order_and_large_ones_within_what_moves_can() -> None:
    x, body = in_the_fold(300), body_of(fold(1.5))
    found = smoothed_planes(x, body)
    away = torch.randn(x.shape, generator=torch.Generator().manual_seed(6)).double()
    away = away / away.norm(dim=1, keepdim=True)
    here = found.distance(x)
    for length, share in ((1e-5, 0.1), (3e-5, 0.4)):
        true = rounded(x + length * away, body)
        first, second = found.distance(x + length * away), found.expected(x + length * away, length * away)
        assert (second - true).abs().mean() < share * (first - true).abs().mean()
    for length in (1e-3, 1e-2):
        fall = here - found.expected(x + length * away, length * away)
        assert fall.max() <= length * (1 + 1e-6) and (fall > 0.9 * length).any()


def test_nothing_to_look_at_is_no_error() -> None:
    body = body_of(fold(1.5))
    assert smoothed_planes(torch.zeros(4, 3, 0, device=DEVICE), replace(body, points=body.points[..., :0],
                          normals=body.normals[..., :0])).curvature.shape == (4, 3, 3, 0)  # fmt: skip
    bare = replace(body, faces=body.faces[:0])
    assert smoothed_planes(torch.ones(4, 3, 1, device=DEVICE), bare).curvature.abs().max() == 0


@pytest.mark.skipif(DEVICE.type != "cpu", reason="float64 is for processors")
def test_inside_it_bends_about_the_nearest_edge() -> None:
    body = body_of(fold(1.5))
    x = torch.tensor([[1e-3, 0.02, -5e-3], [-2e-3, -0.03, -8e-3]], dtype=torch.float64)[..., None]
    found = smoothed_planes(x, body)
    radius = x[:, [0, 2], 0].norm(dim=1)
    torch.testing.assert_close(-found.distance(x)[:, 0], radius * 2 ** (-1 / SMOOTHING_EXPONENT), rtol=1e-6, atol=0)
    for curvature, at, r in zip(found.curvature[..., 0], x[..., 0], radius):
        around = torch.tensor([at[2], 0.0, -at[0]], dtype=torch.float64) / r
        torch.testing.assert_close(curvature.double(), around[:, None] * around / r, rtol=1e-5, atol=1e-4)


def test_only_listed_triangles_are_found_and_all_frames_are_alike() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    other = ball.copy().apply_scale([1.1, 0.9, 1.0])
    x = near(ball, 0.01, 40)[..., None].float().repeat(1, 1, 2).to(DEVICE)
    body = body_of(ball, other)
    vertices = torch.arange(60, device=DEVICE).int()
    table = torch.cat([torch.tensor([60], device=DEVICE).int(), vertices]).repeat(40, 1)
    faces = torch.full((40, 100), -1, device=DEVICE)
    faces[:, :80] = torch.arange(80, device=DEVICE)
    found = smoothed_planes(x, body, patches=Patches(table, faces))
    part = replace(body, faces=body.faces[:80])
    expected = smoothed_planes(x, part, patches=Patches(table, faces[:, :80]))
    torch.testing.assert_close(found.distance(x), expected.distance(x), rtol=0, atol=1e-7)
    alone = smoothed_planes(x[..., 1:], body_of(other), patches=Patches(table, faces))
    torch.testing.assert_close(found.normal[..., 1:], alone.normal, rtol=0, atol=1e-6)


def test_frames_looked_at_in_turn_give_the_same(monkeypatch) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    body, x = body_of(ball, ball, ball), near(ball, 0.01, 50)[..., None].float().repeat(1, 1, 3).to(DEVICE)
    together = smoothed_planes(x, body)
    monkeypatch.setattr(closest_point, "MAX_PAIRS", 1)
    assert torch.equal(smoothed_planes(x, body).curvature, together.curvature)


@pytest.mark.parametrize("listed", [False, True])
def test_the_kernel_finds_what_its_reference_does(monkeypatch, listed: bool) -> None:
    pytest.importorskip("triton")
    walls = fold(1.2)
    ball = trimesh.util.concatenate([walls, trimesh.creation.icosahedron().apply_scale(0.05)])
    far_off, within = torch.tensor([[0.0, 0.0, 0.9]]).double(), in_the_fold(5)[..., 0]
    beyond = 1.7 * near(ball, 0.004, 5)  # what tight cloth can touch
    x = torch.cat([near(ball, 0.01, 4), near(walls, 0.004, 4), within, far_off, beyond])
    x = torch.stack([x, 1.01 * x], dim=-1).float().to(DEVICE)
    body = body_of(ball, ball.copy().apply_scale([1.0, 1.05, 0.95]))
    patches = None
    if listed:
        count = len(body.points)
        vertices = torch.arange(-1, count, device=DEVICE).int().repeat(len(x), 1)
        vertices[:, 0] = count
        faces = torch.arange(len(body.faces), device=DEVICE).repeat(len(x), 1)
        faces[::2, -9:] = -1
        patches = Patches(vertices, faces)
    with monkeypatch.context() as lbs:
        lbs.setattr(distance.kernels, "supports", lambda x: False)
        expected = smoothed_planes(x, body, patches=patches)
        found = distance._smoothed_by_kernel(x, body, None, patches)
    torch.testing.assert_close(found.distance(x.double()), expected.distance(x.double()), rtol=0, atol=3e-7)
    sure = expected.distance(x).abs() > 1e-3  # nearer, rounding decides about weights and directions
    apart = (found.normal - expected.normal).norm(dim=1)[sure]
    assert apart.max() < 2e-2 and apart.quantile(0.9) < 1e-3
    curvatures, scale = (
        (found.curvature - expected.curvature).norm(dim=(1, 2))[sure],
        expected.curvature.norm(dim=(1, 2))[sure],
    )
    assert (curvatures <= 0.05 * scale + 20).all() and scale.max() > 1000


def test_the_kernel_serves_more_frames_than_a_block_some_of_them_far_off(monkeypatch) -> None:
    pytest.importorskip("triton")
    walls, frames = fold(1.2), 40
    body = body_of(*[walls] * frames)
    x = in_the_fold(3).repeat(1, 1, frames).float().to(DEVICE)
    x[:, 2, ::3] += 0.5
    with monkeypatch.context() as lbs:
        lbs.setattr(distance.kernels, "supports", lambda x: False)
        expected = smoothed_planes(x, body)
        found = distance._smoothed_by_kernel(x, body, None, None)
    torch.testing.assert_close(found.distance(x.double()), expected.distance(x.double()), rtol=0, atol=3e-7)
    assert torch.equal(found.curvature[..., ::3], torch.zeros_like(found.curvature[..., ::3]))
    assert (found.curvature[..., 1::3].norm(dim=(1, 2)) > 0).any()


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("precision", [torch.float32, torch.float64], ids=str)
def test_the_loop_finds_what_its_reference_does(monkeypatch, listed: bool, precision: torch.dtype) -> None:
    """Over faces, edges and corners, on creases, inside, far away and where queries are not numbers."""
    pytest.importorskip("numba")
    ball, walls = trimesh.creation.icosphere(subdivisions=2, radius=0.05), fold(1.2)
    both = trimesh.util.concatenate([walls, ball])
    x = torch.cat([near(ball, 0.01, 40), near(walls, 0.004, 40), in_the_fold(20)[..., 0], torch.full((2, 3), 0.9)])
    x[-1, 0] = torch.nan
    x, body = (
        torch.stack([x, 1.01 * x], dim=-1).to(precision),
        body_of(both, both.copy().apply_scale([1, 1.05, 0.95])),
    )
    body = replace(body, points=body.points.cpu(), normals=body.normals.cpu(), faces=body.faces.cpu())
    patches = None
    if listed:
        vertices = torch.arange(-1, len(body.points)).int().repeat(len(x), 1)
        vertices[:, 0] = len(body.points)
        faces = torch.arange(len(body.faces)).repeat(len(x), 1)
        faces[::2, -200:] = -1
        patches = Patches(vertices, faces)
    found = smoothed_planes(x, body, patches=patches)
    monkeypatch.setattr(distance.loops, "available", lambda device: False)
    expected = smoothed_planes(x, body, patches=patches)
    sound = x.isfinite().all(1)
    apart = (found.distance(x) - expected.distance(x)).abs()[sound]
    assert apart.max() < (2e-7 if precision == torch.float32 else 1e-13)
    sure = sound & (expected.distance(x).abs() > 1e-3)  # nearer, float32 does not resolve directions
    tolerance = 2e-3 if precision == torch.float32 else 1e-9
    assert (found.normal - expected.normal).norm(dim=1)[sure].max() < tolerance
    curvatures = [each.curvature.norm(dim=(1, 2)) for each in (found, expected)]
    bent = (found.curvature - expected.curvature).norm(dim=(1, 2))[sure]
    assert (bent <= 10 * tolerance * curvatures[1][sure] + 1e4 * tolerance).all() and curvatures[1].max() > 100
    assert (curvatures[0][~sound] == 0).all() and (expected.distance(x)[sure] < 0).any()


def test_only_distances_that_matter_are_searched_for() -> None:
    body = body_of(trimesh.creation.icosphere(2, 0.1))
    x, within = near(trimesh.creation.icosphere(2, 0.1), 0.06)[..., None].to(DEVICE), 0.01
    right, found = rounded(x, body), smoothed_planes(x, body, within=within).distance(x)
    close = right < 0.95 * within
    assert 50 < int(close.sum()) < 0.7 * close.numel() and bool((right[close] < 0).any())
    torch.testing.assert_close(found[close], right[close])
    assert bool((found[~close] > 0.9 * within).all())
