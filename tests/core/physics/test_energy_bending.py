# SPDX-License-Identifier: Apache-2.0
"""Bending energy: signed angles, closed forms, and gradients where angles are not defined."""

import numpy as np
import pytest
import torch

from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.bending import dihedral_angles
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import Fabric

BENDING = 3e-5
FABRIC = Fabric("test", bending=BENDING)
FACES = np.array([[0, 1, 2], [1, 0, 3]])


def fold(angle: float, scale: float = 1.0) -> np.ndarray:
    """Two triangles that share the edge 0-1 along z, the second turned down by `angle` out of the first's plane."""
    return scale * np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.5], [-np.cos(angle), -np.sin(angle), 0.5]])


def tensor(*frames: np.ndarray, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.tensor(np.stack(frames, axis=-1), dtype=dtype)


def angle_of(points: np.ndarray) -> float:
    x0, x1, left, right = tensor(points)
    return float(dihedral_angles((x1 - x0)[None], (left - x0)[None], (right - x0)[None]))


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.3, 1.5, -2.5, 3.1, -3.1])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_dihedral_angle_is_the_signed_fold_at_any_size(angle, scale):
    # Face 0-1-2 runs z then x, so its normal is +y: folding down is a ridge, which is positive.
    assert angle_of(fold(angle, scale)) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("rest, angle", [(0.0, 0.4), (0.5, 0.5), (0.5, -0.5), (-1.0, 1.2)])
def test_one_hinge_costs_the_square_of_its_signed_change(rest, angle):
    energy = GarmentEnergy(Mesh("/fold", fold(rest), FACES), FABRIC, dtype=torch.float64)
    expected = BENDING * 1.0**2 / (8 * 1.0) * (angle - rest) ** 2  # edge length 1, two areas of 1/2
    assert float(energy.bending(tensor(fold(angle)))) == pytest.approx(expected, abs=1e-18)


@pytest.mark.parametrize("rest", [0.5, -0.5])
def test_a_hinge_folded_flat_goes_on_without_a_jump(rest):
    energy = GarmentEnergy(Mesh("/fold", fold(rest), FACES), FABRIC, dtype=torch.float64)
    angles = np.linspace(np.pi - 0.8, np.pi + 0.8, 41)
    found = energy.bending(tensor(*(fold(angle) for angle in angles))).numpy()
    away = np.minimum(np.abs(angles - rest), 2 * np.pi - np.abs(angles - rest))
    np.testing.assert_allclose(found, BENDING / 8 * away**2, rtol=1e-9)


def test_a_fold_pushed_through_flat_costs_more_than_flat():
    energy = GarmentEnergy(Mesh("/fold", fold(0.5), FACES), FABRIC, dtype=torch.float64)
    kept, flat, flipped = energy.bending(tensor(fold(0.5), fold(0), fold(-0.5))).tolist()
    assert kept < 1e-20 < flat < flipped == pytest.approx(4 * flat)


@pytest.mark.parametrize("facets", [8, 24])
@pytest.mark.parametrize("inward", [1, -1])
def test_a_strip_rolled_into_a_cylinder(toy_grid, facets, inward):
    width, height = 0.2, 0.55
    points, faces = toy_grid(facets + 1, 2, height, width)
    side, turn = height / facets, 2 * np.pi / facets
    radius = side / 2 / np.sin(turn / 2)
    row = np.repeat(np.arange(facets + 1), 2)
    rolled = np.stack([points[:, 0], radius * np.cos(row * turn), inward * radius * np.sin(row * turn)], axis=1)
    energy = GarmentEnergy(Mesh("/strip", points, faces), FABRIC, dtype=torch.float64)
    # Only the edges across bend: each is `width` long between two triangles of side * width / 2.
    expected = (facets - 1) * BENDING * width**2 / (8 * side * width) * turn**2
    assert float(energy.bending(tensor(rolled))) == pytest.approx(expected)


def test_flat_and_rest_cost_nothing_and_pull_nowhere(toy_grid):
    points, faces = toy_grid(6, 4)
    x = tensor(points).requires_grad_()
    value = GarmentEnergy(Mesh("/flat", points, faces), FABRIC, dtype=torch.float64).bending(x)
    value.sum().backward()
    assert value.item() == 0 and x.grad.abs().max() == 0


def test_gradient_at_flat_pulls_towards_a_bent_rest():
    x = tensor(fold(0)).requires_grad_()
    GarmentEnergy(Mesh("/fold", fold(0.5), FACES), FABRIC, dtype=torch.float64).bending(x).sum().backward()
    # dE/dtheta = 2 k (0 - 0.5), and lowering a tip of height 1 over the edge by h folds by h.
    expected = 2 * BENDING / 8 * 0.5
    np.testing.assert_allclose(x.grad[2:, :, 0], np.array([[0, expected, 0]] * 2), atol=1e-18)


@pytest.mark.parametrize("size", 10.0 ** -np.arange(0, 14))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_is_finite_for_collapsing_faces(size, dtype):
    energy = GarmentEnergy(Mesh("/fold", fold(0.3), FACES), FABRIC, dtype=dtype)
    thin, small = fold(0.3), fold(0.3, size)
    thin[2:, :2] *= size
    point, line = fold(0.3, 0.0), fold(0.3)
    line[2:] = line[0]
    x = tensor(thin, small, point, line, dtype=dtype).requires_grad_()
    value = energy.bending(x)
    value.sum().backward()
    assert torch.isfinite(value).all() and torch.isfinite(x.grad).all()


def test_without_hinges_or_stiffness_bending_is_zero_for_each_frame():
    x = tensor(fold(1.0), fold(2.0))
    single = GarmentEnergy(Mesh("/one", fold(0)[:3], FACES[:1]), FABRIC, dtype=torch.float64)
    assert single.bending(x[:3]).tolist() == [0, 0]
    limp = GarmentEnergy(Mesh("/fold", fold(0), FACES), Fabric("limp", bending=0.0), dtype=torch.float64)
    assert limp.bending(x).tolist() == [0, 0]


@pytest.mark.parametrize("height", [1 / 60, 1e-3, 1e-5])
def test_a_sliver_bends_no_more_stiffly_than_the_slimmest_clean_triangle(height):
    def force(height: float) -> float:
        """What moves the tip of a face back that is so high over the hinge, for each metre out of the plane [N/m]."""
        points, lift = fold(0.0), 1e-9
        points[3] = [-height, 0, 0.5]
        energy = GarmentEnergy(Mesh("/sliver", points, FACES), FABRIC, dtype=torch.float64)
        x = tensor(points + lift * np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 1, 0]])).requires_grad_(True)
        (gradient,) = torch.autograd.grad(energy.bending(x).sum(), x)
        return float(gradient[3].norm()) / lift

    assert 0 < force(height) <= 1.05 * force(1 / 50)
