# SPDX-License-Identifier: Apache-2.0
"""What lies on other islands of a garment: how it is found, the springs that hold it, and that it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.authoring.setup.hosts import need_stitch
from ssilk_core.errors import SsilkError
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.stitching import Stitching
from ssilk_core.physics.reach import reachable_body
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions, minimise_from
from ssilk_core.scene.assets import LOOSE, PINNED, Garment, Mesh, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.scene.mesh.stitches import (
    ABOVE,
    SAGITTA,
    TOUCH,
    find_carried,
    find_feet,
    find_stitches,
    joined_islands,
)
from ssilk_core.scene.mesh.topology import vertex_areas

CPU, G = torch.device("cpu"), 9.81
DOWN = torch.tensor([[0.0], [-G], [0.0]], dtype=torch.float64)
CALM = Fabric("calm", drag=0.0, bending=0.0)
EXACT = SolverOptions(tolerance=1e-7, iterations=200)


def joined(*parts: tuple[np.ndarray, np.ndarray], path: str = "/cloth") -> Mesh:
    """One mesh of several islands, in their order."""
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts)]
    return Mesh(path, np.concatenate([points for points, _ in parts]), np.concatenate(faces))


def dressed(scene: Scene, mesh: Mesh, pinned: np.ndarray) -> Scene:
    """The character of a scene in a garment that hangs from its first joint."""
    skin = SkinWeights.rigid("/cloth", 0, mesh.vertex_count)
    garment = Garment(mesh, skin, np.where(pinned, PINNED, LOOSE))
    return replace(scene, garment=garment, rig=ProxyRig("/cloth", (), np.zeros(0, int), np.zeros((0, 4, 4)), skin))


def tensor(points: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.array(points))[:, :, None]


@pytest.fixture
def parts(toy_grid):
    """A sheet with a strap that touches it at both ends, and a button: the mesh, and the first vertex of each."""
    sheet = toy_grid(9, 7, height=0.4, width=0.3)
    points, faces = toy_grid(9, 2, height=0.2, width=0.02)
    bulge = 0.06 * np.sin(np.pi * points[:, 1] / 0.2) ** 2
    strap = points + np.c_[0 * bulge + 0.061, 0 * bulge - 0.063, 0.001 + bulge], faces
    points, faces = toy_grid(3, 3, height=0.02, width=0.02)
    button = points + [-0.062, -0.17, 0.0015], faces
    return joined(sheet, strap, button), (63, 81)


def test_what_lies_on_an_island_is_found_with_its_foot(parts):
    mesh, (strap, button) = parts
    found = find_stitches(mesh).select(find_stitches(mesh).on_larger)
    ends = [strap + row * 2 + side for row in (0, 8) for side in (0, 1)]
    assert found.vertices.tolist() == [*ends, *range(button, mesh.vertex_count)]
    foot = np.einsum("sk,skc->sc", found.weights, mesh.points[found.corners])
    np.testing.assert_allclose(foot, mesh.points[found.vertices] * [1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(np.abs(found.height), mesh.points[found.vertices, 2], atol=1e-12)
    carried = find_carried(mesh, find_feet(mesh))
    assert carried.vertices.tolist() == list(range(button, mesh.vertex_count))
    assert joined_islands(mesh, find_stitches(mesh)).max() == 0


@pytest.mark.parametrize(
    ("offset", "count"),
    [
        ([0, 0, 0.9 * TOUCH], 9),
        ([0, 0, 1.1 * TOUCH], 0),
        ([0, 0, -0.002], 9),  # on the other side
        ([0.076, 0, 0], 0),  # side by side, with a gap
        ([0.075, 0, 0], 3),  # side by side, with a common border
        ([0.076, 0, 0.001], 3),  # past the border by as much as above it
        ([0.076, 0, 0.0004], 0),  # past it by more
    ],
)
def test_a_part_lies_on_another_one_that_is_near_and_beneath_it(toy_grid, offset, count):
    host, (points, faces) = toy_grid(5, 5, height=0.1, width=0.1), toy_grid(3, 3, height=0.05, width=0.05)
    found = find_stitches(joined(host, (points + [0, -0.025, 0] + np.array(offset), faces)))
    assert np.count_nonzero(found.on_larger) == count


def test_coarse_faces_are_lain_on_from_farther(toy_grid):
    (points, faces), host = toy_grid(3, 3, height=0.05, width=0.05), toy_grid(2, 2, height=0.2, width=0.2)
    longest = 0.2 * np.sqrt(2)
    reach = min(ABOVE, SAGITTA * longest)
    assert reach > TOUCH
    near, far = (joined(host, (points + [0, -0.06, z], faces)) for z in (0.99 * reach, 1.01 * reach))
    assert len(find_stitches(near)) == 9 and len(find_stitches(far)) == 0


def test_one_island_has_none_and_slivers_hold_nothing(toy_grid):
    assert len(find_feet(Mesh("/one", *toy_grid(4, 4)))) == 0
    (points, faces), needle = toy_grid(3, 3, height=1e-4, width=0.01), [[-1.0, 0, 0], [1, 0, 0], [0, 1e-3, 0]]
    mesh = joined((np.array(needle), np.array([[0, 1, 2]])), (points + [0, 3e-4, 1e-3], faces))
    assert len(find_feet(mesh)) == 0


@pytest.fixture
def crumpled(parts):
    """The springs of a garment, one of them on a collapsed face, and positions (V, 3, 2) near its rest."""
    mesh, _ = parts
    found = find_stitches(mesh)
    springs = Stitching(mesh, found, 1e6 * vertex_areas(mesh.points, mesh.faces)[found.vertices], CPU, torch.float64)
    noise = torch.randn(mesh.vertex_count, 3, 2, generator=torch.Generator().manual_seed(2)).double()
    x = tensor(mesh.points) + 0.004 * noise
    x[found.corners[0, 1]] = x[found.corners[0, 2]]
    return springs, x


def slow_energy(springs: Stitching, rest: np.ndarray, x: np.ndarray) -> float:
    """The energy of one frame by the formula, spring by spring."""
    total = 0.0
    for (v, a, b, c), stiffness in zip(springs.corners, springs.stiffness[:, 0].numpy()):
        normal = np.cross(rest[b] - rest[a], rest[c] - rest[a])
        area = np.linalg.norm(normal)
        height = (rest[v] - rest[a]) @ normal / area
        foot = rest[v] - height * normal / area
        weights = np.linalg.lstsq(np.r_[rest[[a, b, c]].T, [[1, 1, 1]]], np.r_[foot, 1], rcond=None)[0]
        now = np.cross(x[b] - x[a], x[c] - x[a])
        fading = now / np.sqrt(now @ now + (1e-3 * area) ** 2) * np.sqrt(1 + 1e-6)
        offset = x[v] - weights @ x[[a, b, c]] - height * fading
        total += 0.5 * stiffness * offset @ offset
    return total


def test_the_springs_are_the_formula_and_rest_at_rest(parts, crumpled):
    (mesh, _), (springs, x) = parts, crumpled
    expected = [slow_energy(springs, mesh.points, x[..., frame].numpy()) for frame in range(2)]
    np.testing.assert_allclose(springs.energy(x), expected, rtol=1e-9)
    assert float(springs.energy(tensor(mesh.points))) < 1e-20
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -1.0, 2], [1, 0, -0.5], [-2, 0.5, 0]], dtype=torch.float64))
    assert float(springs.energy(torch.einsum("ab,vbn->van", turn, tensor(mesh.points)))) < 1e-20
    single = Stitching(mesh, find_stitches(mesh), springs.stiffness[:, 0].numpy(), CPU, torch.float32)
    np.testing.assert_allclose(single.energy(x.float()), expected, rtol=1e-4)
    at = x[..., :1].requires_grad_(True)
    assert torch.autograd.gradcheck(springs.energy, (at,), eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("lying", [False, True])
def test_a_weight_on_a_stitch_extends_it_by_its_weight_over_the_stiffness(scene, toy_grid, lying):
    # Mass and stiffness of a vertex have its area in common: the extension is rho g / k, along a sheet or off it.
    points, faces = toy_grid(3, 3, height=0.4, width=0.4)
    part, triangle = np.array([[0, -0.1, 2e-3], [0.02, -0.1, 2e-3], [0, -0.12, 2e-3]]), np.array([[0, 1, 2]])
    mesh = joined((points, faces), (part, triangle))
    if lying:
        mesh = replace(mesh, points=mesh.points[:, [0, 2, 1]])
    fabric = replace(CALM, density=0.3, stitch=2000.0)
    potential = IncrementalPotential(dressed(scene, mesh, np.arange(12) < 9), fabric, device=CPU)
    found = minimise_from(potential, tensor(mesh.points), StepInputs(None, DOWN), EXACT)
    sag = 0.3 * G / 2000.0
    assert sag > 1e-3
    torch.testing.assert_close(found.x[9:, :, 0], torch.tensor(mesh.points[9:] - [0, sag, 0]), rtol=0, atol=1e-7)


def test_pinned_vertices_among_themselves_need_no_stitch(parts):
    mesh, (strap, _) = parts
    classes = np.full(mesh.vertex_count, PINNED)
    assert GarmentEnergy(mesh, CALM, classes).stitching is None
    classes[strap] = LOOSE
    assert GarmentEnergy(mesh, CALM, classes).stitching.corners[:, 0].tolist() == [strap]
    assert len(GarmentEnergy(mesh, CALM).stitching) == 4 + 9
    assert GarmentEnergy(mesh, FABRICS["paper"]).stitching is None


def fallen(scene: Scene, mesh: Mesh, stitch: float) -> np.ndarray:
    """How far each stitch is from its rest [m] after a quarter of a second, shape (S,)."""
    fabric = replace(FABRICS["default"], stitch=stitch)
    potential = IncrementalPotential(dressed(scene, mesh, mesh.points[:, 1] > -1e-9), fabric, device=CPU)
    assert potential.dtype is torch.float64
    last = before = tensor(mesh.points)
    for _ in range(8):
        inputs = StepInputs(None, DOWN, 2 * last - before, last, 1 / 30)
        before, last = last, minimise_from(potential, last, inputs, SolverOptions()).x
    springs = GarmentEnergy(mesh, FABRICS["default"], dtype=torch.float64).stitching
    arm, first, second = springs.arms(last)
    return (arm - springs.height * springs.normal(first, second)[0]).norm(dim=1)[:, 0].numpy()


def test_parts_fall_off_without_stitches_and_hold_within_a_millimetre_with_them(scene, parts):
    mesh, _ = parts
    assert fallen(scene, mesh, 0.0).min() > 0.1
    assert fallen(scene, mesh, FABRICS["default"].stitch).max() < 1e-3


def test_what_hangs_on_a_stitch_can_reach_the_body(scene, toy_grid, toy_motion):
    sheet, (points, faces) = toy_grid(3, 3, height=0.1, width=0.1), toy_grid(9, 3, height=0.4, width=0.1)
    top = scene.character.merged_body().mesh.points[:, 1].max() + 0.45

    def reached(gap: float) -> int:
        mesh = joined(sheet, (points + [0, -0.08, gap], faces))
        tied = dressed(scene, replace(mesh, points=mesh.points + [0, top, 0]), mesh.points[:, 1] > -1e-9)
        return len(reachable_body(tied, [toy_motion(scene, 2)]).vertices)

    assert reached(0.002) > 0 and reached(0.02) == 0


def tube(count: int, radius: float, at: float, outward: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """A tube about an upright axis at x = `at`."""
    turn = 2 * np.pi * np.arange(count) / count
    ring = np.c_[at + radius * np.cos(turn), 0 * turn, radius * np.sin(turn)]
    points = np.concatenate([ring + [0, height, 0] for height in np.linspace(0, 0.2, 5)])
    one = np.arange(4 * count)
    after = one // count * count + (one + 1) % count
    faces = np.concatenate([np.c_[one, one + count, after], np.c_[after, one + count, after + count]])
    return points, faces if outward else faces[:, ::-1]


def test_parts_whose_outsides_face_each_other_are_not_sewn():
    """Two trouser legs in the bind pose; a tube within another one is sewn to it."""
    legs = joined(tube(24, 0.08, -0.0815), tube(24, 0.08, 0.0815))
    assert len(find_feet(legs)) and not len(find_stitches(legs))
    layers = joined(tube(24, 0.08, 0.0), tube(24, 0.083, 0.0))
    assert len(find_stitches(layers)) >= 120


def test_a_fabric_without_stitches_cannot_hold_what_they_alone_hold(parts):
    mesh, _ = parts
    classes = np.where(np.arange(mesh.vertex_count) < 9, PINNED, LOOSE)
    need_stitch(mesh, classes, Fabric("default"))
    with pytest.raises(SsilkError, match=r"2 of 3 islands are all loose, held by stitches alone, .*'paper'"):
        need_stitch(mesh, classes, FABRICS["paper"])
    need_stitch(mesh, np.full(mesh.vertex_count, PINNED), FABRICS["paper"])
