# SPDX-License-Identifier: Apache-2.0
"""Friction on colliders against closed forms: what sticks, what slides, what is carried, and what is let go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from ssilk_core.physics.collision.inner_cloth import InnerSurface
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.physics.refine import RefineOptions, Refiner
from ssilk_core.physics.simulate import SimulationOptions, Simulator, simulate
from ssilk_core.physics.simulate.friction import CREEP
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.newton import SolverOptions
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    Collider,
    Floats,
    Garment,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    ShotWorld,
    SkinWeights,
)
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import bind_pose

G, FPS, MU = 9.81, 60.0, 0.5
DT = 1 / FPS
AWAY = np.array([3.0, 1.0, 0.0])  # from the character's body
CLOTH = Fabric("rough", density=0.3, drag=0.0, margin=4e-3, friction=MU)
LAW = replace(ContactLaw.of(CLOTH), stiffness=CLOTH.loose_contact)
LEVEL = np.eye(4)
LEVEL[:3, 3] = AWAY


def rest_height(slope: float = 0.0) -> float:
    """Where contact bears the part of the weight that presses on a slope."""
    weight = CLOTH.density * G * np.cos(slope)
    return brentq(lambda d: float(LAW.pressure(torch.tensor(d))) - weight, 0, LAW.start)


def turned(axis: int, angle: float) -> Floats:
    """A plane through `AWAY`, turned about an axis there."""
    found, (one, other) = LEVEL.copy(), [each for each in range(3) if each != axis]
    found[[one, other], [one, other]] = np.cos(angle)
    found[one, other], found[other, one] = -np.sin(angle), np.sin(angle)
    return found


def lying(scene: Scene, grid, placed: Floats, slope: float = 0.0) -> Scene:
    """A square of 12 cm, of the first joint alone, that rests on a plane."""
    points, faces = grid(4, 4, height=0.12, width=0.12)
    points = points[:, [0, 2, 1]]
    points = (points - points.mean(axis=0) + [0, rest_height(slope), 0]) @ placed[:3, :3].T + placed[:3, 3]
    skin = SkinWeights("/cloth", np.zeros((len(points), 1), dtype=int), np.ones((len(points), 1)))
    garment = Garment(Mesh("/cloth", points, faces), skin, np.full(len(points), LOOSE))
    return replace(scene, garment=garment, rig=ProxyRig("/cloth", (), np.zeros(0, int), np.zeros((0, 4, 4)), skin))


def plane(placements: Floats = LEVEL, moved: Floats | None = None, present: Floats | None = None) -> Collider:
    """A square of 2 m; `moved` (F, 3) moves its points in its own space."""
    corners = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    points = corners[None] if moved is None else corners + moved[:, None]
    faces, there = np.array([[0, 1, 2], [0, 2, 3]]), np.ones(1, dtype=bool) if present is None else present
    return Collider("/plane", faces, points, placements.reshape(-1, 4, 4), there)


def paths(cloth: Scene, worlds: Sequence[ShotWorld], steps: int, mu: float = MU) -> Floats:
    """Positions (shots, steps + 1, V, 3) of cloth that lies where it was made, in several shots at once."""
    options = SimulationOptions(fps=FPS, solver=SolverOptions(tolerance=1e-6, iterations=100))
    simulator = Simulator(cloth, replace(CLOTH, friction=mu), options)
    rotations, translations = (each[None] for each in bind_pose(cloth.character.skeleton))
    poses, surroundings = simulator.poser.pose(rotations, translations), simulator.surroundings(worlds)
    assert surroundings is not None

    def poses_at(places):
        many = type(poses).concatenated([poses] * len(places))
        at = [(shot, step * DT) for shot, step in places]
        return replace(many, world=surroundings.around(at, many.root, many.lbs))

    x, past = poses.lbs.double() + poses.root, []
    for shot in range(len(worlds)):
        world = poses_at([(shot, 0)]).world
        rubbing = simulator.potential.friction(poses.lbs, poses.body, None, DT, world)
        past.append(StepHistory(x, x, poses.root, poses.lbs, friction=rubbing))
    found = [[x[..., 0].numpy()] for _ in worlds]
    for each in simulator.carry_on(past, [range(1, steps + 1)] * len(worlds), poses_at):
        assert float(each.solution.residual) < 1e-4
        found[each.shot].append(each.state.last[..., 0].numpy())
    return np.array(found)


@pytest.mark.parametrize("slope", [0.2, 0.44, 0.6, 0.9])  # tan < 0.5, twice
def test_cloth_sticks_or_slides_on_a_slope_as_coulomb_says(scene, toy_grid, slope: float) -> None:
    steps, placed = 10, turned(2, -slope)
    cloth = lying(scene, toy_grid, placed, slope)
    path = paths(cloth, [ShotWorld(FPS, (plane(placed),))], steps)[0] @ placed[:3, :3]
    moved = (path[-1] - path[0]).mean(axis=0)
    pull = G * (np.sin(slope) - MU * np.cos(slope))
    if pull < 0:
        assert 0 < moved[0] < steps * DT * CREEP
    else:  # implicit Euler from rest
        assert moved[0] == pytest.approx(pull * DT**2 * steps * (steps + 1) / 2, rel=0.01)
    assert abs(moved[1]) < 1e-4 and abs(moved[2]) < 1e-4


@pytest.mark.usefixtures("few_contacts")
def test_refined_frames_that_look_back_stick_or_slide_as_coulomb_says(scene, toy_grid) -> None:
    """A sheet rests in the first frame, and then is pulled along the plane; the network's stays in the air."""
    steps, cloth = 4, lying(scene, toy_grid, LEVEL)
    rotated, placed = bind_pose(cloth.character.skeleton)
    motion = Motion("/still", FPS, np.tile(rotated, (steps + 1, 1, 1)), np.tile(placed, (steps + 1, 1, 1)))
    points = cloth.garment.mesh.points
    network = np.stack([points, *[points + [0.0, 0.02, 0.01]] * steps])
    beneath = InnerSurface(Mesh("/beneath", points - [0.0, 0.5, 0.0], cloth.garment.mesh.faces), 1e-3)

    def moved(pull: float, mu: float = MU, feedback: bool = True, beneath: Sequence[InnerSurface] = ()) -> Floats:
        options = RefineOptions(iterations=100, feedback=feedback, tolerance=1e-6)
        refiner = Refiner(cloth, replace(CLOTH, friction=mu), options, fps=FPS, beneath=beneath)
        world = ShotWorld(FPS, (plane(),), gravity=np.array([[0.0, -G, 0], *[[pull, -G, 0]] * steps]))
        below = [[each.mesh.points for each in beneath]] * len(network)
        found = np.stack([each.points for each in refiner.frames(motion, network, world, below)])
        return (found[-1] - found[0]).mean(axis=0)

    assert 0 < moved(0.9 * MU * G)[0] < steps * DT * CREEP
    sliding, share = moved(1.5 * MU * G), DT**2 * steps * (steps + 1) / 2  # implicit Euler from rest
    np.testing.assert_allclose(sliding, [0.5 * MU * G * share, 0, 0], atol=2e-5)
    over = moved(1.5 * MU * G, beneath=[beneath])  # its samples are there twice, and rub once
    np.testing.assert_allclose(over, sliding, atol=1e-6)
    smooth = [moved(1.5 * MU * G, mu, feedback=False) for mu in (MU, 0.0)]  # without looking back
    np.testing.assert_array_equal(*smooth)


def test_cloth_is_carried_by_planes_that_move_are_skinned_or_turn_in_shots_of_one_batch(scene, toy_grid) -> None:
    drift, rate, steps = 0.06, 0.5, 12
    cloth, frames = lying(scene, toy_grid, LEVEL), np.arange(steps + 1)
    way = np.outer(frames, [drift * DT, 0, 0])
    belt = plane(np.tile(LEVEL, (steps + 1, 1, 1)) + np.pad(way[:, :, None], ((0, 0), (0, 1), (3, 0))))
    table = plane(np.stack([turned(1, -rate * DT * frame) for frame in frames]))
    worlds = [ShotWorld(FPS, (belt,)), ShotWorld(FPS, (plane(moved=way),)), ShotWorld(FPS, (table,))]
    carried = paths(cloth, worlds, steps)
    for path in carried[:2]:
        moved = (path[-1] - path[0]).mean(axis=0)
        assert drift * steps * DT - 2 * CREEP * DT * steps < moved[0] <= drift * steps * DT
    angle = rate * DT * steps
    start, end = (carried[2][at] - AWAY for at in (0, -1))
    turn = np.arctan2((start[:, 0] * end[:, 2] - start[:, 2] * end[:, 0]).sum(), (start * end)[:, [0, 2]].sum())
    assert abs(turn) == pytest.approx(angle, rel=0.05)
    np.testing.assert_allclose(np.hypot(*end[:, [0, 2]].T), np.hypot(*start[:, [0, 2]].T), atol=1e-3)
    alone = np.concatenate([paths(cloth, [world], steps) for world in worlds[1:]])
    np.testing.assert_allclose(carried[1:], alone, atol=1e-6)
    smooth = paths(cloth, worlds[1:2], steps, 0.0)[0]
    assert abs((smooth[-1] - smooth[0])[:, 0].mean()) < 1e-4


def test_a_plane_that_is_gone_rubs_no_more(scene, toy_grid) -> None:
    """Beside it there is a prop at first, whose vertices come before its own, and then are gone."""
    drift, steps, last = 2.0, 8, 4
    cloth, frames = lying(scene, toy_grid, LEVEL), np.arange(steps + 1)
    belt = plane(moved=np.outer(frames, [drift * DT, 0, 0]), present=frames <= last)
    away = LEVEL.copy()
    away[:3, 3] += [0, -1.5, 0]
    other = plane(away, present=frames < 2)
    speed = np.diff(paths(cloth, [ShotWorld(FPS, (other, belt))], steps)[0].mean(axis=1), axis=0) * FPS
    # It slips all the while: MU G drives it until the plane is gone, and nothing but its weight afterwards.
    np.testing.assert_allclose(speed[:last, 0], MU * G * DT * np.arange(1, last + 1), rtol=1e-2)
    np.testing.assert_allclose(speed[last:, 0], speed[last - 1, 0], rtol=1e-6)
    np.testing.assert_allclose(np.diff(speed[last:, 1]), -G * DT, rtol=1e-3)


def test_shots_drag_cloth_that_is_held_at_an_edge_each_along_its_own_belt(scene, toy_grid) -> None:
    cloth, frames = lying(scene, toy_grid, LEVEL), 6
    far = cloth.garment.mesh.points[:, 2]
    held = np.where(far > far.max() - 1e-9, PINNED, LOOSE)
    cloth = replace(cloth, garment=replace(cloth.garment, classes=held))
    rotated, placed = bind_pose(cloth.character.skeleton)
    motion = Motion("/still", FPS, np.tile(rotated, (frames, 1, 1)), np.tile(placed, (frames, 1, 1)))
    ways = [np.outer(np.arange(frames), [speed * DT, 0, 0]) for speed in (0.06, -0.06)]
    worlds = [*(ShotWorld(FPS, (plane(moved=way),)) for way in ways), None]
    found = simulate(cloth, CLOTH, [motion] * 3, SimulationOptions(fps=FPS), worlds=worlds)
    along, against, alone = ((points[-1] - points[0])[:, 0].mean() for points in found)
    assert along > 1e-3 and against < -1e-3 and abs(alone) < 1e-5
