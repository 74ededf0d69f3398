# SPDX-License-Identifier: Apache-2.0
"""Training for a range of fabrics, and a model of one put on a fabric."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.delivery.bake.fabrics import in_fabric
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import SsilkError
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, model_file, network, save_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.runtime.player import Player
from ssilk_core.network.settings import ModelConfig
from ssilk_core.network.tensors import read_tensors
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.energy.factors import FabricFactors
from ssilk_core.scene.fabric_range import (
    FACTORS,
    UNIT,
    FabricRange,
    ends,
    fabric_with,
    factors_of,
    inputs_of,
)
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.training.fabrics import FabricDrawer
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.parts import build_parts
from ssilk_core.training.run import train
from ssilk_core.training.settings import TrainConfig

CPU = torch.device("cpu")
CONFIG = ModelConfig(latent=8, widths=(16, 12), shapes=4, feedback_points=6)
SEES = replace(CONFIG, proximity_points=4)
OWN = Fabric("toy", bending=1e-4, margin=0.02)
RANGE = FabricRange.of(OWN, ["4", "leather"])
ODD = np.array([0.5, 2.0, 3.0, 1.7, 0.6])
PRESETS = ("silk", "cotton", "denim", "wool", "leather")


@pytest.fixture
def model(scene):
    found = GarmentModel(scene, SEES, np.arange(3), 0, fabrics=len(FACTORS))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in found.parameters():
            value.add_(0.2 * torch.randn(value.shape, generator=generator))
    return found


def fabrics_job(scene, motion, output, **given):
    config = given.pop("model", CONFIG)
    train = given.pop("train", TrainConfig(batch=4, static_batch=2, static_fraction=0))
    return TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=config, train=train, fabric=OWN, output=output,
        **{"fabrics": RANGE, **given},
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["stvk", "baraff_witkin"])
@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_a_point_that_its_factors_give_back(kind, name):
    own, preset = replace(FABRICS["default"], stretch_model=kind), replace(FABRICS[name], stretch_model=kind)
    found = fabric_with(own, factors_of(own, preset), name)
    for key in (
        "density",
        "bending",
        "drag",
        *(("lame_mu", "lame_lambda") if kind == "stvk" else ("stretch", "shear")),
    ):
        assert getattr(found, key) == pytest.approx(getattr(preset, key))
    assert found.thickness == own.thickness and found.name == name
    assert fabric_with(own, np.ones(5)) == own and not inputs_of(factors_of(own, own)).any()


def test_a_range_spans_all_that_it_names():
    own = FABRICS["default"]
    usual, wide = FabricRange.of(own, []), FabricRange.of(own, ["2", "denim", "silk"])
    assert usual.low == (0.25,) * 5 and usual.high == (4.0,) * 5
    for name in ("denim", "silk"):
        assert not wide.beyond(factors_of(own, FABRICS[name]))
    assert wide.high[FACTORS.index("bending")] == pytest.approx(40) and wide.high[FACTORS.index("drag")] == 2
    assert wide.beyond(np.array([1, 1, 50, 1, 1])) == "bending 50 (trained from 0.5 to 40)"
    np.testing.assert_allclose(
        wide.seen(np.array([1, 1, 400, 0, 1])), [0, 0, np.log(40) / UNIT, wide.bounds[0][3], 0]
    )
    assert [fabric.name for fabric in ends(own, wide)] == ["denim", "silk"]
    soft, stiff = ends(own, usual)
    assert stiff.bending == 16 * soft.bending and stiff.lame_lambda == pytest.approx(16 * soft.lame_lambda)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["felt"], "'felt', neither a preset nor a factor"),
        (["1"], "the factor 1 is given|the factor 1;"),
        (["1e9"], "a factor above 1, to 1000, means"),
        (["nan"], "a factor above 1"),
        (["paper"], "contact, 'vertex', is all that it has of its own; contact is as in the training, 'surface'"),
    ],
)
def test_what_is_no_range_is_refused(words, text):
    with pytest.raises(SsilkError, match=text):
        FabricRange.of(OWN, words)


def test_no_factor_gives_a_fabric_what_it_has_none_of():
    for own, other, text in (
        (replace(OWN, drag=0.0), replace(OWN, drag=0.2), "drag = 0.2"),
        (OWN, replace(OWN, stretch_model="baraff_witkin"), "stretch model 'baraff_witkin'"),
        (OWN, replace(OWN, lame_lambda=0.0), "lame_lambda = 0"),
    ):
        with pytest.raises(SsilkError, match=text):
            factors_of(own, other)
    assert factors_of(replace(OWN, drag=0.0), replace(OWN, drag=0.0)).tolist() == [1.0] * 5


@pytest.mark.parametrize("kind", ["stvk", "baraff_witkin"])
def test_energies_of_a_mixed_batch_are_those_of_each_fabric_alone(scene, kind):
    own, rng = replace(OWN, stretch_model=kind), np.random.default_rng(0)
    mesh = scene.garment.mesh
    drawn = 4.0 ** rng.uniform(-1, 1, (7, 5))
    x, last, before = (
        torch.tensor(mesh.points[:, :, None] + 0.02 * rng.normal(size=(*mesh.points.shape, 7))) for _ in range(3)
    )
    x.requires_grad_()
    down, root, shift = (torch.tensor(rng.normal(size=(3, 7))) for _ in range(3))
    energy = GarmentEnergy(mesh, own, scene.classes, dtype=torch.float64)
    planes = (
        torch.ones(len(energy.cloth.samples.area), 3, 7, dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )

    def terms(of, factors, rows):
        sampled = of.cloth.positions(x[..., rows])
        where = planes[0][..., rows], planes[1].expand(len(planes[0]), len(rows))
        return (
            *of.elastic(x[..., rows], factors),
            *of.gravity_and_collision(x[..., rows], root[:, rows], down[:, rows], sampled, *where, factors),
            *of.inertia_and_drag(x[..., rows], last[..., rows], before[..., rows], shift[:, rows], 1 / 30, factors),
        )

    mixed = terms(energy, FabricFactors.of(torch.tensor(np.log(drawn) / UNIT)), list(range(7)))
    (slope,) = torch.autograd.grad(sum(term.sum() for term in mixed), x)
    for row, factors in enumerate(drawn):
        alone = GarmentEnergy(mesh, fabric_with(own, factors), scene.classes, dtype=torch.float64)
        own_terms = terms(alone, None, [row])
        for found, expected in zip(mixed, own_terms):
            torch.testing.assert_close(found[row : row + 1], expected, rtol=1e-10, atol=0)
        (expected,) = torch.autograd.grad(sum(term.sum() for term in own_terms), x)
        torch.testing.assert_close(slope[..., row], expected[..., row], rtol=1e-8, atol=1e-14)


def test_fabrics_are_drawn_within_the_range_their_own_and_mixtures_of_presets():
    fabrics = FabricRange.of(OWN, ["4", "silk", "leather"])
    drawer = FabricDrawer(fabrics, OWN, torch.Generator().manual_seed(0), CPU)
    drawn = drawer.draw(4000).numpy()
    low, high = fabrics.bounds
    assert (drawn >= low - 1e-5).all() and (drawn <= high + 1e-5).all()
    assert 0.17 < (drawn == 0).all(axis=1).mean() < 0.23
    presets = np.stack([inputs_of(factors_of(OWN, FABRICS[name])) for name in ("silk", "leather")])
    near = np.linalg.norm(drawn[:, None] - presets, axis=2) < 0.1
    assert (near.mean(axis=0) > 0.01).all()  # of a box of five dimensions, corners have next to nothing
    alone = FabricDrawer(FabricRange.of(OWN, ["2"]), OWN, torch.Generator().manual_seed(0), CPU).draw(4000).numpy()
    np.testing.assert_allclose(alone.std(axis=0), (0.8 / 12) ** 0.5, rtol=0.1)  # log 2 / log 4 either way


def frames_of(model, motion, skeleton, fabric=None):
    bank = build_bank([motion], skeleton, model.joints, 30.0, CPU)
    frames = torch.arange(bank.frame_count)
    down = torch.tensor([0.0, -1.0, 0.0]).expand(len(frames), 3)
    static, pose = bank.static_descriptor(frames, down), bank.dynamic_descriptor(frames, down)
    if fabric is not None:
        static, pose = (torch.cat([fabric.expand(len(frames), -1), each], dim=1) for each in (static, pose))
    rest = model.initial(static)[:, None]
    z = torch.cat(model.roll([rest[0], rest[1]], rest[2:], pose[2:, None], bank.body(frames[:, None])))
    return model.vertices(z, bank.character(frames))


@torch.no_grad()
def test_a_model_put_on_a_fabric_is_what_it_is_when_it_sees_that_fabric(scene, model, toy_motion):
    motion, skeleton = toy_motion(scene, 12), scene.character.skeleton
    file = model_file(model, OWN, {}, RANGE)
    own = frames_of(model, motion, skeleton)
    for factors in (ODD, np.ones(5)):
        seen = torch.tensor(inputs_of(factors), dtype=torch.float32)
        one = file.on_fabric(fabric_with(OWN, factors, "odd"))
        assert one.fabrics is None and {n: v.shape for n, v in one.parameters.items()} == {
            n: v.shape for n, v in file.parameters.items()
        }
        assert factors_of(OWN, one.fabric) == pytest.approx(factors) and one.fabric.name == "odd"
        folded, unfolded = frames_of(network(one), motion, skeleton), frames_of(model, motion, skeleton, seen)
        torch.testing.assert_close(folded, unfolded, atol=1e-5, rtol=1e-4)
        assert (factors == 1).all() or (folded - own).abs().max() > 0.01
        start = Player(one).play(motion)
        np.testing.assert_allclose(
            start.vertices(7) - start.vertices(7)[:1], folded[..., 7] - folded[:1, :, 7], atol=1e-4
        )
        model.fabric.copy_(seen)  # where descriptors have none, the model's own place counts
        torch.testing.assert_close(frames_of(model, motion, skeleton), unfolded)
        model.fabric.zero_()


@torch.no_grad()
def test_on_its_own_fabric_a_model_is_as_its_file_holds_it_bit_for_bit(scene, model, toy_motion, tmp_path):
    path = tmp_path / "range.safetensors"
    save_model(path, model_file(model, OWN, {"seed": 1}, RANGE))
    file = load_model(path)
    assert file.fabrics.range == RANGE and file.fabrics.columns["stepper"].shape == (16, 5)
    one = file.on_fabric(OWN)
    for name, value in file.parameters.items():
        np.testing.assert_array_equal(one.parameters[name], value)
    motion = toy_motion(scene, 8)
    np.testing.assert_array_equal(Player(file).play(motion).vertices(5), Player(one).play(motion).vertices(5))
    packed = tmp_path / "packed.safetensors"
    save_model(packed, file, pack=True)
    np.testing.assert_array_equal(load_model(packed).fabrics.columns["stepper"], file.fabrics.columns["stepper"])


def test_beyond_its_range_a_network_sees_its_end_and_energies_are_of_the_fabric(model):
    file = model_file(model, OWN, {}, RANGE)
    far, end = np.array([1, 1, 1, 1, 40.0]), np.array([1, 1, 1, 1, 4.0])
    one, other = (file.on_fabric(fabric_with(OWN, factors, "draggy")) for factors in (far, end))
    for name, value in other.parameters.items():
        np.testing.assert_array_equal(one.parameters[name], value)
    assert one.fabric.drag == pytest.approx(40 * OWN.drag)


def test_a_model_of_one_fabric_refuses_another_and_its_file_knows_nothing_of_fabrics(scene, tmp_path):
    path = tmp_path / "one.safetensors"
    save_model(path, model_file(GarmentModel(scene, CONFIG, np.arange(3)), OWN, {}))
    tensors, words = read_tensors(path, "ssilk")
    assert "fabrics" not in json.loads(words["ssilk"]) and not any("fabrics" in name for name in tensors)
    with pytest.raises(SsilkError, match=r"trained for one fabric.*--start-from MODEL --fabrics"):
        load_model(path).on_fabric(FABRICS["silk"])


def test_names_of_presets_mean_what_they_meant_when_a_range_was_made(scene, model, tmp_path, monkeypatch):
    path = tmp_path / "range.safetensors"
    save_model(path, model_file(model, OWN, {}, RANGE))
    monkeypatch.setitem(FABRICS, "leather", replace(FABRICS["leather"], bending=5e-3, drag=0.6))
    found = load_model(path).fabrics.range
    np.testing.assert_array_equal(found.factors_of(OWN, "leather"), RANGE.points[0])
    assert found.other_words(OWN, "leather") == "bending 50, not 2.8, drag 2, not 1"
    assert found.factors_of(OWN, "silk")[2] == pytest.approx(FABRICS["silk"].bending / OWN.bending)
    with pytest.raises(SsilkError, match="each preset has five factors within the range"):
        replace(RANGE, points=((1.0, 1.0, 99.0, 1.0, 1.0),))


def test_a_range_of_before_the_presets_were_calibrated_means_those_of_then(tmp_path):
    shipped = load_model(shipped_path("cape"))
    own, known = shipped.fabric, replace(shipped.fabrics.range, points=None)
    shipped = replace(shipped, fabrics=replace(shipped.fabrics, range=known))
    then = {"silk": 0.3, "cotton": 1.5, "denim": 10, "wool": 5, "leather": 40}
    assert {name: float(known.factors_of(own, name)[2]) for name in known.presets} == pytest.approx(then)
    assert not any(known.beyond(factors_of(own, FABRICS[name])) for name in PRESETS)
    told = "'silk' is the fabric that its training called so; the preset has other factors now: bending 0.7, not 0.3"
    file, words = in_fabric(shipped, "cape", "silk", ())
    assert file.fabric.bending == 3e-6 and any(told in event.text for event in words)
    assert not any("its training called so" in event.text for event in in_fabric(shipped, "cape", "default", ())[1])
    save_model(tmp_path / "again.safetensors", shipped)
    assert load_model(tmp_path / "again.safetensors").fabrics.range == known


def test_a_range_of_another_network_is_refused(model, tmp_path):
    file = model_file(model, OWN, {}, RANGE)
    columns = {name: values[:-1] for name, values in file.fabrics.columns.items()}
    save_model(tmp_path / "odd.safetensors", replace(file, fabrics=replace(file.fabrics, columns=columns)))
    with pytest.raises(SsilkError, match="do not fit the network"):
        load_model(tmp_path / "odd.safetensors")


@torch.no_grad()
@pytest.mark.parametrize("config", [CONFIG, SEES], ids=["blind", "seeing"])
def test_a_model_of_one_fabric_goes_on_for_a_range_as_it_was(scene, toy_motion, tmp_path, config):
    motion = toy_motion(scene, 24)
    alone = GarmentModel(scene, config, np.arange(3), 0)
    generator = torch.Generator().manual_seed(1)
    for value in alone.parameters():
        value.add_(0.2 * torch.randn(value.shape, generator=generator))
    base = model_file(alone, OWN, {})
    parts = build_parts(fabrics_job(scene, motion, tmp_path / "m.safetensors", base=base, whole=True), CPU)
    file = model_file(parts.model, OWN, {}, RANGE)
    assert all(not values.any() for values in file.fabrics.columns.values())
    for found in (file, file.on_fabric(FABRICS["silk"])):
        for name, value in base.parameters.items():
            np.testing.assert_array_equal(found.parameters[name], value)
    skeleton = scene.character.skeleton
    torch.testing.assert_close(
        frames_of(parts.model, motion, skeleton), frames_of(alone, motion, skeleton), atol=5e-5, rtol=1e-3
    )


def test_steps_teach_both_networks_fabrics_and_go_on_from_what_they_learned(scene, toy_motion, tmp_path):
    motion = toy_motion(scene, 24)
    settings = TrainConfig(batch=4, static_batch=2, static_fraction=0, wind_fraction=0.5, collider_fraction=0.5)
    base = model_file(GarmentModel(scene, SEES, np.arange(3), 0), OWN, {})
    job = fabrics_job(scene, motion, tmp_path / "m.safetensors", base=base, whole=True, train=settings)
    parts = build_parts(job, CPU)
    stepper = parts.stepper(job.train, 0)
    for iteration in range(3):
        stepper.run(iteration)
    onward = model_file(parts.model, OWN, {}, RANGE)
    assert all(values.any(axis=0).all() for values in onward.fabrics.columns.values())
    again = build_parts(replace(job, base=onward), CPU).model
    for name, value in parts.model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])


def test_windows_keep_their_fabrics_while_they_go_on(scene, toy_motion, tmp_path):
    job = fabrics_job(
        scene, toy_motion(scene, 200), tmp_path / "m.safetensors", train=TrainConfig(batch=200, window=4)
    )
    sampler = build_parts(job, CPU).stepper(job.train, 0).sampler
    same = []
    for _ in range(4):
        before = sampler.fabric.clone()
        sampler.advance(torch.zeros_like(sampler.latents))
        same.append((sampler.fabric == before).all(1)[sampler.carried])
    assert 0.9 < torch.cat(same).double().mean() < 1
    state = sampler.state()
    assert torch.equal(state["fabric"], sampler.fabric)


@torch.no_grad()
def test_validation_measures_fabrics_as_models_of_these_alone(scene, toy_motion, tmp_path):
    job = fabrics_job(scene, toy_motion(scene, 40), tmp_path / "m.safetensors", train=TrainConfig(valid_frames=20))
    parts = build_parts(job, CPU)
    generator = torch.Generator().manual_seed(1)
    for value in parts.model.parameters():
        value.add_(0.1 * torch.randn(value.shape, generator=generator))
    score = parts.validator.score(parts.model)
    assert [body.name for body in score.bodies] == ["fabric leather"] and not parts.model.fabric.any()
    one = model_file(parts.model, OWN, {}, RANGE).on_fabric(FABRICS["leather"])
    alone = build_parts(replace(job, fabric=one.fabric, fabrics=None), CPU).validator
    density = factors_of(OWN, one.fabric)[FACTORS.index("density")]
    assert score.bodies[0].total == pytest.approx(alone.score(network(one, scene)).total / density, rel=1e-3)
    assert score.bodies[0].lbs == pytest.approx(alone.lbs_score().total / density, rel=1e-3)


def test_what_a_range_cannot_go_on_from_is_refused(scene, model, toy_motion, tmp_path):
    motion, path = toy_motion(scene, 24), tmp_path / "m.safetensors"
    known = model_file(model, OWN, {}, RANGE)
    blind = model_file(GarmentModel(scene, CONFIG, np.arange(3)), OWN, {})
    for given, text in (
        ({"base": known, "whole": True, "fabrics": None}, "name the range with --fabrics"),
        (
            {"base": replace(known, fabric=replace(OWN, drag=0.1)), "whole": True},
            "training goes on with the model's own",
        ),
        ({"base": blind}, "a stepper alone that learns and a range of fabrics"),
        ({"train": TrainConfig(newton_weight=1.0)}, "newton_weight=1 and a range of fabrics"),
    ):
        with pytest.raises(SsilkError, match=text):
            fabrics_job(scene, motion, path, **given)


def test_a_run_does_not_go_on_with_another_range(scene, toy_motion, tmp_path):
    motion, path = toy_motion(scene, 12), tmp_path / "m.safetensors"
    job = fabrics_job(scene, motion, path)
    assert job.identity()["fabrics"] != replace(job, fabrics=FabricRange.of(OWN, ["2"])).identity()["fabrics"]
    assert "fabrics" not in replace(job, fabrics=None).identity()
    assert "points" not in replace(job, fabrics=FabricRange.of(OWN, ["2"])).identity()["fabrics"]  # as runs of before


@pytest.mark.slow
def test_after_a_short_training_stiff_cloth_hangs_less_than_soft_cloth(scene, toy_motion, tmp_path):
    """The strip hangs from its upper end: what is stretched by its weight reaches farther down."""
    motion, path = toy_motion(scene, 40, speed=0.2), tmp_path / "m.safetensors"
    weak = replace(OWN, lame_mu=2.0, lame_lambda=4.0, drag=1.0)
    settings = TrainConfig(
        iterations=260, static_fraction=0.7, pretraining_batch=48, batch=4, static_batch=24, rotated_fraction=0.0,
        recombinations=0, perturbations=0, static_learning_rate=3e-3, learning_rate_warmup=5, valid_frames=20,
        validate_every=260, ema_decay=0.9, shape_learning_rate_scale=1.0,
    )  # fmt: skip
    config = replace(CONFIG, latent=16, widths=(48, 48), translations=True)
    job = replace(fabrics_job(scene, motion, path, model=config, train=settings), fabric=weak)
    job = replace(job, fabrics=FabricRange.of(weak, ["4"]))
    train(job, silent)
    file = load_model(path)
    lowest = []
    for factor in (0.25, 1.0, 4.0):
        one = file.on_fabric(fabric_with(weak, np.array([factor, 1, 1, 1, 1]), "at"))
        played = Player(one).play(motion)
        lowest.append(np.mean([played.vertices(frame)[-5:, 1].mean() for frame in range(5, 40, 5)]))
    assert lowest[0] < lowest[1] - 0.002 and lowest[1] < lowest[2] - 0.002
