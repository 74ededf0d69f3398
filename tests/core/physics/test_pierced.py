# SPDX-License-Identifier: Apache-2.0
"""Limbs that pierce loose cloth: found by their axes, and pushed out along these, on every path."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.authoring.preflight.motion import buried_limbs
from ssilk_core.physics.collision import CollisionBody, Contacts, RayCaster, limb_axes
from ssilk_core.physics.collision.limb_axes import MAX_RADIUS, LimbPoser, body_axes, inside
from ssilk_core.physics.collision.pierced import MARGIN, SLOPE, Piercing
from ssilk_core.physics.collision.ray_casting import EDGE_TOLERANCE
from ssilk_core.physics.samples import vertex_samples
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.skin.covered_skin import CoveredSkin, ShownCounts
from ssilk_core.scene.assets import LOOSE, TIGHT, Body, Character, Mesh, Motion, Scene, Skeleton, SkinWeights
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training import parts
from ssilk_core.training.objective import Objective

CPU = torch.device("cpu")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")  # on a CPU kernels run in an interpreter
KERNELS = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="kernels need Triton")
RADIUS, LENGTH = 0.02, 0.5  # of an arm along x, which a joint at its root and one in its middle move [m]
SHEET = 0.3  # half the side of a sheet of cloth [m]


def joints(*places: tuple[float, float, float], parents: tuple[int, ...]) -> Skeleton:
    bind = np.tile(np.eye(4), (len(places), 1, 1))
    bind[:, :3, 3] = places
    rest = bind.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            rest[joint, :3, 3] -= bind[parent, :3, 3]
    return Skeleton("/arm", tuple(f"j{number}" for number in range(len(places))), np.array(parents), bind, rest)


def arm() -> tuple[Body, Skeleton]:
    shape = trimesh.creation.cylinder(radius=RADIUS, height=LENGTH, sections=12).subdivide_to_size(0.03)
    points = shape.vertices[:, [2, 0, 1]] + [LENGTH / 2, 0, 0]
    moved = (points[:, :1] > LENGTH / 2).astype(int)
    skin = SkinWeights("/arm", moved, np.ones((len(points), 1)))
    return Body(Mesh("/arm", points, shape.faces), skin), joints((0, 0, 0), (LENGTH / 2, 0, 0), parents=(-1, 0))


def sheet(at: float, kind: int, half: float, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sheet across the arm at a place along x: points, faces, classes."""
    assert rows % 2 == 0, "no vertex or edge lies on the axis"
    grid = np.linspace(-half, half, rows)
    y, z = (each.reshape(-1) for each in np.meshgrid(grid, grid + 0.003, indexing="ij"))
    number = np.arange(rows * rows).reshape(rows, rows)
    a, b, c, d = (part.reshape(-1) for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([np.full_like(y, at), y, z], axis=1), faces, np.full(len(y), kind)


def dressed(scene: Scene, rest: float, kind: int = LOOSE, half: float = SHEET, rows: int = 22) -> Scene:
    body, skeleton = arm()
    points, faces, classes = sheet(rest, kind, half, rows)
    skin = SkinWeights("/sheet", np.zeros((len(points), 1), dtype=int), np.ones((len(points), 1)))
    garment = replace(scene.garment, mesh=Mesh("/sheet", points, faces), skin=skin, classes=classes)
    no_joints = {"joint_names": (), "parents": np.zeros(0, dtype=int), "bind_transforms": np.zeros((0, 4, 4))}
    rig = replace(scene.rig, skin=skin, **no_joints)
    return Scene(Character("/arm", skeleton, (body,)), garment, rig)


def with_board(scene: Scene) -> tuple[Body, Skeleton]:
    """The arm, and a board two metres away that a root joint of its own moves."""
    (body,), board = scene.character.bodies, trimesh.creation.box((0.1, 1.2, 1.2))
    points = np.concatenate([body.mesh.points, board.vertices + [2.0, 0.0, 0.02]])
    faces = np.concatenate([body.mesh.faces, board.faces + body.mesh.vertex_count])
    moved = np.concatenate([body.skin.indices, np.full((len(board.vertices), 1), 2)])
    both = Body(Mesh("/arm", points, faces), SkinWeights("/arm", moved, np.ones((len(points), 1))))
    return both, joints((0, 0, 0), (LENGTH / 2, 0, 0), (2, 0, 0), parents=(-1, 0, -1))


def still(count: int, frames: int = 1) -> torch.Tensor:
    return torch.eye(3, 4)[None, :, :, None].repeat(count, 1, 1, frames)


def test_axes_run_along_bones_to_the_tips_of_the_skin():
    body, skeleton = arm()
    axes = body_axes(body, skeleton)
    assert axes.tips.tolist() == [1]
    path = [number for number in axes.paths[0] if number < len(axes.joints)]
    ends = axes.ends[path]
    np.testing.assert_allclose(ends[0, 0], [0, 0, 0])
    np.testing.assert_allclose(ends[-1, 1], [LENGTH, 0, 0], atol=1e-9)
    np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1], atol=1e-12)  # no gap in which cloth could pass
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(LENGTH)
    np.testing.assert_allclose(axes.beyond[0][: len(path)], [LENGTH / 2, 0], atol=1e-9)
    assert (axes.radii <= MAX_RADIUS).all() and axes.radii[path[-1]] == pytest.approx(RADIUS, rel=0.05)


def test_helper_joints_that_move_no_skin_are_no_limbs():
    body, _ = arm()
    skeleton = joints((0, 0, 0), (LENGTH / 2, 0, 0), (2, 0, 0), (0, 3, 0), parents=(-1, 0, 1, 0))
    axes = body_axes(body, skeleton)
    assert axes.tips.tolist() == [1] and axes.ends.max() <= LENGTH + 1e-9


def test_only_loose_cloth_that_was_not_crossed_at_rest_counts(scene):
    assert limb_axes(dressed(scene, 0.7)) is not None
    assert limb_axes(dressed(scene, 0.3)) is None  # the arm passes through it in the bind pose
    assert limb_axes(dressed(scene, 0.7, TIGHT)) is None


def test_an_odd_number_of_crossings_pierces(scene):
    whole = dressed(scene, 0.7)
    axes = limb_axes(whole)
    count = whole.garment.mesh.vertex_count
    points = torch.tensor(whole.garment.mesh.points, dtype=torch.float32)
    once = points - torch.tensor([0.4, 0, 0])
    folded = points.clone()  # two sheets in one: the upper half is laid over the lower one
    folded[:, 0] = 0.32 + 0.05 * torch.sign(points[:, 1] + 0.101)
    folded[:, 1] = (points[:, 1] + 0.101).abs() - 0.101
    x = torch.stack([points, once, folded], dim=-1)
    limbs = LimbPoser(axes, _body(whole)[0], CPU).pose(still(2, 3))
    found = Piercing(whole, vertex_samples(count), device=CPU).find(x, limbs)
    assert (found.radius > 0)[0].tolist() == [False, True, False]
    np.testing.assert_allclose(found.point[0, :, 1], [0.7, 0, 0], atol=0.03)  # of the sheet at rest
    np.testing.assert_allclose(found.direction[0, :, 1], [1, 0, 0], atol=1e-6)
    assert float(found.tip[0, 1]) == pytest.approx(LENGTH)
    assert float(found.radius[0, 1]) == pytest.approx(RADIUS + MARGIN, rel=0.05)
    covering = dressed(scene, 0.55)  # the tip: without covered skin nothing is counted
    counts = ShownCounts.of(CoveredSkin(covering, device=CPU).states(x, still(2, 3)))
    assert counts.pierced is not None and counts.pierced.any(0).tolist() == [False, True, False]


def test_a_limb_whose_tip_lies_in_another_part_of_the_body_does_not_count(scene):
    """A board, moved by a joint of its own, comes over the tip of the arm, which cloth lies across."""
    whole = dressed(scene, 0.7)
    body, skeleton = with_board(whole)
    axes = body_axes(body, skeleton)
    hand = axes.tips.tolist().index(1)
    character = still(3, 3)
    character[2, 0, 3] = torch.tensor([0.0, LENGTH - 2, LENGTH / 2 - 2])  # away, at the tip, at the elbow
    for shift in (0.0, 30.0):  # anywhere in the world
        character[:, 0, 3] += shift
        assert LimbPoser(axes, body, CPU).buried(character)[hand].tolist() == [False, True, False]
    character[:, 0, 3] -= 30
    limbs = LimbPoser(axes, body, CPU).pose(character)
    assert limbs.buried[hand].tolist() == [False, True, False]
    assert limbs.select(torch.tensor([1])).buried.shape == (len(axes.tips), 1)
    points = torch.tensor(whole.garment.mesh.points, dtype=torch.float32)[..., None].repeat(1, 1, 3)
    points[:, 0] -= 0.4
    found = Piercing(whole, vertex_samples(len(points)), device=CPU).find(points, limbs)
    assert (found.radius[hand] > 0).tolist() == [True, False, True]

    skin = SkinWeights("/tip", np.ones((3, 1), dtype=int), np.ones((3, 1)))
    only = Body(Mesh("/tip", axes.ends[axes.last[hand], 1] + 0.01 * np.eye(3), np.array([[0, 1, 2]])), skin)
    assert not LimbPoser(axes, only, CPU).buried(character).any()  # all of it is near a tip


def test_preflight_tells_which_limbs_are_buried_in_which_motion(scene):
    whole = dressed(scene, 0.7)
    body, skeleton = with_board(whole)
    whole = replace(whole, character=Character("/arm", skeleton, (body,)))
    translations = np.tile(skeleton.rest_transforms[:, :3, 3], (20, 1, 1))
    turns = np.tile([1.0, 0, 0, 0], (20, 3, 1))
    apart = Motion("/apart", 10.0, turns, translations)
    translations = translations.copy()
    translations[:5, 2, 0] = LENGTH  # the board, in a quarter of the frames
    (found,) = buried_limbs(whole, [apart, Motion("/pressed", 10.0, turns, translations)])
    assert found.code == "buried-limbs" and found.severity == "warning" and found.indices == (1,)
    assert "in 15.0% of the frames" in found.found and "j1 15.0%" in found.found
    assert "most in /pressed, 30.0%" in found.found  # every second frame is looked at
    assert not [*buried_limbs(whole, [])]
    assert not [*buried_limbs(whole, [apart])]


def test_a_limb_that_bends_past_the_skin_near_its_tip_is_not_buried():
    """An arm bent back onto itself: its axis leaves its own skin once, and where it would come back is too near."""
    body, skeleton = arm()
    axes, character = body_axes(body, skeleton), still(2)
    turn = torch.tensor([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])  # about the elbow
    character[1, :, :3, 0], character[1, 0, 3, 0] = turn, LENGTH
    character[1, 1, 3, 0] = 3 * RADIUS  # beside the upper arm
    assert not LimbPoser(axes, body, CPU).buried(character).any()
    character[1, 1, 3, 0] = 0  # the hand lies in the upper arm
    assert LimbPoser(axes, body, CPU).buried(character).all()


def test_what_is_inside_at_rest_does_not_count_as_buried(scene):
    body, _ = with_board(dressed(scene, 0.7))
    near = joints((0, 0, 0), (LENGTH / 2, 0, 0), (0, 0, 0), parents=(-1, 0, -1))
    points = body.mesh.points - np.where(body.skin.indices == 2, [2 - LENGTH, 0, 0], 0)
    pressed = replace(body, mesh=Mesh("/arm", points, body.mesh.faces))  # the hand lies in the board at rest
    axes = body_axes(pressed, near)
    hand = axes.tips.tolist().index(1)
    assert not LimbPoser(axes, pressed, CPU).buried(still(3))[hand].any()


def test_a_point_is_inside_where_the_surface_winds_around_it():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    x = torch.tensor(np.stack([ball.vertices, 2 * ball.vertices], axis=-1), dtype=torch.float32)
    points = torch.tensor([[0.0, 0, 0], [0.28, 0, 0], [0.4, 0, 0], [0.7, 0, 0]])[..., None].expand(-1, -1, 2)
    faces = torch.tensor(np.array(ball.faces))
    for each in (faces, faces.flip(1), faces[faces.min(dim=1).values > 0]):  # closed, inside out, with a hole
        found = inside(points, x, each)
        assert found.tolist() == [[True, True], [True, True], [False, True], [False, False]]


def test_training_leaves_buried_limbs_out_as_each_pose_does(monkeypatch, scene):
    """Frames of the arm through a sheet, in some of which its hand lies in a board."""
    whole = dressed(scene, 0.7)
    body, skeleton = with_board(whole)
    axes = body_axes(body, skeleton)
    hand = axes.tips.tolist().index(1)
    poser, character = LimbPoser(axes, body, CPU), still(3, 5)
    character[2, 0, 3] = torch.tensor([0.0, LENGTH - 2, 0.0, LENGTH - 2, 0.0])
    bank = SimpleNamespace(frame_count=5, character=lambda frames: character[..., frames])
    collision = CollisionBody(body, 3, limbs=axes, device=CPU)
    monkeypatch.setattr(parts, "POSED_AT_ONCE", 2)
    found = parts.TrainingParts(None, bank, None, collision, None, 0, CPU).buried
    assert torch.equal(found, poser.buried(character))
    assert found[hand].tolist() == [False, True, False, True, False]
    assert parts.TrainingParts(None, bank, None, None, None, 0, CPU).buried is None

    objective = Objective.__new__(Objective)  # only what finds planes
    objective.body, objective.surface, objective.clearance, objective.buried = collision, True, 0.0, found
    objective.inner = None
    objective.contacts = Contacts(whole, vertex_samples(whole.garment.mesh.vertex_count), device=CPU)
    x = torch.tensor(whole.garment.mesh.points, dtype=torch.float32)[..., None] - torch.tensor([0.4, 0, 0])[:, None]
    frames = torch.tensor([1, 0])
    normal, _ = objective._planes(x.expand(-1, -1, 2), character[..., frames], objective._buried(frames))
    pushed = ((normal[:, 0] - SLOPE).abs() < 1e-6).any(0)
    assert pushed.tolist() == [False, True]


def test_pierced_cloth_is_pushed_along_the_limb_by_the_energy_of_its_depth(scene):
    """d = -SLOPE w, w the way to the tip: its gradient is along the bone, and the rest of the cloth is unchanged."""
    whole = dressed(scene, 0.7)
    body = CollisionBody(*_body(whole), limbs=limb_axes(whole), device=CPU)
    x = torch.tensor(whole.garment.mesh.points, dtype=torch.float32)[..., None] - torch.tensor([0.4, 0, 0])[:, None]
    contacts = Contacts(whole, vertex_samples(len(x)), device=CPU)
    posed = body.pose(still(2))
    normal, offset = contacts.planes(x, posed)
    near = (normal[:, :, 0] - torch.tensor([SLOPE, 0, 0])).abs().amax(1) < 1e-6
    assert 4 <= int(near.sum()) < 40
    assert float(x[near, 1:, 0].norm(dim=1).max()) < RADIUS + MARGIN + 0.02  # around a triangle of that size
    distance = (normal * x).sum(1) - offset
    np.testing.assert_allclose(distance[near], -SLOPE * 0.2, atol=1e-6)
    plain = Contacts(whole, vertex_samples(len(x)), device=CPU).planes(x, replace(posed, limbs=None))
    assert torch.equal(normal[~near], plain[0][~near]) and torch.equal(offset[~near], plain[1][~near])
    smoothed = contacts.smoothed(x, posed)
    assert torch.equal(smoothed.normal[near], normal[near]) and not smoothed.curvature[near].any()
    met, whole_body = contacts.distances(x, posed)
    assert torch.equal(met, whole_body) and float(met.min()) > -RADIUS - 1e-3  # energies tell of the skin alone
    drafted = body.pose(still(2), surface=False)
    assert drafted.limbs is None


def _body(scene: Scene) -> tuple[Body, int]:
    return scene.character.merged_body(), scene.character.skeleton.joint_count


def test_the_force_is_minus_the_gradient_of_the_energy(scene):
    whole = dressed(scene, 0.7)
    potential = IncrementalPotential(whole, Fabric("default"), device=CPU)
    posed = CollisionBody(*_body(whole), limbs=limb_axes(whole), device=CPU).pose(still(2))
    x = torch.tensor(whole.garment.mesh.points)[..., None] - torch.tensor([0.4, 0, 0])[:, None]
    inputs = StepInputs(posed, torch.zeros(3, 1, dtype=torch.float64))

    def energy(moved: torch.Tensor) -> float:
        return float(potential.energy(moved, inputs, potential.body_distance(moved, inputs)))

    gradient = potential.gradient(x, inputs, potential.body_distance(x, inputs))
    along = torch.zeros_like(x)
    along[:, 0] = 1.0
    slope, step = float((gradient * along).sum()), 1e-5
    assert slope < 0  # towards the tip the energy falls
    assert (energy(x + step * along) - energy(x - step * along)) / (2 * step) == pytest.approx(slope, rel=1e-3)


def test_cloth_that_is_held_as_pierced_stays_so_wherever_it_goes(scene):
    """Where another triangle is crossed the energy jumps, and where none is any more: not where a step holds on."""
    whole = dressed(scene, 0.7)
    potential = IncrementalPotential(whole, Fabric("default"), device=CPU)
    posed = CollisionBody(*_body(whole), limbs=limb_axes(whole), device=CPU).pose(still(2))
    x = torch.tensor(whole.garment.mesh.points)[..., None] - torch.tensor([0.4, 0, 0])[:, None]
    found = StepInputs(posed, torch.zeros(3, 1, dtype=torch.float64))
    held = replace(found, pierced=potential.contacts.pierced(potential.cloth.positions(x), posed))

    def energy(inputs: StepInputs, aside: float) -> float:
        moved = x + torch.tensor([0.0, aside, 0.0], dtype=x.dtype)[:, None]
        return float(potential.collision(moved, potential.body_distance(moved, inputs)).sum())

    assert energy(held, 0.0) == energy(found, 0.0) > 0  # nothing else is deep
    assert energy(held, 1.0) == pytest.approx(energy(held, 0.5), rel=1e-5) and energy(found, 1.0) == 0
    assert energy(held.select(torch.tensor([0])), 1.0) == energy(held, 1.0)
    turned = still(2)
    turned[:, :, :3, 0] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # the arm points up
    limbs = CollisionBody(*_body(whole), limbs=limb_axes(whole), device=CPU).pose(turned).limbs
    along = held.pierced.on(limbs)
    np.testing.assert_allclose(along.direction[0, :, 0], [0, 1, 0], atol=1e-6)
    assert float(along.tip) == pytest.approx(LENGTH) and float(along.radius) == float(held.pierced.radius) > 0
    assert not along.on(replace(limbs, buried=~limbs.buried)).radius.any()


def test_crossings_are_those_that_solving_finds():
    random = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    x = ball.vertices[:, :, None] + random.normal(0, 0.01, (len(ball.vertices), 3, 2))
    starts, ends = random.uniform(-0.5, 0.5, (2, 40, 3, 2))
    caster = RayCaster(Mesh("/ball", ball.vertices, ball.faces), device=CPU)
    asked = [torch.tensor(values, dtype=torch.float32) for values in (starts, ends, x)]
    counts, last, triangle = caster.crossings(*asked)
    for frame in range(2):
        corners = x[ball.faces, :, frame]
        along = ends[..., frame] - starts[..., frame]
        sides = np.stack(
            np.broadcast_arrays(
                (corners[:, 1] - corners[:, 0])[None], (corners[:, 2] - corners[:, 0])[None], -along[:, None]
            ),
            axis=-1,
        )
        u, v, t = np.moveaxis(
            np.linalg.solve(sides, (starts[:, None, :, frame] - corners[None, :, 0])[..., None])[..., 0], -1, 0
        )
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
        np.testing.assert_array_equal(counts[:, frame], met.sum(axis=1))
        np.testing.assert_allclose(last[:, frame], np.where(met, t, 0).max(axis=1), atol=1e-5)
        np.testing.assert_array_equal(triangle[:, frame], np.where(met, t, 0).argmax(axis=1))
    assert 10 < int((counts > 0).sum()) < 80


@KERNELS
def test_kernels_find_and_push_as_the_reference_does(scene):
    from ssilk_core.physics.kernels.crossings import crossings_kernel, replace_planes_kernel

    whole = dressed(scene, 0.7, half=0.12, rows=8)  # 98 triangles, in two programs: the interpreter is slow
    body, skeleton = with_board(whole)
    axes, character = body_axes(body, skeleton), still(3, 4)
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the board beside the arm, its axis along x as well
    character[2, :, :3, :3], character[2, :, 3, :3] = turn[..., None], torch.tensor([[0.2], [0.0], [2.07]])
    points = torch.tensor(whole.garment.mesh.points, dtype=torch.float32)
    x = torch.stack([points - torch.tensor([by, 0, 0]) for by in (0.0, 0.3, -0.2, 0.3)], dim=-1)
    limbs = LimbPoser(axes, body, CPU).pose(character)
    assert (len(axes.tips), len(character), x.shape[2], len(limbs.start)) == (2, 3, 4, 5)  # no two of them alike
    piercing = Piercing(whole, vertex_samples(len(x)), device=CPU)
    counts, _, triangle = piercing._caster.crossings(limbs.start, limbs.end, x)
    asked = (each.to(DEVICE) for each in (limbs.start, limbs.end, x, piercing._caster.faces))
    own_counts, own_triangle = crossings_kernel(*asked)
    assert torch.equal(own_counts.cpu().long(), counts) and counts.any()
    assert torch.equal(own_triangle.cpu(), triangle)
    pierced = piercing.find(x, limbs)
    hand = axes.tips.tolist().index(1)
    found = pierced.radius > 0
    assert found[hand].tolist() == [False, True, False, True]
    assert found[1 - hand].tolist() == [True, True, False, False]
    planes = torch.zeros_like(x), torch.zeros(len(x), 4), torch.ones(len(x), 3, 3, 4)
    own = [each.clone().to(DEVICE) for each in planes]
    piercing.replace_planes(x, limbs, *planes)
    where = tuple(each.to(DEVICE) for each in (pierced.point, pierced.direction, pierced.tip, pierced.radius))
    replace_planes_kernel(piercing._rest.to(DEVICE), piercing._loose.to(DEVICE), where, SLOPE, *own)
    for mine, theirs in zip(own, planes):
        assert torch.equal(mine.cpu(), theirs) and theirs[..., 1].any() and theirs[..., 0].any()
    assert not planes[2].all()  # what is pushed along a limb is not bent


def test_the_loop_crosses_what_the_reference_does():
    pytest.importorskip("numba")
    from ssilk_core.physics.loops.crossings import crossings_loop

    ball, generator = trimesh.creation.icosphere(subdivisions=2, radius=0.2), torch.Generator().manual_seed(3)
    caster = RayCaster(Mesh("/ball", ball.vertices, ball.faces), device=CPU)
    x = torch.tensor(ball.vertices, dtype=torch.float32)[..., None] * torch.tensor([1.0, 0.7, 1.3])
    starts, ends = 0.3 * torch.randn(2, 40, 3, 3, generator=generator)
    ends[0] = starts[0]  # no length
    expected, _, triangle = caster.crossings(starts, ends, x)
    counts, last = crossings_loop(starts, ends, x, caster.faces, EDGE_TOLERANCE)
    assert torch.equal(counts, expected) and set(counts.unique().tolist()) == {0, 1, 2}
    assert torch.equal(last, triangle)
