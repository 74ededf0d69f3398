# SPDX-License-Identifier: Apache-2.0
"""What surrounds a character: distances against brute force, and the simulator against closed forms."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import brentq

from ssilk_core.errors import SsilkError
from ssilk_core.physics.energy.collision import ContactLaw
from ssilk_core.physics.simulate import SimulationOptions, Simulator, simulate
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions
from ssilk_core.physics.world.air import MovingAir
from ssilk_core.physics.world.colliders import voting_points
from ssilk_core.physics.world.felt import felt_gravity
from ssilk_core.physics.world.surface import CollisionSurface, Nearest
from ssilk_core.physics.world.surroundings import Surroundings
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    Air,
    Collider,
    Garment,
    Mesh,
    Motion,
    ProxyRig,
    ShotWorld,
    SkinWeights,
)
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import bind_pose

G = 9.81
FPS = 30.0
AWAY = np.array([3.0, 1.0, 0.0])  # from the character's body
CLOTH = Fabric("cloth", density=0.3, drag=0.0, bending=1e-6, margin=4e-3, thickness=1e-3)


def flat_sheet(scene, side: float, count: int, pinned=None):
    """A scene in a level square sheet, of the first joint alone, that faces up."""
    at = np.linspace(-side / 2, side / 2, count)
    z, x = np.meshgrid(at, at, indexing="ij")
    points = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3) + AWAY
    row, column = (part.reshape(-1) for part in np.mgrid[0 : count - 1, 0 : count - 1])
    a = row * count + column
    faces = np.concatenate([np.c_[a, a + count, a + 1], np.c_[a + 1, a + count, a + count + 1]])
    return dressed(scene, points, faces, np.zeros(len(points), dtype=bool) if pinned is None else pinned)


def dressed(scene, points, faces, pinned):
    skin = SkinWeights("/cloth", np.zeros((len(points), 1), dtype=int), np.ones((len(points), 1)))
    garment = Garment(Mesh("/cloth", points, faces), skin, np.where(pinned, PINNED, LOOSE))
    return replace(scene, garment=garment, rig=ProxyRig("/cloth", (), np.zeros(0, int), np.zeros((0, 4, 4)), skin))


def still(scene, frames: int) -> Motion:
    """The character in its bind pose, in which its garment is where it was made."""
    turned, placed = bind_pose(scene.character.skeleton)
    return Motion("/still", FPS, np.tile(turned, (frames, 1, 1)), np.tile(placed, (frames, 1, 1)))


def collider(points, faces, placements=None, present=True) -> Collider:
    points = np.asarray(points, dtype=float)
    points = points[None] if points.ndim == 2 else points
    placements = np.eye(4)[None] if placements is None else placements
    return Collider("/prop", np.asarray(faces), points, placements, np.atleast_1d(present))


def floor(height: float, up: bool = True, size: float = 5.0) -> Collider:
    corners = size * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]) + [0, height, 0]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return collider(corners, faces if up else faces[:, ::-1])


def brute_force(points: np.ndarray, faces: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Distances to the nearest of all triangles, one after the other."""
    found = np.full(len(queries), np.inf)
    for triangle in points[faces]:
        nearest = trimesh.triangles.closest_point(np.repeat(triangle[None], len(queries), axis=0), queries)
        found = np.minimum(found, np.linalg.norm(queries - nearest, axis=1))
    return found


SOLIDS = {
    "thin box": trimesh.creation.box((1.0, 2.0, 0.02)),
    "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.5),
    "ring": trimesh.creation.torus(1.0, 0.3, major_sections=16, minor_sections=8),
}


def path(cloth, fabric: Fabric, world: ShotWorld, frames: int, precise: float = 1e-6) -> np.ndarray:
    """Positions (frames, V, 3) of cloth that is let go where it was made."""
    simulator = Simulator(cloth, fabric, SimulationOptions(fps=FPS, solver=SolverOptions(tolerance=precise)))
    motion = still(cloth, 1)
    poses = simulator.poser.pose(motion.rotations, motion.translations)
    surroundings = simulator.surroundings([world])
    assert surroundings is not None
    placed = [
        replace(poses, world=surroundings.around([(0, step / FPS)], poses.root, poses.lbs))
        for step in range(1, frames + 1)
    ]
    x = poses.lbs.double() + poses.root
    past = StepHistory(x, x, poses.root, poses.lbs)
    steps = simulator.carry_on([past], [range(frames)], lambda places: placed[places[0][1]])
    return np.stack([each.state.last[..., 0].numpy() for each in steps])


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_are_those_of_all_triangles_however_a_mesh_is_wound_and_split(name: str) -> None:
    solid, rng = SOLIDS[name], np.random.default_rng(1)
    faces = solid.faces.copy()
    wrong = rng.random(len(faces)) < 0.3
    faces[wrong] = faces[wrong][:, ::-1]
    points, split = solid.vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
    queries = rng.uniform(-1.5, 1.5, (300, 3))
    surface = CollisionSurface(name, points, split).at(points)
    found = surface.distance(queries)
    np.testing.assert_allclose(np.abs(found.distance), brute_force(points, split, queries), atol=1e-12)
    inside = np.asarray(solid.contains(queries))
    assert name == "thin box" or inside.sum() > 5
    np.testing.assert_array_equal(found.distance < 0, inside)
    step = 1e-6
    slopes = [
        (surface.distance(queries + step * axis).distance - surface.distance(queries - step * axis).distance)
        / (2 * step)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(found.normal, np.stack(slopes, axis=1), atol=1e-7)
    nearest = (points[found.corners] * found.weights[..., None]).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(queries - nearest, axis=1), np.abs(found.distance), atol=1e-9)


def test_sides_are_the_same_whatever_finds_the_nearest_points() -> None:
    """As in Blender's Python, which has no libigl."""
    solid, rng = SOLIDS["ring"], np.random.default_rng(3)
    queries = rng.uniform(-1.5, 1.5, (200, 3))

    def each_one(points: np.ndarray, faces: np.ndarray) -> Nearest:
        def nearest(asked: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            many = (np.repeat(points[face][None], len(asked), axis=0) for face in faces)
            found = np.stack([trimesh.triangles.closest_point(face, asked) for face in many])
            squares = ((found - asked) ** 2).sum(axis=2)
            face = squares.argmin(axis=0)
            return squares.min(axis=0), face, found[face, np.arange(len(asked))]

        return nearest

    surface = CollisionSurface("ring", solid.vertices, solid.faces)
    one, other = surface.at(solid.vertices).distance(queries), surface.at(solid.vertices, each_one).distance(queries)
    np.testing.assert_allclose(one.distance, other.distance, atol=1e-12)
    np.testing.assert_allclose(one.normal, other.normal, atol=1e-9)
    assert (one.distance < 0).any() and (one.distance > 0).any()


def test_a_band_that_has_one_side_alone_is_a_part_as_it_is_wound() -> None:
    """A Moebius band cannot be wound alike; cloth meets it nevertheless."""
    angle = np.arange(12) * np.pi / 6
    across = np.stack([np.cos(angle) * np.cos(angle / 2), np.sin(angle) * np.cos(angle / 2), np.sin(angle / 2)], 1)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    points = np.concatenate([ring + 0.2 * across, ring - 0.2 * across])
    low, high = np.arange(12), np.arange(12) + 12
    after, above = np.append(low[1:], high[0]), np.append(high[1:], low[0])  # it comes back upside down
    faces = np.concatenate([np.stack([low, after, high], 1), np.stack([high, after, above], 1)])
    surface = CollisionSurface("/band", points, faces)
    assert not surface.closed.any() and len(surface.closed) == 1
    np.testing.assert_array_equal(np.sort(surface.faces, axis=1), np.sort(faces, axis=1))
    assert np.abs(surface.at(points).distance(points).distance).max() < 1e-9


def test_a_query_that_was_far_is_not_searched_for_again_and_none_is_missed() -> None:
    solid, rng = SOLIDS["ring"], np.random.default_rng(2)
    world = Surroundings([ShotWorld(FPS, (collider(solid.vertices, solid.faces),))], np.zeros(3))
    x = torch.as_tensor(rng.uniform(-1.5, 1.5, (400, 3, 1)))
    around = world.around([(0, 0.0)], torch.zeros(3, 1), x)
    for _ in range(5):
        found = around.touched(x, 0.05)
        expected = (
            CollisionSurface("ring", solid.vertices, solid.faces).at(solid.vertices).distance(x[..., 0].numpy())
        )
        near = np.flatnonzero(expected.distance <= 0.05)
        np.testing.assert_array_equal(found.row, near)
        np.testing.assert_allclose(found.distance, expected.distance[near], atol=1e-12)
        x = x + 0.1 * torch.as_tensor(rng.normal(size=x.shape))


def test_a_floor_has_its_outside_where_the_garment_is_and_nothing_lies_below_beyond_its_border() -> None:
    for up in (True, False):
        own = floor(0.0, up)
        surface = CollisionSurface("/floor", own.points[0], own.faces).at(own.points[0])
        above = np.array([[0.1, 0.5, 0.2], [1.0, 0.2, 0.0], [0.0, -0.1, 0.0]])
        for mirror in (1.0, -1.0):
            sides = surface.outside(above * [1, mirror, 1])
            queries = np.array([[0.2, -0.3, 0.1], [0.2, 0.3, 0.1], [6.0, -1.0, 0.0]]) * [1, mirror, 1]
            found = surface.distance(queries, sides)
            np.testing.assert_allclose(found.distance, [-0.3, 0.3, np.sqrt(2)], atol=1e-12)
            np.testing.assert_allclose(found.normal[0], [0, mirror, 0], atol=1e-12)


def test_a_room_is_hollow_and_a_box_that_holds_some_of_the_garment_is_not() -> None:
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    surface = CollisionSurface("/box", box.vertices, box.faces).at(box.vertices)
    assert surface.outside(np.array([[0.1, 0.2, 0.3], [0.5, 0.5, 0.5]])) == -1
    assert surface.outside(np.array([[0.1, 0.2, 0.3], [0.5, 0.5, 1.5]])) == 1


@pytest.mark.parametrize("shape", ["floor", "ball"])
def test_forces_and_stiffness_are_derivatives_of_the_energy(scene, shape: str) -> None:
    cloth = flat_sheet(scene, 0.3, 5)
    potential = IncrementalPotential(cloth, CLOTH, device=torch.device("cpu"))
    ball = SOLIDS["ball"]
    prop = floor(0.998) if shape == "floor" else collider(ball.vertices + AWAY - [0, 0.499, 0], ball.faces)
    x = torch.as_tensor(np.array(cloth.garment.mesh.points))[..., None]
    x = x + 1e-3 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    world = Surroundings([ShotWorld(FPS, (prop,))], np.zeros(3)).around([(0, 0.0)], torch.zeros(3, 1), x)
    without = StepInputs(None, torch.zeros(3, 1, dtype=x.dtype))
    inputs = replace(without, world=world)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(2), dtype=x.dtype)

    def own(x: torch.Tensor, what: str) -> torch.Tensor:
        return getattr(potential, what)(x, inputs, None) - getattr(potential, what)(x, without, None)

    step = 1e-7
    slope = (own(x + step * direction, "energy") - own(x - step * direction, "energy")) / (2 * step)
    force = own(x, "gradient")
    assert force.abs().max() > 1e-3
    torch.testing.assert_close((force * direction).sum((0, 1)), slope, rtol=1e-5, atol=1e-9)
    if shape == "floor":
        turn = (own(x + step * direction, "gradient") - own(x - step * direction, "gradient")) / (2 * step)
        blocks = [potential.hessian(x, each, None).rows.to_dense().double() for each in (inputs, without)]
        product = ((blocks[0] - blocks[1]) @ direction[potential.free, :, 0].reshape(-1)).reshape(-1, 3)
        torch.testing.assert_close(product, turn[potential.free, :, 0], rtol=1e-3, atol=1e-2)


def test_a_sheet_that_falls_on_a_floor_rests_where_pressure_bears_its_weight(scene) -> None:
    cloth = flat_sheet(scene, 0.4, 9)
    world = ShotWorld(FPS, (floor(0.7),))
    *_, last = path(cloth, CLOTH, world, 60)
    law = replace(ContactLaw.of(CLOTH), stiffness=CLOTH.loose_contact)
    rest = brentq(lambda d: float(law.pressure(torch.tensor(d))) - CLOTH.density * G, 0, law.start)
    np.testing.assert_allclose(last[:, 1], 0.7 + rest, atol=2e-5)
    assert 0.5 * CLOTH.thickness < rest < law.start


def test_a_sheet_over_a_ball_hangs_around_it_and_none_of_it_is_inside(scene) -> None:
    cloth = flat_sheet(scene, 0.6, 13)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.15)
    centre = AWAY - [0, 0.17, 0]
    prop = collider(ball.vertices, ball.faces, np.eye(4)[None] + np.pad(centre[:, None], ((0, 1), (3, 0)))[None])
    points = path(cloth, CLOTH, ShotWorld(FPS, (prop,)), 15, 1e-2)
    away = np.linalg.norm(points - centre, axis=2)
    assert away.min() > 0.15
    assert away[-1].min() < 0.15 + CLOTH.contact_distance
    assert np.ptp(points[-1, :, 1]) > 0.1


def test_a_box_that_moves_takes_the_sheet_before_it_along(scene, toy_grid) -> None:
    points, faces = toy_grid(9, 5, height=0.4, width=0.2)
    cloth = dressed(scene, points + AWAY, faces, points[:, 1] > -1e-9)
    box, frames = trimesh.creation.box((0.6, 0.1, 0.1)), 16
    places = np.tile(np.eye(4), (frames, 1, 1))
    places[:, :3, 3] = AWAY - [0, 0.35, 0]
    places[:, 2, 3] = -0.2 + 0.02 * np.arange(frames)  # its front comes to z = 0.15
    prop = collider(box.vertices, box.faces, places)
    found = simulate(
        cloth, CLOTH, [still(cloth, frames)], SimulationOptions(fps=FPS), worlds=[ShotWorld(FPS, (prop,))]
    )[0]
    front = places[:, 2, 3] + 0.05
    across = (found[:, :, 1] < AWAY[1] - 0.3) & (found[:, :, 1] > AWAY[1] - 0.4)
    for frame in range(frames):
        assert found[frame, across[frame], 2].min() > front[frame]
    assert found[-1, across[-1], 2].min() == pytest.approx(front[-1], abs=0.02)


def test_free_cloth_in_wind_falls_at_its_terminal_velocity(scene) -> None:
    wind, fabric = np.array([2.0, 0.5, -1.0]), replace(CLOTH, drag=1.8)
    world = ShotWorld(FPS, air=Air(wind[None], np.zeros(1)))
    *_, before, after = path(flat_sheet(scene, 0.2, 3), fabric, world, 60)
    fall = np.array([0, -G, 0]) * fabric.density / fabric.drag
    np.testing.assert_allclose((after - before) * FPS, np.broadcast_to(wind + fall, after.shape), atol=1e-4)


def test_a_sheet_that_hangs_in_wind_tilts_by_the_ratio_of_drag_and_weight(scene, toy_grid) -> None:
    points, faces = toy_grid(9, 3, height=0.4, width=0.1)
    cloth = dressed(scene, points + AWAY, faces, points[:, 1] > -1e-9)
    fabric, speed = replace(CLOTH, drag=0.5), 4.0
    world = ShotWorld(FPS, air=Air(np.array([[0, 0, speed]]), np.zeros(1)))
    found = simulate(
        cloth,
        fabric,
        [still(cloth, 3)],
        SimulationOptions(
            fps=FPS,
            solver=SolverOptions(tolerance=1e-4),
            quasi_static_solver=SolverOptions(tolerance=1e-4, iterations=400),
        ),
        worlds=[world],
    )[0]
    hem, seam = found[-1, -3:].mean(axis=0), found[-1, :3].mean(axis=0)
    tilt = np.arctan2(hem[2] - seam[2], seam[1] - hem[1])
    assert tilt == pytest.approx(np.arctan(fabric.drag * speed / (fabric.density * G)), abs=5e-3)


def test_where_the_body_carries_cloth_in_a_long_shot_takes_the_memory_of_what_is_found(scene) -> None:
    motion = still(scene, 1500)
    tracemalloc.start()
    found = voting_points(motion, scene)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found) == motion.frame_count
    np.testing.assert_allclose(found[0], voting_points(motion.clip(0, 1), scene)[0], rtol=0, atol=1e-12)
    assert peak < 5 * found.nbytes


def test_an_even_wind_is_gravity_to_cloth_whatever_the_character_does(scene, toy_grid) -> None:
    points, faces = toy_grid(5, 3, height=0.4, width=0.1)
    cloth, frames = dressed(scene, points + AWAY, faces, points[:, 1] > -1e-9), 8
    fabric, wind, glide = replace(CLOTH, drag=0.6), np.array([3.0, 1.0, 4.0]), np.array([0.0, 0.0, -1.5])
    pull = np.linspace([0, -9.81, 0], [2.0, -5.0, 0.0], frames)
    motion = still(cloth, frames)
    places = motion.translations.copy()
    places[:, 0] += np.arange(frames)[:, None] / FPS * glide
    motion = replace(motion, translations=places)
    world = ShotWorld(FPS, gravity=pull, air=Air(wind[None], np.zeros(1)))
    felt = felt_gravity(world, motion, cloth, fabric)
    np.testing.assert_allclose(felt, pull + fabric.drag / fabric.density * (wind - glide), atol=1e-9)
    options = SimulationOptions(fps=FPS, precision="float64", solver=SolverOptions(tolerance=1e-7))
    # The simulator's first frame is at rest, where the root has no velocity yet: the wind starts from there.
    felt[0] += fabric.drag / fabric.density * glide
    blown, pulled = (
        simulate(cloth, fabric, [motion], options, worlds=[each])[0] for each in (world, ShotWorld(FPS, gravity=felt))
    )
    np.testing.assert_allclose(blown, pulled, atol=1e-5)


def test_what_cloth_feels_is_the_usual_where_nothing_says_otherwise(scene, toy_grid) -> None:
    points, faces = toy_grid(3, 2)
    cloth = dressed(scene, points + AWAY, faces, points[:, 1] > -1e-9)
    motion, wind = still(cloth, 3), Air(np.array([[5.0, 0, 0]]), np.zeros(1))
    assert felt_gravity(None, motion, cloth, CLOTH) is None
    assert felt_gravity(ShotWorld(FPS, (floor(0.0),)), motion, cloth, CLOTH) is None
    assert felt_gravity(ShotWorld(FPS, air=wind), motion, cloth, replace(CLOTH, drag=0.0)) is None
    jump = replace(motion, translations=motion.translations + np.array([[[0.0]], [[0.0]], [[100.0]]]))
    blown = felt_gravity(ShotWorld(FPS, air=wind), jump, cloth, replace(CLOTH, drag=0.6))
    np.testing.assert_allclose(blown, np.tile([10.0, -9.81, 0.0], (3, 1)), atol=1e-9)  # a teleport is no wind


def test_gusts_are_felt_as_their_mean_over_the_cloth(scene, toy_grid) -> None:
    points, faces = toy_grid(9, 9, height=0.4, width=0.4)
    cloth = dressed(scene, points + AWAY, faces, points[:, 1] > 1)
    world = ShotWorld(FPS, air=Air(np.array([[2.0, 0, 0]]), np.array([3.0]), length=4.0, seed=2))
    motion, fabric = still(cloth, 12), replace(CLOTH, drag=0.6)
    felt = felt_gravity(world, motion, cloth, fabric)
    air, at = MovingAir(world.air, FPS), cloth.garment.mesh.points
    every = np.stack([air.velocity(at, frame / FPS).mean(axis=0) for frame in range(12)])
    np.testing.assert_allclose(felt, fabric.drag / fabric.density * every - [0, 9.81, 0], atol=0.5)
    assert np.ptp(felt, axis=0).max() > 1
    places, seconds = np.tile(at + [300.0, 0, -200], (12, 1, 1)), 100 + np.arange(12) / FPS
    mean = air.velocities(places, seconds).mean(axis=1)
    np.testing.assert_allclose(air.mean_velocities(places, seconds), mean, atol=1e-6)


def test_gravity_that_turns_and_grows_in_a_shot_moves_free_cloth_as_implicit_euler_does(scene) -> None:
    frames = 10
    pull = np.linspace([0, -9.81, 0], [5.0, 2.0, -1.0], frames + 1)
    *_, before, after = path(flat_sheet(scene, 0.2, 3), CLOTH, ShotWorld(FPS, gravity=pull), frames)
    start = flat_sheet(scene, 0.2, 3).garment.mesh.points
    speeds = np.cumsum(pull[1:] / FPS, axis=0)
    np.testing.assert_allclose(after - start, np.broadcast_to(speeds.sum(axis=0) / FPS, after.shape), atol=1e-6)
    np.testing.assert_allclose((after - before) * FPS, np.broadcast_to(speeds[-1], after.shape), atol=1e-5)


def test_gusts_are_as_strong_as_they_say_solenoidal_continuous_and_the_same_again() -> None:
    rng = np.random.default_rng(5)
    air = Air(np.array([[4.0, 0, 0], [8.0, 0, 0]]), np.array([3.0]), length=1.5, seed=7)
    moving = MovingAir(air, FPS)
    points = rng.uniform(-200, 200, (40_000, 3))
    found = moving.velocity(points, 2.0)
    assert np.sqrt(((found - [8, 0, 0]) ** 2).sum(axis=1).mean()) == pytest.approx(3.0, rel=0.02)
    np.testing.assert_array_equal(found, MovingAir(air, FPS).velocity(points, 2.0))
    assert np.abs(found - MovingAir(replace(air, seed=8), FPS).velocity(points, 2.0)).max() > 1
    steady = replace(air, velocity=air.velocity[:1])
    later = MovingAir(replace(steady, begins=1.5), FPS).velocity(points, 0.5)
    np.testing.assert_allclose(later, MovingAir(steady, FPS).velocity(points, 2.0), atol=1e-9)
    step = 1e-5
    slopes = np.stack(
        [
            (moving.velocity(points[:50] + step * axis, 2.0) - moving.velocity(points[:50], 2.0)) / step
            for axis in np.eye(3)
        ]
    )
    assert np.abs(np.einsum("iqi->q", slopes)).max() < 1e-3 * np.abs(slopes).max()
    for time in (0.5 / FPS, 1 / FPS, 1.5 / FPS):  # also where the wind's own speed bends
        apart = moving.velocity(points, time + 1e-6) - moving.velocity(points, time - 1e-6)
        assert np.abs(apart).max() < 1e-2


def test_nothing_around_a_character_leaves_every_bit_as_it_is(scene, toy_motion) -> None:
    motion, options = toy_motion(scene, 6), SimulationOptions(fps=FPS)
    plain = simulate(scene, CLOTH, [motion], options)[0]
    empty = simulate(scene, CLOTH, [motion], options, worlds=[ShotWorld(FPS)])[0]
    np.testing.assert_array_equal(plain, empty)
    far = ShotWorld(FPS, (floor(-50.0),))
    np.testing.assert_array_equal(plain, simulate(scene, CLOTH, [motion], options, worlds=[far])[0])


def test_a_collider_that_is_absent_is_not_met(scene) -> None:
    cloth = flat_sheet(scene, 0.2, 3)
    own = floor(0.9)
    gone = Collider("/floor", own.faces, own.points, own.placements, np.array([True, True, False]))
    around = Surroundings([ShotWorld(FPS, (gone,))], np.zeros(3))
    counts = [
        len(around.around([(0, t / FPS)], torch.zeros(3, 1), torch.zeros(4, 3, 1)).colliders[0]) for t in range(4)
    ]
    assert counts == [1, 1, 0, 0] and cloth.garment.mesh.vertex_count == 9


def test_wind_on_cloth_without_drag_is_refused(scene) -> None:
    world = ShotWorld(FPS, air=Air(np.ones((1, 3)), np.zeros(1)))
    with pytest.raises(SsilkError, match="has no drag"):
        simulate(scene, CLOTH, [still(scene, 2)], worlds=[world])


def test_a_collider_without_area_or_with_a_placement_that_scales_is_refused() -> None:
    with pytest.raises(SsilkError, match="no triangle of it has an area"):
        CollisionSurface("/line", np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(SsilkError, match="scales or shears"):
        collider(np.eye(3), np.array([[0, 1, 2]]), 2 * np.eye(4)[None])
