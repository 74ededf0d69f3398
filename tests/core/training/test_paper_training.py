# SPDX-License-Identifier: Apache-2.0
"""The paper's own training: a step against a plain loop over turned motions, and whole runs of the preset."""

from __future__ import annotations

import copy
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.cli import train as command
from ssilk_core.cli.main import parser
from ssilk_core.errors import SsilkError
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, network
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import LOOSE, TIGHT, Motion
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import matrix_from_quaternion, quaternion_from_matrix
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.objective import Objective
from ssilk_core.training.run import train
from ssilk_core.training.settings import PRESETS, TrainConfig
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

from .test_objective import at_frame

PAPER = PRESETS["paper"]
MODEL = {
    name: getattr(PAPER.model, name)
    for name in ("scheme", "descriptors", "tanh", "latent_bound", "max_latent_step", "feedback_points",
                 "feedback_proxies")
}  # fmt: skip
STEP = replace(PAPER.train, batch=3, window=6, rotated_fraction=0.7, learning_rate_warmup=0)
SMALL = replace(PAPER.train, iterations=6, batch=2, window=6, validate_every=3, valid_frames=9, pretraining_batch=1)
DOWN = torch.tensor([[0.0, -1, 0]])


def turned(motion: Motion, direction: torch.Tensor, heading: torch.Tensor) -> Motion:
    """The motion turned about the origin, so that `direction` is -y, and what `heading` has across it x."""
    y = -direction.double().numpy()
    x = heading.double().numpy()
    x = x - (x @ y) * y
    x = x / np.linalg.norm(x)
    turn = np.stack([x, y, np.cross(x, y)])
    assert np.linalg.det(turn) == pytest.approx(1)
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    rotations[:, 0] = quaternion_from_matrix(turn @ matrix_from_quaternion(rotations[:, 0]))
    translations[:, 0] = translations[:, 0] @ turn.T
    return replace(motion, rotations=rotations, translations=translations)


def plain_loss(objective: Objective, sampler: WindowSampler, noise: torch.Tensor, motion: Motion) -> torch.Tensor:
    """Eq. 10 of all slots, state by state, as the mean over all states; gravity is straight down."""
    model, frames = objective.model, []
    skeleton = model.scene.character.skeleton
    for slot, first in enumerate(sampler.first.tolist()):
        own = turned(motion, sampler.direction[slot], sampler.heading[slot])
        kind = model.config.descriptors
        bank = objective.bank = build_bank([own], skeleton, model.joints, 30.0, torch.device("cpu"), kind=kind)
        at = [torch.tensor([first + step]) for step in range(sampler.config.window)]
        z, x = [], []
        for step in range(2):
            initial = model.initial(bank.static_descriptor(at[step], DOWN))
            frames.append(sum(at_frame(objective, initial, at[step], DOWN)[1].values()))
            z.append(initial.detach() + noise[step, slot])
            x.append(at_frame(objective, z[-1], at[step], DOWN)[0].detach())
        for step in range(2, sampler.config.window):
            seen = model.seen_from(*z[-2:], bank.triples(at[step]))
            z.append(model.step(*z[-2:], z[-1], bank.dynamic_descriptor(at[step], DOWN), seen))
            now, terms = at_frame(objective, z[-1], at[step], DOWN)
            terms["inertia"] = objective.energy.inertia(now, 2 * x[-1] - x[-2], objective.dt)
            carried = x[-1] + (bank.root[at[step]] - bank.root[at[step - 1]]).T
            terms["drag"] = objective.energy.drag(now, carried, objective.dt)
            frames.append(sum(terms.values()))
            x.append(now.detach())
    return torch.cat(frames).mean()


@pytest.fixture
def stepper(patched_scene, toy_motion, toy_model, toy_objective):
    scene, motion = patched_scene, toy_motion(patched_scene, 40)
    objective = toy_objective(scene, toy_model(scene, scale=0.1, **MODEL), motion)
    sampler = WindowSampler(objective.bank, STEP, 8, torch.Generator().manual_seed(4))
    return Stepper(objective.model, objective, sampler, STEP), motion


def test_a_step_is_plain_adam_on_the_papers_loss(stepper):
    stepper, motion = stepper
    assert len({*map(tuple, stepper.sampler.direction.tolist())}) > 1
    other, drawn = copy.copy(stepper.objective), stepper.sampler.generator.get_state()
    other.model = copy.deepcopy(stepper.model)
    loss = plain_loss(other, stepper.sampler, stepper.sampler.noise(), motion)
    stepper.sampler.generator.set_state(drawn)  # the step draws the same noise
    adam = torch.optim.Adam(other.model.parameters(), lr=3e-4)
    loss.backward()
    length = torch.nn.utils.get_total_norm([value.grad for value in other.model.parameters()])
    stepper.run(0)
    learnt = dict(stepper.model.named_parameters())
    for name, value in other.model.named_parameters():
        found, expected = learnt[name].grad, value.grad / length
        scale = expected.abs().max()
        assert scale > 0, name
        torch.testing.assert_close(found, expected, rtol=2e-2, atol=float(2e-3 * scale), msg=name)
        value.grad.copy_(found)  # Adam's first step has the size of the rate whatever the gradient
    adam.step()
    for name, value in other.model.named_parameters():
        torch.testing.assert_close(learnt[name], value, rtol=1e-5, atol=1e-7, msg=name)
    for mine, averaged in zip(stepper.model.parameters(), stepper.ema_model.parameters()):
        assert torch.equal(mine, averaged)


def test_the_first_two_poses_alone_train_the_initialiser(stepper):
    stepper, _ = stepper
    without = replace(STEP, initial_loss=False, static_batch=1)
    assert stepper.config.static_batch == 0
    frames, direction, _ = stepper.sampler.with_initial(torch.tensor([7]), DOWN, DOWN)
    first = stepper.sampler.first
    assert frames.tolist() == [7, *first.tolist(), *(first + 1).tolist()]
    assert torch.equal(direction, torch.cat([DOWN, stepper.sampler.direction, stepper.sampler.direction]))
    terms, single, _ = stepper.objective.window(stepper.sampler, stepper.sampler.noise(), frames[1:], direction[1:])
    gradient = torch.autograd.grad(
        sum(value.sum() for value in terms.values()), stepper.model.initialiser[0].weight,
        allow_unused=True, retain_graph=True,
    )  # fmt: skip
    assert gradient == (None,) or not gradient[0].any()
    sum(value.sum() for value in single.values()).backward()
    assert stepper.model.initialiser[0].weight.grad.any()
    with pytest.raises(SsilkError, match="'static_batch'"):
        replace(without, static_batch=0)


def test_headings_are_uniform_across_gravity_and_still_where_it_is_not_turned(stepper):
    stepper, _ = stepper
    sampler = WindowSampler(stepper.objective.bank, replace(STEP, batch=4000), 8, torch.Generator().manual_seed(1))
    for _ in range(2):
        still = (sampler.direction == DOWN).all(1)
        assert 0.25 < still.float().mean() < 0.35
        assert torch.equal(sampler.heading[still], torch.tensor([[1.0, 0, 0]]).expand(int(still.sum()), 3))
        assert sampler.heading[~still].mean(0).abs().max() < 0.1
        before = sampler.heading.clone()
        sampler.advance(torch.zeros(2, 4000, 8))
        assert (sampler.heading != before).any()
    restored = WindowSampler(stepper.objective.bank, replace(STEP, batch=4000), 8, torch.Generator().manual_seed(2))
    restored.restore({name: value.clone() for name, value in sampler.state().items()})
    assert torch.equal(restored.heading, sampler.heading)


def test_gradients_are_normalised_unless_asked_otherwise(stepper):
    stepper, _ = stepper
    sizes = []
    for normalised in (True, False):
        own = copy.deepcopy(stepper.model)
        objective = copy.copy(stepper.objective)
        objective.model = own
        config = replace(STEP, normalised_gradients=normalised)
        sampler = WindowSampler(objective.bank, config, 8, torch.Generator().manual_seed(4))
        Stepper(own, objective, sampler, config).run(0)
        sizes.append(torch.nn.utils.get_total_norm([value.grad for value in own.parameters()]).item())
    assert sizes[0] == pytest.approx(1, rel=1e-4) and abs(sizes[1] - 1) > 0.1


@pytest.mark.parametrize("scale", [0.0, 0.1, 1.0])
def test_skinning_weights_learn_at_their_own_rate(stepper, scale):
    stepper, _ = stepper
    before = stepper.model.decoder.skin_offset.detach().clone()
    config = replace(STEP, skinning_learning_rate_scale=scale)
    Stepper(stepper.model, stepper.objective, stepper.sampler, config).run(0)
    moved = (stepper.model.decoder.skin_offset.detach() - before).abs().max()
    assert float(moved) == pytest.approx(scale * 3e-4, rel=1e-2, abs=1e-9)


def paper_job(scene, toy_motion, output, train_config: TrainConfig = SMALL, **changes) -> TrainJob:
    model = replace(PAPER.model, latent=8, widths=(16,), shapes=4)
    job = TrainJob(
        scene=scene, motions=[toy_motion(scene, 40)], held_out=[toy_motion(scene, 30, speed=1.3)], model=model,
        train=train_config, fabric=replace(FABRICS["paper"], drag=0.0), output=output, device="cpu",
    )  # fmt: skip
    return replace(job, **changes)


@pytest.mark.usefixtures("few_contacts")
def test_the_preset_trains_resumes_and_plays(scene, toy_motion, tmp_path):
    whole = paper_job(scene, toy_motion, tmp_path / "whole.safetensors")
    assert train(whole, silent).finished
    stop, halves = threading.Event(), paper_job(scene, toy_motion, tmp_path / "halves.safetensors")

    def report(event) -> None:
        if getattr(event, "step", 0) == 1 or type(event).__name__ == "Checkpoint":
            stop.set()

    assert not train(halves, report, stop).finished
    assert train(replace(halves, resume=True), silent).finished
    one, other = load_model(whole.output), load_model(halves.output)
    assert all(np.array_equal(value, other.parameters[name]) for name, value in one.parameters.items())
    model, motion = network(one, scene).eval(), toy_motion(scene, 20, speed=2.0)
    expected = np.concatenate([decode(model, motion, pose) for pose in garment_poses(model, motion, 30.0)])
    playback = Player(one).play(motion)
    np.testing.assert_allclose([playback.vertices(frame) for frame in range(20)], expected, atol=2e-5)


@pytest.mark.usefixtures("few_contacts")
def test_a_tight_garment_keeps_the_papers_stepper(scene, toy_motion, tmp_path):
    classes = np.where(scene.classes == LOOSE, TIGHT, scene.classes)
    tight = replace(scene, garment=replace(scene.garment, classes=classes))
    job = paper_job(tight, toy_motion, tmp_path / "tight.safetensors", replace(SMALL, iterations=2))
    assert job.model.scheme == "verlet"
    assert replace(job, model=ModelConfig()).model.scheme == "quasi_static"
    assert train(job, silent).finished
    assert {"integrator.alpha", "integrator.beta"} <= load_model(job.output).parameters.keys()


def test_the_preset_brings_its_fabric_unless_another_is_named():
    words = ["train", "hero.usda", "--motions", "walks", "-o", "cape.safetensors", "--preset", "paper"]
    told = []
    options = parser().parse_args([*words, "--material", "density=0.2"])
    command._take_fabric(options, told.append)
    assert options.fabric == "paper" and options.material == ["drag=0", "density=0.2"]
    assert [event.text for event in told] == ["fabric 'paper' with drag=0 is taken, which preset 'paper' means"]
    options = parser().parse_args([*words, "--fabric", "silk"])
    command._take_fabric(options, told.append)
    assert (options.fabric, options.material, len(told)) == ("silk", [], 1)


def test_turning_is_a_rotation_about_the_origin(toy_motion, scene):
    """The helper of this test, against one of scipy's rotations."""
    rotation = Rotation.random(random_state=3).as_matrix()
    motion = toy_motion(scene, 3)
    found = turned(motion, *(torch.tensor(rotation.T @ axis) for axis in ([0.0, -1, 0], [1.0, 0, 0])))
    np.testing.assert_allclose(found.translations[:, 0], motion.translations[:, 0] @ rotation.T, atol=1e-12)
