# SPDX-License-Identifier: Apache-2.0
"""docs/settings.md names every setting once, with its default and the presets that have another value."""

from __future__ import annotations

import re
from collections import Counter

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
