# SPDX-License-Identifier: Apache-2.0
"""Score trained models on whole held-out clips, each term by itself, beside plain skinning.

    python benchmarks/evaluate.py cape.safetensors --stage character.usdc --motions FOLDER --index FOLDER/index.json

The index is a list of {"clip", "split", "tags"}; `valid` and `flips` are splits, `inertia` a tag within `valid`.
Gravity is relative to plain skinning. Motion of its own is the RMS distance to the quasi-static state of each pose.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from reports import table, write_results
from subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.energy import TERMS

SPLITS = ("valid", "inertia", "flips")
HEADER = ("garment", "split", "", "total [J]", "lower by", *TERMS, "inside the body", "own motion [mm]",
          "total of clips: min / median / max")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Clips:
    """Frame terms of several clips, under the model or under plain skinning."""

    terms: list[dict[str, Tensor]]

    def mean(self, name: str) -> float:
        """Return the mean over all frames of all clips."""
        return float(torch.cat([clip[name] for clip in self.terms]).mean())

    def figures(self) -> dict[str, Any]:
        """Return means over frames and the totals of each clip."""
        totals = torch.stack([sum(clip[name] for name in TERMS).mean() for clip in self.terms])  # type: ignore[union-attr]
        return {
            **{name: self.mean(name) for name in TERMS},
            "total": sum(self.mean(name) for name in TERMS),
            "collisions": self.mean("collisions"),
            "own motion [m]": self.mean("dynamics") ** 0.5,
            "clips": [float(value) for value in (totals.min(), totals.median(), totals.max())],
            "frames": sum(len(clip["stretch"]) for clip in self.terms),
        }


def chosen(index: list[dict[str, Any]], split: str) -> list[str]:
    """Return the clips of a split, or those of `valid` with a tag."""
    return [e["clip"] for e in index if e["split"] == split or (e["split"] == "valid" and split in e["tags"])]


def measure(subject: Subject, names: list[str], options: Any) -> dict[str, dict[str, dict[str, Tensor]]]:
    """Return frame terms by clip, under the model and under plain skinning."""
    motions = {name: clip_of(options, name, subject) for name in names}
    return {
        "model": {name: subject.frame_terms(motion) for name, motion in motions.items()},
        "plain": {name: subject.frame_terms(motion, plain=True) for name, motion in motions.items()},
    }


def row(garment: str, split: str, how: str, found: dict[str, Any], plain: dict[str, Any]) -> list[str]:
    """Return one line of the table."""
    lower = "" if found is plain else f"{1 - found['total'] / plain['total']:.1%}"
    own = "" if found is plain else f"{1000 * found['own motion [m]']:.0f}"
    terms = [f"{found[name]:.4g}" for name in TERMS]
    spread = " / ".join(f"{value:.3g}" for value in found["clips"])
    return [garment, split, how, f"{found['total']:.4g}", lower, *terms, f"{found['collisions']:.2%}", own, spread]


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips with their splits and tags")
    options = parsed(parser)
    index = json.loads(options.index.read_text())
    names = {split: chosen(index, split) for split in SPLITS}
    rows, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        terms = measure(subject, sorted({name for split in names.values() for name in split}), options)
        for split, clips in names.items():
            found = {how: Clips([terms[how][name] for name in clips]).figures() for how in terms}
            measured[f"{subject.name} {split}"] = found
            rows += [row(subject.name, split, how, found[how], found["plain"]) for how in terms]
        print(table(HEADER, rows), flush=True)
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
