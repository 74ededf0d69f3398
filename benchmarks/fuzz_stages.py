# SPDX-License-Identifier: Apache-2.0
"""Damage stages, motions and models at random, and read them: any bytes are read, or refused with one sentence.

    python benchmarks/fuzz_stages.py FOLDER character:STAGE scene:RIGGED motion:FILE model:MODEL --minutes 60

The files are damaged again and again, in FOLDER, where one that ends this process stays. The readers read USD first
in a process of its own; what ended that process is counted, for it would have ended this one.
"""

from __future__ import annotations

import argparse
import random
import resource
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from helpers.reports import table, write_results
from ssilk_usd.opening.trial import stop
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model

KINDS = ("flip", "huge", "zero", "insert", "cut", "double", "swap")
MOST_EDITS = 6


def damaged(content: bytes, draw: random.Random) -> bytes:
    """Return bytes with some random edits."""
    data = bytearray(content)
    for _ in range(draw.randint(1, MOST_EDITS)):
        at, size, kind = draw.randrange(max(len(data), 1)), draw.choice((1, 4, 16, 256)), draw.choice(KINDS)
        if kind == "flip":
            data[at : at + 1] = bytes([draw.randrange(256)])
        elif kind == "huge":
            data[at : at + 8] = struct.pack("<Q", 10**9 << draw.randrange(8))
        elif kind == "zero":
            data[at : at + size] = bytes(size)
        elif kind == "insert":
            data[at:at] = bytes([draw.randrange(256)] * size)
        elif kind == "cut":
            del data[at : at + size if draw.random() < 0.8 else None]
        elif kind == "double":
            data[at:at] = data[at : at + size]
        else:
            other = draw.randrange(max(len(data), 1))
            data[at : at + size], data[other : other + size] = data[other : other + size], data[at : at + size]
    return bytes(data)


class Fuzzer:
    """Reads damaged copies of one file and counts how the readings end."""

    def __init__(self, folder: Path, kind: str, source: Path, character: Path) -> None:
        self.content, self.path = source.read_bytes(), folder / f"damaged{source.suffix}"
        skeleton = read_character(character).skeleton
        readers: dict[str, Callable[[Path], object]] = {
            "character": read_character,
            "scene": read_scene,
            "motion": lambda path: read_motion(path, skeleton),
            "model": load_model,
        }
        self.read, self.longest = readers[kind], 0.0
        self.ends: Counter[str] = Counter()

    def step(self, draw: random.Random) -> None:
        """Read one more."""
        self.path.write_bytes(damaged(self.content, draw))
        start = time.monotonic()
        try:
            self.read(self.path)
            end = "read"
        except SsilkError as error:
            text = str(error)
            ended = "ends the process" in text or "takes more than" in text
            end = text.partition(": ")[2].partition(";")[0] if ended else "refused"
        self.ends[end] += 1
        self.longest = max(self.longest, time.monotonic() - start)


def main() -> int:
    """Fuzz for some minutes, and write the counts."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("folder", type=Path)
    words.add_argument("files", nargs="+", metavar="KIND:FILE")
    words.add_argument("--minutes", type=float, default=60.0)
    words.add_argument("--seed", type=int, default=0)
    words.set_defaults(name="fuzz_stages", device="cpu", threads=1)
    options = words.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    pairs = [(kind, Path(file)) for kind, _, file in (text.partition(":") for text in options.files)]
    character = next(file for kind, file in pairs if kind == "character")
    fuzzers = {f"{kind}{file.suffix}": Fuzzer(options.folder, kind, file, character) for kind, file in pairs}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    draw, end = random.Random(options.seed), time.monotonic() + 60 * options.minutes
    while time.monotonic() < end:
        for fuzzer in fuzzers.values():
            fuzzer.step(draw)
    stop()  # what its processes took is known once it has ended
    most = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    readers = {
        name: {**fuzzer.ends, "all": sum(fuzzer.ends.values()), "longest [s]": fuzzer.longest}
        for name, fuzzer in fuzzers.items()
    }
    measured = {"minutes": options.minutes, "memory added at most [MiB]": (most - before) / 1024, "readers": readers}
    lines = [[name, reader["all"], f"{reader['longest [s]']:.2g}"] for name, reader in readers.items()]
    write_results(options, table(["reader", "files", "longest [s]"], lines), measured)
    return 0


if __name__ == "__main__":
    sys.exit(main())
