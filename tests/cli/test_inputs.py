# SPDX-License-Identifier: Apache-2.0
"""Inputs that are not there are told before anything heavy is loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.cli import main
from ssilk_core.cli.inputs import CHARACTER, MODEL, MOTIONS, need_input
from ssilk_core.cli.options.bodies import members
from ssilk_core.errors import SsilkError
from ssilk_core.events import silent


def refusal(name: object, kind=MODEL) -> str:
    with pytest.raises(SsilkError) as caught:
        need_input(str(name), kind)
    return str(caught.value)


def test_what_is_no_file_is_told_by_what_it_is(tmp_path):
    os.mkfifo(tmp_path / "pipe.usda")
    (tmp_path / "loop.usda").symlink_to("loop.usda")
    (tmp_path / "gone.usda").symlink_to("nowhere.usda")
    assert "a pipe, and no model file; a file of 'ssilk train' is needed." in refusal(tmp_path / "pipe.usda")
    for name in ("loop.usda", "gone.usda"):
        assert f"{name}: a link that leads to no file;" in refusal(tmp_path / name)
    assert "a folder, and no model file;" in refusal(tmp_path)
    need_input(str(tmp_path), MOTIONS)


def test_a_mistyped_name_is_told_with_the_file_that_it_resembles(tmp_path):
    (tmp_path / "cape.safetensors").touch()
    (tmp_path / "cape.txt").touch()
    said = refusal(tmp_path / "cpe.safetensors")
    assert said.endswith("no such model file; a file of 'ssilk train' is needed; did you mean 'cape.safetensors'?")
    assert refusal(tmp_path / "nope.safetensors").endswith("a file of 'ssilk train' is needed.")
    need_input(f"{tmp_path}/cape.safetensors:/Hero", MODEL)
    for elsewhere in ("show.usdz[cape.usda]", "asset://cape"):
        need_input(elsewhere, MODEL)


def test_a_list_that_is_missing_is_told_as_one_where_a_list_is_taken(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garments.toml").touch()
    world = ["--stage", "s.usda", "--motion", "m.usda", "-o", "layers"]
    for words in (
        ["bake", "garment.toml", *world],
        ["bake", "garment.toml:/Hero", *world],
        ["inspect", "garment.toml"],
    ):
        assert main(words) == 2
        told = capsys.readouterr().err
        assert "there is no such list of garments; a TOML file with one table for each" in told
        assert "did you mean 'garments.toml'?" in told
    assert main(["evaluate", "garment.toml", "--stage", "s.usda", "--motions", "m.usda"]) == 2
    assert "there is no such model file; a file of 'ssilk train' is needed" in capsys.readouterr().err


def test_a_shape_without_a_weight_is_told(tmp_path):
    (tmp_path / "hero.usda").touch()
    need_input(f"{tmp_path}/hero.usda:tall=1", CHARACTER)
    for named in ("tall", "tall:1"):
        said = refusal(f"{tmp_path}/hero.usda:{named}", CHARACTER)
        assert f"'{named}' is no shape with a weight; a body of a stage is named as STAGE:SHAPE=WEIGHT" in said


def test_a_shape_that_is_named_like_a_file_is_suggested_with_its_weight(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    stage = Usd.Stage.CreateNew("hero.usda")
    UsdSkel.Root.Define(stage, "/Hero")
    binding = UsdSkel.BindingAPI.Apply(UsdGeom.Mesh.Define(stage, "/Hero/Body").GetPrim())
    shape = UsdSkel.BlendShape.Define(stage, "/Hero/Body/Tall")
    binding.CreateBlendShapesAttr(["tall"])
    binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    stage.Save()
    for words, says in (
        ("inspect hero.usda --onto tall", "tall: there is no such file;"),
        ("train hero.usda --motions . -o cape.safetensors --family tal", "tal: there is no such file;"),
    ):
        assert main(words.split()) == 2
        told = capsys.readouterr().err
        assert says in told and told.rstrip().endswith("did you mean 'tall=1'?")
    assert "weights of shapes without their stage; a body of a stage is named as" in refusal("tall=1", CHARACTER)


def test_a_body_is_named_once_however_its_weights_are_written():
    options = Namespace(stage=Path("hero.usda"), family=[Path("tall=1,heavy=0.5"), Path("heavy=1")])
    assert members(options, silent) == ["hero.usda:heavy=0.5,tall=1", "hero.usda:heavy=1"]
    options.family.append(Path("hero.usda:heavy=1.0"))
    with pytest.raises(SsilkError, match=r"--family hero\.usda:heavy=1: a body that is named twice"):
        members(options, silent)


def test_nothing_heavy_is_loaded_to_say_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "import sys; from ssilk_core.cli import main; code = main(sys.argv[1:]); print({'torch', 'pxr'} & "
    code += "sys.modules.keys()); sys.exit(code)"
    for words in (["bake", "no.safetensors", "--stage", "a.usda", "--motion", "b.usda", "-o", "c.usda"],
                  ["train", "no.usda", "--motions", "b.usda", "-o", "c.safetensors"]):  # fmt: skip
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
        assert done.returncode == 2 and f"{words[1]}: there is no such" in done.stderr
        assert done.stdout.strip() == "set()"


def test_one_of_several_motions_of_a_bake_may_be_missing_and_one_of_a_training_may_not(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("a.usda", "s.usda", "m.safetensors"):
        (tmp_path / name).touch()
    assert main(["train", "s.usda", "--motions", "a.usda", "b.usda", "-o", "c.safetensors"]) == 2
    assert "b.usda: there is no such file or folder; motions are" in capsys.readouterr().err
    main(["bake", "m.safetensors", "--stage", "s.usda", "--motion", "a.usda", "b.usda", "-o", "layers"])
    assert "b.usda: there is no such file or folder; motions are" not in capsys.readouterr().err
