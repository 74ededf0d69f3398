# SPDX-License-Identifier: Apache-2.0
"""Where the initialiser P holds a garment in a worse state than the network has reached.

    python benchmarks/rest_states.py cape.safetensors --stage character.usdc --motions FOLDER --index index.json

The energy of cloth has many minima. In every tenth frame of each clip of `valid` the energy of P's quasi-static state
is compared with that of the network's moving state, both without inertia and drag. Where the second is lower by more
than `--least`, P holds the garment in a state that it should have left, and the spring draws the network to it.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from static_states import StillFrames, energy_of

from ssilk_core.evaluation.splits import chosen, read_index
from ssilk_core.motion_bank import roll_states

EVERY = 10  # frames of a clip
ENERGIES = ("P", "P gravity", "network", "network gravity")
HEADER = ("garment", "clip", "frames", *(f"{name} [J]" for name in ENERGIES), "network is lower [%]")


def measure(subject: Subject, options: Namespace) -> dict[str, dict[str, float]]:
    """Return the figures of each clip; energies are means over its frames [J]."""
    return {clip: _clip(subject, options, clip) for clip in chosen(read_index(options.index), "valid")}


def _clip(subject: Subject, options: Namespace, clip: str) -> dict[str, float]:
    validator, model = subject.validator(clip_of(options, clip, subject)), subject.model
    (span,) = validator.clips
    at = torch.arange(0, len(span), EVERY, device=subject.device)
    still = StillFrames.of(subject, validator, at + span.start)
    (rolled,) = roll_states(model, validator.bank, [span], validator.down)
    states = model.initial(still.descriptor), rolled[at]
    rest, moving = (still.terms(model.vertices(z, still.character)) for z in states)
    energy, reached = energy_of(rest), energy_of(moving)
    return {
        "frames": len(at),
        "P": float(energy.mean()),
        "P gravity": float(rest["gravity"].mean()),
        "network": float(reached.mean()),
        "network gravity": float(moving["gravity"].mean()),
        "lower": float((energy - reached > options.least).float().mean()),
    }


def rows(garment: str, found: dict[str, dict[str, float]]) -> list[list[str]]:
    """Return the lines of a garment."""
    return [
        [garment, clip, str(at["frames"]), *(f"{at[name]:.3f}" for name in ENERGIES), f"{at['lower']:.0%}"]
        for clip, at in found.items()
    ]


@torch.no_grad()
def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--least", type=float, default=0.1, help="difference that counts [J] (default 0.1)")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
