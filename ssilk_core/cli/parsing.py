# SPDX-License-Identifier: Apache-2.0
"""A parser whose errors are one sentence, which names what was mistyped and suggests what was meant."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Container, Sequence
from typing import Any, NoReturn

from ..errors import did_you_mean, fail, fail_unknown

LIKE = 0.8  # likeness from which on an option may be another one misspelt: all begin with dashes
NUMBERS = re.compile(r"^-(\d|\.\d)[\d.,eE+-]*$")


class Parser(argparse.ArgumentParser):
    """An `argparse.ArgumentParser` that takes no abbreviations and raises `SsilkError`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)
        self._negative_number_matcher = NUMBERS  # argparse knows single numbers alone: `--wind -5,0,0`

    def error(self, message: str) -> NoReturn:
        """Raise `SsilkError`."""
        fail(self.prog, message, self._help())

    def parse_known_args(  # type: ignore[override]  # typeshed's overloads say the same
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Parse, but name an unknown option before argparse misses the one that was meant."""
        words = sys.argv[1:] if args is None else list(args)
        known = self._option_string_actions
        for word in words:
            if word == "--" or (self._subparsers and not word.startswith("-")):
                break  # what follows is no option, or belongs to the verb's own parser
            name = word.partition("=")[0]
            if re.fullmatch(r"--?[A-Za-z][\w-]*", name) and not {name, name[:2]} & known.keys():
                meant = _as_value(name, known) or did_you_mean(name, known, LIKE)
                fail(self.prog, f"no such option '{name}'", self._help(), meant)
        return super().parse_known_args(words, namespace)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            name = action.option_strings[-1] if action.option_strings else action.metavar or action.dest
            fail_unknown(f"{self.prog} {name}", f"'{value}'", str(value), action.choices)

    def _help(self) -> str:
        return f"'{self.prog} --help' lists what is allowed"


def _as_value(option: str, known: Container[str]) -> str:
    """Return a question that suggests the option whose values have what was given as an option; "" where none has."""
    from ..network.settings import ModelConfig, setting_names
    from ..scene.fabrics import Fabric
    from ..training.settings import TrainConfig

    name = option.lstrip("-").replace("-", "_")
    for of, kinds in (("--material", (Fabric,)), ("--set", (TrainConfig, ModelConfig))):
        if of in known and any(name in setting_names(kind) for kind in kinds):
            return f"did you mean '{of} {name}=VALUE'?"
    return ""
