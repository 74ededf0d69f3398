# SPDX-License-Identifier: Apache-2.0
"""Write the tables of README.md and docs/ from the figures in benchmarks/results/.

    python benchmarks/tables_of_documents.py            # writes what is not current
    python benchmarks/tables_of_documents.py --check    # says what is not current, and writes nothing

A table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`. NAME is one of `TABLES`; the function of
that name makes it. The exit code is 1 where --check finds a table that is not current, and 2 where a document names a
table that does not exist.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "usd"), str(ROOT / "benchmarks")]

from documents import dial, farm, guides, results  # noqa: E402  # the script runs by itself

TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        results.overview, results.other_methods, results.trainings, results.own_start, results.rest,
        results.playing, results.extremes, dial.dial,
        farm.cluster, farm.fuzzed, farm.disturbed, farm.disk, farm.disk_workers, farm.large_job,
        guides.targets, guides.growth, guides.presets, guides.drape, guides.bodies, guides.peers,
        guides.self_contact,
    )
}  # fmt: skip
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def written(text: str, tables: Mapping[str, Callable[[], str]]) -> str:
    """Return a document with its tables as they are now.

    Raises:
        KeyError: it names a table that does not exist, or does not end one before the next begins.
    """
    begun = re.findall(r"<!-- (?:table: (\w+)|end) -->", text)  # a name, or "" for an end
    for name, end in zip_longest(begun[::2], begun[1::2], fillvalue="?"):
        if not name or end:
            raise KeyError(f"{name or end} that begins and ends")
    return MARKED.sub(lambda found: f"{found[1]}{tables[found[2]]()}\n{found[3]}", text)


def documents(root: Path = ROOT) -> list[Path]:
    """Return the documents that may hold tables."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def main(words: list[str] | None = None, root: Path = ROOT) -> int:
    """Write or check all documents; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="say which documents are not current, and write nothing")
    check, code = parser.parse_args(words).check, 0
    for path in documents(root):
        text = path.read_text()
        try:
            new = written(text, TABLES)
        except KeyError as error:
            print(f"{path}: there is no table {error}; tables are {', '.join(TABLES)}", file=sys.stderr)
            return 2
        if new != text:
            code = int(check)
            print(f"{path} {'is not current: run benchmarks/tables_of_documents.py' if check else 'is written'}")
            if not check:
                path.write_text(new)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
