# SPDX-License-Identifier: Apache-2.0
"""Membrane energies against closed forms, and what they must not depend on."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.errors import SsilkError
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.stretch import rest_frames, stretched_areas
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import Fabric

MU, LAMBDA, STRETCH, SHEAR = 22.2, 41.8, 20.0, 2.0
AREA = 0.55 * 0.2
STVK = Fabric("stvk", lame_mu=MU, lame_lambda=LAMBDA)
WOVEN = Fabric("woven", stretch_model="baraff_witkin", stretch=STRETCH, shear=SHEAR)
FABRICS = pytest.mark.parametrize("fabric", [STVK, WOVEN], ids=lambda fabric: fabric.stretch_model)


def stretch_of(mesh: Mesh, fabric: Fabric, *posed: np.ndarray) -> np.ndarray:
    energy = GarmentEnergy(mesh, fabric, dtype=torch.float64)
    return energy.stretch(torch.tensor(np.stack(posed, axis=-1))).numpy()


@pytest.fixture(scope="module")
def sheet(toy_grid) -> Mesh:
    points, faces = toy_grid(7, 4)
    return Mesh("/sheet", points, faces)


@pytest.mark.parametrize("s", [0.5, 0.9, 1.0, 1.3, 2.0])
def test_uniform_stretch(sheet, s):
    posed = sheet.points * s
    green = (s * s - 1) / 2
    assert stretch_of(sheet, STVK, posed)[0] == pytest.approx(AREA * (2 * MU + 2 * LAMBDA) * green**2, abs=1e-12)
    assert stretch_of(sheet, WOVEN, posed)[0] == pytest.approx(AREA * 2 * STRETCH * (s - 1) ** 2, abs=1e-12)


@pytest.mark.parametrize("s", [0.7, 1.2])
def test_stretch_along_one_thread(sheet, s):
    for axis in ([s, 1, 1], [1, s, 1]):
        posed, green = sheet.points * axis, (s * s - 1) / 2
        assert stretch_of(sheet, STVK, posed)[0] == pytest.approx(AREA * (MU + LAMBDA / 2) * green**2)
        assert stretch_of(sheet, WOVEN, posed)[0] == pytest.approx(AREA * STRETCH * (s - 1) ** 2)


@pytest.mark.parametrize("g", [-0.6, 0.1, 0.8])
def test_simple_shear(sheet, g):
    posed = sheet.points + g * sheet.points[:, 1:2] * [1, 0, 0]
    # F = [[1, g], [0, 1]], so F^T F - I = [[0, g], [g, g^2]].
    expected = AREA * (MU * (g**2 / 2 + g**4 / 4) + LAMBDA / 2 * g**4 / 4)
    assert stretch_of(sheet, STVK, posed)[0] == pytest.approx(expected)
    expected = AREA * (STRETCH * (np.hypot(1, g) - 1) ** 2 + SHEAR * g * g)
    assert stretch_of(sheet, WOVEN, posed)[0] == pytest.approx(expected)


@FABRICS
def test_rigid_motion_costs_nothing_and_rotations_change_nothing(sheet, fabric):
    turns = Rotation.random(5, random_state=0).as_matrix()
    rigid = [sheet.points @ turn.T + [3, -2, 1] for turn in turns]
    np.testing.assert_allclose(stretch_of(sheet, fabric, *rigid), 0, atol=1e-25)
    bent = sheet.points + 0.05 * np.random.default_rng(0).normal(size=sheet.points.shape)
    values = stretch_of(sheet, fabric, bent, *(bent @ turn.T + 7 for turn in turns))
    np.testing.assert_allclose(values, values[0], rtol=1e-10)


@FABRICS
def test_each_frame_stands_by_itself(sheet, fabric):
    frames = [sheet.points * s for s in (1.1, 0.9, 1.4)]
    together = stretch_of(sheet, fabric, *frames)
    assert together.shape == (3,)
    np.testing.assert_allclose(together, [stretch_of(sheet, fabric, frame)[0] for frame in frames])


@FABRICS
def test_energy_does_not_depend_on_which_corner_comes_first(sheet, fabric):
    posed = sheet.points * [1.3, 0.8, 1] + 0.2 * sheet.points[:, 1:2] * [1, 0, 0]
    values = [
        stretch_of(Mesh("/sheet", sheet.points, np.roll(sheet.faces, turn, axis=1)), fabric, posed)[0]
        for turn in range(3)
    ]
    np.testing.assert_allclose(values, values[0], rtol=1e-12)


@FABRICS
@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [1, 1, 1]])
def test_flat_panels_of_any_facing_are_finite(sheet, fabric, normal):
    turn = Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_matrix()
    flat = Mesh("/panel", sheet.points @ turn.T, sheet.faces)
    x = torch.tensor(1.1 * flat.points)[:, :, None].requires_grad_()
    value = GarmentEnergy(flat, fabric, dtype=torch.float64).stretch(x)
    value.sum().backward()
    assert value.item() == pytest.approx(stretch_of(sheet, fabric, 1.1 * sheet.points)[0])
    assert torch.isfinite(x.grad).all()


@FABRICS
def test_gradient_is_finite_where_cloth_is_crushed_to_a_point(sheet, fabric):
    x = torch.zeros(sheet.vertex_count, 3, 1, requires_grad=True)
    GarmentEnergy(sheet, fabric).stretch(x).sum().backward()
    assert torch.isfinite(x.grad).all()


def test_threads_run_up_the_cloth_however_its_triangles_lie(sheet):
    c = np.sqrt(0.5)
    tilted = Mesh("/bias", sheet.points @ np.array([[c, -c, 0], [c, c, 0], [0, 0, 1]]).T, sheet.faces)
    along, across = sheet.points * [1, 1.2, 1], tilted.points * [1, 1.2, 1]
    np.testing.assert_allclose(stretch_of(sheet, WOVEN, along), stretch_of(tilted, WOVEN, across))
    bias = np.array([[1.1, 0.1, 0], [0.1, 1.1, 0], [0, 0, 1]])  # 1.2 along the diagonal, 1 across it
    expected = AREA * (2 * STRETCH * (np.hypot(1.1, 0.1) - 1) ** 2 + SHEAR * 0.22**2)
    assert stretch_of(sheet, WOVEN, sheet.points @ bias)[0] == pytest.approx(expected)


def test_rest_frames_are_orthonormal_and_areas_true(sheet):
    inverse, areas = rest_frames(sheet)
    a, b, c = (sheet.points[sheet.faces[:, corner]] for corner in range(3))
    gradient = np.stack([b - a, c - a], axis=-1) @ inverse
    np.testing.assert_allclose(
        np.swapaxes(gradient, 1, 2) @ gradient, np.tile(np.eye(2), (len(areas), 1, 1)), atol=1e-12
    )
    assert areas.sum() == pytest.approx(AREA)


def test_a_triangle_without_area_is_named():
    with pytest.raises(SsilkError, match=r"/line: 1 of 2 triangles have no area; .*degenerate"):
        rest_frames(Mesh("/line", [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 3]]))


@pytest.mark.parametrize("height", [1.0, 0.1, 1 / 49])
def test_clean_triangles_count_for_their_area(height):
    mesh = Mesh("/one", [[0, 0, 0], [1, 0, 0], [0.5, height, 0]], [[0, 1, 2]])
    assert stretched_areas(mesh) == pytest.approx(rest_frames(mesh)[1])


def test_a_sliver_is_no_stiffer_than_the_slimmest_clean_triangle():
    """Energy of a tip moved by a tenth of the base, which StVK counts by the fourth power of tenth over height."""
    found = []
    for height in (1 / 50, 1e-3, 1e-5):
        mesh = Mesh("/one", [[0, 0, 0], [1, 0, 0], [0.5, height, 0]], [[0, 1, 2]])
        found.append(stretch_of(mesh, Fabric("sliver"), mesh.points + [[0, 0, 0], [0, 0, 0], [0, 0.1, 0]])[0])
    np.testing.assert_allclose(found[1:], found[0], rtol=0.8)
    assert 0 < found[2] < found[0]
