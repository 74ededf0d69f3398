# SPDX-License-Identifier: Apache-2.0
"""Help of the command line: 'ssilk help VERB' says what 'ssilk VERB --help' says."""

from __future__ import annotations

import re

import pytest

from ssilk_core.cli import main
from ssilk_core.cli.main import VERBS, name_of


def printed(capsys, *words: str) -> str:
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code
    assert code == 0
    return capsys.readouterr().out


def test_help_lists_every_verb(capsys):
    text = printed(capsys, "help")
    assert text == printed(capsys, "--help")
    assert all(re.search(rf"^    {name_of(module)}\s", text, re.MULTILINE) for module in VERBS)


@pytest.mark.parametrize("verb", [name_of(module) for module in VERBS])
def test_help_about_a_verb_is_that_of_its_own_option(capsys, verb):
    text = printed(capsys, "help", verb)
    assert text.startswith(f"usage: ssilk {verb} ")
    assert text == printed(capsys, verb, "--help")
