# SPDX-License-Identifier: Apache-2.0
"""Tables in the documents are those that `benchmarks/tables_of_documents.py` makes of the result files."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import sys
from pathlib import Path

import pytest

from ssilk_core.errors import SsilkError

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
LARGEST_FILE, LARGEST_FOLDER = 64_000, 400_000  # bytes


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    spec = importlib.util.spec_from_file_location("tables_of_documents", ROOT / "benchmarks/tables_of_documents.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.results.document.cache_clear()
    return module


@pytest.fixture
def copied(tmp_path):
    shutil.copy(ROOT / "README.md", tmp_path)
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("images"))
    return tmp_path


def test_tables_are_current(tables, capsys):
    assert tables.main(["--check"]) == 0, capsys.readouterr().out


def test_a_changed_figure_is_caught_and_written_again(tables, copied, capsys):
    page = copied / "docs" / "results.md"
    text = page.read_text()
    figure = re.search(r"<!-- table: overview -->.*?(\d\.\d{3}), ", text, re.DOTALL)
    page.write_text(text[: figure.start(1)] + "9.999" + text[figure.end(1) :])
    assert tables.main(["--check"], copied) == 1
    assert str(page) in capsys.readouterr().out
    assert tables.main([], copied) == 0
    assert page.read_text() == text


def test_a_table_that_does_not_exist_is_named(tables, copied, capsys):
    (copied / "README.md").write_text("<!-- table: nowhere -->\n<!-- end -->\n")
    assert tables.main(["--check"], copied) == 2
    assert "'nowhere'" in capsys.readouterr().err


def test_an_unfinished_evaluation_makes_no_table(tables, tmp_path, monkeypatch):
    unfinished = {"unfinished": "rows are missing", **json.loads((RESULTS / "evaluate_cape.json").read_text())}
    (tmp_path / "evaluate_cape.json").write_text(json.dumps(unfinished))
    monkeypatch.setattr(sys.modules["documents.forms"], "RESULTS", tmp_path)
    with pytest.raises(SsilkError, match=r"evaluate_cape.json: this measurement is unfinished"):
        tables.TABLES["rest"]()


def test_every_table_is_shown(tables):
    shown = "".join(path.read_text() for path in tables.documents())
    assert set(re.findall(r"<!-- table: (\w+) -->", shown)) == set(tables.TABLES)


def test_every_result_file_is_read_and_small(tables, monkeypatch):
    read, whole = set(), Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, *words: (read.add(path.name), whole(path, *words))[1])
    for table in tables.TABLES.values():
        table()
    files = {path.name: path.stat().st_size for path in RESULTS.iterdir()}
    assert not set(files) - read, f"no table reads {sorted(set(files) - read)}"
    assert not [name for name, size in files.items() if size > LARGEST_FILE]
    assert sum(files.values()) <= LARGEST_FOLDER


@pytest.mark.parametrize("text", ["<!-- table: a -->\n", "<!-- table: a -->\n<!-- table: b -->\n<!-- end -->\n"])
def test_a_table_that_does_not_end_is_refused(tables, text):
    with pytest.raises(KeyError, match="begins and ends"):
        tables.written(text, {"a": str, "b": str})
