# SPDX-License-Identifier: Apache-2.0
"""docs/settings.md names every setting once, with its default and the presets that have another value."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import fields

from ssilk_core.network.settings import apply_overrides
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.training.settings import PRESETS
from tools.settings_page import PAGE, ROW, settings, written


def test_the_page_names_every_setting_once_and_no_other():
    named = Counter(re.findall(r"^\| `(\w+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert named == Counter(list(settings()))


def test_defaults_and_presets_on_the_page_are_current():
    page = PAGE.read_text(encoding="utf-8")
    assert written(page) == page, "run python -m tools.settings_page"


def test_a_stale_default_is_found():
    page = PAGE.read_text(encoding="utf-8")
    assert written(ROW.sub(r"| `\1` | stale | |", page)) == page


def test_five_are_for_artists_and_ten_for_researchers():
    parts = PAGE.read_text(encoding="utf-8").split("\n## ")
    assert [len(ROW.findall(part)) for part in parts[1:3]] == [5, 10]


def test_the_table_of_the_papers_own_has_every_difference_and_no_other():
    page = (PAGE.parent / "training.md").read_text(encoding="utf-8")
    section = page.partition("### The paper's own")[2].partition("\n## ")[0]
    said = re.findall(r"^\|[^|]*\| `(\w+)`[^|]*\| (\S+) \| (\S+) \|$", section, re.MULTILINE)
    paper, final = PRESETS["paper"], PRESETS["final"]
    fabric = apply_overrides(FABRICS[paper.fabric], [*paper.material])
    differing = {}
    for own, other in ((paper.model, final.model), (paper.train, final.train), (fabric, FABRICS["default"])):
        pairs = {item.name: (getattr(own, item.name), getattr(other, item.name)) for item in fields(own)}
        differing |= {name: pair for name, pair in pairs.items() if pair[0] != pair[1] and name != "name"}
    words = {
        name: tuple(f"{v:g}" if isinstance(v, float) else str(v).lower() for v in p) for name, p in differing.items()
    }
    assert {name: (own, other) for name, own, other in said} == words and len(said) == len(words) > 40
