# SPDX-License-Identifier: Apache-2.0
"""Intersection contours: closed forms, gradients by differences, and the kernel against the reference in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.physics import kernels
from ssilk_core.physics.intersections.cloth import ClothIntersections
from ssilk_core.physics.intersections.contours import IntersectionContours, segment_lengths
from ssilk_core.scene.assets import LOOSE, PINNED, Mesh

pytest.importorskip("igl")
CPU = torch.device("cpu")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")  # on a CPU kernels run in an interpreter


def sheet(count: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """A square of 2 count^2 triangles about the origin, in the plane z = 0."""
    at = (np.arange(count + 1) / count - 0.5) * size
    points = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((count + 1, count + 1))], axis=-1).reshape(-1, 3)
    corner = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).reshape(-1)
    a, b, c, d = corner, corner + count + 1, corner + count + 2, corner + 1
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def sheets(count: int) -> Mesh:
    """Two sheets of 2 count^2 triangles, 10 cm wide and 1 m apart."""
    points, faces = sheet(count, 0.1)
    return Mesh(
        "/sheets", np.concatenate([points, points + [0, 0, 1.0]]), np.concatenate([faces, faces + len(points)])
    )


@pytest.fixture
def mesh() -> Mesh:
    return sheets(4)


def contours_of(mesh: Mesh, kind: int = LOOSE, device: torch.device = CPU) -> IntersectionContours:
    return IntersectionContours(ClothIntersections(mesh), np.full(mesh.vertex_count, kind), 0.5, device)


def crossing(mesh: Mesh, seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """The second sheet stands upright in the first, by half."""
    points = mesh.points.copy()
    half = len(points) // 2
    upper = points[half:] - [0, 0, 1.0]
    points[half:] = np.stack([0.9 * upper[:, 0] + 0.003, 0.002 + 0.1 * upper[:, 0], upper[:, 1] + 0.013], axis=1)
    return points + noise * np.random.default_rng(seed).normal(size=points.shape)


def test_a_triangle_through_another_has_the_length_of_their_common_segment() -> None:
    flat = torch.tensor([[[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]], dtype=torch.float64)
    upright = torch.tensor([[[0.5, 1, -1], [2.5, 1, -1], [1.5, 1, 1]]], dtype=torch.float64)
    # Half way up, the upright one is 1 wide.
    assert segment_lengths(flat, upright).item() == pytest.approx(1.0, abs=1e-12)
    moved = upright + torch.tensor([1.5, 0, 0])  # from x = 2.5 on; the flat one ends at x = 3 there
    assert segment_lengths(flat, moved).item() == pytest.approx(0.5, abs=1e-12)
    assert segment_lengths(flat, upright + torch.tensor([0.0, 0, 3])).item() == 0


def test_two_sheets_meet_along_a_line(mesh) -> None:
    x = torch.tensor(np.stack([mesh.points, crossing(mesh)], axis=2))
    found = contours_of(mesh).lengths(x)
    assert found[0] == 0
    assert found[1].item() == pytest.approx(0.1 * np.hypot(0.9, 0.1), rel=1e-9)
    # One frame in four stands for all.
    many = x[..., [1, 0, 1, 0, 0, 1]]
    energy = contours_of(mesh).energy(many)
    torch.testing.assert_close(energy, 3 * 0.5 * found[[1, 0, 0, 0, 0, 0]])
    torch.testing.assert_close(energy.mean(), 0.5 * found[[1, 0]].mean())  # of frames 0 and 4


def test_gradients_are_those_by_differences_where_edges_are_steep(mesh) -> None:
    contours = contours_of(mesh)
    at = torch.tensor(crossing(mesh, 3, 1e-3)[:, :, None]).requires_grad_()
    contours.lengths(at).sum().backward()
    direction = torch.randn(at.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad():
        ahead, behind = (contours.lengths(at + side * 1e-7 * direction).item() for side in (1, -1))
    assert (at.grad * direction).sum().item() == pytest.approx((ahead - behind) / 2e-7, rel=1e-5)


def test_cloth_leaves_the_other_by_the_shortest_way(mesh) -> None:
    half = mesh.vertex_count // 2
    x = torch.tensor(crossing(mesh)[:, :, None])
    x[half:, 2] += 0.03  # its lower border is 7 mm below the other
    contours = contours_of(mesh)
    for _ in range(400):
        x.requires_grad_()
        length = contours.lengths(x)
        (gradient,) = torch.autograd.grad(length.sum(), x)
        x = (x - 1e-3 * gradient).detach()
    assert length.item() == 0


@pytest.mark.parametrize("steep", [True, False])
def test_the_kernel_is_the_reference(monkeypatch, steep) -> None:
    pytest.importorskip("triton")
    from ssilk_core.physics.kernels import contours as kernel

    monkeypatch.setattr(kernel, "TILE", 8)
    monkeypatch.setattr(kernel, "SLOTS", 256)
    mesh = sheets(3)  # a few tiles: the interpreter is slow
    crossed = crossing(mesh, 0, 2e-3 if steep else 2e-2)
    x = torch.tensor(np.stack([mesh.points, crossed], axis=2))
    reference = x.clone().requires_grad_()
    expected = contours_of(mesh).lengths(reference)
    weights = torch.tensor([1.0, 2])
    (expected * weights).sum().backward()
    monkeypatch.setattr(kernels, "available", lambda device: True)
    own = x.float().to(DEVICE).requires_grad_()
    found = contours_of(mesh, device=DEVICE).lengths(own)
    (found * weights.to(DEVICE)).sum().backward()
    assert expected[1:].min() > 0.05
    torch.testing.assert_close(found.cpu().double(), expected.detach(), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(own.grad.cpu().double(), reference.grad, rtol=2e-3, atol=2e-3)


def test_cloth_that_follows_skin_alone_does_not_count(mesh) -> None:
    x = torch.tensor(crossing(mesh)[:, :, None])
    assert contours_of(mesh, PINNED).lengths(x).item() == 0


def test_what_intersects_at_rest_does_not_count(mesh) -> None:
    tangled = replace(mesh, points=crossing(mesh))
    x = torch.tensor(np.array(tangled.points)[:, :, None])
    assert contours_of(tangled).lengths(x).item() == 0
