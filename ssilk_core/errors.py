# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can act on, each one sentence, and the exit codes that carry them."""

from __future__ import annotations

from typing import NoReturn

EXIT_OK = 0
EXIT_INTERNAL = 1
EXIT_BAD_INPUT = 2
EXIT_VERIFICATION = 3
EXIT_TASKS = 4
EXIT_WORSE = 5  # a model was trained and is worse than linear blend skinning
EXIT_INTERRUPTED = 130


class SsilkError(Exception):
    """Bad input: one sentence that says where, what was found, what is allowed and what to do."""

    exit_code = EXIT_BAD_INPUT


class VerificationError(SsilkError):
    """A written file does not reproduce what was computed."""

    exit_code = EXIT_VERIFICATION


def fail(where: str, found: str, allowed: str, todo: str = "") -> NoReturn:
    """Raise `SsilkError` as one sentence: where, what was found, what is allowed, what to do."""
    raise SsilkError(f"{where}: {found}; {allowed}" + (f"; {todo}" if todo else "") + ".")
