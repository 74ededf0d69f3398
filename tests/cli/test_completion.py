# SPDX-License-Identifier: Apache-2.0
"""Completion by the tab key: what bash and fish offer, from the script alone."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from ssilk_core.cli import main
from ssilk_core.cli.main import VERBS
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.training.settings import PRESETS

BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
_shtab_ssilk
printf '%s\\n' "${COMPREPLY[@]}"
"""
FISH = 'source $argv[1]; complete -C "$argv[2..-1]"'


def offered(shell: str, folder: Path, script: str, words: list[str]) -> set[str]:
    """Return what a shell offers for the last word of a command, from a script and without ssilk."""
    path = folder / "script"
    path.write_text(script)
    found = shutil.which(shell)
    assert found
    code = {"bash": [found, "--norc", "-c", BASH, "-"], "fish": [found, "--no-config", "-c", FISH]}[shell]
    done = subprocess.run(
        [*code, str(path), *words], capture_output=True, text=True, check=True, cwd=folder,
        env={"PATH": "/usr/bin:/bin", "HOME": str(folder)},
    )  # fmt: skip
    return {line.partition("\t")[0] for line in done.stdout.split("\n")} - {""}


@pytest.fixture(params=["bash", "fish"])
def complete(request, tmp_path, capsys):
    if not shutil.which(request.param):
        pytest.skip(f"{request.param} is not installed")
    assert main(["completion", request.param]) == 0
    script = capsys.readouterr().out
    return lambda *words: offered(request.param, tmp_path, script, list(words))


def test_verbs_options_and_names_are_completed(complete):
    assert complete("ssilk", "") >= VERBS.keys()
    assert complete("ssilk", "help", "tr") == {"train", "trade"}
    assert complete("ssilk", "bake", "--refine") == {"--refine", "--refined-output"}
    assert complete("ssilk", "bake", "--quality", "") == set(QUALITIES)
    assert complete("ssilk", "train", "--preset", "") == set(PRESETS)


def test_settings_materials_and_files_are_completed(complete, tmp_path):
    (tmp_path / "hero.usdc").touch()
    assert complete("ssilk", "train", "--set", "iter") == {"iterations="}
    assert complete("ssilk", "train", "--material", "dr") == {"drag="}
    assert "name=" not in complete("ssilk", "train", "--material", "na")
    assert complete("ssilk", "bake", "--stage", "he") == {"hero.usdc"}
    assert complete("ssilk", "bake", "--motion", "he") == {"hero.usdc"}


def test_no_shell_but_these_is_taken(capsys):
    assert main(["completion", "cmd"]) == 2
    assert capsys.readouterr().err == "error: ssilk completion shell: 'cmd'; it is one of bash, zsh, fish.\n"
