# SPDX-License-Identifier: Apache-2.0
"""NCS and SNUG on the toy scene: their descriptors, their memory, their training and their files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.baselines.descriptors import JointBank, joint_bank
from benchmarks.baselines.files import load_network, save_baseline
from benchmarks.baselines.networks import METHODS, Baseline, BaselineConfig, baseline
from benchmarks.baselines.run import BaselineJob, BaselineRun, train_baseline
from benchmarks.baselines.training import BaselineObjective, BaselineStepper
from ssilk_core.errors import SsilkError
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, model_file, save_model
from ssilk_core.network.descriptors import RATE_TIME
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.collision import CollisionBody, signed_distance_to_planes
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.skinning import Skinning
from ssilk_core.scene.assets import PINNED, Motion, Scene
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import matrix_from_quaternion, motion_transforms, quaternion_from_matrix
from ssilk_core.training.curve import curve_path
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.objective import total
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.validation import Validator
from ssilk_core.training.windows import WindowSampler

pytestmark = pytest.mark.usefixtures("few_contacts")

JOINTS, INNER = np.arange(3), torch.tensor([False, True, True])
CPU = torch.device("cpu")
FABRIC = Fabric("toy", bending=1e-4, margin=0.02)
CONFIG = TrainConfig(
    iterations=60,
    static_fraction=0.0,
    batch=3,
    window=8,
    state_reuse=0.0,
    rotated_fraction=0.0,
    learning_rate=1e-3,
    learning_rate_warmup=5,
    optimiser="adam",
)


def bank_of(scene: Scene, *motions: Motion) -> JointBank:
    return joint_bank(build_bank(motions, scene.character.skeleton, JOINTS, 30.0, CPU), INNER, 30.0)


def network(scene: Scene, method: str, *, spread: float = 0.0) -> Baseline:
    """An untrained network, `spread` of which lets offsets of that size through [m]."""
    model = baseline(scene, BaselineConfig(method=method), JOINTS, seed=1)
    with torch.no_grad():
        model.shapes.add_(spread * torch.randn(model.shapes.shape, generator=torch.Generator().manual_seed(2)))
    return model


def objective_of(scene: Scene, method: str, *motions: Motion, spread: float = 1e-3, **options) -> BaselineObjective:
    energy = GarmentEnergy(scene.garment.mesh, FABRIC, scene.classes)
    body = CollisionBody(scene.character.merged_body(), 3, device=CPU)
    model, bank = network(scene, method, spread=spread), bank_of(scene, *motions)
    return BaselineObjective(model, energy, body, bank, True, **{"judged": 2, **options})


def stepper_of(objective: BaselineObjective, config: TrainConfig = CONFIG) -> BaselineStepper:
    return BaselineStepper(objective, config, torch.Generator().manual_seed(3))


def rolled(model: Baseline, bank: JointBank, start: int, stop: int, states: list[torch.Tensor] | None = None):
    """States of frames of a bank's first clip, those of the first two being initial ones by default."""
    frames, down = torch.arange(start, stop), torch.tensor([[0.0, -1, 0]]).repeat(stop - start, 1)
    rest = model.initial(bank.static_descriptor(frames, down))[:, None]
    pose = bank.dynamic_descriptor(frames, down)[:, None]
    if states is None:
        return model.roll([*rest[:2]], rest[2:], pose[2:])
    return model.roll(states, rest, pose)[len(states) :]


@pytest.fixture
def motions(scene, toy_motion) -> tuple[Motion, Motion]:
    return toy_motion(scene, 40), toy_motion(scene, 25, speed=2.0, path="/toy/fast")


def test_descriptors_are_those_of_each_joint_by_itself(scene, motions):
    """Against the features' definitions, in slow motion, where nothing saturates."""
    slow = replace(motions[0], translations=motions[0].translations * 0.1)
    bank, frame, down = bank_of(scene, motions[1], slow), 12, np.array([0.6, -0.8, 0.0])
    world = motion_transforms(slow, scene.character.skeleton.parents)
    turn, place = world[..., :3, :3], world[..., :3, 3]
    local = matrix_from_quaternion(slow.rotations)
    at = torch.tensor([motions[1].frame_count + frame])
    pose = bank.dynamic_descriptor(at, torch.tensor(down[None], dtype=torch.float32))[0].numpy()
    static, moving, velocity = pose[:27].reshape(3, 9), pose[27:63].reshape(3, 12), pose[63:]
    rate = RATE_TIME * 30
    acceleration = (place[frame] - 2 * place[frame - 1] + place[frame - 2]) * 30**2 / GRAVITY
    for joint in range(3):
        own = turn[frame, joint].T
        six = np.array([1.0, 0, 0, 0, 1, 0]) if joint == 0 else local[frame, joint][:, :2].T.reshape(6)
        np.testing.assert_allclose(static[joint], [*six, *(own @ down)], atol=1e-5)
        before = local[frame - 1, joint][:, :2].T.reshape(6)
        turned = (turn[frame, 0].T @ turn[frame - 1, 0] - np.eye(3))[:, :2].T.reshape(6)
        expected = turned if joint == 0 else six - before
        np.testing.assert_allclose(moving[joint, :6], expected * rate, atol=0.02)
        np.testing.assert_allclose(moving[joint, 6:9], own @ acceleration[joint], atol=0.02)
        np.testing.assert_allclose(moving[joint, 9:], (own - turn[frame - 1, joint].T) @ down * rate, atol=1e-4)
    np.testing.assert_allclose(velocity, turn[frame, 0].T @ (place[frame, 0] - place[frame - 1, 0]) * 30, atol=1e-4)
    first = bank.dynamic_descriptor(torch.tensor([motions[1].frame_count]), torch.tensor([[0.0, -1, 0]]))[0]
    assert first[63:].abs().max() == 0 and first[27:63].unflatten(0, (3, 12))[:, 9:].abs().max() == 0


def test_turning_character_and_gravity_together_changes_no_descriptor(scene, motions):
    turn = Rotation.random(random_state=3).as_matrix()
    rotations, places = motions[0].rotations.copy(), motions[0].translations.copy()
    rotations[:, 0] = quaternion_from_matrix(turn @ matrix_from_quaternion(rotations[:, 0]))
    places[:, 0] = places[:, 0] @ turn.T
    frames, down = torch.arange(40), torch.tensor([[0.3, -0.9, 0.1]]).repeat(40, 1)
    before = bank_of(scene, motions[0]).dynamic_descriptor(frames, down)
    there = bank_of(scene, replace(motions[0], rotations=rotations, translations=places))
    after = there.dynamic_descriptor(frames, down @ torch.tensor(turn.T, dtype=torch.float32))
    np.testing.assert_allclose(before, after, atol=2e-4)
    assert (before - there.dynamic_descriptor(frames, down)).abs().max() > 0.1


@pytest.mark.parametrize("method", METHODS)
def test_networks_give_vertices_with_pinned_ones_where_the_skeleton_puts_them(scene, motions, method):
    model, bank = network(scene, method, spread=0.01), bank_of(scene, motions[0])
    states = torch.cat(rolled(model, bank, 0, 10))
    character = bank.character(torch.arange(10))
    x = model.vertices(states, character)
    lbs = model.skin(model.rest, None, model.skin.weights, character)
    assert x.shape == (scene.garment.mesh.vertex_count, 3, 10) and x.is_contiguous()
    pinned = torch.tensor(scene.classes == PINNED)
    np.testing.assert_allclose(x[pinned].detach(), lbs[pinned], atol=1e-6)
    assert (x - lbs)[~pinned].norm(dim=1).min() > 0


@pytest.mark.parametrize("method", METHODS)
def test_window_by_window_equals_one_pass(scene, motions, method):
    model, bank = network(scene, method), bank_of(scene, motions[0])
    whole = rolled(model, bank, 0, 30)
    parts = rolled(model, bank, 0, 11)
    for start, stop in ((11, 12), (12, 30)):
        parts += rolled(model, bank, start, stop, parts[-2:])
    assert len(whole) == len(parts) == 30
    np.testing.assert_allclose(torch.cat(whole).detach(), torch.cat(parts).detach(), atol=1e-5)
    fresh = rolled(model, bank, 11, 30)
    assert (torch.cat(fresh[2:]) - torch.cat(whole[13:])).abs().max() > 1e-3  # what was before matters


def test_snug_is_a_stack_of_four_recurrent_layers(scene, motions):
    model, bank = network(scene, "snug"), bank_of(scene, motions[0])
    stack = torch.nn.GRU(30, 256, num_layers=4)
    for depth, layer in enumerate(model.layers):
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            getattr(stack, f"{name}_l{depth}").data = getattr(layer, f"{name}_l0").data
    frames, down = torch.arange(5, 15), torch.tensor([[0.0, -1, 0]]).repeat(10, 1)
    pose = bank.dynamic_descriptor(frames, down)
    expected, _ = stack(torch.cat([pose[:, :27], pose[:, 63:]], dim=1)[:, None])
    states = model.roll([torch.zeros(1, 1024)], pose, pose[:, None])[1:]
    np.testing.assert_allclose(torch.cat(states)[:, -256:].detach(), expected[:, 0].detach(), atol=1e-5)


def test_ncs_without_motion_is_its_static_code_alone(scene, motions):
    model, bank = network(scene, "ncs"), bank_of(scene, motions[0])
    frames, down = torch.arange(10), torch.tensor([[0.0, -1, 0]]).repeat(10, 1)
    static, pose = bank.static_descriptor(frames, down), bank.dynamic_descriptor(frames, down)
    still = torch.cat([static, torch.zeros_like(pose[:, 27:])], dim=1)[:, None]
    quiet = model.initial(static)
    states = torch.cat(model.roll([quiet[:1]], quiet, still)[1:])
    assert torch.equal(states, quiet) and quiet[:, 512:].abs().max() == 0
    moving = torch.cat(model.roll([quiet[:1]], quiet, pose[:, None])[1:])
    assert moving[:, 512:].abs().max() > 1e-3 and torch.equal(moving[:, :512], quiet[:, :512])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("judged", [1, 3])
def test_the_terms_of_a_window_are_those_of_its_frames(scene, motions, method, judged):
    objective = objective_of(scene, method, *motions, judged=judged)
    sampler = WindowSampler(
        objective.bank, replace(CONFIG, rotated_fraction=1.0), 0, torch.Generator().manual_seed(3)
    )
    terms, model, energy = objective.rolled(sampler), objective.model, objective.energy
    for slot in range(3):
        frames, down = sampler.first[slot] + torch.arange(8), sampler.direction[slot].repeat(8, 1)
        static, pose = objective.bank.static_descriptor(frames, down), objective.bank.dynamic_descriptor(frames, down)
        rest = model.initial(static)[:, None]
        states = torch.cat(model.roll([*rest[:2]], rest[2:], pose[2:, None]))
        character = objective.bank.character(frames)
        x = model.vertices(states, character)
        sampled = energy.cloth.positions(x)
        root = objective.bank.root[frames].T
        rest_points = torch.tensor(np.array(scene.garment.mesh.points), dtype=torch.float32)
        skin = Skinning(scene.lbs_skin)
        lbs = skin(rest_points, None, skin.weights, character)
        direct = {
            "stretch": energy.stretch(x),
            "bending": energy.bending(x),
            "gravity": energy.gravity(x - character[0, :, 3], GRAVITY * down.T),
            "collision": energy.collision_at(
                signed_distance_to_planes(
                    sampled, *objective.contacts.planes(sampled, objective.body.pose(character))
                )
            ),
            "inertia": energy.inertia(x[..., 2:], 2 * x[..., 1:-1] - x[..., :-2], 1 / 30),
            "drag": energy.drag(x[..., 2:], x[..., 1:-1] + root[:, 2:] - root[:, 1:-1], 1 / 30),
            "tether": energy.tether(x, lbs[energy.tethered]),
        }
        assert terms.keys() == direct.keys()
        for name, values in direct.items():
            found = terms[name].unflatten(0, (judged, 3))[:, slot].detach()
            np.testing.assert_allclose(found, values[-judged:].detach(), rtol=2e-3, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_the_gradient_reaches_every_parameter(scene, motions, method):
    objective = objective_of(scene, method, *motions)
    sampler = WindowSampler(objective.bank, CONFIG, 0, torch.Generator().manual_seed(3))
    total(objective.rolled(sampler)).backward()
    for name, value in objective.model.named_parameters():
        assert value.grad is not None and value.grad.isfinite().all() and value.grad.abs().max() > 0, name


def test_mixed_windows_teach_the_decoder_alone(scene, motions):
    """Two of three windows swap their motion: they have their own energies, no inertia, and nothing for encoders."""
    lbs, mixed = (objective_of(scene, "ncs", *motions, mixed=share) for share in (0.0, 0.67))
    samplers = [WindowSampler(mixed.bank, CONFIG, 0, torch.Generator().manual_seed(3)) for _ in range(2)]
    before, after = (o.rolled(sampler) for o, sampler in zip((lbs, mixed), samplers))
    slots = {name: (before[name].unflatten(0, (2, 3)), after[name].unflatten(0, (2, 3))) for name in before}
    for name, (own, found) in slots.items():
        assert torch.equal(found[:, 2], own[:, 2] * (3 if name in ("inertia", "drag") else 1)), name
    assert (slots["stretch"][0] != slots["stretch"][1])[:, :2].all()
    assert slots["inertia"][1][:, :2].abs().max() == 0 == slots["drag"][1][:, :2].abs().max()
    sum(found[:, :2].sum() for _, found in slots.values()).backward()
    for name, value in mixed.model.named_parameters():
        reached = value.grad is not None and value.grad.abs().max() > 0
        assert reached == name.startswith(("decoder.", "shapes")), name
    with pytest.raises(SsilkError, match="baseline 'snug': mixed windows; only NCS"):
        objective_of(scene, "snug", *motions, mixed=0.5)


def test_rotation_augmentation_changes_the_direction_of_gravity_alone(scene, motions):
    bank = bank_of(scene, *motions)
    samplers = [
        WindowSampler(bank, replace(CONFIG, rotated_fraction=share), 0, torch.Generator().manual_seed(3))
        for share in (0.0, 1.0)
    ]
    upright, turned = samplers
    assert torch.equal(upright.first, turned.first) and (upright.direction != turned.direction).any(1).all()
    seen = [bank.dynamic_descriptor(sampler.first, sampler.direction) for sampler in samplers]
    gravity = torch.cat([torch.arange(63) < 0, torch.zeros(3, dtype=torch.bool)])
    for joint in range(3):
        gravity[9 * joint + 6 : 9 * joint + 9] = True
        gravity[27 + 12 * joint + 9 : 27 + 12 * joint + 12] = True
    assert torch.equal(seen[0][:, ~gravity], seen[1][:, ~gravity])
    assert (seen[0][:, gravity] - seen[1][:, gravity]).abs().amax(1).min() > 0.01


@pytest.mark.parametrize("method", METHODS)
def test_a_short_training_lowers_the_energy_of_whole_clips(scene, motions, method):
    stepper = stepper_of(objective_of(scene, method, *motions, spread=0.0))
    objective = stepper.objective
    body = CollisionBody(scene.character.merged_body(), 3, device=CPU)
    rest = objective.model.rest
    validator = Validator(objective.bank, objective.energy, body, scene, rest, 30.0, 20)
    before, lbs = validator.score(objective.model).total, validator.lbs_score().total
    for iteration in range(60):
        stepper.run(iteration)
    after = validator.score(objective.model)
    assert after.total < before and after.total < lbs and after.dynamics > 0
    assert int(stepper.skipped.count) == 0


def test_a_window_must_hold_what_inertia_needs(scene, motions):
    with pytest.raises(SsilkError, match="a window of 8 poses of which 7 are judged"):
        stepper_of(objective_of(scene, "snug", *motions, judged=7))


def test_an_unknown_method_is_refused():
    with pytest.raises(SsilkError, match="baseline 'hood': no such method; it is one of ncs, snug"):
        BaselineConfig(method="hood")


@pytest.fixture
def job(scene, motions, tmp_path):
    def made(method: str = "snug", seconds: float = float("inf"), **changes) -> BaselineJob:
        base = TrainJob(
            scene=scene,
            motions=motions,
            held_out=motions[1:],
            model=ModelConfig(latent=4, widths=(8,), shapes=2),
            train=replace(CONFIG, iterations=8, validate_every=3, valid_frames=12, recombinations=0),
            fabric=FABRIC,
            output=tmp_path / f"{method}.safetensors",
            device="cpu",
        )
        return BaselineJob(base=replace(base, **changes), config=BaselineConfig(method=method), seconds=seconds)

    return made


@pytest.mark.parametrize("method", METHODS)
def test_a_run_writes_its_best_model_with_where_it_comes_from(scene, job, method):
    asked = job(method)
    state = train_baseline(asked, silent)
    assert [point.iteration for point in state.curve] == [3, 6, 8] and curve_path(asked.base.output).is_file()
    file, model = load_network(asked.base.output)
    told = file.provenance
    assert told["baseline"] == {"method": method, "fps": 30.0} and told["train"]["window"] == 8
    assert (told["iteration"], told["validation"]["total"]) == (state.best.iteration, state.best.score.total)
    assert file.fabric == FABRIC and file.joints.tolist() == [0, 1]  # the arm does not matter to the strip
    run = BaselineRun(asked, silent)
    assert run.validator.score(model).total == pytest.approx(state.best.score.total, rel=1e-6)


def test_a_run_goes_on_where_it_stopped(job):
    whole = train_baseline(job(), silent)
    stopped = BaselineRun(job(), silent)
    for _ in range(2):
        stopped.advance()
        stopped.validate()
    resumed = train_baseline(job(resume=True), silent)
    assert [point.score for point in whole.curve] == [point.score for point in resumed.curve]


def test_a_run_ends_with_its_time(job, monkeypatch):
    """At ten seconds a step, of which a hundred seconds hold ten."""
    clock = iter(range(10**6))
    run = BaselineRun(job(seconds=100.0), silent)
    monkeypatch.setattr("benchmarks.baselines.run.time.monotonic", lambda: 30.0 * next(clock))
    run.advance()  # three steps between two looks at the clock
    assert run.iterations == run.stepper.config.iterations == 10 and run.state.seconds == 30


def test_files_are_written_and_read_whole(scene, tmp_path):
    path, model = tmp_path / "ncs.safetensors", network(scene, "ncs")
    save_baseline(path, model, FABRIC, {"seed": 1})
    file, loaded = load_network(path)
    assert file.provenance == {"seed": 1, "baseline": {"method": "ncs", "fps": 30.0}}
    assert loaded.state_dict().keys() == model.state_dict().keys()
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())
    with pytest.raises(SsilkError, match=r"ncs.safetensors: the model cannot be used: .*do not fit its header"):
        load_model(path)


def test_models_open_as_what_they_are(scene, toy_model, tmp_path):
    path, model = tmp_path / "model.safetensors", toy_model(scene)
    save_model(path, model_file(model, FABRIC, {}))
    file, loaded = load_network(path)
    assert isinstance(loaded, GarmentModel) and file.config == model.config
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())
