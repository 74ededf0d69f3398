# SPDX-License-Identifier: Apache-2.0
"""Measure the quality levels on trained garments: cut for other motions, as by 'ssilk reduce', and for each clip.

    python benchmarks/levels.py cape.safetensors --stage character.usdc --motions FOLDER --clips 02_04 49_08a

Cut for each clip is what 'ssilk bake --quality' does. Distances are from the whole model's vertices, RMS over mass,
frames and clips. The solver, which level `hero` adds, is measured by 'ssilk trade'.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from reports import table, write_results
from subjects import arguments, parsed

from ssilk_core.checkpoint import ModelFile
from ssilk_core.cli.trade import Bench
from ssilk_core.cost import model_bytes
from ssilk_core.quality import QUALITIES
from ssilk_core.trade.measure import VariantMeter
from ssilk_core.trade.point import SECONDS, TradePoint
from ssilk_core.trade.variants import Variant, variants

HEADER = ("garment", "level", "shapes/proxies/influences", "fps", "off [mm]", "cut for the shot [mm]", "energy [J]",
          "cut for the shot [J]", "inside", f"{SECONDS} s shot [MB]", "model, 16 bits [MB]",
          "ms a frame")  # fmt: skip


@dataclass(frozen=True)
class Level:
    """A level on some clips: cut for other motions, and for each clip, of so many frames, by itself."""

    other: TradePoint
    own: list[TradePoint]
    frames: list[int]
    packed: int

    def row(self) -> list[str]:
        """Return one line of the table."""
        p, size = self.other, f"{self.other.shapes}/{self.other.joints}/{self.other.influences}"
        off = self._over_frames([each.position**2 for each in self.own]) ** 0.5
        own = self._over_frames([each.total for each in self.own])
        return [p.model, p.variant, size, f"{p.fps:g}", f"{1000 * p.position:.3g}", f"{1000 * off:.3g}",
                f"{p.total:.4g}", f"{own:.4g}", f"{p.collisions:.2%}", f"{p.shot_bytes / 1e6:.3g}",
                f"{self.packed / 1e6:.3g}", f"{p.milliseconds:.3g}"]  # fmt: skip

    def _over_frames(self, values: list[float]) -> float:
        """Return the mean over frames of what are means over clips."""
        return float(np.average(values, weights=self.frames))


def levels(meter: VariantMeter, fps: float) -> list[Variant]:
    """Return the whole model and the levels, none of them refined."""
    tried = variants(meter.reducer.whole, fps, refined=False)
    return [variant for variant in tried if variant.name in ("as trained", *QUALITIES)]


def measured(bench: Bench, path: Path, file: ModelFile) -> Iterator[Level]:
    """Yield the levels of one model."""
    other = bench.meter(path, file)
    own = [bench.meter(path, file, only=clip) for clip in bench.clips]
    for variant in levels(other, file.config.fps):
        packed = model_bytes(other.reducer.reduced(variant.size).file, pack=True)
        frames = [meter.motion.frame_count for meter in own]
        yield Level(other.point(variant), [meter.point(variant) for meter in own], frames, packed)


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--clips", nargs="+", required=True, metavar="NAME", help="clips to measure on")
    options = parsed(parser)
    rows: list[list[str]] = []
    found: dict[str, Any] = {}
    for path in options.models:
        bench = Bench(Namespace(**{**vars(options), "models": [path], "root": None}))
        for level in measured(bench, path, bench.files[path]):
            rows.append(level.row())
            found.setdefault(path.stem, {})[level.other.variant] = asdict(level)
    write_results(options, table(HEADER, rows), found)


if __name__ == "__main__":
    main()
