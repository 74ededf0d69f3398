# SPDX-License-Identifier: Apache-2.0
"""Help of the command line: 'ssilk help VERB' says what 'ssilk VERB --help' says."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from ssilk_core.cli import main
from ssilk_core.cli.main import VERBS, module_of


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
    assert all(re.search(rf"^    {verb}\s", text, re.MULTILINE) for verb in VERBS)


def test_the_list_says_what_the_verbs_say_of_themselves():
    assert {verb: (module_of(verb).__doc__ or "").splitlines()[0] for verb in VERBS} == VERBS


def test_a_verb_is_loaded_alone():
    code = "import sys; from ssilk_core.cli import main\ntry:\n main(['verify', '--help'])\nexcept SystemExit: pass\n"
    code += "print([name for name in sys.modules if name.startswith('ssilk_core.cli.')], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "'ssilk_core.cli.verify'" in done.stderr and "'ssilk_core.cli.train'" not in done.stderr


@pytest.mark.parametrize("verb", [*VERBS])
def test_help_about_a_verb_is_that_of_its_own_option(capsys, verb):
    text = printed(capsys, "help", verb)
    assert text.startswith(f"usage: ssilk {verb} ")
    assert text == printed(capsys, verb, "--help")
