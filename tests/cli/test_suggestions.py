# SPDX-License-Identifier: Apache-2.0
"""Mistyped names: what was mistyped is named, and what was probably meant is suggested."""

from __future__ import annotations

import pytest

from ssilk_core.cli import main
from ssilk_core.errors import SsilkError
from ssilk_core.network.settings import apply_overrides
from ssilk_core.scene.fabrics import FABRICS, fabric_named
from ssilk_core.training.settings import PRESETS, TrainConfig, preset_named

BAKE = "bake cape.safetensors --stage hero.usdc --motion walk.usdc -o shot.usdc"
TRAIN = "train hero.usdc --motions walks -o cape.safetensors"


def told(capsys, command: str) -> str:
    """Return the one line that a command fails with."""
    assert main(command.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("command", "mistyped", "meant"),
    [
        ("bkae cape.safetensors", "'bkae'", "'bake'"),
        ("help trian", "'trian'", "'train'"),
        ("--vresion", "'--vresion'", "'--version'"),
        ("bake --stge hero.usdc", "'--stge'", "'--stage'"),
        ("bake --stge=hero.usdc", "'--stge'", "'--stage'"),
        ("bake -stage hero.usdc", "'-stage'", "'--stage'"),
        (f"{BAKE} --quality heroo", "'heroo'", "'hero'"),
        (f"{BAKE} --target game9", "'game9'", "'game8'"),
        (f"{TRAIN} --preset fianl", "'fianl'", "'final'"),
        (f"{TRAIN} --fabric slik", "'slik'", "'silk'"),
        (f"{TRAIN} --preset draft --set iteratons=3", "iteratons", "'iterations'"),
        (f"{TRAIN} --preset draft --material dragg=3", "dragg", "'drag'"),
        ("completion bsh", "'bsh'", "'bash'"),
        ("simulate hero.usdc --friction 0.4", "'--friction'", "'--material friction=VALUE'"),
        (f"{TRAIN} --iterations=300", "'--iterations'", "'--set iterations=VALUE'"),
    ],
)
def test_what_was_mistyped_is_named_and_what_was_meant_is_suggested(
    tmp_path, monkeypatch, capsys, command, mistyped, meant
):
    monkeypatch.chdir(tmp_path)
    for name in ("hero.usdc", "walks"):
        (tmp_path / name).touch()
    line = told(capsys, command)
    assert mistyped in line
    assert line.endswith(f"did you mean {meant}?")


def test_names_that_resemble_none_get_no_suggestion(capsys):
    assert told(capsys, "bake --xyzzy") == (
        "error: ssilk bake: no such option '--xyzzy'; 'ssilk bake --help' lists what is allowed."
    )
    assert "did you mean" not in told(capsys, f"{TRAIN} --name=x")  # a fabric's is no property of it
    line = told(capsys, f"{BAKE} --quality q")
    assert "'q'; it is one of crowd, game, film, latent, hero" in line and "did you mean" not in line


def test_an_option_that_is_missing_is_named_where_no_other_is_mistyped(capsys):
    assert "required: --stage" in told(capsys, "bake cape.safetensors --motion walk.usdc -o shot.usdc")


@pytest.mark.parametrize("words", [["-3-5"], ["--", "--stge"], ["a --stge b"], ["-oshot.usdc"]])
def test_what_argparse_takes_for_a_value_is_no_mistyped_option(capsys, words):
    assert main(["bake", *words]) == 2
    assert "no such option" not in capsys.readouterr().err


def test_python_gets_the_same_suggestions():
    with pytest.raises(SsilkError, match=r"no such preset; it is one of draft, .*; did you mean 'draft'\?$"):
        preset_named("drfat")
    with pytest.raises(SsilkError, match=r"did you mean 'wool'\?$"):
        fabric_named("wol")
    with pytest.raises(SsilkError, match=r"did you mean 'seed'\?$"):
        apply_overrides(TrainConfig(), ["sed=1"])
    with pytest.raises(SsilkError, match=r"^--material name=lace: 'name' is a label, not a setting; it is one of "):
        apply_overrides(FABRICS["wool"], ["name=lace"], "--material")
    assert preset_named("draft") is PRESETS["draft"] and fabric_named("wool") is FABRICS["wool"]


def test_an_option_that_another_verb_has_is_not_taken_for_one_that_looks_like_it(capsys):
    said = told(capsys, f"{BAKE.replace('bake', 'farm', 1)} --quality hero")
    assert "no such option '--quality'" in said and "did you mean" not in said
