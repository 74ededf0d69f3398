# SPDX-License-Identifier: Apache-2.0
"""The training objective against a plain loop over slots and frames, in values and in gradients."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.physics.collision import signed_distance_to_planes
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.physics.intersections.cloth import ClothIntersections
from ssilk_core.physics.intersections.contours import IntersectionContours
from ssilk_core.physics.skinning import Skinning
from ssilk_core.training.motion_bank import MotionBank
from ssilk_core.training.objective import Objective, total
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

CONFIG = TrainConfig(batch=3, window=6, static_batch=6, rotated_fraction=0.5, noise=0.2, outlier_energy=0)
ROUNDING = 64  # units in the last place of the largest latent: four steps in single precision are off by 14 to 19


@pytest.fixture
def scene(patched_scene):
    return patched_scene


@pytest.fixture
def objective(scene, toy_motion, toy_model, toy_objective) -> Objective:
    return toy_objective(scene, toy_model(scene), toy_motion(scene, 40), toy_motion(scene, 20, speed=2.0))


POSES = torch.tensor([3, 45, 20]), torch.nn.functional.normalize(torch.tensor([[0.0, -1, 0], [1, 2, 0], [0, 1, 1]]))


def sampler_of(objective: Objective, config: TrainConfig) -> WindowSampler:
    sampler = WindowSampler(objective.bank, config, 8, torch.Generator().manual_seed(4))
    sampler.advance(torch.randn(2, 3, 8, generator=torch.Generator().manual_seed(5)))
    sampler.carried.copy_(torch.tensor([True, False, True]))
    return sampler


def at_frame(objective: Objective, z: torch.Tensor, frame: torch.Tensor, down: torch.Tensor) -> tuple:
    """Positions and potential terms of one state at one frame."""
    character, energy = objective.bank.character(frame), objective.energy
    x = objective.model.vertices(z, character)
    sampled = energy.cloth.positions(x)
    planes = objective.contacts.planes(sampled, objective.body.pose(character))
    terms = {
        "stretch": energy.stretch(x),
        "bending": energy.bending(x),
        "stitch": energy.stitch(x),
        "gravity": energy.gravity(x - character[0, :, 3], GRAVITY * down.T),
        "collision": energy.collision_at(signed_distance_to_planes(sampled, *planes) - objective.clearance),
    }
    skin, rest = Skinning(objective.model.scene.lbs_skin), objective.model.decoder.rest
    terms["tether"] = energy.tether(x, skin(rest, None, skin.weights, character)[energy.tethered])
    return x, terms


def reference(objective: Objective, sampler: WindowSampler, noise: torch.Tensor, bptt: bool) -> tuple:
    """The windows of all slots, one state at a time; time-major lists of terms, and the last two latents."""
    model, bank, length = objective.model, objective.bank, sampler.config.window
    dynamic = [[{} for _ in sampler.first] for _ in range(length - 2)]
    static_batch = [[{}] for _ in POSES[0]]
    for slot, first in enumerate(sampler.first):
        down = sampler.direction[slot : slot + 1]
        frames = [first[None] + t for t in range(length)]
        z = rolled(model, bank, sampler, noise, slot, bptt)
        x = [at_frame(objective, z[t], frames[t], down)[0].detach() for t in range(2)]
        for t in range(2, length):
            now, terms = at_frame(objective, z[t], frames[t], down)
            terms["inertia"] = objective.energy.inertia(now, 2 * x[-1] - x[-2], objective.dt)
            carried = x[-1] + (bank.root[frames[t]] - bank.root[frames[t - 1]]).T
            terms["drag"] = objective.energy.drag(now, carried, objective.dt)
            dynamic[t - 2][slot] = terms
            x.append(now.detach())
    for row, frame, down in zip(static_batch, POSES[0].split(1), POSES[1].split(1)):
        row[0] = at_frame(objective, model.initial(bank.static_descriptor(frame, down)), frame, down)[1]
    return flat(dynamic), flat(static_batch)


def rolled(
    model: GarmentModel, bank: MotionBank, sampler: WindowSampler, noise: torch.Tensor, slot: int, bptt: bool
) -> list[torch.Tensor]:
    """The latents of the window of a slot, (1, m) each, in the precision of the model."""
    down, kind = sampler.direction[slot : slot + 1], model.decoder.rest.dtype
    frames = [sampler.first[slot : slot + 1] + t for t in range(sampler.config.window)]
    rest = [model.initial(bank.static_descriptor(frame, down).to(kind)) for frame in frames]
    begun = sampler.latents[:, slot] if sampler.carried[slot] else torch.cat(rest[:2]).detach()
    z = list((begun.to(kind) + noise[:, slot]).split(1))
    for t in range(2, len(frames)):
        past = z[-2:] if bptt else [v.detach() for v in z[-2:]]
        pose = bank.dynamic_descriptor(frames[t], down).to(kind)
        with torch.set_grad_enabled(bptt):
            body = bank.triples(frames[t])
            seen = model.seen_from(*past, BodyFrames(body.matrices.to(kind), body.bend.to(kind)))
        z.append(model.step(*past, rest[t].detach(), pose, seen))
    return z


def flat(rows: list) -> dict[str, torch.Tensor]:
    return {name: torch.cat([slot[name] for row in rows for slot in row]) for name in rows[0][0]}


def gradients(objective: Objective, loss: torch.Tensor) -> dict[str, torch.Tensor]:
    names, values = zip(*objective.model.named_parameters())
    found = torch.autograd.grad(loss, values, allow_unused=True, retain_graph=True)
    return {name: torch.zeros_like(v) if g is None else g for name, v, g in zip(names, values, found)}


@pytest.mark.parametrize(("bptt", "clearance"), [(False, 0.0), (True, 0.0), (False, 0.02)])
def test_a_window_equals_a_plain_loop(objective, bptt, clearance):
    sampler, objective.clearance = sampler_of(objective, replace(CONFIG, bptt=bptt)), clearance
    noise = sampler.noise()
    found, expected = objective.window(sampler, noise, *POSES), reference(objective, sampler, noise, bptt)
    for mine, theirs in zip(found[:2], expected):
        assert mine.keys() == theirs.keys()
        for name, value in mine.items():
            assert value.abs().min() > 0 or name == "collision"
            np.testing.assert_allclose(value.detach(), theirs[name].detach(), rtol=2e-3, atol=1e-6, err_msg=name)
    assert found[0]["collision"].max() > 0
    exact = copy.deepcopy(objective.model).double()
    states = [
        torch.cat(rolled(exact, objective.bank, sampler, noise, slot, bptt)[-2:]) for slot in range(CONFIG.batch)
    ]
    rounding = ROUNDING * torch.finfo(torch.float32).eps * float(found[2].abs().max())
    np.testing.assert_allclose(found[2], torch.stack(states, dim=1).detach(), rtol=0, atol=rounding)
    mine, theirs = (gradients(objective, total(each[0]) + total(each[1])) for each in (found, expected))
    for name, value in mine.items():
        np.testing.assert_allclose(
            value, theirs[name], atol=2e-3 * float(theirs[name].abs().max()) + 1e-9, err_msg=name
        )


def test_the_contours_of_every_fourth_frame_stand_for_all(objective, monkeypatch):
    pytest.importorskip("igl")
    assert "intersection" not in objective.window(sampler_of(objective, CONFIG), torch.zeros(2, 3, 8), *POSES)[0]
    mesh, classes = objective.model.scene.garment.mesh, objective.model.scene.classes
    objective.contours = IntersectionContours(ClothIntersections(mesh), classes, 0.5, torch.device("cpu"))
    posed = objective.model.vertices
    crumpled = 0.1 * torch.randn(mesh.vertex_count, 3, 1, generator=torch.Generator().manual_seed(1))
    decoded = []
    monkeypatch.setattr(
        objective.model, "vertices", lambda *known: decoded.append(posed(*known) + crumpled) or decoded[-1]
    )
    dynamic, static_batch, _ = objective.window(sampler_of(objective, CONFIG), torch.zeros(2, 3, 8), *POSES)
    found = torch.cat([dynamic["intersection"], static_batch["intersection"]])
    expected = objective.contours.lengths(decoded[-1])
    assert len(found) == len(expected) == 15 and expected.min() > 0.1
    torch.testing.assert_close(found[::4], 15 / 4 * 0.5 * expected[::4])
    assert not found.reshape(-1)[torch.arange(15) % 4 > 0].any()
    slopes = gradients(objective, found.sum())
    for name in ("decoder.shapes", "stepper.0.weight", "initialiser.0.weight"):
        assert slopes[name].abs().max() > 0


def test_through_time_the_stepper_answers_for_later_frames(objective):
    slopes = []
    for bptt in (False, True):
        sampler = sampler_of(objective, replace(CONFIG, bptt=bptt))
        dynamic, _, _ = objective.window(sampler, torch.zeros(2, 3, 8), *POSES)
        slopes.append(gradients(objective, dynamic["gravity"][-3:].sum())["stepper.0.weight"])
    assert (slopes[0] - slopes[1]).norm() > 0.05 * slopes[1].norm()


@pytest.mark.parametrize("bptt", [False, True])
def test_the_initialiser_learns_from_rest_states_alone(objective, bptt):
    sampler = sampler_of(objective, replace(CONFIG, bptt=bptt))
    dynamic, static_batch, _ = objective.window(sampler, sampler.noise(), *POSES)
    from_motion, from_rest = gradients(objective, total(dynamic)), gradients(objective, total(static_batch))
    for name in from_motion:
        if name.startswith("initialiser."):
            assert from_motion[name].abs().max() == 0 and from_rest[name].abs().max() > 0
        if name.startswith(("stepper.", "integrator.")):
            assert from_rest[name].abs().max() == 0 and from_motion[name].abs().max() > 0


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_trains_every_parameter(scene, toy_motion, toy_model, toy_objective, scheme):
    objective = toy_objective(scene, toy_model(scene, scheme=scheme), toy_motion(scene, 50))
    sampler = sampler_of(objective, CONFIG)
    dynamic, static_batch, _ = objective.window(sampler, sampler.noise(), *POSES)
    for name, value in gradients(objective, total(dynamic) + total(static_batch)).items():
        assert torch.isfinite(value).all() and value.abs().max() > 0, name


def test_static_terms_are_those_of_the_initialisers_states(objective):
    frames, down = torch.tensor([3, 45]), torch.nn.functional.normalize(torch.randn(2, 3), dim=1)
    terms = objective.static(frames, down)
    for i in range(2):
        z = objective.model.initial(objective.bank.static_descriptor(frames[i : i + 1], down[i : i + 1]))
        expected = at_frame(objective, z, frames[i : i + 1], down[i : i + 1])[1]
        for name in expected:
            assert terms[name][i].item() == pytest.approx(expected[name].item(), rel=2e-3, abs=1e-6), name


def test_total_is_the_mean_over_frames_of_the_sum_of_terms():
    assert total({"a": torch.tensor([1.0, 3.0]), "b": torch.tensor([10.0])}).item() == 12


def test_a_step_weighs_every_frame_the_same(objective):
    """Those the initialiser answers for included, and the gradient of exactly that reaches the optimiser."""
    sampler = sampler_of(objective, replace(CONFIG, noise=0.0, learning_rate=0.0))
    dynamic, static_batch, _ = objective.window(sampler, torch.zeros(2, 3, 8), *POSES)
    decoded = len(dynamic["gravity"]) + len(static_batch["gravity"])
    frames = sum(value.sum() for terms in (dynamic, static_batch) for value in terms.values()) / decoded
    expected = gradients(objective, frames)
    length = torch.cat([value.flatten() for value in expected.values()]).norm()  # only directions count
    stepper = Stepper(objective.model, objective, sampler, sampler.config)
    sampler.poses = lambda count: (*POSES, POSES[1])
    stepper.dynamic_step()
    for name, value in objective.model.named_parameters():
        assert value.grad is not None
        direction = expected[name] / length
        np.testing.assert_allclose(value.grad, direction, atol=1e-5 * float(direction.abs().max()) + 1e-12)
    assert stepper.terms["inertia"].item() == pytest.approx(dynamic["inertia"].mean().item(), rel=1e-5)
    assert all(value.is_leaf and not value.requires_grad for value in stepper.ema_model.parameters())  # no history


@pytest.mark.parametrize("scale", [1e-3, 1e6])
def test_only_the_direction_of_a_gradient_counts(objective, scale):
    """One garment torn in one step must not move everything."""
    moved = []
    for factor in (1.0, scale):
        other = copy.copy(objective)
        other.model = copy.deepcopy(objective.model)
        stepper = Stepper(other.model, other, sampler_of(objective, CONFIG), CONFIG)
        for optimiser in stepper.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = 0.01
        loss = factor * sum((value**2).sum() for value in other.model.parameters())
        stepper._descend(loss, {"loss": loss}, {})
        moved.append(dict(other.model.named_parameters()))
    for name, value in moved[0].items():
        np.testing.assert_allclose(moved[1][name].detach(), value.detach(), atol=1e-6)


@pytest.mark.parametrize("optimiser", ["muon", "adam"])
def test_only_the_matrices_of_networks_decay(objective, optimiser):
    config = replace(CONFIG, optimiser=optimiser)
    moved = []
    for decay in (0.0, 0.5):
        other = copy.copy(objective)
        other.model = copy.deepcopy(objective.model)
        stepper = Stepper(other.model, other, sampler_of(objective, config), replace(config, weight_decay=decay))
        for group in (group for each in stepper.optimisers.values() for group in each.param_groups):
            group["lr"] = 0.01
        before = {name: value.detach().clone() for name, value in other.model.named_parameters()}
        loss = sum(value.sum() for value in other.model.parameters())
        stepper._descend(loss, {"loss": loss}, {})
        moved.append({name: value.detach() for name, value in other.model.named_parameters()})
    networks = ("initialiser.", "stepper.", "output.")
    for name, value in moved[1].items():
        decays = value.ndim == 2 and name.startswith(networks)
        expected = moved[0][name] - (0.01 * 0.5 * before[name] if decays else 0)
        np.testing.assert_allclose(value, expected, atol=1e-6, err_msg=name)


def test_each_part_of_a_model_moves_at_its_own_rate(objective):
    config = replace(
        CONFIG,
        optimiser="adam",
        integrator_learning_rate_scale=3.0,
        shape_learning_rate_scale=0.5,
    )
    other = copy.copy(objective)
    other.model = copy.deepcopy(objective.model)
    stepper = Stepper(other.model, other, sampler_of(objective, config), config)
    for group in stepper.optimisers["adam"].param_groups:
        group["lr"] = 0.01 * group["scale"]
    before = {name: value.detach().clone() for name, value in other.model.named_parameters()}
    loss = sum(value.sum() for value in other.model.parameters())
    stepper._descend(loss, {"loss": loss}, {})
    rates = {"integrator.beta": 3.0, "integrator.share": 3.0, "decoder.skin_offset": 0.1, "decoder.shapes": 0.5}
    for name, value in other.model.named_parameters():  # Adam's first step is one learning rate
        moved = (before[name] - value.detach()).numpy()
        np.testing.assert_allclose(moved, np.full(moved.shape, 0.01 * rates.get(name, 1.0)), rtol=1e-3)
