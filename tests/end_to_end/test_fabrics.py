# SPDX-License-Identifier: Apache-2.0
"""One model for a range of fabrics: trained, put on by its name or factors, and what is written of that."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Usd
from ssilk_usd.opening.garment_api import read_garment_record

from ssilk_core.cli import main
from ssilk_core.cli.main import parser
from ssilk_core.cli.trade import Bench
from ssilk_core.errors import EXIT_OK, EXIT_WORSE
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.network.fabrics import SeenFabrics
from ssilk_core.network.runtime import Player
from ssilk_core.scene.fabric_range import FabricRange, fabric_with
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.training.wardrobe.listing import read_list

from .conftest import run
from .test_direction import points_of

FABRICS_OF_RANGE = ["4", "leather"]
BAKE = "bake ranged.safetensors --stage rigged.usda --motion sway.usda"


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory) -> Path:
    """The toy, a model that is trained on for a range, and one that knows far more of it."""
    folder = tmp_path_factory.mktemp("fabrics")
    toy.copy(folder)
    toy.write_clip(folder / "sway.usda", frames=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        words = "train rigged.usda --motions clip.usda -o learned.safetensors --start-from model.safetensors"
        settings = ("--preset", "draft", "--device", "cpu", "--set", "iterations=4", "--set", "batch=2")
        fabrics = ("--fabrics", *FABRICS_OF_RANGE)
        assert run(words, *settings, "--set", "valid_frames=8", *fabrics) in (EXIT_OK, EXIT_WORSE)
        file, rng = load_model("model.safetensors"), np.random.default_rng(0)
        biases = {name: file.parameters[f"{name}.0.bias"] for name in ("initialiser", "stepper")}
        columns = {name: rng.normal(size=(len(bias), 5)) for name, bias in biases.items()}
        own = {name: value.copy() for name, value in file.parameters.items()}
        own["output.2.weight"] *= 20
        known = SeenFabrics(FabricRange.of(file.fabric, FABRICS_OF_RANGE), columns)
        save_model("ranged.safetensors", replace(file, parameters=own, fabrics=known))
    return folder


def record_of(path: str):
    opened = Usd.Stage.Open(path)
    (mesh,) = (each for each in opened.Traverse() if each.GetName() == "Skirt")
    return read_garment_record(mesh)


def test_training_learns_a_range_from_a_model_of_one_fabric_and_says_so(copy, capsys):
    learned, base = load_model("learned.safetensors"), load_model("model.safetensors")
    assert learned.fabrics.range == FabricRange.of(base.fabric, FABRICS_OF_RANGE)
    assert all(values.any() for values in learned.fabrics.columns.values())
    assert learned.provenance["fabrics"]["presets"] == ["leather"] and "fabrics" not in base.provenance
    assert run("train rigged.usda --motions clip.usda -o on.safetensors --start-from learned.safetensors") == 2
    assert "name the range with --fabrics" in capsys.readouterr().err
    words = "train rigged.usda --motions clip.usda -o on.safetensors --stepper-of model.safetensors --fabrics"
    assert run(words) == 2
    assert "a stepper alone that learns and a range of fabrics" in capsys.readouterr().err
    assert run("train rigged.usda --motions clip.usda -o on.safetensors --fabrics felt") == 2
    assert "'felt', neither a preset nor a factor" in capsys.readouterr().err
    assert not Path("on.safetensors").exists()


def test_a_bake_is_in_the_fabric_that_is_asked_for_and_verify_says_which(copy, capsys):
    assert run(f"{BAKE} -o own.usdc") == 0
    assert run(f"{BAKE} --fabric leather --material bending=0.5x -o leather.usdc") == 0
    told = "fabric 'leather', as factors of the model's own: stretch 3.83, shear 1.41, bending 0.5, density 4, drag 1"
    assert told in capsys.readouterr().err
    found, own = points_of("leather.usdc"), points_of("own.usdc")
    assert np.abs(found - own).max() > 0.01
    record = record_of("leather.usdc")
    assert record.fabric == "leather" and record.parameters["bending"] == pytest.approx(5e-6)
    assert (
        record.parameters["thickness"] == FABRICS["default"].thickness and record_of("own.usdc").fabric == "default"
    )
    capsys.readouterr()
    assert run("verify leather.usdc") == 0
    assert "fabric: leather (lame_lambda 160, lame_mu 120, bending 5e-06, density 0.6" in capsys.readouterr().err
    assert run("verify own.usdc") == 0
    assert "fabric" not in capsys.readouterr().err
    assert run(f"{BAKE} --material lame_mu=22.2 --material density=1x -o same.usdc") == 0
    np.testing.assert_array_equal(points_of("same.usdc"), own)


def test_numpy_plays_what_is_baked(copy):
    from ssilk_usd.reading.motion import read_motion

    assert run(f"{BAKE} --material density=2x --material drag=0.5x -o heavy.usdc") == 0
    file = load_model("ranged.safetensors")
    one = file.on_fabric(fabric_with(file.fabric, np.array([1, 1, 1, 2, 0.5])))
    played = Player(one).play(read_motion("sway.usda", file.scene.character.skeleton))
    found = points_of("heavy.usdc")
    np.testing.assert_allclose([played.vertices(frame) for frame in range(len(found))], found, atol=1e-4)


def test_the_solver_refines_in_the_same_fabric(copy):
    """From the same states: what the solver does differs by its energies alone."""
    file = load_model("ranged.safetensors")
    blind = {name: np.zeros_like(values) for name, values in file.fabrics.columns.items()}
    save_model("blind.safetensors", replace(file, fabrics=replace(file.fabrics, columns=blind)))
    words = "bake blind.safetensors --stage rigged.usda --motion sway.usda --range 0-2"
    assert run(f"{words} --refine 3 -o own.usdc") == 0
    assert run(f"{words} --refine 3 --material stretch=0.25x --material density=4x -o soft.usdc") == 0
    assert run(f"{words} -o own_plain.usdc") == 0
    assert run(f"{words} --material stretch=0.25x --material density=4x -o soft_plain.usdc") == 0
    np.testing.assert_array_equal(points_of("own_plain.usdc"), points_of("soft_plain.usdc"))
    assert np.abs(points_of("own.usdc") - points_of("soft.usdc")).max() > 1e-3


def test_shots_of_one_asset_may_be_of_several_fabrics(copy):
    assert run(f"{BAKE} --shot-name own -o layers") == 0
    assert run(f"{BAKE} --shot-name silk --fabric silk -o layers") == 0
    assets = {path: path.read_bytes() for path in Path("layers/assets").rglob("*.usd*")}
    assert record_of("layers/shots/own/shot.usda").fabric == "default"
    assert record_of("layers/shots/silk/shot.usda").fabric == "silk"
    kept = json.loads(Path("layers/shots/silk/ranged/bake.json").read_text())["key"]
    assert run(f"{BAKE} --shot-name silk --fabric silk -o layers") == 0
    assert json.loads(Path("layers/shots/silk/ranged/bake.json").read_text())["key"] == kept
    assert run(f"{BAKE} --shot-name silk --fabric wool -o layers") == 0
    assert json.loads(Path("layers/shots/silk/ranged/bake.json").read_text())["key"] != kept
    assert record_of("layers/shots/silk/shot.usda").fabric == "wool"
    assert assets == {path: path.read_bytes() for path in Path("layers/assets").rglob("*.usd*")}


def test_fabrics_travel_in_jobs(copy):
    assert run("farm ranged.safetensors --stage rigged.usda --motion sway.usda --fabric wool "
               "--material bending=2x --bundle job") == 0  # fmt: skip
    held = "".join(path.read_text() for path in Path("job").rglob("*") if path.suffix in (".json", ".yaml"))
    assert '"wool"' in held.replace('\\"', '"') and "bending=2x" in held


def test_a_job_tells_what_its_tasks_lack_and_replaces_no_files_of_others(copy, capsys):
    """What one task lacks is told; what all lack is refused."""
    farm = "farm ranged.safetensors model.safetensors --stage rigged.usda --motion sway.usda --bundle job"
    assert run(f"{farm} --fabric silk") == 0
    assert "model.safetensors: --fabric silk for a model of one fabric" in capsys.readouterr().err
    assert run(f"{farm} --material drag=9x") == 0
    assert "drag 9 (trained from 0.25 to 4) is beyond the fabrics of its training" in capsys.readouterr().err
    before = Path("job/job.json").read_bytes()
    for words, text in (
        ("--fabric silk --range 0-999", "--range 0-999"),
        ("--range 0-999", "sway.usda has samples from time code"),
        ("--material bendin=2x", "networks see no factor of it"),
    ):
        assert run(f"{farm} {words}") == 2
        assert text in capsys.readouterr().err
    assert Path("job/job.json").read_bytes() == before
    assert run(farm) == 0 and "the job that was there is replaced" in capsys.readouterr().err
    assert run(farm) == 0 and "replaced" not in capsys.readouterr().err
    Path("job/job.json").write_text('{"name": "of another program"}')
    assert run(farm) == 2 and "and no job of 'ssilk farm'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--material thickness=0.01", "networks do not see it"),
        ("--material thickness=2x", "networks see no factor of it"),
        ("--material bending=x", "a factor is a number before the x"),
        ("--material density=0x", "finite and not negative"),
        ("--material stretch=-1x", "finite and not negative"),
        ("--material bending=2x --material bending=3x", "'bending=2x' and 'bending=3x' are two values of 'bending'"),
        ("--lbs --fabric silk", "linear blend skinning has no fabric"),
        ("--fabric paper", "fabric 'paper': its contact, 'vertex', is all that it has of its own"),
    ],
)
def test_what_networks_do_not_see_is_refused(copy, capsys, words, text):
    assert run(f"{BAKE} {words} -o shot.usdc") == 2
    assert text in capsys.readouterr().err
    assert not Path("shot.usdc").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--material density", "--material density: a name without a value; NAME=VALUE is needed."),
        ("--material density=x1", "--material density=x1: 'x1' is not a value for 'density'"),
        ("--material desnity=3", "--material desnity=3: networks do not see it"),
        ("--material density=-3", "density = -3.0; it must be finite and not negative"),
        ("--material stretch=0x", "those of stretch and density positive"),
    ],
)
def test_a_fabric_that_no_model_has_is_refused_before_a_file_is_opened(tmp_path, monkeypatch, capsys, words, text):
    monkeypatch.chdir(tmp_path)
    for name in ("empty.safetensors", "empty.usda"):
        Path(name).touch()
    for verb in (
        "bake empty.safetensors --stage empty.usda --motion empty.usda -o shot.usdc",
        "evaluate empty.safetensors --stage empty.usda --motions empty.usda",
        "export empty.safetensors -o model.onnx",
    ):
        assert run(f"{verb} {words}") == 2
        assert text in capsys.readouterr().err


def test_a_model_of_one_fabric_refuses_others_in_every_command(copy, capsys):
    base = "model.safetensors --stage rigged.usda"
    for words in (
        f"bake {base} --motion sway.usda -o shot.usdc --fabric silk",
        f"bake {base} --motion sway.usda -o layers --material bending=2x",
        f"evaluate {base} --motions . --fabric silk --no-probes --clips sway",
        "export model.safetensors -o model.onnx --fabric silk",
        f"stress {base} --fabric silk",
        f"trade {base} --motions . --fabric silk",
        f"farm {base} --motion sway.usda --fabric silk --bundle job",
    ):
        assert run(words) == 2
        said = capsys.readouterr().err
        assert "it was trained for one fabric" in said and "--start-from MODEL --fabrics" in said
    assert not Path("shot.usdc").exists() and not Path("model.onnx").exists()
    assert not Path("job").exists()


def test_stress_and_trade_measure_the_fabric_that_is_asked_for(copy):
    stress, found = "stress ranged.safetensors --stage rigged.usda --quick -o cases.json", {}
    for fabric in ("silk", "leather"):
        assert run(stress, "--fabric", fabric, "--only", "rate: 60") == 0
        found[fabric] = json.loads(Path("cases.json").read_text())["outcomes"]
    assert [len(each) for each in found.values()] == [1, 1] and found["silk"] != found["leather"]
    Path("clips").mkdir()
    shutil.copy("sway.usda", "clips")
    words = "trade ranged.safetensors --stage rigged.usda --motions clips --fabric silk --material drag=2x"
    bench = Bench(parser().parse_args(words.split()), silent)
    (file,) = bench.files.values()
    assert (file.fabric.name, file.fabrics) == ("silk", None)
    assert file.fabric.drag == 2 * load_model("ranged.safetensors").fabric.drag


def test_beyond_the_range_is_told(copy, capsys):
    assert run(f"{BAKE} --material drag=9x -o shot.usdc") == 0
    said = capsys.readouterr().err
    assert "drag 9 (trained from 0.25 to 4) is beyond the fabrics of its training" in said
    assert run(f"{BAKE} --material drag=4x -o end.usdc") == 0
    np.testing.assert_array_equal(points_of("shot.usdc"), points_of("end.usdc"))


def test_onnx_holds_the_fabric_it_was_exported_for(copy, capsys, graphs):
    assert run("export ranged.safetensors -o own.onnx") == 0
    assert "a model of a range of fabrics: it is exported for that of its training" in capsys.readouterr().err
    assert run("export ranged.safetensors -o silk.onnx --fabric silk") == 0
    save_model("alone.safetensors", load_model("ranged.safetensors").on_fabric(FABRICS["silk"]))
    assert run("export alone.safetensors -o alone.onnx") == 0

    def alike(one: str, other: str) -> bool:
        return all(torch.equal(value, graphs[other][name]) for name, value in graphs[one].items())

    assert alike("silk.onnx", "alone.onnx") and not alike("silk.onnx", "own.onnx")


@pytest.mark.parametrize(
    ("words", "text"), [("2 8", "the factors 2 and 8"), ("silkk", "'silkk', neither a preset nor a factor")]
)
def test_words_of_a_range_are_checked_before_anything_is_read(copy, capsys, words, text):
    assert run(f"train rigged.usda --motions sway.usda -o new.safetensors --fabrics {words}") == 2
    told = capsys.readouterr()
    assert text in told.err and "read" not in told.out + told.err


def test_lists_name_ranges(tmp_path, capsys):
    path = tmp_path / "list.toml"
    path.write_text('[cape]\nstage = "a.usdc"\nmotions = "b"\nfabrics = [4, "silk"]\n')
    (entry,) = read_list(path)
    words = list(entry.words)
    at = words.index("--fabrics")
    assert words[at + 1 : at + 3] == ["4", "silk"]
    path.write_text('[cape]\nstage = "a.usdc"\nmotions = "b"\nfabrics = true\n')
    assert main(["wardrobe", str(path), "-o", str(tmp_path / "out")]) == 2
    assert "a list of presets and factors" in capsys.readouterr().err


def test_what_is_reduced_still_knows_the_range_and_what_it_was_measured_in_is_told(copy, capsys):
    assert run("reduce ranged.safetensors -o small.safetensors --shapes 2 --motions sway.usda") == 0
    told = capsys.readouterr()
    assert "what is kept is the best for its own fabric, and is kept for all" in told.out + told.err
    assert load_model("small.safetensors").fabrics.range == load_model("ranged.safetensors").fabrics.range
