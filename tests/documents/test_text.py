# SPDX-License-Identifier: Apache-2.0
"""What the documents' text promises: links, pictures, settings and commands exist, lines fit a terminal."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from ssilk_usd.opening.shaped import body_parameters
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path

from benchmarks.helpers.paper_schemes import PAPER_SCHEMES
from ssilk_core.cli.main import parser
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.network.settings import ModelConfig, apply_overrides
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training.settings import TrainConfig

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted(str(path.relative_to(ROOT)) for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")))
COLUMNS = 118
BLOCK = re.compile(r"```.*?```", re.DOTALL)
LINK = re.compile(r"\]\(([^)\s#:]*)(#[^)\s]+)?\)")


def prose(document: str) -> str:
    """Return a document without its blocks of code."""
    return BLOCK.sub("", (ROOT / document).read_text())


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", text), flags=re.MULTILINE)
    return {"#" + re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_lines_fit_a_terminal(document):
    lines = (ROOT / document).read_text().splitlines()  # a table's row is a line, whatever its length
    assert not [number for number, line in enumerate(lines, 1) if len(line) > COLUMNS and not line.startswith("|")]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_to_files_and_headings(document):
    path, missing = ROOT / document, []
    for name, anchor in LINK.findall(prose(document)):
        target = path.parent / name if name else path
        found = target.exists() and (not anchor or anchor in anchors(target.read_text()))
        missing += [] if found else [name + anchor]
    assert not missing


def test_pictures_are_shown():
    shown = "".join(map(prose, DOCUMENTS))
    assert not [path.name for path in (ROOT / "docs" / "images").iterdir() if path.name not in shown]


@pytest.mark.parametrize("document", ["docs/training.md", "docs/results.md"])
def test_settings_exist_and_take_these_values(document, monkeypatch):
    for name, scheme in PAPER_SCHEMES.items():  # the paper's recipe needs one of them
        monkeypatch.setitem(SCHEMES, name, scheme)
    said = re.findall(r"(?:`|--set )([a-z_]+=[^`\s]+)", (ROOT / document).read_text())
    assert said
    for assignment in said:
        name = assignment.partition("=")[0]
        configs = (ModelConfig(), TrainConfig(), Fabric(""))
        config = next((config for config in configs if hasattr(config, name)), None)
        assert config is not None, f"{document}: no setting '{assignment}'"
        if not isinstance(config, Fabric):
            apply_overrides(config, [assignment])


def test_defaults_of_the_decisions_are_those_of_the_code():
    text = (ROOT / "docs/training.md").read_text().partition("## What was decided")[2]
    rows = re.findall(r"^\| `(\w+)`(?: \((material)\))?(?: \[([^\]]*)\])? \| (\S+) \|", text, flags=re.MULTILINE)
    assert len(rows) > 20
    for name, material, unit, said in rows:
        owners = (Fabric("default"),) if material else (ModelConfig(), TrainConfig())
        value = next(getattr(owner, name) for owner in owners if hasattr(owner, name))
        value = 1000 * value if unit == "mm" else value
        assert said == (value if isinstance(value, str) else f"{value:g}"), name


def test_commands_are_those_of_the_command_line():
    texts = "".join((ROOT / name).read_text() for name in DOCUMENTS)
    lines = "".join(re.findall(r"```sh\n(.*?)```", texts, re.DOTALL)).replace("\\\n", " ").splitlines()
    commands = [shlex.split(line, comments=True) for line in lines]
    ours = [words for words in commands if words[:1] == ["ssilk"] and "..." not in words]
    assert ours
    for words in ours:
        parser().parse_args(words[1:])


def test_the_bodies_by_shapes_of_the_recipe_are_the_demos(tmp_path, monkeypatch):
    """The lines of docs/pipeline.md as they stand: each shape in full gives the points of that body's own stage."""
    (recipe,) = re.findall(r"```python\n([^`]*demo_body_path[^`]*)```", (ROOT / "docs/pipeline.md").read_text())
    monkeypatch.chdir(tmp_path)
    exec(recipe, {})
    assert {name for name, each in body_parameters(open_stage("hero.usda")).items() if each.is_marked} == {
        "tall", "heavy"
    }  # fmt: skip
    for name in ("tall", "heavy"):
        shaped, own = map(read_character, (f"hero.usda:{name}=1", str(demo_body_path(name))))
        np.testing.assert_allclose(shaped.bodies[0].mesh.points, own.bodies[0].mesh.points, atol=1e-6)
