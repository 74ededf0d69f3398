# SPDX-License-Identifier: Apache-2.0
"""Contact on surfaces: its law, its samples, and that a garment rests at the same gap on any mesh."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.physics.collision.sampled_cloth import SampledCloth
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.physics.samples import MAX_SPACING, contact_samples
from ssilk_core.scene.assets import LOOSE, PINNED, TIGHT, Mesh
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.scene.mesh.topology import subdivision_middles

CPU = torch.device("cpu")
SOFT = Fabric("soft", contact=2e5, margin=0.01, thickness=0.002)


def sheet(toy_grid, rows: int, columns: int, width: float = 0.2, height: float = 0.3) -> Mesh:
    points, faces = toy_grid(rows, columns)
    points = points / np.ptp(points, axis=0).clip(1e-9) * [width, height, 0]
    return Mesh("/sheet", points, faces)


@pytest.mark.parametrize("fabric", [SOFT, FABRICS["paper"]], ids=lambda fabric: fabric.name)
def test_pressure_and_curvature_are_derivatives_of_the_energy(fabric):
    distance = torch.linspace(-0.03, 0.015, 181).double().requires_grad_()
    law = ContactLaw.of(fabric)
    (slope,) = torch.autograd.grad(law.energy(distance).sum(), distance, create_graph=True)
    torch.testing.assert_close(law.pressure(distance), -slope)
    step = 1e-7
    bent = (law.pressure(distance - step) - law.pressure(distance + step)) / (2 * step)
    smooth = (distance - law.start).abs() > 1e-6  # the paper's curvature jumps where contact begins
    torch.testing.assert_close(law.curvature(distance)[smooth], bent[smooth], rtol=1e-4, atol=1e-2)


def test_the_skin_meets_half_the_stiffness_times_the_margin():
    """With K = 2e5 N/m3 and a margin of 10 mm the pressure at the skin is 1000 Pa, and 2 mm deeper 1400 Pa."""
    law = ContactLaw.of(SOFT)
    inner = torch.tensor([0.011, 0.001, -0.001]).double()  # of the mesh: half the thickness above the inner face
    torch.testing.assert_close(law.pressure(inner), torch.tensor([0.0, 1000, 1400]).double())
    torch.testing.assert_close(law.energy(inner)[1], torch.tensor(2e5 * 0.01**2 / 6).double())


@pytest.mark.parametrize("fabric", [SOFT, FABRICS["paper"]], ids=lambda fabric: fabric.name)
def test_a_body_that_is_not_finite_is_not_taken_for_free_space(fabric):
    law, nowhere = ContactLaw.of(fabric), torch.tensor([float("nan")])
    assert all(value(nowhere).isnan() for value in (law.energy, law.pressure, law.curvature))


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_triangle_is_divided_into_equal_parts(n):
    middles = subdivision_middles(n)
    assert middles.shape == (n * n, 3) and (middles > 0).all()
    np.testing.assert_allclose(middles.sum(axis=1), 1)
    np.testing.assert_allclose(middles.mean(axis=0), 1 / 3)
    apart = np.linalg.norm(middles[:, None] - middles[None], axis=2) + np.eye(n * n) * 9
    assert n == 1 or np.ptp(apart.min(axis=1)) < 1e-12


@pytest.mark.parametrize("rows, columns", [(31, 21), (5, 4), (2, 2)])
def test_samples_integrate_quadratic_functions_exactly(toy_grid, rows, columns):
    mesh = sheet(toy_grid, rows, columns)
    samples = contact_samples(mesh, SOFT)
    x, y, _ = samples.points(mesh.points).T
    x = x + 0.1
    np.testing.assert_allclose(samples.area.sum(), 0.06)
    np.testing.assert_allclose((samples.area * x * x).sum(), 0.3 * 0.2**3 / 3)
    np.testing.assert_allclose((samples.area * x * y).sum(), 0.02 * -(0.3**2) / 2)


@pytest.mark.parametrize("rows, columns", [(4, 3), (12, 9), (45, 31)])
def test_cloth_rests_at_the_same_gap_on_any_mesh(toy_grid, rows, columns):
    """Over a plane, at the distance where the pressure bears 0.15 kg/m2, energy and force balance for each mesh."""
    mesh, law = sheet(toy_grid, rows, columns), ContactLaw.of(SOFT)
    gap = law.start - np.sqrt(2 * SOFT.margin * SOFT.density * 9.81 / SOFT.contact)
    energy = GarmentEnergy(mesh, SOFT, dtype=torch.float64)
    x = torch.tensor(mesh.points)[:, :, None]
    x[:, 2] = gap
    x.requires_grad_()
    distance = energy.cloth.positions(x)[:, 2]
    (push,) = torch.autograd.grad(energy.collision_at(distance).sum(), x)
    assert -push[:, 2].sum().item() == pytest.approx(0.06 * SOFT.density * 9.81, rel=1e-9)
    spacing = contact_samples(mesh, SOFT).points(mesh.points)
    assert np.linalg.norm(spacing[:, None] - [[0.03, -0.15, 0]], axis=2).min() < MAX_SPACING


def test_a_sample_is_pinned_with_all_its_corners_and_loose_with_most(toy_grid):
    mesh = Mesh("/t", np.eye(3) * 0.01, np.array([[0, 1, 2]]))
    samples = contact_samples(mesh, SOFT)
    kinds = [(PINNED, PINNED, PINNED), (PINNED, PINNED, TIGHT), (TIGHT, LOOSE, LOOSE), (PINNED, TIGHT, LOOSE)]
    assert [int(samples.classes(np.array(kind))[3]) for kind in kinds] == [PINNED, TIGHT, LOOSE, TIGHT]
    assert samples.classes(np.array(kinds[2])).tolist()[:3] == list(kinds[2])


def test_forces_on_samples_go_to_their_corners(toy_grid):
    mesh = sheet(toy_grid, 4, 3)
    cloth = SampledCloth(contact_samples(mesh, SOFT), CPU, torch.float64)
    x = torch.tensor(mesh.points)[:, :, None].requires_grad_()
    force = torch.randn(len(cloth.area), 3, 1, generator=torch.Generator().manual_seed(1)).double()
    (expected,) = torch.autograd.grad((cloth.positions(x) * force).sum(), x)
    torch.testing.assert_close(cloth.to_vertices(force), expected)


def test_the_papers_energy_counts_vertices(toy_grid):
    mesh, fabric = sheet(toy_grid, 4, 3), replace(FABRICS["paper"], collision=50.0, margin=0.01)
    energy = GarmentEnergy(mesh, fabric, dtype=torch.float64)
    assert energy.collision_at(torch.full((12, 1), 0.004).double()).item() == pytest.approx(12 * 50 * 0.006**2)
