# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can act on, each one sentence, and the exit codes that carry them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NoReturn

EXIT_OK = 0
EXIT_INTERNAL = 1
EXIT_BAD_INPUT = 2
EXIT_VERIFICATION = 3
EXIT_TASKS = 4
EXIT_WORSE = 5  # a model was trained, and is worse than linear blend skinning or has not learned to move
EXIT_INTERRUPTED = 130


class SsilkError(Exception):
    """Bad input: one sentence that says where, what was found, what is allowed and what to do.

    Attributes:
        found, allowed, todo: its parts, for those who say themselves where; empty where `fail` did not raise it.
    """

    exit_code = EXIT_BAD_INPUT
    found = allowed = todo = ""


class VerificationError(SsilkError):
    """A written file does not reproduce what was computed."""

    exit_code = EXIT_VERIFICATION


def fail(where: str, found: str, allowed: str, todo: str = "") -> NoReturn:
    """Raise `SsilkError` as one sentence: where, what was found, what is allowed, what to do."""
    text = f"{where}: {found}; {allowed}" + (f"; {todo}" if todo else "")
    error = SsilkError(text if text.endswith("?") else f"{text}.")
    error.found, error.allowed, error.todo = found, allowed, todo
    raise error


def fail_unknown(where: str, found: str, name: str, allowed: Iterable[str]) -> NoReturn:
    """Raise `SsilkError` for a name that is none of the allowed ones, and suggest the one that it resembles."""
    names = list(allowed)
    fail(where, found, f"it is one of {', '.join(names)}", did_you_mean(name, names))


def did_you_mean(name: str, allowed: Iterable[str], like: float = 0.6, *, ending: str = "") -> str:
    """Return a question that suggests the allowed name which `name` resembles most; "" where it resembles none.

    Args:
        like: likeness, up to 1 of the same, from which on it does.
        ending: what all names end in: told, and not compared, as it would make all alike.
    """
    from difflib import get_close_matches  # only failures need it

    near = get_close_matches(name, list(allowed), n=1, cutoff=like)
    return f"did you mean '{near[0]}{ending}'?" if near else ""
