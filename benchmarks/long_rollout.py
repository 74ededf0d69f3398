# SPDX-License-Identifier: Apache-2.0
"""Roll trained models over 10,000 frames of a looped clip and compare each energy term between the loops.

    python benchmarks/long_rollout.py cape.safetensors --stage character.usdc --motions FOLDER

A loop is the clip played forward and backward, slowing to a stop for a quarter of a second at either end: it is
seamless and every loop is the same motion. The first loop starts from the quasi-static initialiser, so it holds
the transient from there into the swing; the second and the last do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from helpers.reports import RESULTS, table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.physics.energy import TERMS
from ssilk_core.quality.charts import ChartPanel, write_chart
from ssilk_core.quality.evaluation.methods import Network, build_take_set
from ssilk_core.quality.evaluation.record import recorded
from ssilk_core.quality.evaluation.takes import Take, back_and_forth

CLIPS = ("02_04", "02_02", "49_08a")
HEADER = ("garment", "clip", "loops x frames", "term", "first [J]", "second [J]", "last [J]", "first to last",
          "second to last")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Looped:
    """Energies of a clip that loops.

    Attributes:
        terms: of each frame [J], shape (N,).
        length: frames of a loop.
        largest: largest entry of any latent.
    """

    terms: dict[str, Tensor]
    length: int
    largest: float

    @property
    def means(self) -> dict[str, Tensor]:
        """Mean of each term in each loop [J], shape (loops,)."""
        return {name: values.reshape(-1, self.length).mean(1) for name, values in self.terms.items()}

    @property
    def totals(self) -> Tensor:
        """Total of each frame [J], shape (N,)."""
        return torch.stack(list(self.terms.values())).sum(0)


def rolled(subject: Subject, clip: str, frames: int, options: Any) -> Looped:
    """Roll a model over a looped clip."""
    dressed = subject.dressed
    motion, length = back_and_forth(clip_of(options, clip, subject), dressed.fps, frames)
    model, takes = subject.model, [Take(clip, 0, motion)]
    take_set = build_take_set(takes, dressed, model.joints, model.config.descriptors)
    network = Network(subject.model, take_set)
    values = recorded(dressed, take_set, network, 0).values
    return Looped({name: values[name] for name in TERMS}, length, float(network.states[0].abs().max()))


def drift(before: Tensor, last: Tensor) -> str:
    """Return a change as text."""
    return f"{float((last - before) / before.abs()):+.3%}"


def rows_of(garment: str, clip: str, means: dict[str, Tensor], length: int) -> list[list[str]]:
    """Return one line for each term and one for the total."""
    loops = f"{len(means['stretch'])} x {length}"
    every = {**means, "total": torch.stack(list(means.values())).sum(0)}
    rows = []
    for name, m in every.items():
        values = [f"{float(m[i]):.5g}" for i in (0, 1, -1)]
        rows.append([garment, clip, loops, name, *values, drift(m[0], m[-1]), drift(m[1], m[-1])])
    return rows


def draw(path: Path, title: str, looped: Looped, span: float = 0.05) -> None:
    """Draw each term's loop means relative to the second loop, within +- `span`, and all totals, as a PNG."""
    means, totals = looped.means, looped.totals
    change = {name: 100 * (means[name] - means[name][1]) / means[name][1].abs() for name in TERMS}
    loops = ChartPanel(
        title=f"{title}: mean of each loop", x="loop", y="change since the second loop [%]", levels=(0.0,),
        span=(-100 * span, 100 * span),
        curves={name: (range(len(values)), values.tolist()) for name, values in change.items()},
    )  # fmt: skip
    frames = ChartPanel(
        title="each frame (the paper's Figure 10)", x="frame", y="total [J]",
        curves={"": (range(len(totals)), totals.tolist())},
    )  # fmt: skip
    write_chart(path, [[loops], [frames]], size=(6.5, 2.6))


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--clips", nargs="+", default=CLIPS, help=f"clips to loop (default {' '.join(CLIPS)})")
    parser.add_argument("--frames", type=int, default=10_000, help="at least so many (default 10000)")
    options = parsed(parser)
    rows, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        for clip in options.clips:
            looped = rolled(subject, clip, options.frames, options)
            means = looped.means
            rows += rows_of(subject.name, clip, means, looped.length)
            figures = {name: values.tolist() for name, values in means.items()}
            told = {"frames of a loop": looped.length, "largest |z|": looped.largest, "J": figures}
            measured[f"{subject.name} {clip}"] = told
            draw(RESULTS / f"{options.name}_{subject.name}_{clip}.png", f"{subject.name}, {clip} looped", looped)
            print(table(HEADER, rows), f"largest |z| {looped.largest:.3f}", flush=True)
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
