# SPDX-License-Identifier: Apache-2.0
"""Training for a family of bodies, and a model of one put on a body."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ssilk_core.authoring.bodies.carry import dressed_family
from ssilk_core.errors import SsilkError
from ssilk_core.network.bodies import SeenBodies
from ssilk_core.network.checkpoint import load_model, model_file, network, save_model
from ssilk_core.network.descriptors import pose_features
from ssilk_core.network.model.bodies import SeenBody
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.proximity import proximity_reach
from ssilk_core.network.runtime.player import Player
from ssilk_core.network.runtime.sight import seen_proximity
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.collision import CollisionBody, limb_axes
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.scene.assets import Collider, ShotWorld
from ssilk_core.scene.fabric_range import FabricRange, fabric_with, factors_of, inputs_of
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.family import BodyFamily, motion_on
from ssilk_core.scene.kinematics import motion_transforms
from ssilk_core.training.bodies import BEYOND, DrawnBodies, FamilyBody, random_body
from ssilk_core.training.family_bank import build_family_bank
from ssilk_core.training.inner_garments import InnerModel
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.obstacles import Obstacles
from ssilk_core.training.parts import build_parts
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.state import learned_tensors, restore
from ssilk_core.training.step import Stepper
from ssilk_core.training.validation import BodyScore, Score, Validator
from ssilk_core.training.verdict import worse_bodies, worst_body

from ..body_family import members_of, shaped

CPU = torch.device("cpu")
CONFIG = ModelConfig(latent=8, widths=(16, 12), shapes=4, feedback_points=6)


@pytest.fixture(scope="module")
def members(scene):
    return members_of(scene.character)


@pytest.fixture(scope="module")
def family(scene, members):
    return dressed_family(scene, BodyFamily.of(members), members[1:])[0]


@pytest.fixture
def model(scene, family):
    found = GarmentModel(scene, CONFIG, np.arange(3), 0, family)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in found.parameters():
            value.add_(0.2 * torch.randn(value.shape, generator=generator))
    return found


def test_motions_play_on_a_member_as_on_its_own_skeleton(scene, members, family, toy_motion):
    motion, base, bodies = toy_motion(scene, 12), members[0].skeleton, family.bodies
    bank = build_family_bank([motion], base, np.arange(3), 30.0, CPU, bodies)
    frames = torch.arange(bank.frame_count)
    for member, coordinates in zip(members, bodies.members):
        bank.wear(torch.as_tensor(coordinates.copy()))
        ratio = 1 + float(bodies.taller @ coordinates)
        own = build_bank([motion_on(motion, base, member.skeleton, ratio)], member.skeleton, np.arange(3), 30.0, CPU)
        torch.testing.assert_close(bank.character(frames), own.character(frames), atol=2e-6, rtol=1e-5)
        torch.testing.assert_close(bank.root_at(frames), own.root, atol=2e-6, rtol=1e-5)
        torch.testing.assert_close(bank.dynamic_at(frames), own.dynamic, atol=2e-5, rtol=1e-5)
        torch.testing.assert_close(bank.static, own.static, atol=1e-6, rtol=1e-5)
    at = frames[3:5][:, None].expand(2, 2)
    torch.testing.assert_close(bank.body(at).matrices, own.body(at).matrices, atol=2e-6, rtol=1e-5)


def test_what_garments_collide_with_takes_the_shape_of_a_member(scene, members, family):
    limbs, joints = limb_axes(scene), scene.character.skeleton.joint_count
    chosen = np.arange(10, 90)
    body = CollisionBody(members[0].merged_body(), joints, vertices=chosen, limbs=limbs, device=CPU)
    shape = FamilyBody(body, scene, family.bodies)
    still = torch.eye(3, 4)[None, :, :, None].expand(joints, 3, 4, 1).contiguous()
    before = body.pose(still)
    for member, coordinates in zip((*members[1:], members[0]), family.bodies.members[[1, 2, 0]]):
        shape.wear(torch.tensor(coordinates, dtype=torch.float32))
        own = CollisionBody(member.merged_body(), joints, vertices=chosen, device=CPU).pose(still)
        found = body.pose(still)
        torch.testing.assert_close(found.points, own.points, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(found.normals, own.normals, atol=1e-5, rtol=1e-4)
    if limbs:
        torch.testing.assert_close(found.limbs.end, before.limbs.end, atol=1e-6, rtol=1e-5)


def frames_of(model, motion, skeleton):
    bank = build_bank([motion], skeleton, model.joints, 30.0, CPU)
    frames = torch.arange(bank.frame_count)
    down = torch.tensor([0.0, -1.0, 0.0]).expand(len(frames), 3)
    static, pose = bank.static_descriptor(frames, down), bank.dynamic_descriptor(frames, down)
    rest = model.initial(static)[:, None]
    z = torch.cat(model.roll([rest[0], rest[1]], rest[2:], pose[2:, None], bank.body(frames[:, None])))
    return model.vertices(z, bank.character(frames))


@torch.no_grad()
def test_a_model_put_on_a_body_is_what_it_is_when_it_sees_that_body(scene, members, family, model, toy_motion):
    motion, base = toy_motion(scene, 12), members[0].skeleton
    file = model_file(model, Fabric("toy"), {})
    for member, coordinates in zip(members, family.bodies.members):
        ratio = 1 + float(family.bodies.taller @ coordinates)
        its = motion_on(motion, base, member.skeleton, ratio)
        model.wear(torch.tensor(coordinates, dtype=torch.float32))
        one = file.on_body(coordinates)
        assert one.bodies is None and one.parameters.keys() == file.parameters.keys()
        folded = frames_of(network(one), its, member.skeleton)
        torch.testing.assert_close(folded, frames_of(model, its, member.skeleton), atol=1e-5, rtol=1e-4)
        # Banks have a motion about where its hub starts.
        start = motion_transforms(its, base.parents)[0, base.hub, :3, 3]
        played = Player(one).play(its).vertices(7) - start
        np.testing.assert_allclose(played, folded[..., 7], atol=1e-4)
    model.wear(torch.zeros(family.bodies.size))


@torch.no_grad()
def test_bodies_make_a_difference_to_all_three_networks(scene, family, model):
    static = torch.randn(4, model.static, generator=torch.Generator().manual_seed(2))
    z = torch.randn(4, CONFIG.latent, generator=torch.Generator().manual_seed(3))
    inputs = torch.randn(4, model.stepper[0].in_features, generator=torch.Generator().manual_seed(4))
    seen = []
    for coordinates in family.bodies.members[:2]:
        model.wear(torch.tensor(coordinates, dtype=torch.float32))
        seen.append((model.initialiser(static), model.stepper(inputs), model.output(z)))
    model.wear(torch.zeros(family.bodies.size))
    assert all((one - other).abs().max() > 1e-3 for one, other in zip(*seen))


@torch.no_grad()
def test_nothing_plays_a_family_that_was_put_on_no_body(model, members, family, tmp_path, toy_motion, scene):
    path, motion = tmp_path / "family.safetensors", toy_motion(scene, 6)
    save_model(path, model_file(model, Fabric("toy"), {}))
    for play in (lambda: Player.load(path), lambda: network(load_model(path)), lambda: InnerModel.load(path)):
        with pytest.raises(SsilkError, match="a model of a family of bodies"):
            play()
    heavier = Player.load(path, family.bodies.members[2])
    np.testing.assert_allclose(heavier.skeleton.bind_transforms, members[2].skeleton.bind_transforms, atol=1e-6)
    own = [Player.load(path, at).play(motion).vertices(3) for at in family.bodies.members[[0, 2]]]
    assert np.abs(own[0] - own[1]).max() > 0.05
    for wrong in (np.zeros(3), [np.nan, 0.0]):
        with pytest.raises(SsilkError, match="bodies of its family have 2 finite numbers each"):
            Player.load(path, wrong)
    save_model(path, load_model(path).on_base())
    with pytest.raises(SsilkError, match="a model of one body"):
        Player.load(path, np.zeros(2))


def test_at_the_base_the_file_is_as_one_of_that_body(model, tmp_path, scene):
    file = model_file(model, Fabric("toy"), {"seed": 1})
    save_model(tmp_path / "family.safetensors", file)
    save_model(tmp_path / "base.safetensors", file.on_body(np.zeros(2)))
    found, base = (load_model(tmp_path / f"{name}.safetensors") for name in ("family", "base"))
    assert base.bodies is None and found.bodies is not None
    for name, value in base.parameters.items():
        np.testing.assert_array_equal(found.parameters[name], value)
    np.testing.assert_array_equal(found.scene.garment.mesh.points, base.scene.garment.mesh.points)
    known = found.bodies.family.bodies
    np.testing.assert_array_equal(known.members, file.bodies.family.bodies.members)
    assert known.names == ("/toy", "/taller", "/heavier")


def test_a_stored_family_finds_its_members(model, members, tmp_path):
    save_model(tmp_path / "family.safetensors", model_file(model, Fabric("toy"), {}))
    bodies = load_model(tmp_path / "family.safetensors").bodies.family.bodies
    for member, coordinates in zip(members, bodies.members):
        place = bodies.place_of(member)
        np.testing.assert_allclose(place.coordinates, coordinates, atol=1e-5)
        assert place.beyond == 0 and max(place.joints_off, place.points_off) < 1e-6


def test_a_family_of_another_network_is_refused(model, tmp_path):
    file = model_file(model, Fabric("toy"), {})
    columns = file.bodies.columns
    shorter = {name: values[:, :-1] for name, values in columns.items()}
    last = {"output.4": np.zeros((2, len(file.parameters["output.4.weight"]), file.bodies.family.bodies.size))}
    for odd, told in ((shorter, "do not fit the network"), ({}, "no weights"), (columns | last, "'output.4' do not")):
        save_model(tmp_path / "odd.safetensors", replace(file, bodies=replace(file.bodies, columns=odd)))
        with pytest.raises(SsilkError, match=told):
            load_model(tmp_path / "odd.safetensors")


def test_a_network_that_saw_bodies_in_its_first_layers_alone_plays_as_before(model):
    file = model_file(model, Fabric("toy"), {})
    columns, coordinates = file.bodies.columns, file.bodies.family.bodies.members[1]
    first = {name: values[0] for name, values in columns.items() if name.endswith(".0")}
    assert len(first) == 3 and all(values.any() for values in first.values())
    tensors = file.bodies.tensors()
    before = {name: value for name, value in tensors.items() if name.removeprefix("family.") not in columns}
    before |= {f"family.{name.removesuffix('.0')}": values for name, values in first.items()}
    read = SeenBodies.of(before, file.bodies.family.bodies.names, file.bodies.family.bodies.meshes)
    found = replace(file, bodies=read).on_body(coordinates).parameters
    for name, value in file.parameters.items():
        layer = name.removesuffix(".bias")
        added = first[layer] @ coordinates if layer in first else 0
        np.testing.assert_allclose(found[name], value + added, atol=1e-6)


def test_bodies_are_drawn_within_the_members_and_a_little_beyond_again_by_their_number(family):
    bodies = family.bodies
    drawn = np.array([random_body(bodies, np.random.default_rng([0, number])) for number in range(300)])
    middle = bodies.members.mean(axis=0)
    within = middle + (drawn - middle) / (1 + BEYOND)
    assert all(bodies.beyond(each) < 1e-3 for each in within[:20])
    assert 0 < max(map(bodies.beyond, drawn[:30])) < BEYOND + 1e-3
    np.testing.assert_allclose(drawn.mean(axis=0), middle, atol=0.06)  # evenly
    seen = []

    class Seen:
        def wear(self, place):
            seen.append(place.clone())

    for number in (3, 4, 3):
        drawn = DrawnBodies(bodies, [Seen()], 7, CPU)
        drawn.draw(number)
        drawn.put_on()
    assert torch.equal(seen[0], seen[2]) and not torch.equal(seen[0], seen[1])


def test_a_run_does_not_go_on_with_another_family_of_the_same_coordinates(scene, members, toy_motion, tmp_path):
    """Two members are always at zero and one."""
    motion = toy_motion(scene, 12)

    def identity(member):
        family = dressed_family(scene, BodyFamily.of([members[0], member]), [member])[0]
        return TrainJob(
            scene=scene, motions=[motion], held_out=[motion], model=CONFIG, train=TrainConfig(), fabric=Fabric("toy"),
            output=tmp_path / "model.safetensors", family=family,
        ).identity()  # fmt: skip

    taller, heavier = (identity(member) for member in members[1:])
    assert taller["family"] != heavier["family"] and identity(members[1]) == taller
    moved = shaped(members[1], lambda points: points * (1 + 1e-12), "/taller")
    assert identity(moved)["family"] == taller["family"]


@torch.no_grad()
def test_validation_measures_members_as_models_of_these_alone(scene, members, family, toy_motion, tmp_path):
    motion, base = toy_motion(scene, 40), members[0].skeleton
    job = TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=CONFIG, train=TrainConfig(valid_frames=20),
        fabric=Fabric("toy"), output=tmp_path / "model.safetensors", family=family,
    )  # fmt: skip
    parts = build_parts(job, CPU)
    generator = torch.Generator().manual_seed(1)
    for value in parts.model.parameters():
        value.add_(0.1 * torch.randn(value.shape, generator=generator))
    score = parts.validator.score(parts.model)
    assert [body.name for body in score.bodies] == ["/taller", "/heavier"]
    file = model_file(parts.model, Fabric("toy"), {})
    for body, member, coordinates in zip(score.bodies, members[1:], family.bodies.members[1:]):
        own = family.scene_at(scene, coordinates)
        its = motion_on(motion, base, member.skeleton, 1 + float(family.bodies.taller @ coordinates))
        bank = build_bank([its], own.character.skeleton, parts.model.joints, 30.0, CPU)
        energy = GarmentEnergy(own.garment.sewn_mesh, job.fabric, own.classes, device=CPU)
        touched = CollisionBody(member.merged_body(), 3, limbs=limb_axes(own), device=CPU)
        rest = torch.tensor(own.garment.mesh.points, dtype=torch.float32)
        alone = Validator(bank, energy, touched, own, rest, 30.0, 10)
        one = alone.score(network(file.on_body(coordinates), own))
        assert body.total == pytest.approx(one.total, rel=1e-3) and not one.bodies
        assert body.lbs == pytest.approx(alone.lbs_score().total, rel=1e-3)
        assert body.collisions == pytest.approx(one.collisions, abs=1e-3)
    assert not any(module.place.any() for module in parts.model.modules() if isinstance(module, SeenBody))
    again = Score.of(json.loads(json.dumps(asdict(score))))
    assert again.bodies == score.bodies and parts.validator.lbs_score().bodies == ()
    several = replace(score, bodies=(BodyScore("/a", 1.0, 4.0, 0.0), BodyScore("/b", 3.0, 2.9, 0.0)))
    lbs = replace(score, bodies=())
    worst = worst_body(several.of_each("/base", lbs))
    assert worst.name == "/b" and worst_body(lbs.of_each("/base", lbs)) is None
    low = replace(lbs, terms={"all": score.total - 2 * abs(score.total) - 1})
    assert worst_body(several.of_each("/base", low)).name == "/base"
    (told,) = worse_bodies("m", replace(score, bodies=(BodyScore("/a", 1.0, 4.0, 0.0), worst)))
    assert "on /b the model is worse than none" in told.text


def test_the_average_that_is_validated_is_on_the_base_whatever_was_worn_before(model, family, scene):
    """Steps that are timed, or a batch that is halved, leave the model on some body when its average is begun."""
    model.wear(torch.tensor(family.bodies.members[1], dtype=torch.float32))
    drawn = DrawnBodies(family.bodies, [model], 0, CPU)
    sampler, objective = SimpleNamespace(first=torch.zeros(1)), SimpleNamespace(scale=1.0)
    stepper = Stepper(model, objective, sampler, TrainConfig(), bodies=drawn)
    rest = torch.tensor(scene.garment.mesh.points, dtype=torch.float32)
    for found in (stepper.ema_model, model):
        torch.testing.assert_close(found.decoder.rest, rest)
        assert not any(module.place.any() for module in found.modules() if isinstance(module, SeenBody))
    drawn.draw(1)
    drawn.put_on()
    torch.testing.assert_close(stepper.ema_model.decoder.rest, rest)
    assert not torch.allclose(model.decoder.rest, rest)


def family_job(scene, family, motion, output, **given):
    config = given.pop("model", CONFIG)
    train = given.pop("train", TrainConfig(batch=4, static_batch=2, static_fraction=0, collider_fraction=0.0))
    return TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=config, train=train, fabric=Fabric("toy"),
        output=output, family=family, **given,
    )  # fmt: skip


@torch.no_grad()
def test_a_model_of_one_body_goes_on_for_a_family_as_it_was(scene, members, family, toy_motion, tmp_path):
    motion = toy_motion(scene, 24)
    alone = GarmentModel(scene, CONFIG, np.arange(3), 0)
    generator = torch.Generator().manual_seed(1)
    for value in alone.parameters():
        value.add_(0.2 * torch.randn(value.shape, generator=generator))
    base = model_file(alone, Fabric("toy"), {})
    job = family_job(scene, family, motion, tmp_path / "m.safetensors", base=base, whole=True)
    parts = build_parts(job, CPU)
    file = model_file(parts.model, Fabric("toy"), {})
    assert all(not values.any() for values in file.bodies.columns.values())
    for coordinates in family.bodies.members:
        found = file.on_body(coordinates)
        assert found.parameters.keys() == base.parameters.keys()
        for name, value in base.parameters.items():
            np.testing.assert_array_equal(found.parameters[name], value)
    assert torch.equal(
        frames_of(parts.model, motion, members[0].skeleton), frames_of(alone, motion, members[0].skeleton)
    )


def test_a_step_from_a_model_of_one_body_teaches_it_bodies(scene, family, toy_motion, tmp_path):
    motion = toy_motion(scene, 24)
    base = model_file(GarmentModel(scene, CONFIG, np.arange(3), 0), Fabric("toy"), {})
    job = family_job(scene, family, motion, tmp_path / "m.safetensors", base=base, whole=True)
    parts = build_parts(job, CPU)
    stepper = parts.stepper(job.train, 0)
    for iteration in range(3):
        stepper.run(iteration)
    assert all(module.columns.any() for module in parts.model.modules() if isinstance(module, SeenBody))
    before = {name: value for name, value in learned_tensors(stepper).items() if ".weight.0.columns" not in name}
    before = {name.replace(".parametrizations.weight.original", ".weight"): value for name, value in before.items()}
    with pytest.raises(SsilkError, match="of an earlier version"):
        restore(tmp_path / "state.safetensors", stepper, before)
    onward = model_file(parts.model, Fabric("toy"), {})
    again = build_parts(replace(job, base=onward), CPU).model
    for name, value in parts.model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])


def test_what_a_family_cannot_go_on_from_is_refused(scene, members, family, model, toy_motion, tmp_path):
    motion, path = toy_motion(scene, 24), tmp_path / "m.safetensors"
    file = model_file(model, Fabric("toy"), {})
    with pytest.raises(SsilkError, match="without the family"):
        family_job(scene, None, motion, path, base=file, whole=True)
    with pytest.raises(SsilkError, match="a stepper alone"):
        family_job(scene, family, motion, path, base=file)
    other = dressed_family(scene, BodyFamily.of([members[0], members[2], members[1]]), [members[2], members[1]])[0]
    with pytest.raises(SsilkError, match="another family"):
        family_job(scene, other, motion, path, base=file, whole=True)
    bodies, last = family.bodies, len(family.bodies.points) - 1
    fewer = replace(
        bodies, points=bodies.points[:last], point_moves=bodies.point_moves[:, :last], rows=bodies.rows[:last],
        counts=(last,),
    )  # fmt: skip
    with pytest.raises(SsilkError, match="another family"):
        family_job(scene, replace(family, bodies=fewer), motion, path, base=file, whole=True)


def test_a_family_of_a_file_whose_directions_go_the_other_way_is_the_same(
    scene, members, family, model, toy_motion, tmp_path
):
    """Earlier versions left their signs to linear algebra."""
    motion, path, signs = toy_motion(scene, 24), tmp_path / "m.safetensors", np.array([1.0, -1.0])
    file, bodies = model_file(model, Fabric("toy"), {}), family.bodies
    moves = {name: getattr(family, name) * signs[:, None, None] for name in ("cloth_moves", "proxy_moves")}
    other = replace(family, bodies=bodies.mirrored(signs), **moves)
    columns = {name: values * signs for name, values in file.bodies.columns.items()}
    mirrored = replace(file, bodies=replace(file.bodies, family=other, columns=columns))
    save_model(path, mirrored)
    job = family_job(scene, family, motion, path, base=load_model(path), whole=True)
    onward = model_file(build_parts(job, CPU).model, Fabric("toy"), {})
    for member, coordinates in zip(members, bodies.members):
        at = onward.bodies.family.bodies.place_of(member).coordinates
        np.testing.assert_allclose(at, coordinates * signs, atol=1e-6)
        one, two = onward.on_body(coordinates * signs), file.on_body(coordinates)
        np.testing.assert_allclose(one.scene.garment.mesh.points, two.scene.garment.mesh.points, atol=1e-6)
        for name, value in two.parameters.items():
            np.testing.assert_allclose(one.parameters[name], value, atol=1e-6)


def test_a_garment_that_was_settled_otherwise_goes_on_where_it_lies_on_each_body(
    scene, members, family, model, toy_motion, tmp_path
):
    motion, path = toy_motion(scene, 24), tmp_path / "m.safetensors"
    base = model_file(model, Fabric("toy"), {})
    moved = np.array(family.cloth_moves)
    moved[1, :, 2] -= 0.02
    settled = replace(family, cloth_moves=moved)
    assert family_job(scene, settled, motion, path, base=base, whole=True).family is not None
    moved[1, 7, 2] -= 0.5
    with pytest.raises(SsilkError, match=r"mm off where the given model has it on /(taller|heavier)"):
        family_job(scene, replace(family, cloth_moves=moved), motion, path, base=base, whole=True)


SEEING_COLLIDERS = TrainConfig(batch=64, window=4, static_batch=2, static_fraction=0, collider_fraction=1.0)


def colliding_parts(scene, family, motion, output):
    job = family_job(scene, family, motion, output, train=SEEING_COLLIDERS, model=replace(CONFIG, proximity_points=5))
    assert job.train.collider_fraction == 1 and job.model.proximity_points == 5
    parts = build_parts(job, CPU)
    stepper = parts.stepper(job.train, 0)
    return parts, stepper, stepper.sampler.drawer


def clearances(parts, drawer, obstacles, frames, member):
    """Distances of a member's own points from obstacles in windows, least of each, from its own skinning."""
    body = member.merged_body()
    whole = CollisionBody(body, member.skeleton.joint_count, device=CPU)
    found = []
    for at in frames:
        points = whole.pose(parts.bank.character(at)).points
        found.append(torch.stack([obstacles.distance(points, box).amin(0) for box in range(2)]))
    return torch.stack(found).amin(0)


@torch.no_grad()
def test_floors_lie_at_the_lowest_point_of_the_body_that_is_drawn(scene, members, family, toy_motion, tmp_path):
    parts, stepper, drawer = colliding_parts(scene, family, toy_motion(scene, 40), tmp_path / "m.safetensors")
    sampler, bodies = stepper.sampler, family.bodies
    sampler.carried.fill_(False)
    floor_gaps = []
    for row in (1, 2, 0):
        stepper.bodies.wear(bodies.members[row].copy())
        sampler.change_body()
        least = clearances(parts, drawer, sampler.obstacles, sampler.frames(), members[row])
        there = sampler.obstacles.radius > -1
        assert there.any() and (least[there] > -1e-3).all()  # the body is in none of them
        floor_gaps.append(float(least[0][there[0]].median()))
    assert max(floor_gaps) < 0.02  # most touch it: `SKIN` away, and a little where the lowest point is not sampled


@torch.no_grad()
def test_floors_go_along_with_bodies_of_windows_that_continue(scene, members, family, toy_motion, tmp_path):
    parts, stepper, drawer = colliding_parts(scene, family, toy_motion(scene, 40), tmp_path / "m.safetensors")
    sampler, bodies = stepper.sampler, family.bodies
    stepper.bodies.wear(bodies.members[1].copy())
    sampler.carried.fill_(False)
    sampler.change_body()
    sampler.carried.fill_(True)
    there, frames = sampler.obstacles.radius[0] > -1, sampler.frames()
    before = clearances(parts, drawer, sampler.obstacles, frames, members[1])[0][there]
    for row in (2, 0, 1):
        stepper.bodies.wear(bodies.members[row].copy())
        sampler.change_body()
        now = clearances(parts, drawer, sampler.obstacles, frames, members[row])
        torch.testing.assert_close(now[0][there], before, atol=0.01, rtol=0)
        standing = sampler.obstacles.radius > -1
        assert (now[standing] > -1e-3).all()


def test_training_for_a_family_that_sees_colliders_goes_on_again(scene, family, toy_motion, tmp_path):
    """What obstacles were drawn around is part of the state."""
    runs = []
    for split in (False, True):
        _, stepper, _ = colliding_parts(scene, family, toy_motion(scene, 40), tmp_path / "m.safetensors")
        for iteration in range(3):
            stepper.run(iteration)
            if split and iteration == 1:
                saved = {name: value.clone() for name, value in stepper.sampler.state().items()}
                stepper.bodies.wear(family.bodies.members[1].copy())
                stepper.sampler.restore(saved)
        runs.append(stepper.sampler.obstacles)
    assert all(torch.equal(one, other) for one, other in zip(runs[0].parts, runs[1].parts))


def test_the_best_model_of_a_family_is_that_of_all_its_bodies():
    first = Score({"stretch": 1.0}, 0.0, bodies=(BodyScore("/a", 5.0, 9.0, 0.0),))
    then = Score({"stretch": 1.5}, 0.0, bodies=(BodyScore("/a", 2.0, 9.0, 0.0),))
    assert then.judged < first.judged and then.total > first.total
    assert Score({"stretch": 1.5}, 0.0).judged == 1.5


@torch.no_grad()
def test_colliders_are_seen_on_a_body_as_in_training(scene, members, family, toy_motion, tmp_path):
    """A player on a body tells a network what training told it there, although the garment is larger."""
    motion, row = toy_motion(scene, 40), 1
    parts, stepper, drawer = colliding_parts(scene, family, motion, tmp_path / "m.safetensors")
    generator = torch.Generator().manual_seed(1)
    for value in parts.model.parameters():
        value.add_(0.1 * torch.randn(value.shape, generator=generator))
    coordinates = family.bodies.members[row].copy()
    stepper.bodies.wear(coordinates)
    file = model_file(parts.model, Fabric("toy"), {}).on_body(coordinates)
    assert proximity_reach(file.scene) == drawer.reach
    ratio = 1 + float(family.bodies.taller @ coordinates)
    its = motion_on(motion, scene.character.skeleton, members[row].skeleton, ratio)
    frames = torch.arange(motion.frame_count)  # others are made of it
    down = torch.tensor([0.0, -1.0, 0.0]).expand(len(frames), 3)
    height = float(drawer._resting(frames, down)[:, 1].min()) - 0.02
    floor = Obstacles(
        torch.eye(3).expand(1, len(frames), 3, 3),
        torch.tensor([0.0, height - 50.0, 0.0]).expand(1, len(frames), 3),
        torch.full((1, len(frames), 3), 50.0),
        torch.zeros(1, len(frames)),
    )
    told = drawer.seen(drawer.near(floor, frames, down), frames)
    assert told.abs().max() > 0.1
    start = motion_transforms(its, scene.character.skeleton.parents)[0, scene.character.skeleton.hub, :3, 3]
    corners = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]) * 50 + start + [0, height, 0]
    faces, whole = np.array([[0, 1, 2], [0, 2, 3]]), np.ones(1, dtype=bool)
    world = ShotWorld(its.fps, (Collider("floor", faces, corners[None], np.eye(4)[None], whole),))
    seen = seen_proximity(world, its, Player(file))
    features = pose_features(
        replace(its, proximity=seen), file.scene.character.skeleton, parts.model.joints
    ).proximity
    np.testing.assert_allclose(features, told, atol=2e-3)


def test_a_model_may_know_bodies_and_fabrics(scene, members, family, toy_motion, tmp_path):
    """Put on both, in either order, it is what it is when it sees both."""
    motion, own = toy_motion(scene, 24), Fabric("toy")
    fabrics = FabricRange.of(own, ["4"])
    base = model_file(GarmentModel(scene, CONFIG, np.arange(3), 0), own, {})
    job = family_job(scene, family, motion, tmp_path / "m.safetensors", base=base, whole=True, fabrics=fabrics)
    parts = build_parts(job, CPU)
    stepper = parts.stepper(job.train, 0)
    for iteration in range(3):
        stepper.run(iteration)
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        for value in parts.model.parameters():
            value.add_(0.1 * torch.randn(value.shape, generator=generator))
    save_model(tmp_path / "both.safetensors", model_file(parts.model, own, {}, fabrics))
    file, place = load_model(tmp_path / "both.safetensors"), family.bodies.members[1]
    fabric = fabric_with(own, np.array([2, 1, 0.5, 3, 1.0]), "odd")
    one, other = file.on_body(place).on_fabric(fabric), file.on_fabric(fabric).on_body(place)
    for name, value in one.parameters.items():
        np.testing.assert_allclose(other.parameters[name], value, atol=1e-6)
    its = motion_on(motion, members[0].skeleton, members[1].skeleton, 1 + float(family.bodies.taller @ place))
    with torch.no_grad():
        parts.model.wear(torch.tensor(place, dtype=torch.float32))
        parts.model.fabric.copy_(torch.tensor(inputs_of(factors_of(own, fabric)), dtype=torch.float32))
        unfolded = frames_of(parts.model, its, members[1].skeleton)
        torch.testing.assert_close(frames_of(network(one), its, members[1].skeleton), unfolded, atol=1e-4, rtol=1e-3)
    parts.model.wear(torch.zeros(family.bodies.size))
    parts.model.fabric.zero_()
    assert [each.name for each in parts.validator.score(parts.model).bodies][-2:] == [
        "fabric softest", "fabric stiffest",
    ]  # fmt: skip
