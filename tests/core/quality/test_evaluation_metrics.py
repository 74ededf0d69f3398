# SPDX-License-Identifier: Apache-2.0
"""Measures of moving cloth against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.network.descriptors import six_d
from ssilk_core.physics.energy.stretch import deformation_gradient_operator
from ssilk_core.quality.evaluation.metrics import (
    derivative,
    histogram_quantiles,
    kinetic_energy,
    mean_square,
    pose_distance,
    principal_stretches,
    settling_time,
    stretch_histogram,
)
from ssilk_core.scene.assets import Mesh

FPS = 30.0


@pytest.fixture
def sheet(toy_grid) -> Mesh:
    return Mesh("/sheet", *toy_grid(6, 5))


def moved(mesh: Mesh, path: np.ndarray) -> torch.Tensor:
    """The sheet, carried along a path (N, 3) as it is: (V, 3, N)."""
    return torch.as_tensor(mesh.points[:, :, None] + path.T)


def test_a_translating_sheet_has_the_energy_of_its_mass(sheet):
    mass = torch.rand(sheet.vertex_count, dtype=torch.float64) + 0.1
    velocity = np.array([0.3, -1.2, 0.4])
    energy = kinetic_energy(moved(sheet, np.arange(7)[:, None] / FPS * velocity), mass, FPS)
    assert energy.shape == (6,)
    np.testing.assert_allclose(energy, float(mass.sum()) * (velocity**2).sum() / 2)


def test_a_spinning_rod_has_the_energy_of_its_moment():
    """Two masses at a radius r: m r^2 w^2 in all, less what chords cut off arcs, (2 sin(a/2) / a)^2."""
    rate, radius = 2.0, 0.5
    angle = torch.arange(20, dtype=torch.float64) * rate / FPS
    arm = radius * torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)])
    energy = kinetic_energy(torch.stack([arm, -arm]), torch.full((2,), 0.7, dtype=torch.float64), FPS)
    chord = 2 * math.sin(rate / FPS / 2) / (rate / FPS)
    np.testing.assert_allclose(energy, 0.7 * (radius * rate * chord) ** 2)


def test_the_third_difference_of_a_sinusoid(sheet):
    """Each difference of a wave of frequency w multiplies it by 2 sin(w dt / 2) / dt."""
    rate, amplitude, mass = 6.0, 0.02, torch.rand(sheet.vertex_count, dtype=torch.float64) + 0.1
    time = np.arange(4001) / FPS
    path = amplitude * np.stack([np.sin(rate * time), np.zeros_like(time), np.zeros_like(time)], axis=1)
    jerk = mean_square(derivative(moved(sheet, path), 3, FPS), mass).mean().sqrt()
    expected = amplitude / math.sqrt(2) * (2 * math.sin(rate / FPS / 2) * FPS) ** 3
    assert float(jerk) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("order", "expected"), [(0, 0.0), (1, 1.5 + 0.4 / FPS), (2, 0.8), (3, 0.0)])
def test_derivatives_of_a_parabola_are_its_coefficients(order, expected):
    time = torch.arange(6, dtype=torch.float64) / FPS
    x = (1.5 * time + 0.4 * time**2)[None, None].expand(2, 3, 6)
    found = derivative(x, order, FPS)[..., 0]
    assert found.allclose(torch.full_like(found, expected), atol=1e-9)


def test_an_exponential_decay_settles_when_it_crosses_the_threshold():
    tau, calm, time = 0.4, 0.01, torch.arange(200) / FPS
    speed = torch.stack([torch.exp(-time / tau), 2 * torch.exp(-time / tau)])
    settled = settling_time(speed, calm, FPS)
    expected = tau * np.log([1 / calm, 2 / calm])
    assert (settled.numpy() >= expected).all() and (settled.numpy() < expected + 1 / FPS).all()


def test_what_moves_again_has_not_settled_before():
    speed = torch.zeros(3, 30)
    speed[1, 20] = speed[2, 29] = 1.0
    assert settling_time(speed, 0.01, FPS).tolist() == [0.0, pytest.approx(21 / FPS), math.inf]


@pytest.mark.parametrize(("across", "along"), [(1.0, 1.0), (1.3, 1.3), (0.8, 1.5), (0.2, 0.9)])
def test_a_uniformly_stretched_sheet_has_the_stretches_of_its_axes(sheet, across, along):
    columns = deformation_gradient_operator(sheet, torch.device("cpu"), torch.float64)
    turn = Rotation.random(random_state=4).as_matrix()
    x = torch.as_tensor((sheet.points * [across, along, 1]) @ turn.T + 0.5)[:, :, None]
    larger, smaller = principal_stretches(columns(x))
    assert larger.shape == (len(sheet.faces), 1)
    np.testing.assert_allclose(larger, max(across, along))
    np.testing.assert_allclose(smaller, min(across, along))


def test_a_sheared_sheet_has_the_singular_values_of_its_gradient(sheet):
    columns = deformation_gradient_operator(sheet, torch.device("cpu"), torch.float64)
    affine = np.array([[1.1, 0.4, 0], [-0.2, 0.9, 0], [0.3, 0.1, 1]])
    stretches = principal_stretches(columns(torch.as_tensor(sheet.points @ affine.T)[:, :, None]))
    expected = np.linalg.svd(affine[:, :2], compute_uv=False)
    np.testing.assert_allclose(stretches[:, :, 0].T, np.tile(expected, (len(sheet.faces), 1)))


def test_quantiles_from_parts_are_those_of_the_whole():
    stretch = 1 + 0.3 * torch.randn(40_000, generator=torch.Generator().manual_seed(5)).abs()
    counts = sum(stretch_histogram(part) for part in stretch.split(7_000))
    found = histogram_quantiles(counts, (0.5, 0.95, 0.99))
    np.testing.assert_allclose(found, stretch.quantile(torch.tensor([0.5, 0.95, 0.99])), atol=1e-3)
    far = stretch_histogram(torch.tensor([-1.0, 1e6]))
    assert far.sum() == 2 and far[0] == far[-1] == 1


def test_the_distance_of_a_pose_is_the_angle_that_joints_turned():
    """Small turns of every joint about random axes, gravity's direction in its frame turning with it."""
    joints, angle = 4000, 0.05
    before = Rotation.random(joints, random_state=6)
    axis = np.random.default_rng(7).normal(size=(joints, 3))
    after = before * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    poses = []
    for turns in (before, after):
        matrices = turns.as_matrix()
        poses.append(np.concatenate([six_d(matrices), matrices[:, 1]], axis=1).reshape(1, -1))
    elsewhere = -poses[0]
    seen = torch.as_tensor(np.concatenate([elsewhere, poses[0]]))
    found = pose_distance(torch.as_tensor(poses[1]), seen, joints)
    assert float(found) == pytest.approx(angle, rel=0.02)
    assert float(pose_distance(seen[:1], seen, joints)) < 1e-4
