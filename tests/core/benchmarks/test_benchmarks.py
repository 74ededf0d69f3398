# SPDX-License-Identifier: Apache-2.0
"""The folder of benchmarks is what its README says."""

from __future__ import annotations

import json
import re
from fnmatch import fnmatch
from pathlib import Path

import pytest

from benchmarks.helpers.reports import indented, rounded

FOLDER = Path(__file__).parents[3] / "benchmarks"
NAMED = re.findall(r"`([\w*]+\.\w+)`", (FOLDER / "README.md").read_text(encoding="utf-8"))
RESULTS = sorted((FOLDER / "results").iterdir())


@pytest.mark.parametrize("folder", [FOLDER, FOLDER / "helpers"], ids=lambda folder: folder.name)
def test_every_script_and_helper_is_in_the_readme(folder):
    found = {path.name for path in folder.glob("*.py") if path.name != "__init__.py"}
    assert found <= set(NAMED), found - set(NAMED)


def test_the_readme_names_no_script_that_is_gone():
    found = {path.name for path in FOLDER.rglob("*.py")}
    assert {name for name in NAMED if name.endswith(".py")} <= found


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_some_script_makes_each_result(path):
    assert any(fnmatch(path.name, name) for name in NAMED), "benchmarks/README.md does not name it"


def test_result_files_hold_six_digits_and_lines_that_read():
    document = {"a": [0.123456789, 1], "b": {str(n): [n / 3] * 9 for n in range(4)}, "c": (1e-9, None, True, 10**9)}
    text = indented(rounded(document))
    assert json.loads(text)["a"] == [0.123457, 1] and json.loads(text)["c"] == [1e-9, None, True, 10**9]
    assert len(text.splitlines()) == 10 and json.loads(text) == rounded(document)
