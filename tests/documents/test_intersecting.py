# SPDX-License-Identifier: Apache-2.0
"""Columns of cloth that passes through cloth stand in the tables where the result files have its figures."""

from __future__ import annotations

import copy
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
FOUND = {"mean": 0.0312, "worst": 0.258}


@pytest.fixture
def results(monkeypatch, tmp_path):
    """The tables of results.md, of result files that can be changed before they are read."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from documents import forms, results

    forms.document.cache_clear()
    monkeypatch.setattr(sys.modules["documents.forms"], "RESULTS", tmp_path)
    for path in RESULTS.iterdir():
        (tmp_path / path.name).write_text(path.read_text())
    yield results
    forms.document.cache_clear()


def change(folder: Path, name: str, at) -> None:
    path = folder / f"{name}.json"
    document = json.loads(path.read_text())
    at(document)
    path.write_text(json.dumps(document))


def with_shown(document) -> None:
    document["measured"]["cape"]["test"]["network"]["intersections"] = copy.copy(FOUND)


def with_totals(document) -> None:
    row = next(row for row in document["figures"] if (row["method"], row["split"]) == ("ssilk", "test"))
    row["figures"]["intersections"].update(FOUND)


@pytest.mark.parametrize(
    ("table", "name", "at", "shown"),
    [
        ("overview", "shown_skin", with_shown, "3.12, 25.8"),
        ("other_methods", "evaluate_cape", with_totals, "3.12, 25.8"),
    ],
)
def test_a_measured_share_has_a_column(results, tmp_path, table, name, at, shown):
    change(tmp_path, name, at)
    header, _, *lines = getattr(results, table)().splitlines()
    assert "intersect" in header and sum(f" {shown} |" in line for line in lines) == 1
    assert {line.count("|") for line in lines} == {header.count("|")}
