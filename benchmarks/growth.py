# SPDX-License-Identifier: Apache-2.0
"""Measure how the cost of playing grows with vertices, garments, shots and threads on a processor.

    OMP_NUM_THREADS=1 python benchmarks/growth.py

Garments are synthetic cloaks with untrained networks of the default size. Each is played whole, poses included, with
numpy alone and, where that says so, in compiled loops. Threads each play garments of their own. Figures are medians
of processor time, so that other programs lengthen them little: with several threads they tell what threads cost each
other, not how soon they end. The exponent is the slope of the logarithms between two sizes that follow each other.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from helpers.playing import with_numpy
from helpers.reports import table, write_results
from runtime import cloak

from ssilk_core.errors import fail
from ssilk_core.network.checkpoint import model_file
from ssilk_core.network.runtime import Player
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import Motion
from ssilk_core.scene.fabrics import Fabric

VERTICES = (500, 2_500, 10_000, 50_000, 200_000)
COUNTS = {"garments": (1, 4, 16, 64), "shots": (1, 8, 64, 512)}
USUAL, REPEATS = 2_500, 64  # fewer of what takes longer
WAYS = ("numpy", "compiled loops")


def player_of(vertices: int) -> tuple[Player, Motion]:
    """Return an untrained garment of so many vertices, and a motion of 64 frames."""
    model, motion = cloak(vertices, ModelConfig())
    return Player(model_file(model, Fabric("default"), {})), motion


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the median processor time of some work [s] that is repeated."""
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return float(np.median(taken))


def by_vertices() -> dict[str, dict[str, list[float]]]:
    """Return microseconds a frame, by way, for each size."""
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    for vertices in VERTICES:
        player, motion = player_of(vertices)
        for way in WAYS:
            work = partial(with_numpy, player, motion, compiled=way != WAYS[0])
            work()  # warms up
            found[way].append(1e6 * seconds(work, max(3, REPEATS * VERTICES[0] // vertices)) / motion.frame_count)
    return {"vertices": found}


def by_counts() -> dict[str, dict[str, list[float]]]:
    """Return microseconds of a garment's frame where many are played, by way and threads, for each count."""
    found: dict[str, dict[str, list[float]]] = {}
    players: list[Player] = []
    motion = player_of(USUAL)[1]
    for counted, counts in COUNTS.items():
        rows = found.setdefault(counted, {})
        for way in WAYS:
            for threads in (1, 2):
                row = rows.setdefault(f"{way}, {threads} threads" if threads > 1 else f"{way}, 1 thread", [])
                for count in counts:
                    needed = count if counted == "garments" else threads
                    players += [player_of(USUAL)[0] for _ in range(needed - len(players))]
                    play = partial(with_numpy, motion=motion, compiled=way != WAYS[0])
                    each = [players[number % needed] for number in range(count)]
                    with ThreadPoolExecutor(threads) as pool:
                        work = partial(_all, pool, play, each)
                        taken = seconds(work, max(1, REPEATS // count))
                    row.append(1e6 * taken / (count * motion.frame_count))
    return found


def _all(pool: ThreadPoolExecutor, play: Callable[[Player], object], players: list[Player]) -> None:
    """Play garments side by side."""
    for _ in pool.map(play, players):
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(name="growth", device="cpu", threads=1)
    options = parser.parse_args()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        fail("benchmarks/growth.py", "numpy may use several threads", "one is measured", "set OMP_NUM_THREADS to 1")
    found, text = by_vertices() | by_counts(), ""
    sizes = {"vertices": VERTICES, **COUNTS}
    for name, rows in found.items():
        lines = []
        for way, values in rows.items():
            steps = np.diff(np.log(values)) / np.diff(np.log(sizes[name]))
            cells = [f"{values[0]:,.0f}", *(f"{value:,.0f} ({step:+.2f})" for value, step in zip(values[1:], steps))]
            lines.append([way, *cells])
        text += f"µs a frame of a garment, by {name} (exponent from the size before)\n\n"
        text += table((name, *(f"{size:,}" for size in sizes[name])), lines) + "\n"
    write_results(options, text, {"sizes": sizes, "microseconds": found})


if __name__ == "__main__":
    main()
