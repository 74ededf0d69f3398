# SPDX-License-Identifier: Apache-2.0
"""Garments worn together in the simulator: forces against slow references, weights, sides, and starts in a tangle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.physics.intersections.pairs import intersections_between
from ssilk_core.physics.self_contact import SelfContact
from ssilk_core.physics.self_contact.pairs import between_edges, over_faces
from ssilk_core.physics.simulate import SimulationOptions, Simulator, WornGarment
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import SolverOptions, minimise_from
from ssilk_core.physics.simulate.outfit import OutfitPotential
from ssilk_core.physics.simulate.wind import pushed_by_wind
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    TIGHT,
    Collider,
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
from ssilk_core.scene.mesh import topology

CPU = torch.device("cpu")
G = 9.81
AWAY = np.array([3.0, 1.0, 0.0])  # from the character's body
LIGHT = Fabric("light", density=0.1, thickness=1e-3, friction=0.2)
HEAVY = Fabric("heavy", density=0.3, lame_mu=35.0, bending=5e-5, thickness=2e-3, loose_contact=3e5, friction=0.4)
BETWEEN = 0.5 * (LIGHT.thickness + HEAVY.thickness) + 0.5 * LIGHT.margin  # [m] at which one begins to touch the other


def wearing(scene: Scene, points: np.ndarray, faces: np.ndarray, classes: np.ndarray | int, name: str) -> Scene:
    """The character of a scene in another garment, which hangs from its first joint."""
    skin = SkinWeights(name, np.zeros((len(points), 1), dtype=int), np.ones((len(points), 1)))
    garment = Garment(Mesh(name, points, faces), skin, np.broadcast_to(classes, len(points)).copy())
    rig = ProxyRig(name, (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    return replace(scene, garment=garment, rig=rig)


def lying(toy_grid, height: float, size: float, count: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """A horizontal square sheet, away from the character's body."""
    points, faces = toy_grid(count, count, height=size, width=size)
    flat = np.column_stack([points[:, 0], np.full(len(points), height), points[:, 1] + size / 2])
    return flat + AWAY, faces


@pytest.fixture
def crossed(scene) -> list[WornGarment]:
    """Two sheets of two triangles, of two fabrics, 3 mm apart where one turns over the other."""
    square = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0, 0.1], [0, 0, 0.1]], dtype=float)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    upper = square @ turn.T + [0.01, 0.003, 0.03]
    return [
        WornGarment(wearing(scene, square, faces, LOOSE, "/lower"), HEAVY),
        WornGarment(wearing(scene, upper, faces, LOOSE, "/upper"), LIGHT),
    ]


def outfit(garments: list[WornGarment], own: bool = False) -> OutfitPotential:
    return OutfitPotential(garments, own=own, device=CPU, dtype=torch.float64)


def positions(garments: list[WornGarment]) -> torch.Tensor:
    return torch.as_tensor(np.concatenate([each.scene.garment.mesh.points for each in garments]))[:, :, None]


def slow_contact_energy(garments: list[WornGarment], x: np.ndarray, rest: np.ndarray) -> float:
    """The energy of contact between two garments, pair by pair, as `self_contact` defines it."""
    fabrics = [each.fabric for each in garments]
    meshes = [each.scene.garment.mesh for each in garments]
    first = [0, meshes[0].vertex_count]
    ramp = 0.5 * max(fabric.margin for fabric in fabrics)
    starts = [fabric.thickness + 0.5 * fabric.margin for fabric in fabrics]
    stiffness = 0.5 * sum(fabric.loose_contact for fabric in fabrics)

    def energy(measure, corners: list[int], area: float) -> float:
        now, then = (float(measure(torch.as_tensor(at[corners])[:, :, None]).distance) for at in (x, rest))
        depth = max(0.0, min(0.5 * sum(starts), 0.7 * then) - now)
        return (
            area * stiffness * (depth**3 / (6 * ramp) if depth < ramp else 0.5 * depth * (depth - ramp) + ramp**2 / 6)
        )

    total = 0.0
    for one, other in ((0, 1), (1, 0)):
        areas = topology.vertex_areas(meshes[one].points, meshes[one].faces)
        for vertex in range(meshes[one].vertex_count):
            for face in meshes[other].faces:
                corners = [first[one] + vertex, *(first[other] + face)]
                total += energy(over_faces, corners, 0.5 * areas[vertex])

    def edge_areas(mesh: Mesh) -> dict[tuple[int, int], float]:
        found: dict[tuple[int, int], float] = {}
        for face, area in zip(mesh.faces, topology.face_areas(mesh.points, mesh.faces)):
            for a, b in ((0, 1), (1, 2), (2, 0)):
                key = tuple(sorted((int(face[a]), int(face[b]))))
                found[key] = found.get(key, 0.0) + area / 3
        return found

    own, others = (edge_areas(mesh) for mesh in meshes)
    for (a, b), area in own.items():
        for (c, d), of_other in others.items():
            total += energy(between_edges, [a, b, first[1] + c, first[1] + d], 0.25 * min(area, of_other))
    return total


def touching(potential: OutfitPotential, x: torch.Tensor) -> StepInputs:
    """Inputs without gravity and body, with the contacts at x."""
    inputs = StepInputs(None, torch.zeros(3, 1, dtype=torch.float64))
    inputs = replace(inputs, neighbours=potential.self_contact.neighbours(x, x))
    return potential.with_contacts(x, inputs)


def test_the_energy_is_that_of_each_garment_and_of_all_pairs_between_them(crossed):
    rest = positions(crossed)
    far = [replace(crossed[0]), replace(crossed[1], start=crossed[1].scene.garment.mesh.points + [0, 0.1, 0])]
    potential = outfit(far)  # so that they touch with their whole thickness
    away = torch.as_tensor(np.concatenate([far[0].scene.garment.mesh.points, far[1].start]))
    x = rest + 2e-4 * torch.rand(8, 3, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    inputs = touching(potential, x)
    alone = 0.0
    for each, rows in zip(far, (slice(0, 4), slice(4, 8))):
        part = IncrementalPotential(each.scene, each.fabric, device=CPU)
        alone += float(part.energy(x[rows], replace(inputs, neighbours=None, contacts=None), None))
    between = slow_contact_energy(far, x[..., 0].numpy(), away.numpy())
    assert between > 1e-7
    assert float(potential.energy(x, inputs, None)) == pytest.approx(alone + between, rel=1e-9)


def test_forces_are_minus_the_slope_of_the_energy_and_move_nothing_as_a_whole(crossed):
    potential, x = (
        outfit(crossed),
        positions(crossed)
        - torch.tensor([[0.0], [0.0015], [0.0]]) * torch.tensor([0.0] * 4 + [1.0] * 4)[:, None, None],
    )
    inputs, step = touching(potential, x), 1e-7
    gradient = potential.gradient(x, inputs, None)

    def energy(at: torch.Tensor) -> float:
        return float(potential.energy(at, potential.with_contacts(at, inputs), None))

    for vertex, axis in np.ndindex(8, 3):
        moved = torch.zeros_like(x)
        moved[vertex, axis] = step
        slope = (energy(x + moved) - energy(x - moved)) / (2 * step)
        assert gradient[vertex, axis].item() == pytest.approx(slope, rel=1e-4, abs=1e-9)
    assert inputs.contacts is not None
    push = inputs.contacts.gradient(x)[..., 0]
    lower, upper = push[:4].sum(0), push[4:].sum(0)
    assert upper[1] < -1e-4  # the energy falls where the upper sheet rises
    torch.testing.assert_close(lower, -upper, rtol=0, atol=1e-14)
    torch.testing.assert_close(
        torch.linalg.cross(x[..., 0], push).sum(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_the_hessian_is_that_of_each_garment_and_of_the_contacts(crossed):
    potential, x = outfit(crossed), positions(crossed)
    inputs = touching(potential, x)
    found = potential.hessian(x, inputs, None)
    assert inputs.contacts is not None
    vectors = torch.rand(8, 3, 1, generator=torch.Generator().manual_seed(2))
    expected = torch.zeros(8, 3, 1)
    plain = replace(inputs, neighbours=None, contacts=None)
    for part, rows in zip(potential.parts, (slice(0, 4), slice(4, 8))):
        own = part.hessian(x[rows], plain, None)
        expected[rows] = (own @ vectors[rows].permute(2, 0, 1).contiguous()).permute(1, 2, 0)
    slopes = inputs.contacts.slopes(x)
    for number in range(len(slopes.frame)):
        row = torch.zeros(8, 3)
        for corner in range(4):
            row[slopes.vertices[corner, number]] += slopes.values[corner, :, number].float()
        expected[..., 0] += row * (row * vectors[..., 0]).sum()
    image = (found @ vectors.permute(2, 0, 1).contiguous()).permute(1, 2, 0)
    torch.testing.assert_close(image, expected, rtol=1e-4, atol=1e-4)


def test_a_sheet_on_a_sheet_on_a_floor_keeps_its_thickness_and_weighs_on_both(scene, toy_grid):
    low = wearing(scene, *lying(toy_grid, 0.009, 0.25, 5), LOOSE, "/low")
    high = wearing(scene, *lying(toy_grid, 0.018, 0.15, 4), LOOSE, "/high")
    options = SimulationOptions(solver=SolverOptions(tolerance=1e-5, iterations=200))
    smooth, light = replace(HEAVY, friction=0.0), replace(LIGHT, friction=0.0)
    simulator = Simulator(low, smooth, options, over=[WornGarment(high, light)])
    corners = AWAY + 5 * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    floor = Collider("/floor", np.array([[0, 1, 2], [0, 2, 3]]), corners[None], np.eye(4)[None], np.array([True]))
    surroundings = simulator.surroundings([ShotWorld(30.0, (floor,))])
    rotations, translations = bind_pose(scene.character.skeleton)
    poses = simulator.poser.pose(rotations[None], translations[None])
    assert surroundings is not None
    around = replace(poses, world=surroundings.around([(0, 0.0)], poses.root, poses.lbs))
    begun = poses.lbs.double() + poses.root
    past = StepHistory(begun, begun, poses.root, poses.lbs)
    last = [each.state for each in simulator.carry_on([past], [range(16)], lambda places: around)][-1]
    potential, x = simulator.potential, last.local
    assert isinstance(potential, OutfitPotential) and around.world is not None
    below, above = (rows for rows, _ in potential.garments)
    weights = [G * float(part.mass.sum()) for part in potential.parts]
    inputs = StepInputs(None, torch.zeros(3, 1, dtype=torch.float64), neighbours=last.neighbours)
    contacts = potential.with_contacts(x, inputs).contacts
    assert contacts is not None
    push = -contacts.gradient(x)[..., 0]
    assert float(push[above, 1].sum()) == pytest.approx(weights[1], rel=0.01)
    assert float(push[below, 1].sum()) == pytest.approx(-weights[1], rel=0.01)
    from_floor = [
        float(-part._world_gradient(x[rows], around.world)[:, 1].sum())
        for part, (rows, _) in zip(potential.parts, potential.garments)
    ]
    assert from_floor == [pytest.approx(sum(weights), rel=0.01), 0]  # the lower sheet carries the upper one
    rough = Simulator(low, HEAVY, options, over=[WornGarment(high, LIGHT)]).potential
    rubbing = rough.friction(x, poses.body, None, 1 / 30, around.world)
    assert float(rubbing.limit.sum()) == pytest.approx(HEAVY.friction * sum(weights), rel=0.01)
    # p = K d^2 / (2 m) carries the weight of an area; corners of triangles and edges share it unevenly.
    stiffness = 0.5 * (LIGHT.loose_contact + HEAVY.loose_contact)
    sunk = np.sqrt(LIGHT.margin * LIGHT.density * G / stiffness)
    height = contacts.gap(x)[contacts.pressure(x) > 0]
    assert BETWEEN - 2 * sunk < float(height.min()) < float(height.max()) < BETWEEN


def swept(scene: Scene, toy_motion, toy_grid) -> tuple[Scene, Scene, Motion]:
    """Two strips that hang 6 mm apart on a character that turns fast."""
    points, faces = toy_grid(12, 5)
    points = points + [0, 1.35, -0.15]
    classes = np.where(points[:, 1] > 1.349, PINNED, LOOSE)
    inner, outer = (wearing(scene, points + [0, 0, z], faces, classes, f"/{z}") for z in (0.0, -0.006))
    return inner, outer, toy_motion(scene, 12, speed=2.0)


def crossings(inner: Scene, outer: Scene, x: np.ndarray, y: np.ndarray) -> int:
    return sum(
        len(intersections_between(one, inner.garment.mesh.faces, other, outer.garment.mesh.faces))
        for one, other in zip(x, y)
    )


@pytest.mark.slow
def test_what_starts_apart_never_intersects(scene, toy_motion, toy_grid):
    inner, outer, motion = swept(scene, toy_motion, toy_grid)
    fabric = replace(LIGHT, friction=0.0)
    simulator = Simulator(inner, HEAVY, over=[WornGarment(outer, fabric)])
    x = np.stack([frame.points for frame in simulator.frames([motion])])
    count = inner.garment.mesh.vertex_count
    assert crossings(inner, outer, x[:, :count], x[:, count:]) == 0
    alone = [
        np.stack([frame.points for frame in Simulator(each, own).frames([motion])])
        for each, own in ((inner, HEAVY), (outer, fabric))
    ]
    assert crossings(inner, outer, *alone) > 0  # where nothing keeps them apart they do


def test_shots_side_by_side_are_those_of_each_alone(scene, toy_motion, toy_grid, monkeypatch):
    monkeypatch.setattr("ssilk_core.physics.simulate.simulator.WAY_APART", (2, 5))  # the first poses are near
    inner, outer, motion = swept(scene, toy_motion, toy_grid)
    other = toy_motion(scene, 4, speed=2.0)
    simulator = Simulator(inner, HEAVY, over=[WornGarment(outer, LIGHT)])
    together = list(simulator.frames([motion.clip(0, 3), other]))
    for shot, one in enumerate((motion.clip(0, 3), other)):
        alone = np.stack([frame.points for frame in simulator.frames([one])])
        own = np.stack([frame.points for frame in together if frame.shot == shot])
        np.testing.assert_allclose(own, alone, rtol=0, atol=1e-4)


def test_garments_that_are_far_apart_move_as_alone(scene, toy_motion, toy_grid):
    inner, outer, _ = swept(scene, toy_motion, toy_grid)
    motion = toy_motion(scene, 4, speed=0.2)
    away = outer.garment.mesh
    moved = wearing(scene, away.points + [2.0, 0, 0], away.faces, outer.classes, "/away")
    options = SimulationOptions(solver=SolverOptions(tolerance=1e-6, iterations=300))

    def steps(simulator: Simulator) -> np.ndarray:
        def poses_at(places):
            return simulator.poser.poses_at([(motion, frame) for _, frame in places])

        first = poses_at([(0, 0)])
        x = first.lbs.double() + first.root
        past = StepHistory(x, x, first.root, first.lbs)
        return np.stack([each.state.last[..., 0] for each in simulator.carry_on([past], [range(1, 4)], poses_at)])

    together = steps(Simulator(inner, HEAVY, options, over=[WornGarment(moved, LIGHT)]))
    alone = [steps(Simulator(each, own, options)) for each, own in ((inner, HEAVY), (moved, LIGHT))]
    assert np.abs(np.diff(together, axis=0)).max() > 1e-3
    np.testing.assert_allclose(together, np.concatenate(alone, axis=1), rtol=0, atol=1e-6)


def test_a_garment_alone_never_looks_for_others(scene, toy_motion, toy_grid, monkeypatch):
    inner, outer, motion = swept(scene, toy_motion, toy_grid)

    def looked(*_):
        raise LookupError

    monkeypatch.setattr(SelfContact, "neighbours", looked)
    alone = Simulator(inner, HEAVY)
    assert len(list(alone.frames([motion.clip(0, 2)]))) == 2
    assert type(alone.potential) is IncrementalPotential
    with pytest.raises(LookupError):
        list(Simulator(inner, HEAVY, over=[WornGarment(outer, LIGHT)]).frames([motion.clip(0, 2)]))


def test_tight_cloth_touches_the_tight_cloth_of_another_garment_that_it_lies_on(scene, toy_grid):
    points, faces = lying(toy_grid, 0.01, 0.1, 3)
    for height, expected in ((0.003, True), (0.3, False)):
        over = wearing(scene, points + [0, height, 0], faces, TIGHT, "/over")
        potential = outfit(
            [WornGarment(wearing(scene, points, faces, TIGHT, "/in"), HEAVY), WornGarment(over, LIGHT)]
        )
        x = torch.as_tensor(np.concatenate([points, points + [0.002, 0.001, 0]]))[:, :, None]
        contacts = touching(potential, x).contacts
        assert contacts is not None
        assert (float(contacts.energy(x)) > 0) == expected
        assert (len(contacts.frame) > 0) == expected


def test_tight_cloth_stays_over_other_cloth_that_its_tether_pulls_it_through(scene, toy_grid):
    fabric = replace(LIGHT, tether=5e3, friction=0.0)
    points, faces = lying(toy_grid, 0.0, 0.2, 6)
    garments = [
        WornGarment(wearing(scene, points, faces, PINNED, "/in"), fabric),
        WornGarment(wearing(scene, points + [0.003, 0.004, 0.002], faces, TIGHT, "/over"), fabric),
    ]
    potential, x = outfit(garments), positions(garments)
    skinned = x.clone()
    skinned[len(points) :, 1] -= 0.16  # 800 Pa
    inputs = replace(touching(potential, x), skinned=skinned)
    found = minimise_from(potential, x, inputs, SolverOptions(tolerance=1e-3, iterations=300))
    gap = (found.x[len(points) :, 1] - found.x[: len(points), 1]).numpy()
    inner = np.abs((points - AWAY)[:, [0, 2]]).max(axis=1) < 0.09
    assert 0 < gap[inner].min() < 0.004


def test_cloth_that_lies_close_on_other_cloth_is_not_led_through_it(scene, toy_grid):
    points, faces = lying(toy_grid, 0.0, 0.2, 6)
    count, close = len(points), points + [0.003, 0.0045, 0.002]
    far = np.concatenate([close, close + [1.0, 0, 0]])  # the second half has a long way to go, in many rounds
    over = wearing(scene, far, np.concatenate([faces, faces + count]), TIGHT, "/over")
    potential = outfit([WornGarment(wearing(scene, points, faces, PINNED, "/in"), LIGHT), WornGarment(over, LIGHT)])
    x = torch.as_tensor(np.concatenate([points, far]))[:, :, None]
    target = x.clone()
    target[count:, 1] -= 0.02
    target[2 * count :, 1] += 0.5
    came, _ = potential.approach(x, target, StepInputs(None, torch.zeros(3, 1, dtype=torch.float64)), None)
    assert float((came - x)[2 * count :, 1].min()) > 0.05
    assert float((came[count : 2 * count, 1] - came[:count, 1]).min()) > 0


def test_a_garment_starts_where_it_was_settled_off_another(scene, toy_motion, toy_grid):
    inner, outer, motion = swept(scene, toy_motion, toy_grid)
    beside = outer.garment.mesh.points  # where it was made is on the other side of the inner one, and across it
    made = beside + [0, 0, 0.009] * (beside[:, 1:2] < 1.1)
    tangled = wearing(scene, made, outer.garment.mesh.faces, outer.classes, "/tangled")
    count, shares = inner.garment.mesh.vertex_count, []
    for start in (None, beside):
        simulator = Simulator(inner, HEAVY, over=[WornGarment(tangled, LIGHT, start)])
        (frame,) = simulator.frames([motion.clip(0, 1)])
        shares.append(crossings(inner, tangled, frame.points[None, :count], frame.points[None, count:]))
    assert shares[0] > 0 and shares[1] == 0


def test_wind_pushes_each_garment_by_its_own_drag(scene, toy_motion, toy_grid):
    inner, outer, _ = swept(scene, toy_motion, toy_grid)
    simulator = Simulator(inner, HEAVY, over=[WornGarment(outer, replace(LIGHT, drag=0.6))])
    count = inner.garment.mesh.vertex_count

    class Air:
        def velocity(self, points: np.ndarray, seconds: float) -> np.ndarray:
            return np.broadcast_to([0.0, 0.0, 2.0], points.shape)

    class World:
        gravity, air, seconds, roots = torch.zeros(3, 1, dtype=torch.float64), [Air()], [0.0], np.zeros((1, 3))

    garments = simulator.potential.garments
    found = pushed_by_wind(garments, World(), positions([WornGarment(inner, HEAVY), WornGarment(outer, LIGHT)]))
    assert found.shape == (2 * count, 3, 1)
    assert float(found[0, 2]) == pytest.approx(2.0 * HEAVY.drag / HEAVY.density)
    assert float(found[-1, 2]) == pytest.approx(2.0 * 0.6 / LIGHT.density)


def test_garments_of_two_characters_are_no_outfit(scene, crossed):
    other = scene.character.skeleton
    renamed = replace(other, joint_names=("Root", "Root/Spine", "Root/Spine/Arm"))
    strange = replace(crossed[1].scene, character=replace(scene.character, skeleton=renamed))
    with pytest.raises(SsilkError, match="garments of an outfit are worn by one character"):
        outfit([crossed[0], WornGarment(strange, LIGHT)])
