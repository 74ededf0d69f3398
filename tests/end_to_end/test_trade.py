# SPDX-License-Identifier: Apache-2.0
"""The trade as users measure it."""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest
from pxr import Sdf

from ssilk_core.cli import main
from ssilk_core.cli.trade import Bench
from ssilk_core.errors import EXIT_WORSE
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.quality.cost import Time

TRADE = "trade model.safetensors --stage rigged.usda --motions motions"


def run(command: str) -> int:
    return main(shlex.split(command))


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    """A folder with the toy's files and three motions, as the working folder; few variants are tried."""
    for name, values in (("SHAPES", (0.5,)), ("JOINTS", (0.0,)), ("INFLUENCES", ()), ("RATES", (0.5,))):
        monkeypatch.setattr(f"ssilk_core.quality.trade.variants.{name}", values)
    monkeypatch.chdir(toy.copy(tmp_path))
    (tmp_path / "motions").mkdir()
    for name, frames in (("long", 14), ("short", 10), ("other", 14)):
        toy.write_clip(tmp_path / "motions" / f"{name}.usda", frames)
    return tmp_path


@pytest.fixture
def no_clock(monkeypatch):
    """Takes no time to tell the time."""
    monkeypatch.setattr("ssilk_core.quality.trade.measure.play_time", lambda player, motion: Time(1.0, 2.0))


@pytest.mark.slow
def test_a_sweep_is_written_drawn_and_taken_up_again(world, capsys, no_clock):
    assert run(f"{TRADE} --clips long short --frames 12 --no-refine -o trade.json") == 0
    document, text = json.loads((world / "trade.json").read_text()), capsys.readouterr().out
    points = {point["variant"]: point for point in document["points"]}
    assert {"as trained", "2 blendshapes", "0 proxies", "int16", "15 frames/s", "crowd", "film"} <= points.keys()
    assert all(name in text for name in points) and document["asked"]["clips"] == ["long", "short"]
    assert document["asked"]["versions"]["libigl"] == version("libigl")  # which counts what intersects
    assert document["asked"]["frames"] == {"long": 12, "short": 10} and "the first 12 of long, 10 of short" in text
    whole, half = points["as trained"], points["15 frames/s"]
    assert whole["position"] == 0 and half["shot_bytes"] < whole["shot_bytes"]
    assert points["2 blendshapes"]["shot_bytes"] < whole["shot_bytes"]
    assert (world / "trade.png").stat().st_size > 1000
    assert run(f"{TRADE} --clips long short --frames 12 --no-refine -o trade.json") == 0
    assert f"{len(points)} rows were measured before and are taken over; it is complete" in capsys.readouterr().err
    assert json.loads((world / "trade.json").read_text()) == document


def test_points_are_of_what_files_hold_and_not_of_their_names(world):
    """A clip, another motion, or a layer of the stage changes under its name, and all files move together."""
    (world / "above.usda").write_text("#usda 1.0\n(\n    subLayers = [@./rigged.usda@]\n)\n")

    def asked(folder: Path) -> dict[str, object]:
        options = argparse.Namespace(
            models=[folder / "model.safetensors"], stage=folder / "above.usda", motions=folder / "motions",
            clips=["long"], frames=12, root=None, device="cpu", output=folder / "trade.json",
            fabric=None, material=[],
        )  # fmt: skip
        return Bench(options, silent).asked

    before = asked(world)
    assert before["clips"] == ["long"] and before["frames"] == {"long": 12}
    moved = shutil.copytree(world, world / "moved")
    assert asked(moved) == before
    reduced = "motions that models are reduced for"
    for name, kind in (("motions/long", "motions"), ("motions/other", reduced), ("rigged", "stage")):
        layer = Sdf.Layer.OpenAsAnonymous(str(moved / f"{name}.usda"))
        layer.comment = "another one"
        layer.Export(str(moved / f"{name}.usda"))
        found = asked(moved)
        assert [name for name, value in found.items() if before[name] != value] == [kind]
        before = found


def test_models_are_put_on_one_table(world, capsys, no_clock):
    shutil.copy("model.safetensors", "again.safetensors")
    command = TRADE.replace("trade model", "trade model.safetensors again", 1)
    assert run(f"{command} --clips short --no-refine --json") == 0
    points = json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]["points"]
    first, second = ([p for p in points if p["model"] == name] for name in ("model", "again"))
    totals = {p["variant"]: p["total"] for p in first}
    assert [p["variant"] for p in second] == ["as trained", "crowd", "game", "film"]  # of another network
    assert [totals[p["variant"]] for p in second] == pytest.approx([p["total"] for p in second])
    assert first[0]["excess"] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--clips nothing", "no clip is called nothing; it holds long, other, short and so on"),
        ("--frames 3", "'3' is not a whole number from 4 to 1e+06"),
        ("-o trade.txt", "it ends in .json"),
        ("-o model.json --stage nowhere.usda", "nowhere.usda: there is no such file"),
        (
            "--motions clip.usda",
            "a folder of motion files is needed; name its folder, and this one with --clips clip",
        ),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(world, capsys, options, message):
    assert run(f"{TRADE} {options}") == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


def test_garments_are_told_apart_by_their_names(world, capsys, no_clock, monkeypatch):
    for name in ("SHAPES", "JOINTS", "RATES"):
        monkeypatch.setattr(f"ssilk_core.quality.trade.variants.{name}", ())
    file = load_model("model.safetensors")
    garment = file.scene.garment
    longer = replace(garment.mesh, points=1.1 * garment.mesh.points)
    for name, mesh in (("apron", replace(longer, path="/Hero/Apron")), ("longer", longer)):
        scene = replace(file.scene, garment=replace(garment, mesh=mesh))
        save_model(f"{name}.safetensors", replace(file, scene=scene))
    command = TRADE.replace("trade model", "trade apron.safetensors model", 1)
    assert run(f"{command} --clips short --no-refine --json") == 0
    points = json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]["points"]
    assert {(p["model"], p["garment"]) for p in points} == {("apron", "Apron"), ("model", "Skirt")}
    assert run(TRADE.replace("trade model", "trade longer.safetensors model", 1)) == 2
    assert "its garment is called Skirt, as is another one of longer" in capsys.readouterr().err


def test_rates_are_not_mixed(world, capsys):
    assert (
        run(
            "train rigged.usda --garment Skirt --motions clip.usda -o other.safetensors --preset draft --set "
            "iterations=2 --set latent=4 --set widths=8 --set shapes=2 --set feedback_points=0 --set fps=24 "
            "--set valid_frames=8"
        )
        == EXIT_WORSE
    )
    capsys.readouterr()
    assert run(TRADE.replace("trade model", "trade other.safetensors model")) == 2
    assert "a model of another skeleton, or rate" in capsys.readouterr().err


def test_models_of_one_name_are_not_taken_for_each_other(world, capsys):
    (world / "other").mkdir()
    shutil.copy("model.safetensors", "other/model.safetensors")
    assert run(TRADE.replace("trade model.safetensors", "trade model.safetensors other/model.safetensors")) == 2
    assert "several models have one name" in capsys.readouterr().err
