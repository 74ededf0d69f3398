# SPDX-License-Identifier: Apache-2.0
"""Friction against closed forms: what sticks, what slides, and how fast; and its slopes against its energy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.simulate import SimulationOptions, Simulator
from ssilk_core.physics.simulate.friction import CREEP, Friction
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions, minimise_from
from ssilk_core.scene.assets import LOOSE, Body, Garment, Mesh, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import bind_pose

CPU = torch.device("cpu")
G, DT, MU = 9.81, 1 / 60, 0.5
EXACT = SolverOptions(tolerance=1e-5, iterations=200)
FABRIC = Fabric("rough", drag=0.0, friction=MU)


def lying(scene: Scene, grid, layers: int) -> tuple[Scene, torch.Tensor]:
    """Square sheets of 12 cm over one another, on a plane y = 0."""
    flat, faces = grid(4, 4, height=0.12, width=0.12)
    flat = flat[:, [0, 2, 1]]
    points = np.concatenate([flat + [0.007 * layer, 0.007 + 0.005 * layer, 0.004 * layer] for layer in range(layers)])
    faces = np.concatenate([faces + layer * len(flat) for layer in range(layers)])
    wide, triangles = grid(11, 19, height=0.5, width=0.9)
    ground = Mesh("/ground", wide[:, [0, 2, 1]] + [0.2, 0, 0.2], triangles)

    def held(mesh: Mesh) -> SkinWeights:
        return SkinWeights(mesh.path, np.zeros((mesh.vertex_count, 1), dtype=int), np.ones((mesh.vertex_count, 1)))

    cloth = Mesh("/cloth", points + [[0, 0.3 * (i // len(flat)), 0] for i in range(len(points))], faces)
    return replace(
        scene,
        character=replace(scene.character, bodies=(Body(ground, held(ground)),)),
        garment=Garment(cloth, held(cloth), np.full(len(points), LOOSE)),
        rig=ProxyRig("/cloth", (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), held(cloth)),
    ), torch.as_tensor(points)[:, :, None]


def slide(scene: Scene, x: torch.Tensor, fabric: Fabric, slope: float, steps: int, drift: float = 0.0) -> Iterator:
    """Positions and energy of sheets that come to rest on the level plane, which then is tilted.

    Args:
        drift: velocity of the plane along x [m/s].
    """
    potential = IncrementalPotential(scene, fabric, device=CPU)
    ground = CollisionBody(scene.character.merged_body(), 1, device=CPU)

    def posed(time: float):
        matrix = torch.eye(3, 4)[None, :, :, None].clone()
        matrix[0, 0, 3] = drift * time
        return ground.pose(matrix, exact=True)

    layered = len(scene.garment.mesh.points) > 16
    down = G * torch.tensor([[0.0], [-np.cos(slope)], [0.0]], dtype=torch.float64)
    known = potential.self_contact.neighbours(x, x) if layered else None
    rest = StepInputs(posed(0.0), down, neighbours=known)
    solution = minimise_from(potential, x, rest, SolverOptions(tolerance=1e-6, iterations=300))
    x, before, known = solution.x, solution.x, solution.neighbours
    down = G * torch.tensor([[np.sin(slope)], [-np.cos(slope)], [0.0]], dtype=torch.float64)
    yield x[..., 0], 0.0
    for step in range(steps):
        friction = potential.friction(x, posed(DT * step), known, DT)
        body = posed(DT * (step + 1))
        inputs = StepInputs(body, down, 2 * x - before, x, DT, friction=friction and friction.after(body.points))
        start = 2 * x - before
        if layered:
            start, inputs = potential.approach(x, start, inputs, known)
        solution = minimise_from(potential, start, inputs, EXACT)
        assert solution.residual < 1e-2
        before, x, known = x, solution.x, solution.neighbours
        still = StepInputs(body, down, neighbours=inputs.neighbours, contacts=inputs.contacts)
        stored = potential.energy(x, still, potential.body_distance(x, still))
        moving = (0.5 * potential.mass * ((x - before) / DT).square().sum(1)).sum()
        yield x[..., 0], float(stored + moving)


def need_falling_energy(path: list[tuple[torch.Tensor, float]]) -> None:
    assert np.all(np.diff([energy for _, energy in path[1:]]) < 1e-9)


@pytest.mark.parametrize("slope", [0.2, 0.44])  # tan < 0.5
def test_a_sheet_sticks_on_a_gentle_slope(scene, toy_grid, slope):
    sheet, x = lying(scene, toy_grid, 1)
    path = list(slide(sheet, x, FABRIC, slope, 12))
    moved = (path[-1][0] - path[0][0])[:, 0].mean()
    assert 0 < moved < 12 * DT * CREEP
    need_falling_energy(path)


@pytest.mark.parametrize("slope", [0.6, 0.9])
def test_a_sheet_slides_down_a_steep_slope(scene, toy_grid, slope):
    sheet, x = lying(scene, toy_grid, 1)
    steps = 12
    path = list(slide(sheet, x, FABRIC, slope, steps))
    moved = float((path[-1][0] - path[0][0])[:, 0].mean())
    pull = G * (np.sin(slope) - MU * np.cos(slope))
    # Implicit Euler from rest; it sticks at most in the first step, which is CREEP dt of the way.
    assert moved == pytest.approx(pull * DT**2 * steps * (steps + 1) / 2, rel=0.02, abs=2 * CREEP * DT)
    need_falling_energy(path)


@pytest.mark.slow
def test_a_sheet_is_carried_by_what_it_lies_on(scene, toy_grid):
    sheet, x = lying(scene, toy_grid, 1)
    drift, steps = 0.05, 20
    path = list(slide(sheet, x, FABRIC, 0.0, steps, drift))
    moved = float((path[-1][0] - path[0][0])[:, 0].mean())
    assert drift * steps * DT * (1 - 0.1) < moved <= drift * steps * DT
    smooth = list(slide(sheet, x, replace(FABRIC, friction=0.0), 0.0, steps, drift))
    assert abs(float((smooth[-1][0] - smooth[0][0])[:, 0].mean())) < 1e-3


@pytest.mark.slow
def test_an_upper_layer_is_held_by_the_lower_one(scene, toy_grid):
    sheets, x = lying(scene, toy_grid, 2)
    steps, half = 4, x.shape[0] // 2
    rough = list(slide(sheets, x, FABRIC, 0.3, steps))
    moved = float((rough[-1][0] - rough[0][0])[half:, 0].mean())
    assert 0 < moved < 2 * steps * DT * CREEP
    smooth = list(slide(sheets, x, replace(FABRIC, friction=0.0), 0.3, steps))
    free = G * np.sin(0.3) * DT**2 * steps * (steps + 1) / 2
    assert float((smooth[-1][0] - smooth[0][0])[half:, 0].mean()) == pytest.approx(free, rel=0.05)


def rubbing(seed: int) -> tuple[Friction, torch.Tensor]:
    """Friction in random places of ten vertices in two frames, with slips around `creep`."""
    made = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=made, dtype=torch.float64) - 0.5

    x, count, creep = random(10, 3, 2), 12, 0.01
    frame = torch.arange(count) % 2
    frame = frame.sort()[0]
    vertices = torch.rand(10, count, generator=made).argsort(0)[:4]
    coefficients, direction = random(4, count), torch.nn.functional.normalize(random(3, count), dim=0)
    none = torch.zeros(3, count, dtype=torch.long)
    held = (coefficients[:, None] * x[vertices, :, frame].movedim(-1, 1)).sum(0) + 0.03 * random(3, count)
    rows = frame, vertices, coefficients, none, none.double(), direction, random(count).abs(), held
    return Friction(2, creep, *rows), x


def test_forces_are_the_slope_of_the_potential_and_stiffness_that_of_forces():
    friction, x = rubbing(1)
    gradient = torch.autograd.functional.jacobian(lambda x: friction.energy(x).sum(), x)
    torch.testing.assert_close(friction.gradient(x), gradient)
    curved = torch.autograd.functional.hessian(lambda x: friction.energy(x).sum(), x)
    slopes = friction.slopes(x)
    built = torch.zeros_like(curved)
    for row in range(len(slopes.frame)):
        frame, vertices, values = int(slopes.frame[row]), slopes.vertices[:, row], slopes.values[..., row]
        built[vertices[:, None], :, frame, vertices[None], :, frame] += torch.einsum("ai,bj->abij", values, values)
    torch.testing.assert_close(built, curved, rtol=1e-6, atol=1e-9)
    part = friction.select(torch.tensor([1]))
    torch.testing.assert_close(part.energy(x[..., 1:]), friction.energy(x)[1:])


def test_a_shot_with_friction_moves_less_over_its_body(scene, toy_motion):
    garment, mesh = scene.garment, scene.garment.mesh
    near = replace(mesh, points=mesh.points + [0, 0, 0.05])  # it lies on the ball
    scene = replace(scene, garment=replace(garment, mesh=near))
    motions = [toy_motion(scene, 4), toy_motion(scene, 3)]
    found = {}
    for mu in (0.0, 0.6):
        simulator = Simulator(scene, Fabric("f", friction=mu), SimulationOptions())
        found[mu] = list(simulator.frames(motions))
        assert all(frame.residual <= 1e-2 for frame in found[mu])
    apart = [np.abs(a.points - b.points).max() for a, b in zip(found[0.0], found[0.6], strict=True)]
    assert max(apart[:2]) < 1e-12 < max(apart)  # the first frames are quasi-static


def test_in_shorter_steps_cloth_creeps_as_fast_as_in_whole_ones(scene, toy_grid) -> None:
    """Also in the first of them: shots in the midst of theirs are solved with it."""
    cloth, _ = lying(scene, toy_grid, 1)
    simulator = Simulator(cloth, FABRIC, SimulationOptions(fps=1 / DT))
    poses = simulator.poser.pose(*(each[None] for each in bind_pose(cloth.character.skeleton)))
    rubbing = simulator.potential.friction(poses.lbs, poses.body, None, DT)
    assert rubbing.creep == pytest.approx(CREEP * DT)
    x = poses.lbs.double() + poses.root
    past = StepHistory(x, x, poses.root, poses.lbs, friction=rubbing, matrices=poses.matrices)
    asked = next(simulator._in_parts(past, poses))
    assert asked.past.friction.creep == pytest.approx(CREEP * asked.dt) and asked.dt < DT
