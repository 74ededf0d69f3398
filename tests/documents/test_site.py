# SPDX-License-Identifier: Apache-2.0
"""The documents as a site: `make docs` builds it from all of them, with the public names and films that play."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "CHANGELOG.md"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built as `make docs` does; what Sphinx warns of fails it."""
    folder = tmp_path_factory.mktemp("site")
    words = (ROOT / "Makefile").read_text(encoding="utf-8").partition("-m sphinx ")[2].partition("\n")[0].split()
    words = [str(folder / Path(word).name) if word.startswith("build/") else word for word in words]
    done = subprocess.run([sys.executable, "-m", "sphinx", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "site"


def page(site: Path, document: Path) -> str:
    return (site / document.relative_to(ROOT).with_suffix(".html")).read_text(encoding="utf-8")


def test_the_start_page_leads_to_every_document(site):
    assert "url=docs/index.html" in (site / "index.html").read_text(encoding="utf-8")
    start = page(site, ROOT / "docs" / "index.md")
    for document in DOCUMENTS[:-1]:
        if document.stem != "index":
            assert f'href="{document.stem}.html"' in start
    assert 'href="../CHANGELOG.html"' in start


def test_the_reference_has_every_public_class_and_function(site):
    text = page(site, ROOT / "docs" / "reference.md")
    table = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Public packages")[2]
    packages = re.findall(r"^\| `([\w.]+)` \|", table.partition("\n## ")[0], re.MULTILINE)
    assert packages
    for package in map(importlib.import_module, packages):
        items = {name: getattr(package, name) for name in package.__all__}
        public = [name for name, item in items.items() if inspect.isclass(item) or inspect.isfunction(item)]
        missing = [name for name in public if f'id="{package.__name__}.{name}"' not in text]
        assert public and not missing


def test_every_film_plays_and_nothing_is_loaded_from_elsewhere(site):
    linked = "".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
    films = set(re.findall(r"\(images/(\w+\.mp4)\)", linked))
    html = "".join(page(site, document) for document in DOCUMENTS)
    players = re.findall(r'<video [^>]*src="([^"]+)"', html)
    assert films and {address.rpartition("/")[2] for address in players} == films
    assert all((site / "docs" / address).is_file() for address in players)
    assert not re.findall(r'<(?:script|img|video|iframe)[^>]* src="(?:https?:)?//', html)
    assert not re.findall(r'<link[^>]* href="(?:https?:)?//', html)
