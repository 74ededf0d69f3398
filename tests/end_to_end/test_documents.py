# SPDX-License-Identifier: Apache-2.0
"""What stands in the documents for others to copy: commands that are understood, USD that is read, tests that are."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from pxr import Sdf

from ssilk_core.cli import main

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("docs/pipeline.md", "docs/farm.md")


def blocks(document: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / document).read_text(), flags=re.DOTALL)


def test_layers_of_artists_are_read():
    for text, attribute, codes in zip(
        blocks("docs/pipeline.md", "usda"),
        (
            "/Shot/cape/Animation.blendShapeWeights",
            "/Set/Floor.points",
            "/Hero/Cape.ssilk:free",
            "/Hero/Cape.ssilk:free:left",
            "/Hero/Brooch.ssilk:rideVertices",
        ),
        ([12], [], [1020, 1028, 1050, 1058], [20, 40, 70, 80], []),
        strict=True,
    ):
        layer = Sdf.Layer.CreateAnonymous(".usda")
        assert layer.ImportFromString(text)
        assert layer.GetAttributeAtPath(attribute)
        assert layer.ListTimeSamplesForPath(attribute) == codes


def test_the_floor_and_the_table_of_a_shot_are_met(toy, tmp_path, monkeypatch, capsys):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "walk.usda", frames=3)
    (text,) = [block for block in blocks("docs/pipeline.md", "usda") if "PhysicsCollisionAPI" in block]
    Path("shot.usda").write_text(text.replace("@walk.usd@", "@walk.usda@"))
    words = "simulate rigged.usda --no-body --points --tolerance 0.5 --motion shot.usda -o met.usdc"
    assert main(words.split()) == 0
    assert "shot.usda: cloth meets /Set/Floor, /Set/Table/Top, /Set/Table/Leg\n" in capsys.readouterr().err


def is_there(name: str) -> bool:
    """Return whether "[FOLDER/]FILE::FUNCTION" is one test: test_FUNCTION of one file test_FILE.py."""
    found = re.fullmatch(r"(?:(\w+)/)?(\w+)::(\w+)", name)
    if not found:
        return False
    folder, file, function = found.groups()
    paths = [path for path in (ROOT / "tests").rglob(f"test_{file}.py") if folder in (None, path.parent.name)]
    if len(paths) != 1:
        return False
    tree = ast.parse(paths[0].read_text())
    return f"test_{function}" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def unproved(text: str) -> list[str]:
    """Return the promises of a table that name no test, or one that is not there."""
    rows = [row.strip("|").split("|") for row in re.findall(r"^\|.*\|$", text, re.MULTILINE)[2:]]
    assert rows
    named = {promise.strip(): re.findall(r"`([^`]+)`", tests) for promise, tests in rows}
    assert len(named) == len(rows), "a promise stands there twice"
    return [promise for promise, tests in named.items() if not (tests and all(map(is_there, tests)))]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_each_promise_has_its_test(document):
    assert unproved((ROOT / document).read_text().partition("## Promises")[2]) == []


@pytest.mark.parametrize("tests", [
    "", "`farm`", "`test_farm.py`", "`farm::no_such_test`", "`no_such_file::a_bundle_runs_unchanged_with_openjd`",
    "`layers::hidden_spans_are_kept`", "`farm_jobs::numbers_of_tasks`, `farm::layers`",
])  # fmt: skip
def test_a_promise_without_a_test_is_found(tests):
    """A file alone, names that are not there, a file of two names, and a function beside the tests."""
    rows = ["| promise | test |", "|---|---|", "| held | `farm_jobs::numbers_of_tasks` |", f"| broken | {tests} |"]
    assert unproved("\n".join(rows)) == ["broken"]
