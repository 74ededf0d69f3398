# SPDX-License-Identifier: Apache-2.0
"""What single steps of trained garments miss on clips of each split, training included.

    python benchmarks/step_errors.py cape.safetensors --stage character.usdc --motions FOLDER --index index.json

The figures are those of a validation (`ssilk_core.training.newton_steps`): from the model's own past, the energy that
a Newton step would win, and how far it would move the cloth. The median tells of ordinary frames, the 95th percentile
of the worst. What is as large on clips of training as on others was not learnt; what is larger does not generalise.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed

from ssilk_core.quality.evaluation.splits import chosen, read_index
from ssilk_core.training.motion_bank import roll_states

HEADER = ("garment", "split", "steps", "mean [mJ]", "median [mJ]", "95 % below [mJ]", "RMS [mm]")


def measure(subject: Subject, options: Namespace) -> dict[str, dict[str, float]]:
    """Return the figures of each split, energies in J and distances in m."""
    found, model, index = {}, subject.model, read_index(options.index)
    for split in dict.fromkeys(entry.split for entry in index):
        validator = subject.validator(*(clip_of(options, clip, subject) for clip in chosen(index, split)))
        states = roll_states(model, validator.bank, validator.clips, validator.down)
        energy, square = validator.missed_by_steps(model, states, options.steps)
        found[split] = {
            "steps": len(energy),
            "mean": float(energy.mean()),
            "median": float(energy.median()),
            "p95": float(energy.quantile(0.95)),
            "distance": float(square.mean().sqrt()),
        }
    return found


def row(garment: str, split: str, figures: dict[str, float]) -> list[str]:
    energies = (f"{1000 * figures[name]:.1f}" for name in ("mean", "median", "p95"))
    return [garment, split, f"{figures['steps']}", *energies, f"{1000 * figures['distance']:.1f}"]


@torch.no_grad()
def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips with their splits and tags")
    parser.add_argument("--steps", type=int, default=64, help="in each split (default 64)")
    options = parsed(parser)
    subjects = [open_subject(path, options.stage, options.device) for path in options.models]
    measured = {subject.name: measure(subject, options) for subject in subjects}
    rows = [row(name, split, figures) for name, found in measured.items() for split, figures in found.items()]
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
