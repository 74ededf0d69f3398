# SPDX-License-Identifier: Apache-2.0
"""Cloth that is stiffer in one place than in another: against fabrics of its own, and against the heavy elastica."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_bvp

from ssilk_core.errors import SsilkError
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.simulate.cubature import cubature_between, sampled_potential
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions, minimise_from
from ssilk_core.scene.assets import LOOSE, PINNED, Garment, Mesh, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import Fabric

CPU, G = torch.device("cpu"), 9.81
FABRIC = Fabric("test", drag=0.0, density=0.15, lame_mu=300.0, lame_lambda=200.0, bending=6e-5)
MODELS = [FABRIC, replace(FABRIC, stretch_model="baraff_witkin", stretch=250.0, shear=90.0)]
NUMBERS = ("lame_mu", "lame_lambda", "stretch", "shear", "bending")


def times(fabric: Fabric, factor: float) -> Fabric:
    return replace(fabric, **{name: factor * getattr(fabric, name) for name in NUMBERS})


def bent(points: np.ndarray, seed: int = 0) -> torch.Tensor:
    moved = points + np.random.default_rng(seed).normal(scale=0.004, size=points.shape)
    return torch.as_tensor(moved)[:, :, None]


def dressed(scene: Scene, mesh: Mesh, pinned: np.ndarray) -> Scene:
    """The character of a scene in another garment, which hangs from its first joint."""
    skin = SkinWeights("/cloth", np.zeros((mesh.vertex_count, 1), dtype=int), np.ones((mesh.vertex_count, 1)))
    garment = Garment(mesh, skin, np.where(pinned, PINNED, LOOSE))
    rig = ProxyRig("/cloth", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    return replace(scene, garment=garment, rig=rig)


@pytest.mark.parametrize("fabric", MODELS, ids=["stvk", "baraff_witkin"])
@pytest.mark.parametrize("factor", [0.25, 8.0])
def test_cloth_that_is_stiffer_everywhere_is_that_of_a_stiffer_fabric(toy_grid, fabric, factor):
    points, faces = toy_grid(9, 5)
    mesh = Mesh("/cloth", points, faces, stiffness=np.full(len(points), factor))
    own = GarmentEnergy(mesh, fabric, dtype=torch.float64)
    other = GarmentEnergy(replace(mesh, stiffness=None), times(fabric, factor), dtype=torch.float64)
    x = bent(points)
    assert torch.equal(own.stretch(x), other.stretch(x)) and torch.equal(own.bending(x), other.bending(x))
    single = x.float().requires_grad_()  # as compiled loops have it, where there are any
    for found, wanted in zip(own.elastic(single), other.elastic(single)):
        torch.testing.assert_close(found, wanted)
    assert torch.equal(own.mass, other.mass)


def test_one_everywhere_is_nothing(toy_grid):
    points, faces = toy_grid(4, 3)
    assert Mesh("/cloth", points, faces, stiffness=np.ones(len(points))).stiffness is None


def test_an_element_has_the_mean_of_its_corners(toy_grid):
    points, faces = toy_grid(2, 2)
    stiffness = np.array([1.0, 4.0, 10.0, 0.5])
    mesh = Mesh("/cloth", points, faces, stiffness=stiffness)
    soft, stiff = (GarmentEnergy(each, FABRIC, dtype=torch.float64) for each in (replace(mesh, stiffness=None), mesh))
    shares = (stiff.area / soft.area)[:, 0].numpy()
    np.testing.assert_allclose(shares, [(1 + 4 + 10) / 3, (4 + 0.5 + 10) / 3])
    assert float(stiff.bending_stiffness / soft.bending_stiffness) == pytest.approx(shares.mean())


@pytest.mark.parametrize("fabric", MODELS, ids=["stvk", "baraff_witkin"])
def test_the_simulator_and_its_sampled_elements_have_it_too(scene, toy_grid, fabric):
    points, faces = toy_grid(9, 5)
    pinned = points[:, 1] > -1e-9
    mesh = Mesh("/cloth", points, faces, stiffness=np.full(len(points), 8.0))
    scenes = [dressed(scene, each, pinned) for each in (mesh, replace(mesh, stiffness=None))]
    own, other = (
        IncrementalPotential(each, cloth, device=CPU) for each, cloth in zip(scenes, (fabric, times(fabric, 8.0)))
    )
    inputs = StepInputs(None, torch.tensor([[0.0], [-G], [0.0]], dtype=torch.float64))
    x = bent(points)
    torch.testing.assert_close(own.energy(x, inputs, None), other.energy(x, inputs, None))
    torch.testing.assert_close(own.gradient(x, inputs, None), other.gradient(x, inputs, None))
    vertices = np.flatnonzero(np.arange(len(points)) % 7)
    few = [
        sampled_potential(each, dress, cubature_between(dress, each, vertices))
        for each, dress in zip((own, other), scenes)
    ]
    torch.testing.assert_close(*(each.energy(x[vertices], inputs, None) for each in few))


def hung(scene: Scene, mesh: Mesh, fabric: Fabric, pinned: np.ndarray) -> np.ndarray:
    potential = IncrementalPotential(dressed(scene, mesh, pinned), fabric, device=CPU)
    down = torch.tensor([[0.0], [-G], [0.0]], dtype=torch.float64)
    x = last = torch.as_tensor(np.array(mesh.points))[:, :, None]
    for _ in range(STEPS):  # of implicit Euler, whose inertia damps
        inputs = StepInputs(None, down, 2 * x - last, x, 0.1)
        last, x = x, minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-4, iterations=100)).x
    found = minimise_from(potential, x, StepInputs(None, down), SolverOptions(tolerance=1e-4, iterations=400))
    assert found.residual < 1e-3
    return found.x[:, :, 0].numpy()


def cantilever(length: float, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A strip of equilateral triangles along z that is held level by two rows up to z = 0."""
    height = length / rows
    side = 2 * height / np.sqrt(3)
    row, column = np.mgrid[-1 : rows + 1, 0 : columns + 1]
    across = side * (column - columns / 2 + 0.5 * (row % 2))
    points = np.stack([across, 0 * across, height * row], axis=-1).reshape(-1, 3)
    a = (np.arange(rows + 1)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    b, d, e = a + 1, a + columns + 1, a + columns + 2
    odd = np.repeat(np.arange(-1, rows) % 2 == 1, columns)[:, None]
    faces = np.where(
        odd[:, None], np.stack([np.c_[a, e, b], np.c_[a, d, e]], 1), np.stack([np.c_[a, d, b], np.c_[b, d, e]], 1)
    )
    return points, faces.reshape(-1, 3), points[:, 2] < 1e-9


def elastica(length: float, rigidity, weight: float) -> float:
    """Return how far the free end of a heavy strip sinks below its held end [m], by its own differential equation.

    The moment D(s) theta' of a section is what the weight beyond it exerts: (D theta')' = -w (L - s) cos(theta)
    [Bickley 1934; Peirce 1930 measures D by it].

    Args:
        rigidity: takes places (N,) [m] and returns D there [N m].
        weight: w, of each area [N/m2].
    """

    def slopes(s, y):
        return np.stack([y[1] / rigidity(s), -weight * (length - s) * np.cos(y[0]), np.sin(y[0])])

    def ends(a, b):
        return np.array([a[0], b[1], a[2]])

    s = np.linspace(0, length, 400)
    start = np.stack([s / length, weight * (length - s) ** 2 / 2, 0.5 * s**2 / length])
    found = solve_bvp(slopes, ends, s, start, tol=1e-6, max_nodes=20_000)
    assert found.success
    return float(found.y[2, -1])


LENGTH, ROWS, COLUMNS, STEPS = 0.10, 24, 8, 12
STRIP = 8 / 9  # of the rigidity of a plate: its edges are free to curl, as by Poisson's ratio 1/3 of such a lattice
"""[Seung and Nelson 1988]"""
NEAR = 0.03  # of the sag: triangles at the edges have hinges on two sides only


@pytest.mark.slow
@pytest.mark.parametrize(("bending_length", "rows"), [(0.03, 18), (0.05, 22)])  # cotton, denim
def test_a_strip_overhangs_as_the_heavy_elastica(scene, toy_grid, bending_length, rows):
    """The sag is compared, also where the strip hangs steeply."""
    columns = rows // 3
    points, faces, pinned = cantilever(LENGTH, rows, columns)
    weight = FABRIC.density * G
    rigidity = weight * bending_length**3  # of the strip
    found = hung(scene, Mesh("/strip", points, faces), replace(FABRIC, bending=4 * rigidity / STRIP), pinned)
    sag = elastica(LENGTH, lambda s: rigidity + 0 * s, weight)
    assert -found[-columns - 1 :, 1].mean() == pytest.approx(sag, rel=NEAR)


def test_a_strip_that_is_stiffer_at_its_root_bends_as_its_own_elastica(scene):
    """Eight times as stiff up to its middle, as by a lining: the sag is that of its own equation."""
    points, faces, pinned = cantilever(LENGTH, ROWS, COLUMNS)
    weight = FABRIC.density * G
    rigidity = weight * 0.05**3

    def stiffness(s):
        return np.interp(s, [0.04, 0.06], [8.0, 1.0])

    mesh = Mesh("/strip", points, faces, stiffness=stiffness(points[:, 2]))
    found = -hung(scene, mesh, replace(FABRIC, bending=4 * rigidity / STRIP), pinned)[-COLUMNS - 1 :, 1].mean()
    assert found == pytest.approx(elastica(LENGTH, lambda s: rigidity * stiffness(s), weight), rel=NEAR)
    assert found < 0.7 * elastica(LENGTH, lambda s: rigidity + 0 * s, weight)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        (np.full(12, 200.0), "a stiffness of 200 at 12 points, first at point 0; 0.01 to 100 times the fabric's"),
        (np.r_[np.ones(11), 0.0], "a stiffness of 0 at 1 points, first at point 11"),
        (np.r_[np.ones(11), np.nan], "a stiffness of nan at 1 points"),
        (np.ones(11) * 2, "11 values of stiffness for 12 points"),
    ],
)
def test_what_is_no_stiffness_is_refused(toy_grid, values, complaint):
    points, faces = toy_grid(4, 3)
    with pytest.raises(SsilkError, match=complaint.replace("(", r"\(")):
        Mesh("/cloth", points, faces, stiffness=values)


def test_the_range_may_come_from_single_precision(toy_grid):
    points, faces = toy_grid(4, 3)
    ends = np.where(np.arange(12) % 2, 0.01, 100.0).astype(np.float32)
    assert Mesh("/cloth", points, faces, stiffness=ends).stiffness is not None
