# SPDX-License-Identifier: Apache-2.0
"""What stands in the documents for others to copy: commands that are understood, USD that is read, tests that are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pxr import Sdf

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("docs/pipeline.md", "docs/farm.md")


def blocks(document: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / document).read_text(), flags=re.DOTALL)


def test_layers_of_artists_are_read():
    (text,) = blocks("docs/pipeline.md", "usda")
    layer = Sdf.Layer.CreateAnonymous(".usda")
    assert layer.ImportFromString(text)
    assert layer.ListTimeSamplesForPath("/Shot/cape/Animation.blendShapeWeights") == [12]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_each_promise_has_its_test(document):
    text = (ROOT / document).read_text().partition("## Promises")[2]
    paths = list((ROOT / "tests").rglob("test_*.py"))
    there = {path.name for path in paths}.union(*(re.findall(r"def (test_\w+)", path.read_text()) for path in paths))
    named = re.findall(r"\btest_\w+(?:\.py)?", text)
    assert named
    assert not set(named) - there
