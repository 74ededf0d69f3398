# SPDX-License-Identifier: Apache-2.0
"""Mass, gravity, inertia and drag against mechanics, and symmetries of the whole energy."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.errors import SsilkError
from ssilk_core.physics.collision import PosedBody
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import FABRICS, Fabric, fabric_named

G, DT = 9.81, 1 / 30
DOWN = torch.tensor([[0.0], [-G], [0.0]], dtype=torch.float64)
FABRIC = Fabric("test", density=0.2, drag=0.3)
AREA = 0.55 * 0.2


@pytest.fixture(scope="module")
def sheet(toy_grid) -> Mesh:
    return Mesh("/sheet", *toy_grid(7, 4))


@pytest.fixture(scope="module")
def energy(sheet) -> GarmentEnergy:
    return GarmentEnergy(sheet, FABRIC, dtype=torch.float64)


def placed(sheet: Mesh, *offsets: np.ndarray) -> torch.Tensor:
    return torch.tensor(sheet.points)[:, :, None] + torch.tensor(np.array(offsets, dtype=float).T)[None]


def gradient_of(value: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return torch.autograd.grad(value.sum(), x)[0]


def test_mass_is_density_times_area(energy):
    assert float(energy.mass.sum()) == pytest.approx(0.2 * AREA)
    assert (energy.mass > 0).all()


def test_gravity_is_weight_times_height_for_each_frame(sheet, energy):
    heights = np.array([0.0, 1.0, -2.5])
    x = placed(sheet, *(heights[:, None] * [0, 1, 0] + [3, 0, 4]))
    centre = float(energy.mass @ torch.tensor(sheet.points[:, 1])) / (0.2 * AREA)
    np.testing.assert_allclose(energy.gravity(x, DOWN), 0.2 * AREA * G * (heights + centre), rtol=1e-12)


def test_gravity_takes_a_direction_for_each_frame(sheet, energy):
    x, sideways = placed(sheet, [1, 0, 0], [1, 0, 0]), torch.tensor([[G, 0.0], [0.0, -G], [0.0, 0.0]]).double()
    each = [float(energy.gravity(x[..., i : i + 1], sideways[:, i : i + 1])) for i in range(2)]
    assert energy.gravity(x, sideways).tolist() == pytest.approx(each)
    assert each[0] != each[1]


def test_free_fall_has_the_inertia_of_its_acceleration_and_balances_gravity(sheet, energy):
    time = np.arange(6) * DT
    path = placed(sheet, *(np.array([0.4, 1, 2]) * time[:, None] - [0, G / 2, 0] * time[:, None] ** 2))
    x = path[..., 2:].clone().requires_grad_()
    value = energy.inertia(x, 2 * path[..., 1:-1] - path[..., :-2], DT)
    np.testing.assert_allclose(value.detach(), 0.2 * AREA * G**2 * DT**2 / 2, rtol=1e-9)
    balance = gradient_of(value, x) + gradient_of(energy.gravity(x, DOWN), x)
    assert balance.abs().max() < 1e-10 * G


def test_steady_motion_has_no_inertia_and_the_past_no_gradient(sheet, energy):
    path = placed(sheet, *np.outer(np.arange(3), [0.1, 0.2, -0.3])).requires_grad_()
    value = energy.inertia(path[..., 2:], 2 * path[..., 1:-1] - path[..., :-2], DT)
    assert value.item() == pytest.approx(0, abs=1e-20)
    thrown = energy.inertia(path[..., 2:] + 0.01, 2 * path[..., 1:-1] - path[..., :-2], DT)
    assert gradient_of(thrown, path)[..., :2].abs().max() == 0


def test_drag_pulls_back_in_proportion_to_area_and_velocity(sheet, energy):
    velocity = np.array([0.5, -1.0, 2.0])
    last, x = placed(sheet, [0, 0, 0]), placed(sheet, velocity * DT).requires_grad_()
    force = -gradient_of(energy.drag(x, last, DT), x)[..., 0]
    area = (energy.mass / FABRIC.density)[:, None]
    np.testing.assert_allclose(force, -FABRIC.drag * area * torch.tensor(velocity), rtol=1e-9)


def test_a_falling_sheet_is_in_balance_at_its_terminal_velocity(sheet, energy):
    speed = FABRIC.density * G / FABRIC.drag
    path = placed(sheet, *np.outer(np.arange(3) * DT, [0, -speed, 0]))
    x = path[..., 2:].clone().requires_grad_()
    total = (
        energy.gravity(x, DOWN)
        + energy.drag(x, path[..., 1:2], DT)
        + energy.inertia(x, 2 * path[..., 1:2] - path[..., :1], DT)
    )
    assert gradient_of(total, x).abs().max() < 1e-12 * G


def test_turning_the_character_is_turning_gravity_back(sheet):
    """Energies of the turned world under straight gravity equal those of the world under gravity turned back."""
    rng = np.random.default_rng(4)
    energy = GarmentEnergy(sheet, FABRIC, dtype=torch.float64)
    path = torch.tensor(sheet.points[:, :, None] + 0.02 * rng.normal(size=(sheet.vertex_count, 3, 3)))
    body = torch.tensor(
        sheet.points[rng.integers(sheet.vertex_count, size=40), :, None] + 0.02 * rng.normal(size=(40, 3, 1))
    )
    normals = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(40, 3, 1))), dim=1)
    turn = torch.tensor(Rotation.random(random_state=1).as_matrix())

    def terms(path: torch.Tensor, points: torch.Tensor, normals: torch.Tensor, down: torch.Tensor) -> list[float]:
        x, predicted = path[..., 2:], 2 * path[..., 1:2] - path[..., :1]
        found = PosedBody(points, normals)
        values = [energy.stretch(x), energy.bending(x), energy.gravity(x, down), energy.collision(x, found)]
        return [float(v) for v in (*values, energy.inertia(x, predicted, DT), energy.drag(x, path[..., 1:2], DT))]

    outward = terms(*(torch.einsum("ab,vbn->van", turn, v) for v in (path, body, normals)), DOWN)
    back = terms(path, body, normals, turn.T @ DOWN)
    assert outward == pytest.approx(back, rel=1e-9)
    assert min(map(abs, back)) > 0


def test_fabrics_are_found_by_name_and_refuse_nonsense():
    assert fabric_named("silk") is FABRICS["silk"]
    assert FABRICS["silk"].density < FABRICS["cotton"].density < FABRICS["leather"].density
    for bad, words in (
        ({"density": 0.0}, "density of zero"),
        ({"bending": -1.0}, "bending = -1.0"),
        ({"drag": float("nan")}, "drag = nan"),
        ({"lame_mu": float("inf")}, "lame_mu = inf"),
        ({"stretch_model": "rubber"}, "one of stvk, baraff_witkin"),
    ):
        with pytest.raises(SsilkError, match=words):
            Fabric("bad", **bad)
    with pytest.raises(SsilkError, match=r"'tweed'.*silk"):
        fabric_named("tweed")
