# SPDX-License-Identifier: Apache-2.0
"""Format findings as text, the most severe first and grouped by kind."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from itertools import groupby

from ...events import format_count
from .finding import SEVERITIES, Finding

WIDTH = 110
MAX_PLACES = 5  # findings of one kind that are printed; --json lists all


def format_findings(findings: Sequence[Finding]) -> str:
    """Format findings grouped by severity and kind: place, count, what was found, why it matters and the fix."""
    lines: list[str] = []
    for severity in SEVERITIES:
        chosen = [finding for finding in findings if finding.severity == severity]
        lines += [line for _, group in groupby(chosen, lambda finding: finding.code) for line in _block(list(group))]
    return "\n".join([*lines, summary(findings)])


def summary(findings: Sequence[Finding]) -> str:
    """Format the numbers of errors and warnings as one line."""
    counts = [(severity, sum(finding.severity == severity for finding in findings)) for severity in SEVERITIES[:2]]
    told = " and ".join(format_count(count, f"{severity}s") for severity, count in counts if count)
    return f"{told}." if told else "Nothing wrong was found."


def _block(group: list[Finding]) -> Iterator[str]:
    first = group[0]
    yield f"{first.severity.upper()}  {first.code}{'  (--fix repairs it)' if _all_fixable(group) else ''}"
    for finding in group[:MAX_PLACES]:
        yield from _wrapped(f"{_count(finding)}{finding.prim}: {finding.found}", "  ")
    if len(group) > MAX_PLACES:
        yield f"  and in {len(group) - MAX_PLACES} more places; --json lists all"
    for label, text in (("why", first.why), ("fix", first.fix)):
        if text:
            yield from _wrapped(f"{label}: {text}", "    ")
    yield ""


def _all_fixable(group: list[Finding]) -> bool:
    return all(finding.fixable for finding in group)


def _count(finding: Finding) -> str:
    return f"{format_count(finding.count, finding.elements)} in " if finding.elements else ""


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
