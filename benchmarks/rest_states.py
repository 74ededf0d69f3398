# SPDX-License-Identifier: Apache-2.0
"""Where the initialiser P holds a garment in a worse state than the network has reached.

    python benchmarks/rest_states.py cape.safetensors --stage character.usdc --motions FOLDER --index index.json

The energy of cloth has many minima. In every tenth frame of each clip of `valid` the energy of P's quasi-static state
is compared with that of the network's moving state, both without inertia and drag. Where the second is lower by more
than `--least`, P holds the garment in a state that it should have left: the spring of the stepper draws it there.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.evaluation.splits import chosen, read_index
from ssilk_core.motion_bank import roll_states
from ssilk_core.training.objective import Objective, Terms

EVERY = 10  # frames of a clip
HEADER = ("garment", "clip", "frames", "P [J]", "gravity [J]", "network [J]", "gravity [J]", "network is lower [%]")


def measure(subject: Subject, options: Namespace) -> dict[str, dict[str, float]]:
    """Return the figures of each clip; energies are means over its frames [J]."""
    return {clip: _clip(subject, options, clip) for clip in chosen(read_index(options.index), "valid")}


def _clip(subject: Subject, options: Namespace, clip: str) -> dict[str, float]:
    validator, model = subject.validator(clip_of(options, clip, subject)), subject.model
    bank, objective = validator.bank, Objective(model, subject.energy, subject.body, validator.bank)
    (span,) = validator.clips
    at = torch.arange(0, len(span), EVERY, device=subject.device)
    frames = at + span.start
    direction, character = validator.down.expand(len(frames), 3), bank.character(frames)
    height = objective.quasi_static_terms(validator.lbs_vertices(character), direction, character)["gravity"]

    def terms(z: Tensor) -> Terms:
        found = objective.quasi_static_terms(model.vertices(z, character), direction, character)
        return found | {"gravity": found["gravity"] - height}

    rest = terms(model.initial(bank.static_descriptor(frames, direction)))
    moving = terms(roll_states(model, bank, [span], validator.down)[0][at])
    energy, reached = (torch.stack([*each.values()]).sum(0) for each in (rest, moving))
    return {
        "frames": len(frames),
        "P": float(energy.mean()),
        "P gravity": float(rest["gravity"].mean()),
        "network": float(reached.mean()),
        "network gravity": float(moving["gravity"].mean()),
        "lower": float((energy - reached > options.least).float().mean()),
    }


@torch.no_grad()
def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--least", type=float, default=0.1, help="difference that counts [J] (default 0.1)")
    options = parsed(parser)
    lines, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        measured[subject.name] = found = measure(subject, options)
        for clip, figures in found.items():
            energies = (f"{figures[name]:.3f}" for name in ("P", "P gravity", "network", "network gravity"))
            lines.append([subject.name, clip, str(figures["frames"]), *energies, f"{figures['lower']:.0%}"])
        write_results(options, table(HEADER, lines), measured)


if __name__ == "__main__":
    main()
