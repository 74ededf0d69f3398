# SPDX-License-Identifier: Apache-2.0
"""Training over inner garments: what rolls along, what is drawn, what a run and its model remember."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, silent
from ssilk_core.network.checkpoint import load_model, model_file, save_model
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import PINNED, TIGHT, Scene
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training import inner_garments
from ssilk_core.training.inner_garments import InnerModel
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import roll_states
from ssilk_core.training.parts import build_parts
from ssilk_core.training.run import train
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.state import learned_tensors, load_state, state_path

pytestmark = pytest.mark.usefixtures("few_contacts")
CPU = torch.device("cpu")
SHORT = TrainConfig(
    iterations=10, static_fraction=0.3, recombinations=0, perturbations=0, pretraining_batch=6, batch=3,
    static_batch=4, window=5, state_reuse=0.8, learning_rate_warmup=2, ema_decay=0.9,
    validate_every=5, valid_frames=12, seed=7,
)  # fmt: skip


def moved(scene: Scene, by: list[float]) -> Scene:
    mesh = scene.garment.mesh
    return replace(scene, garment=replace(scene.garment, mesh=replace(mesh, points=mesh.points + by)))


@pytest.fixture(scope="module")
def inner(scene, toy_model, tmp_path_factory) -> InnerModel:
    path = tmp_path_factory.mktemp("inner") / "shirt.safetensors"
    model = toy_model(scene, scale=0.05)
    save_model(path, model_file(model, Fabric("toy", thickness=2e-3), {"seed": 3}))
    return InnerModel.load(path)


@pytest.fixture
def asked(scene, toy_motion, inner, tmp_path) -> TrainJob:
    motions = [toy_motion(scene, 60, path="/a"), toy_motion(scene, 45, speed=1.7, path="/b")]
    return TrainJob(
        scene=moved(scene, [0, 0, -0.012]), motions=motions,
        held_out=[toy_motion(scene, 40, speed=1.3, path="/held")],
        model=ModelConfig(latent=6, widths=(16,), shapes=3), train=SHORT, fabric=Fabric("toy", bending=1e-4),
        output=tmp_path / "coat.safetensors", device="cpu", over=[inner],
    )  # fmt: skip


def test_inner_garments_roll_along_as_they_play_alone(asked, inner):
    """Window after window, the inner garment is where its network has it in the whole clip."""
    train_config = replace(SHORT, rotated_fraction=0, state_reuse=1, batch=2)
    parts = build_parts(replace(asked, train=train_config), CPU)
    assert parts.inner is not None and parts.inner.names == ["shirt"]
    sampler = parts.stepper(train_config, 0).sampler
    one = parts.inner._garments[0]
    sampler.first.copy_(torch.tensor([0, 60]))
    down = torch.tensor([0.0, -1.0, 0.0])
    expected = [
        one.positions(z[:20], one.bank.character(torch.arange(start, start + 20)))
        for z, start in zip(roll_states(one.model, one.bank, [range(60), range(60, 105)], down), (0, 60))
    ]
    frames, direction = torch.tensor([7]), down[None]
    worn = None
    for at in (0, 3, 6, 9):
        found = parts.inner.window(sampler, frames, direction)
        moving = found.positions[0][..., :-1].unflatten(2, (3, 2))
        for slot in range(2):
            torch.testing.assert_close(moving[..., slot], expected[slot][..., at + 2 : at + 5], atol=1e-5, rtol=0)
        still = one.model.initial(one.bank.static_descriptor(frames, direction))
        torch.testing.assert_close(found.positions[0][..., -1:], one.positions(still, one.bank.character(frames)))
        kept = sampler.inner["inner.0.worn"].clone()
        assert worn is None or torch.equal(kept, worn)
        worn = kept
        sampler.advance(sampler.latents)
        assert sampler.carried.all()


def test_pinned_cloth_is_tight_where_it_lies_over_cloth_that_moves(asked, inner):
    """Nothing could push it out of that; over pinned cloth, and far from any, it stays pinned."""
    pinned = asked.scene.classes.copy()
    pinned[:5] = pinned[10:15] = PINNED
    worn = replace(asked.scene, garment=replace(asked.scene.garment, classes=pinned))
    found = replace(asked, scene=worn)
    assert found.loosened == 10 and (found.scene.classes[:15] == TIGHT).all() and asked.loosened == 5
    held = replace(inner.file.scene.garment, classes=np.full(len(pinned), PINNED))
    still = replace(inner, file=replace(inner.file, scene=replace(inner.file.scene, garment=held)))
    assert replace(asked, scene=worn, over=[still]).scene is worn
    away = replace(inner, file=replace(inner.file, scene=moved(inner.file.scene, [0, 0, 0.2])))
    assert replace(asked, scene=worn, over=[away]).loosened == 0


def test_a_stepper_alone_leaves_pinned_what_its_model_has_pinned(asked, scene, toy_model):
    """It has no shapes for what would become tight; what is tight in the model already becomes so here."""
    worn = moved(scene, [0, 0, -0.012])
    for own, count in ((worn, 0), (asked.scene, 5)):
        base = model_file(toy_model(own), Fabric("toy"), {})
        found = replace(asked, scene=worn, base=base)
        assert found.loosened == count and np.array_equal(found.scene.classes, own.classes)


def test_inner_garments_see_the_obstacles_that_the_outer_one_meets(asked, scene, toy_model, tmp_path):
    path = tmp_path / "sees.safetensors"
    seeing = toy_model(scene, scale=0.05, proximity_points=3)
    save_model(path, model_file(seeing, Fabric("toy", thickness=2e-3), {"seed": 3}))
    train_config = replace(SHORT, collider_fraction=1.0)
    parts = build_parts(replace(asked, train=train_config, over=[InnerModel.load(path)]), CPU)
    stepper = parts.stepper(train_config, 0)
    sampler, one = stepper.sampler, parts.inner._garments[0]
    frames, direction = torch.arange(20), torch.tensor([0.0, -1.0, 0.0]).expand(20, 3)
    obstacles = sampler.obstacles_at(frames, direction)
    found = parts.inner.poses(frames, direction, sampler.generator, obstacles).positions[0]
    near = one.sight.near(obstacles, frames, direction)
    static = torch.cat([one.sight.seen(near, frames), one.bank.static_descriptor(frames, direction)], dim=1)
    expected = one.positions(one.model.initial(static), one.bank.character(frames))
    torch.testing.assert_close(found, expected)
    blind = parts.inner.poses(frames, direction, sampler.generator).positions[0]
    assert (found - blind).abs().max() > 1e-4
    state = sampler.generator.get_state()
    rolled = [parts.inner.window(sampler, frames, direction, obstacles).positions[0]]
    sampler.obstacles, sampler.inner["inner.0.latents"] = None, torch.zeros_like(sampler.inner["inner.0.latents"])
    sampler.generator.set_state(state)
    rolled.append(parts.inner.window(sampler, frames, direction, obstacles).positions[0])
    assert (rolled[0] - rolled[1])[..., :-20].abs().max() > 1e-4  # of the windows


def test_a_garment_learns_with_and_without_what_is_beneath(asked, monkeypatch):
    parts = build_parts(asked, CPU)
    stepper = parts.stepper(SHORT, 0)
    objective, sampler = stepper.objective, stepper.sampler
    frames = torch.arange(400) % 100
    direction = torch.tensor([0.0, -1.0, 0.0]).expand(400, 3)
    alone = objective.static(frames, direction)["collision"]
    drawn = parts.inner.poses(frames, direction, sampler.generator)
    over = objective.static(frames, direction, drawn)["collision"]
    worn = drawn.worn[0]
    assert 0.65 < worn.float().mean() < 0.85
    assert torch.equal(over[~worn], alone[~worn]) and (over[worn] > alone[worn]).float().mean() > 0.9
    monkeypatch.setattr(inner_garments, "WORN", 0.0)
    nothing = objective.static(frames, direction, parts.inner.poses(frames, direction, sampler.generator))
    assert torch.equal(nothing["collision"], alone)


def test_training_and_validation_meet_the_inner_garment(asked):
    """With cloth beneath, contact costs more and its gradient pushes the garment out, away from the body."""
    over, alone = build_parts(asked, CPU), build_parts(replace(asked, over=()), CPU)
    scores = [parts.validator.lbs_score() for parts in (over, alone)]
    assert scores[0].terms["collision"] > scores[1].terms["collision"] + 1e-6
    assert scores[0].collisions == scores[1].collisions  # of the body alone
    terms, x = [], torch.tensor(asked.scene.garment.mesh.points, dtype=torch.float32)[:, :, None].requires_grad_()
    for parts in (over, alone):
        stepper = parts.stepper(SHORT, 0)
        beneath = None
        if parts.inner:
            cloth = parts.inner._garments[0].cloth
            rest = torch.tensor(asked.over[0].file.scene.garment.mesh.points, dtype=torch.float32)[:, :, None]
            beneath = inner_garments.Beneath([rest[cloth.vertices]], [torch.ones(1, dtype=torch.bool)])
        character = torch.eye(4)[:3].expand(3, 3, 4)[..., None]
        down = torch.tensor([[0.0, -1.0, 0.0]])
        terms.append(stepper.objective.quasi_static_terms(x, down, character, beneath=beneath)["collision"].sum())
    slope = torch.autograd.grad(terms[0] - terms[1], x)[0][:, :, 0]
    loose = slope[15:].norm(dim=1) > 0
    assert loose.any() and (slope[15:][loose][:, 2] > 0).all()  # energy falls towards -z, away from the ball


def test_a_garment_that_cannot_reach_the_inner_one_trains_as_alone(asked, inner, tmp_path):
    """Bit for bit: nothing is drawn, nothing is tested, and it is said."""
    far = replace(inner, name="far", file=replace(inner.file, scene=moved(inner.file.scene, [9.0, 0, 0])))
    told: list[object] = []
    found = []
    for name, over in (("alone", ()), ("beside", [far])):
        job = replace(asked, output=tmp_path / f"{name}.safetensors", over=over)
        train(job, told.append)
        found.append(load_state(state_path(job.output), job.identity())[1])
    assert found[0].keys() == found[1].keys()
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())
    assert any(isinstance(event, Message) and "'far' is left out" in event.text for event in told)
    assert "over" not in replace(asked, over=()).identity()


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(asked, tmp_path):
    whole, parted = asked, replace(asked, output=tmp_path / "parted.safetensors")
    train(whole, silent)
    import threading

    from ssilk_core.training.run import TrainingRun

    run = TrainingRun(parted, silent)
    for _ in range(7):
        run.step()
    run.save()
    train(replace(parted, resume=True), silent, threading.Event())
    (_, one), (_, other) = (load_state(state_path(job.output), job.identity()) for job in (whole, parted))
    assert one.keys() == other.keys() and any("inner.0.latents" in name for name in one)
    assert all(torch.equal(value, other[name]) for name, value in one.items())


def test_a_model_says_what_it_was_trained_over(asked, inner):
    train(asked, silent)
    assert load_model(asked.output).provenance["over"] == {"shirt": inner.sha256}
    with pytest.raises(SsilkError, match="another shirt"):
        train(replace(asked, resume=True, over=[replace(inner, sha256="0" * 64)]), silent)


def test_inner_garments_stay_as_they_are(asked, inner):
    before = {name: value.copy() for name, value in inner.file.parameters.items()}
    parts = build_parts(asked, CPU)
    stepper = parts.stepper(SHORT, 0)
    for iteration in range(6):
        stepper.run(iteration)
    own = dict(parts.inner._garments[0].model.state_dict())
    assert all(np.array_equal(own[name], value) for name, value in before.items())
    assert not any("inner" in name for name in learned_tensors(stepper))


def test_a_skipped_step_is_kept_with_the_inner_states_that_it_began_with(asked, monkeypatch):
    stepper = build_parts(asked, CPU).stepper(SHORT, 0)
    stepper.run(SHORT.static_iterations)
    before = {name: value.clone() for name, value in stepper.sampler.inner.items()}
    monkeypatch.setattr(stepper, "_half", float("nan"))
    stepper.run(SHORT.static_iterations + 1)
    assert int(stepper.skipped.count) == 1
    assert all(torch.equal(stepper.skipped.window[name], value) for name, value in before.items())
    assert not torch.equal(stepper.sampler.inner["inner.0.latents"], before["inner.0.latents"])


@pytest.mark.parametrize("case", ["rate", "joints", "binds", "twice"])
def test_inner_models_that_do_not_fit_are_refused(asked, inner, case):
    file, skeleton = inner.file, inner.file.scene.character.skeleton
    if case == "rate":
        over, says = (
            [replace(inner, file=replace(file, config=replace(file.config, fps=24.0)))],
            "24 frames per second",
        )
    elif case == "twice":
        over, says = [inner, inner], "two inner models of this name"
    else:
        binds = skeleton.bind_transforms.copy()
        binds[1, 0, 3] += 0.01
        other = (
            replace(skeleton, bind_transforms=binds)
            if case == "binds"
            else replace(skeleton, joint_names=("Hips", "Hips/Chest", "Hips/Chest/Arm"))
        )
        says = "bound elsewhere" if case == "binds" else "the joint 'Hips/Chest'"
        scene = replace(file.scene, character=replace(file.scene.character, skeleton=other))
        over = [replace(inner, file=replace(file, scene=scene))]
    with pytest.raises(SsilkError, match=f"--over shirt: .*{says}"):
        replace(asked, over=over)


def test_a_model_that_is_missing_is_told(tmp_path: Path):
    with pytest.raises(SsilkError, match="no such model file"):
        InnerModel.load(tmp_path / "none.safetensors")


def test_models_of_one_file_name_are_told_apart_by_their_folders(inner, tmp_path: Path):
    """As Blender has them, whose trainings all write a model.safetensors into a folder of their own."""
    paths = [tmp_path / name / "model.safetensors" for name in ("Shirt-001", "Vest-001")]
    for path in paths:
        path.parent.mkdir()
        save_model(path, inner.file)

    def names(given: list[Path], output: str) -> list[str]:
        return [model.name for model in InnerModel.load_all(given, Path(output))]

    assert names(paths, "coat.safetensors") == names(paths, "model.safetensors") == ["Shirt-001", "Vest-001"]
    assert names(paths[:1], "coat.safetensors") == ["model"]
    assert names(paths[:1], "Coat-001/model.safetensors") == ["Shirt-001"]
