# SPDX-License-Identifier: Apache-2.0
"""Refinement over a garment that moves by itself: heights by closed forms, energies against a slow reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.physics import captured
from ssilk_core.physics.collision.inner_cloth import InnerSurface
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.physics.refine import RefineOptions, Refiner
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.over_cloth import OverPotential
from ssilk_core.scene.assets import LOOSE, Garment, Mesh, Motion, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import bind_pose

CPU = torch.device("cpu")
FPS = 30.0
CLOTH = Fabric("cloth", density=0.2, thickness=1e-3, margin=4e-3, drag=0.0)
INNER = 2e-3  # [m] thick
HEIGHT = 1.5  # [m] of the inner sheet at rest, above the toy's ball
FRAMES = 6
LAW = ContactLaw(CLOTH.loose_contact, CLOTH.contact_distance, CLOTH.margin)  # that of loose cloth
CREASES = 1e-4  # [m] by which smoothed distances lift cloth at most: 1.8 % of those at which contact begins


def sheet(toy_grid, height: float, size: float, count: int) -> Mesh:
    """A horizontal square above the toy's ball."""
    points, faces = toy_grid(count, count, height=size, width=size)
    flat = np.column_stack([points[:, 0], np.full(len(points), height), points[:, 1] + size / 2])
    return Mesh("/sheet", flat, faces)


@pytest.fixture
def world(scene, toy_grid) -> tuple[Scene, InnerSurface]:
    """A loose sheet over a larger one that others move."""
    mesh = sheet(toy_grid, HEIGHT + 0.01, 0.2, 4)
    skin = SkinWeights("/sheet", np.zeros((mesh.vertex_count, 1), dtype=int), np.ones((mesh.vertex_count, 1)))
    rig = ProxyRig("/sheet", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    garment = Garment(mesh, skin, np.full(mesh.vertex_count, LOOSE))
    return replace(scene, garment=garment, rig=rig), InnerSurface(sheet(toy_grid, HEIGHT, 0.5, 9), INNER)


def still(scene: Scene) -> Motion:
    turned, placed = bind_pose(scene.character.skeleton)
    return Motion("/still", FPS, np.tile(turned, (FRAMES, 1, 1)), np.tile(placed, (FRAMES, 1, 1)))


def heights(*, by: float, stops: int = FRAMES) -> np.ndarray:
    """Heights of the inner sheet, which rises by so much in each frame until it stops."""
    return HEIGHT + by * np.minimum(np.arange(FRAMES), stops)


def refined(world, starts: np.ndarray, beneath: np.ndarray, **options: object) -> np.ndarray:
    """Heights (F, V) of the sheet, from those of its network's and of the inner one's frames (F,)."""
    scene, inner = world
    options = RefineOptions(**({"iterations": 80, "tolerance": 1e-5} | options))
    refiner = Refiner(scene, CLOTH, options, fps=FPS, beneath=[inner])

    def at(mesh: Mesh, each: np.ndarray) -> list[np.ndarray]:
        return [mesh.points * [1, 0, 1] + [0, height, 0] for height in each]

    below = [[points] for points in at(inner.mesh, beneath)]
    found = list(refiner.frames(still(scene), at(scene.garment.mesh, starts), beneath=below))
    return np.stack([frame.points[:, 1] for frame in found])


def held_at(network: float, beneath: float) -> float:
    """The height at which contact bears the sheet's weight and the inertia that holds it where the network has it."""
    low, high = beneath - 0.01, beneath + 0.01
    for _ in range(60):
        height = (low + high) / 2
        pressure = float(LAW.pressure(torch.tensor(height - beneath - INNER / 2, dtype=torch.float64)))
        down = CLOTH.density * (GRAVITY + (height - network) * FPS**2)
        low, high = (height, high) if pressure > down else (low, height)
    return low


def test_a_sheet_comes_out_over_one_that_moves_by_the_height_of_the_law(world) -> None:
    """It starts 3 to 20 mm beneath the inner sheet, which rises: each frame by itself is in a closed form."""
    beneath = heights(by=0.01)
    starts = beneath - np.linspace(0.003, 0.02, FRAMES)
    found = refined(world, starts, beneath)
    expected = np.array([held_at(start, below) for start, below in zip(starts, beneath)])
    np.testing.assert_allclose(found, np.broadcast_to(expected[:, None], found.shape), atol=CREASES)
    assert (found - beneath[:, None] > (INNER + CLOTH.thickness) / 2).all()


def test_with_feedback_it_is_carried_and_comes_to_rest_where_contact_bears_its_weight(world) -> None:
    beneath = heights(by=0.004, stops=3)
    found = refined(world, beneath - 0.005, beneath, feedback=True)
    assert (found - beneath[:, None] > (INNER + CLOTH.thickness) / 2).all()
    at_rest = LAW.start - np.sqrt(2 * LAW.ramp * CLOTH.density * GRAVITY / LAW.stiffness)  # where p is its weight
    np.testing.assert_allclose(found[0] - HEIGHT - INNER / 2, at_rest, atol=CREASES)


def test_the_energy_adds_that_of_each_sample_over_the_inner_cloth(world) -> None:
    """Values and gradients against distances to planes, in float64, of samples above and beneath a flat sheet."""
    scene, inner = world
    over = OverPotential(scene, CLOTH, [inner], device=CPU)
    alone = IncrementalPotential(scene, CLOTH, device=CPU)
    random = torch.Generator().manual_seed(2)
    away = 0.004 * torch.randn(len(alone.mass), 3, 2, generator=random, dtype=torch.float64)
    rest = torch.tensor(scene.garment.mesh.points)[:, :, None]
    x = (rest + away - torch.tensor([0, 0.008, 0])[:, None]).requires_grad_()
    root = torch.zeros(3, 2, dtype=torch.float64)
    posed = over.posed([np.repeat(inner.mesh.points[..., None], 2, axis=-1)], root)
    inputs = StepInputs(None, root)
    samples = alone.cloth.positions(x)
    law, distance = alone.law, samples[:, 1] - HEIGHT - INNER / 2
    energy = alone.energy(x, inputs, None) + (alone.cloth.area * law.energy(distance)).sum(0)
    (slope,) = torch.autograd.grad((alone.cloth.area * law.energy(distance)).sum(), x)
    x = x.detach()
    none = over._with_beneath(x, replace(inputs, beneath=posed), alone_distances(alone, x), 0.1)
    np.testing.assert_allclose(over.energy(x, inputs, none), energy.detach(), rtol=2e-4)
    expected = alone.gradient(x, inputs, None) + slope
    np.testing.assert_allclose(over.gradient(x, inputs, none), expected, atol=2e-2 * float(slope.abs().max()))


def alone_distances(potential: IncrementalPotential, x: torch.Tensor):
    """Distances of samples that no body is near."""
    from ssilk_core.physics.collision import SmoothedDistance
    from ssilk_core.physics.collision.contacts import no_planes

    samples = potential.cloth.positions(x)
    return SmoothedDistance(*no_planes(samples), samples.new_zeros(len(samples), 3, 3, 2, dtype=torch.float32))


def test_without_garments_beneath_nothing_is_added(world) -> None:
    scene, _ = world
    potential = Refiner(scene, CLOTH, RefineOptions(iterations=1), fps=FPS).potential
    assert type(potential) is IncrementalPotential and potential.sample_count == len(potential.cloth.area)


def test_no_graph_is_captured_where_garments_lie_beneath(world) -> None:
    """It would keep these where they were in its first frames."""
    scene, inner = world
    over, root = OverPotential(scene, CLOTH, [inner], device=CPU), torch.zeros(3, 1, dtype=torch.float64)
    inputs = StepInputs(None, root, beneath=over.posed([inner.mesh.points[..., None].copy()], root))
    assert not inputs.is_plain and replace(inputs, beneath=None).is_plain
    with pytest.raises(TypeError, match="PosedBeneath"):
        captured._kind(inputs)
