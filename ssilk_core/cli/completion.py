# SPDX-License-Identifier: Apache-2.0
"""Write the script that lets a shell complete verbs, options and names with the tab key.

Type the line of your shell once; new shells then complete:

    ssilk completion bash > ~/.local/share/bash-completion/completions/ssilk
    ssilk completion zsh > ~/.zfunc/_ssilk
    ssilk completion fish > ~/.config/fish/completions/ssilk.fish

Make the folder first if it is missing. bash needs its package bash-completion. zsh searches the folders of $fpath:
write 'fpath+=~/.zfunc' before 'compinit' in ~/.zshrc. Completing starts no Python. After an update of ssilk, type the
line again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import EXIT_OK
from ..events import Reporter
from ..network.settings import ModelConfig, setting_names
from ..scene.fabrics import Fabric
from ..training.settings import TrainConfig

SHELLS = ("bash", "zsh", "fish")
ASSIGNED = {
    "settings": [*setting_names(ModelConfig), *setting_names(TrainConfig)],
    "material": setting_names(Fabric),
}
"""What stands before the = of an option's value, by the name under which the option is parsed."""


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("shell", choices=SHELLS, help="the shell that reads the script")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Print the script; return 0."""
    import shtab

    for action in _actions(options.parser):
        if names := ASSIGNED.get(action.dest):
            _complete(action, shtab.cmd("printf '%s=\\n' " + " ".join(names)))
        elif _takes_files(action):
            _complete(action, shtab.FILE)
        elif action.dest == "about":  # of 'ssilk help'
            action.choices = _verbs(options.parser)
    print(shtab.complete(options.parser, options.shell))
    return EXIT_OK


def _complete(action: argparse.Action, how: dict[str, Any]) -> None:
    action.complete = how  # type: ignore[attr-defined]  # shtab reads it


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the arguments of a parser and of its verbs."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                yield from _actions(verb)


def _verbs(parser: argparse.ArgumentParser) -> list[str]:
    return [name for action in parser._actions if action.dest == "verb" for name in action.choices or ()]


def _takes_files(action: argparse.Action) -> bool:
    """Return whether an argument takes the path of a file, with or without a prim behind it."""
    return action.type is Path or ":/" in str(action.metavar)
