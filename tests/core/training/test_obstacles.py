# SPDX-License-Identifier: Apache-2.0
"""Obstacles that training draws around characters, and what the network sees of them."""

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import ModelFile, model_file
from ssilk_core.network.descriptors import place_of_hub, pose_features
from ssilk_core.network.model.descriptors import proximity_length
from ssilk_core.network.parameters import parameter_shapes, seeing_more
from ssilk_core.network.proximity import proximity, proximity_size, proximity_vectors
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.sight import seen_proximity
from ssilk_core.network.settings import PROXIMITY_POINTS, ModelConfig
from ssilk_core.physics.world.surface import CollisionSurface
from ssilk_core.scene.assets import Collider, ShotWorld
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import motion_transforms, skin_points
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.obstacles import LARGE, SKIN, ObstacleDrawer, Obstacles
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.windows import WindowSampler

CPU, JOINTS, POINTS = torch.device("cpu"), np.arange(3), 7
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"  # on a CPU kernels run in Triton's interpreter
KERNELS = pytest.mark.skipif(find_spec("triton") is None, reason="kernels need Triton")


def one_box(turn: np.ndarray, centre, half, radius: float) -> Obstacles:
    """A rounded box in one frame."""
    numbers = (turn, np.array(centre), np.array(half), np.array(radius))
    return Obstacles(*(torch.tensor(each, dtype=torch.float32)[None, None] for each in numbers))


def boxes() -> dict[str, tuple[Obstacles, trimesh.Trimesh]]:
    """Rounded boxes, and meshes of the same surfaces; those of curved ones are fine."""
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.9]))[:3, :3]
    place, place[:3, :3], place[:3, 3] = np.eye(4), turn, (0.1, -0.2, 0.3)
    along = trimesh.geometry.align_vectors([0, 0, 1], [1, 0, 0])
    capsule = trimesh.creation.capsule(height=0.6, radius=0.1, count=(128, 128))
    capsule.apply_translation([0, 0, -capsule.bounds.mean(axis=0)[2]])
    meshes = {
        "box": trimesh.creation.box((0.4, 0.6, 0.2)),
        "capsule": capsule.apply_transform(along),
        "ball": trimesh.creation.icosphere(subdivisions=5, radius=0.25),
        # A box whose radius is negative is the smaller one.
        "shrunk box": trimesh.creation.box((0.3, 0.5, 0.1)),
    }
    sizes = {
        "box": ((0.2, 0.3, 0.1), 0.0),
        "capsule": ((0.3, 0, 0), 0.1),
        "ball": ((0, 0, 0), 0.25),
        "shrunk box": ((0.2, 0.3, 0.1), -0.05),
    }
    return {
        name: (one_box(turn, place[:3, 3], *size), meshes[name].apply_transform(place))
        for name, size in sizes.items()
    }


@pytest.fixture(scope="module")
def seeing(scene, toy_model):
    """A network that sees colliders."""
    return toy_model(scene, proximity_points=POINTS)


@pytest.fixture(scope="module")
def bank(scene, toy_motion):
    return build_bank(
        [toy_motion(scene, 40), toy_motion(scene, 25, speed=3.0)], scene.character.skeleton, JOINTS, 30, CPU
    )


def drawer(scene, model, bank, share: float = 1.0, seed: int = 0) -> ObstacleDrawer:
    hub = place_of_hub(scene.character.skeleton, model.joints)
    return ObstacleDrawer(model, bank, hub, share, torch.Generator().manual_seed(seed))


def looked(model, motion, *colliders: Collider) -> np.ndarray | None:
    """What a network sees of colliders of a shot."""
    player = Player(model_file(model, FABRICS["silk"], {}))
    return seen_proximity(ShotWorld(30.0, colliders), motion, player)


@pytest.mark.parametrize("name", boxes())
def test_distances_are_those_to_the_surface_and_directions_lead_away(name) -> None:
    box, mesh = boxes()[name]
    queries = np.random.default_rng(1).uniform(-0.8, 0.8, (400, 3)) + mesh.bounds.mean(axis=0)
    points = torch.tensor(queries, dtype=torch.float32)[:, :, None]
    distance, away = (each[..., 0].numpy() for each in box.nearest(points))
    surface = CollisionSurface(name, np.array(mesh.vertices), np.array(mesh.faces)).at(np.array(mesh.vertices))
    expected = surface.distance(queries).distance
    exact = expected > 0
    if name == "shrunk box":  # outside of it distances are those to its faces, and at most the true ones
        assert (distance[exact] <= expected[exact] + 1e-5).all()
        exact = expected < 0
    np.testing.assert_allclose(distance[exact], expected[exact], atol=3e-4)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 1, atol=1e-5)
    moved = box.nearest(points + 1e-3 * torch.tensor(away)[:, :, None])[0][:, 0].numpy()
    near_edges = np.abs(moved - distance - 1e-3) > 1e-5
    assert near_edges.mean() < 0.02
    assert np.array_equal(box.distance(points, 0)[:, 0].numpy(), distance)


def test_of_several_the_nearest_counts() -> None:
    (one, _), (other, _) = boxes()["box"], boxes()["ball"]
    far = Obstacles(other.turn, other.centre + 1, other.half, other.radius)
    both = Obstacles(*(torch.cat(parts) for parts in zip(one.parts, far.parts)))
    points = torch.rand(50, 3, 1) * 2 - 0.5
    distance, away = both.nearest(points)
    alone = [each.nearest(points) for each in (one, far)]
    assert torch.equal(distance, torch.minimum(alone[0][0], alone[1][0]))
    first = alone[0][0] <= alone[1][0]
    assert first.any() and not first.all()
    assert torch.equal(away, torch.where(first[:, None], alone[0][1], alone[1][1]))


@KERNELS
def test_kernels_find_what_their_references_find() -> None:
    from ssilk_core.physics.kernels.boxes import box_clearance_kernel, nearer_planes_kernel, nearest_box_kernel

    draw = torch.Generator().manual_seed(0)
    turn, half = torch.linalg.qr(torch.randn(2, 37, 3, 3, generator=draw))[0], torch.rand(2, 37, 3, generator=draw)
    half[1, ::2, 1:] = 0  # capsules
    drawn = turn, torch.randn(2, 37, 3, generator=draw), half, 0.3 * torch.rand(2, 37, generator=draw)
    obstacles, points = Obstacles(*drawn), 1.5 * torch.randn(21, 3, 37, generator=draw)
    normal, offset = torch.nn.functional.normalize(torch.randn(21, 3, 37), dim=1), torch.randn(21, 37)
    distance, away = obstacles.nearest(points)
    assert (distance < 0).any() and (distance > 0).any()
    nearer = distance < (normal * points).sum(1) - offset
    assert nearer.any() and not nearer.all()
    planes = obstacles.nearer_planes(points, normal, offset, 0.005)
    on_device = [points.to(DEVICE), tuple(part.to(DEVICE) for part in obstacles.parts)]
    found = [normal.to(DEVICE).clone(), offset.to(DEVICE).clone()]
    nearer_planes_kernel(*on_device, *found, 0.005)
    for one, other in zip((*nearest_box_kernel(*on_device), *found), (distance, away, *planes)):
        torch.testing.assert_close(one.cpu(), other, atol=1e-5, rtol=1e-5)
    least = box_clearance_kernel(*on_device).cpu()
    torch.testing.assert_close(least, torch.stack([obstacles.distance(points, box).amin(0) for box in range(2)]))


def test_the_body_stays_outside_and_the_share_without_has_nothing_near(scene, seeing, bank) -> None:
    draws = drawer(scene, seeing, bank, share=0.6)
    frames = torch.arange(0, 15)[:, None] + torch.randint(0, 10, (1, 300), generator=torch.Generator().manual_seed(2))
    found = draws.draw(frames, torch.tensor([0.0, -1, 0]).expand(300, 3))
    absent = found.radius < -LARGE
    assert 0.3 < absent.all(dim=0).float().mean() < 0.5
    # Of obstacles beside the garment some have no room.
    assert 0.5 * 0.6 * 0.25 < (~absent).all(dim=0).float().mean() < 1.2 * 0.6 * 0.25
    body = scene.character.merged_body()
    for number in range(0, 300, 7):
        for frame in frames[:, number].tolist():
            matrices = bank.character(torch.tensor([frame]))[..., 0].double().numpy()
            square = np.concatenate([matrices, np.tile([[[0, 0, 0, 1]]], (3, 1, 1))], axis=1)
            skinned = skin_points(body.mesh.points, body.skin, square[None])[0]
            points = torch.tensor(skinned, dtype=torch.float32)[:, :, None]
            own = Obstacles(*(each[:, number : number + 1] for each in found.parts))
            assert own.nearest(points)[0].min() > SKIN - 1e-3
    # Most floors touch the body.
    touching = draws._clearance(found, frames)[0][~absent[0]]
    assert 0.4 < (touching.abs() < 1e-3).float().mean() < 0.8


def test_bodies_that_are_turned_over_mostly_lie_on_a_level_floor(scene, seeing, bank) -> None:
    draws = drawer(scene, seeing, bank, share=1e-3)
    frames = torch.arange(0, 6)[:, None].expand(6, 400)
    turn = torch.linspace(0, np.pi, 400)
    gravity = torch.stack([turn.sin(), -turn.cos(), torch.zeros(400)], dim=1)
    found = draws.draw(frames, gravity)
    floor = found.radius[0] > -LARGE
    turned = turn > 0.8
    assert 0.5 < floor[turned].float().mean() < 0.7
    assert floor[~turned].float().mean() < 0.05
    lies = floor & turned
    up = found.turn[0, :, :, 0]
    assert torch.allclose(up[lies], -gravity[lies], atol=1e-6)
    assert draws._clearance(found, frames)[0][lies].abs().max() < 1e-3


def test_an_obstacle_in_the_way_draws_back_and_others_stay(scene, seeing, bank) -> None:
    draws = drawer(scene, seeing, bank)
    first = torch.arange(0, 5)[:, None].expand(5, 64)
    found = draws.draw(first, torch.tensor([0.0, -1.0, 0.0]).expand(64, 3))
    later = draws.drawn_back(found, first + 20)
    moved = later.radius < found.radius
    assert moved.any() and not moved.all()
    assert torch.equal(later.radius <= found.radius, torch.ones_like(moved))
    assert (draws._clearance(later, first + 20) > -1e-4).all()


def test_the_network_sees_in_training_what_it_sees_of_the_same_collider_in_a_shot(scene, seeing, toy_motion) -> None:
    """A box as an obstacle of training, and as a mesh of a stage; one that no network saw is all zeros."""
    motion = toy_motion(scene, 12, speed=2.0)
    skeleton = scene.character.skeleton
    assert proximity_size(scene, seeing.config) == 3 * POINTS
    box = trimesh.creation.box((0.5, 0.4, 0.3))
    place = np.eye(4)
    place[:3, :3] = trimesh.transformations.random_rotation_matrix(np.array([0.7, 0.1, 0.4]))[:3, :3]
    place[:3, 3] = (0.05, 1.0, -0.3)
    whole = np.ones(1, dtype=bool)
    collider = Collider("/box", np.array(box.faces), np.array(box.vertices)[None], place[None], whole)
    near = looked(seeing, motion, collider)
    seen = pose_features(replace(motion, proximity=near), skeleton, JOINTS).proximity
    bank = build_bank([motion], skeleton, JOINTS, 30.0, CPU)
    start = motion_transforms(motion, skeleton.parents)[0, skeleton.hub, :3, 3]  # where the bank has its origin
    own = one_box(place[:3, :3], place[:3, 3] - start, (0.25, 0.2, 0.15), 0.0).repeated(12)
    draws, frames = drawer(scene, seeing, bank), torch.arange(12)
    met = draws.near(own, frames, torch.tensor([0.0, -1.0, 0.0]).expand(12, 3))
    trained = draws.seen(met, frames)
    assert np.abs(seen).max() > 0.5
    np.testing.assert_allclose(trained.numpy(), seen, atol=2e-4)
    hubs = motion_transforms(motion, skeleton.parents)[:, skeleton.hub, :3, 3]
    planes = met.planes(POINTS).permute(2, 0, 1).numpy()
    # About the root of each frame, and about where the bank has its origin.
    height = near[..., 4] + (near[..., :3] * (hubs - start)[:, None]).sum(axis=2)
    np.testing.assert_allclose(planes, np.concatenate([near[..., :3], height[..., None]], axis=2), atol=2e-4)
    assert looked(seeing, motion) is None


def test_colliders_beyond_the_reach_are_not_searched(scene, seeing, toy_motion, monkeypatch) -> None:
    """A stage may have a thousand props; those near the character count, wherever they move."""
    motion, whole, still = toy_motion(scene, 6), np.ones(1, dtype=bool), np.eye(4)[None]
    box = trimesh.creation.box((0.2, 0.3, 0.4))

    def prop(name: str, place, moves: np.ndarray = still) -> Collider:
        return Collider(name, np.array(box.faces), (np.array(box.vertices) + place)[None], moves, whole)

    def seen(*props: Collider) -> np.ndarray:
        found = looked(seeing, motion, *props)
        assert found is not None
        return found

    comes = np.tile(np.eye(4), (6, 1, 1))
    comes[:3, 0, 3] = 40.0
    near = prop("/near", (0.1, 0.7, 0.3)), prop("/comes", (0.3, 0.6, 0.0), comes)
    alone = seen(*near)
    assert np.abs(alone[2] - alone[3]).max() > 0.1
    built: list[str] = []
    start = CollisionSurface.__init__
    monkeypatch.setattr(
        CollisionSurface, "__init__", lambda own, path, *rest: (built.append(path), start(own, path, *rest))[1]
    )
    far = [prop(f"/far{number}", (30.0 + number, 0.0, 0.0)) for number in range(5)]
    np.testing.assert_array_equal(seen(*far, *near), alone)
    assert built == ["/near", "/comes"]


def test_what_is_not_near_is_not_seen_and_what_holds_a_point_is_seen_from_inside() -> None:
    """A floor at the height of 0.3 m, about a root at 1 m, for a garment of 2 m."""
    height = np.array([3.0, 0.5, 0.4, 0.3, -0.7, -5.0])
    points = np.stack([np.zeros(6), height, np.ones(6)], axis=1)
    away = np.tile([0.0, 1.0, 0.0], (6, 1))
    near = proximity(points, height - 0.3, away, np.array([0.0, 1.0, 0.0]), 2.0)
    np.testing.assert_allclose(near[:, 3], [1, 0.1, 0.05, 0, -0.5, -2.65])
    # The plane of the floor is 0.7 m below the root, but for what is so far away that it is not known.
    np.testing.assert_allclose(near[:, 4], [0, -0.7, -0.7, -0.7, -0.7, -0.7])
    vectors = proximity_vectors(near)
    np.testing.assert_allclose(vectors[:, 1], [0, 0, 0.25, 1, 2, 2], atol=1e-12)
    assert not vectors[:, [0, 2]].any()
    length = proximity_length(torch.tensor(near[:, 3])).numpy()
    np.testing.assert_allclose(length, vectors[:, 1], atol=1e-12)


@pytest.mark.parametrize("given", [{}, {"scheme": "verlet", "feedback_proxies": True}])
def test_a_network_that_learns_to_see_begins_as_it_was(scene, toy_model, given) -> None:
    before = toy_model(scene, feedback_points=3, **given)
    after = toy_model(scene, proximity_points=POINTS, feedback_points=5, **given)
    kept = {name: value.numpy() for name, value in before.state_dict().items()}
    more = seeing_more(kept, scene, before.config, after.config)
    assert {name: value.shape for name, value in more.items()} == parameter_shapes(scene, after.config, JOINTS)
    after.load_state_dict({name: torch.tensor(value) for name, value in more.items()})
    static = torch.randn(4, before.initialiser[0].in_features)
    pose = torch.cat([static, torch.randn(4, before.described - static.shape[1])], dim=1)
    rest, seen = before.initial(static), torch.randn(4, after.feedback.size)
    seen[:, 3 * 3 : 5 * 3] = 0  # their size bounds what S may give
    known = torch.cat([seen[:, : 3 * 3], seen[:, 5 * 3 :]], dim=1)  # proxies come after points
    blind = before.step(rest, rest + 0.1, rest, pose, known)
    for near in (torch.zeros(4, after.proximity), torch.rand(4, after.proximity)):
        given = torch.cat([near, static], dim=1), torch.cat([near, pose], dim=1)
        torch.testing.assert_close(after.initial(given[0]), rest)
        torch.testing.assert_close(after.step(rest, rest + 0.1, rest, given[1], seen), blind)
    torch.testing.assert_close(after.initial(static), rest)  # descriptors without have nothing near


def test_obstacles_go_on_with_their_windows_and_are_restored(scene, seeing, bank) -> None:
    config = TrainConfig(batch=8, window=5, state_reuse=0.7, collider_fraction=0.8)

    def sampler(seed: int) -> WindowSampler:
        dice = torch.Generator().manual_seed(seed)
        hub = place_of_hub(scene.character.skeleton, seeing.joints)
        draws = ObstacleDrawer(seeing, bank, hub, config.collider_fraction, dice)
        return WindowSampler(bank, config, 3, dice, draws)

    one, other = sampler(1), sampler(2)
    before = [each.clone() for each in one.obstacles.parts]
    one.advance(torch.zeros(2, 8, 3))
    assert one.carried.any() and not one.carried.all()
    for old, new in zip(before[:3], one.obstacles.parts):
        assert torch.equal(old[:, one.carried], new[:, one.carried])
        assert not torch.equal(old[:, ~one.carried], new[:, ~one.carried])
    other.restore({name: value.clone() for name, value in one.state().items()})
    for each in (one, other):
        each.advance(torch.ones(2, 8, 3))
    assert all(torch.equal(a, b) for a, b in zip(one.state().values(), other.state().values()))


def test_floors_of_single_poses_are_level_in_wind(scene, seeing, bank) -> None:
    draws = drawer(scene, seeing, bank)
    config = TrainConfig(batch=4, window=5, wind_fraction=1.0, rotated_fraction=0.0, collider_fraction=1.0)
    sampler = WindowSampler(bank, config, 3, draws.generator, draws)
    frames, pulled, direction = sampler.poses(400)
    assert (pulled - direction).norm(dim=1).min() > 0  # it blows in all of them
    found = sampler.obstacles_at(frames, direction)
    up = found.turn[0, found.radius[0] > -LARGE, :, 0]
    assert 0.5 < (up[:, 1] > 1 - 1e-6).float().mean() < 0.7


def test_cloth_meets_obstacles(scene, seeing, toy_motion, toy_objective, bank) -> None:
    """A wall through the cloth pushes what is behind it, and nothing else."""
    objective = toy_objective(scene, seeing, toy_motion(scene, 20))
    objective.drawer = drawer(scene, seeing, objective.bank)
    frames, down = torch.arange(4), torch.tensor([0.0, -1.0, 0.0]).expand(4, 3)
    wall = one_box(np.eye(3), (0, 0, -1000.25), (1000, 1000, 1000), 0.0).repeated(4)
    far = one_box(np.eye(3), (0, 0, -1e6), (1, 1, 1), 0.0).repeated(4)
    alone, beyond, met = (objective.static(frames, down, None, each) for each in (None, far, wall))
    assert torch.equal(alone["collision"], beyond["collision"])
    assert (met["collision"] > alone["collision"] + 1e-6).any()


@pytest.fixture
def job(scene, toy_motion) -> Callable[..., TrainJob]:
    def make(base: ModelFile | None = None, whole: bool = False, points: int = 0, **train: float) -> TrainJob:
        return TrainJob(
            scene=scene,
            motions=[toy_motion(scene, 9)],
            held_out=[toy_motion(scene, 9)],
            model=ModelConfig(proximity_points=points),
            train=TrainConfig(**train),
            fabric=FABRICS["silk"],
            output=Path("out.safetensors"),
            base=base,
            whole=whole,
        )

    return make


def test_a_network_sees_colliders_where_training_has_some(job, scene, toy_model) -> None:
    blind = model_file(toy_model(scene), FABRICS["silk"], {})
    assert job().model.proximity_points == 0
    assert job(collider_fraction=0.2).model.proximity_points == PROXIMITY_POINTS
    assert job(blind, whole=True, collider_fraction=0.2).model.proximity_points == PROXIMITY_POINTS
    alone = job(blind, collider_fraction=0.2)  # P stays, which does not see
    assert alone.model.proximity_points == 0 and alone.train.collider_fraction == 0
    with pytest.raises(SsilkError, match=r"proximity_points=4 and collider_fraction=0.*give --set collider_fraction"):
        job(points=4)
