# SPDX-License-Identifier: Apache-2.0
"""Whether the solver shows less skin than the network in a clip's worst frame.

    python benchmarks/worst_frames.py cape.safetensors --stage character.usdc --motions FOLDER --clips 01_14

Solver iterations start from the network's state in that frame, and inertia holds the cloth there: a few, as
`bake --refine` makes them, and as many as the solver needs to its tolerance. Then cloth is lifted off skin that still
shows.
"""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import numpy as np
import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from refine import NetworkTake
from shown_skin import refined_points, seen

from ssilk_core.assets import Floats
from ssilk_core.collision import CoveredSkin

ITERATIONS = (4, 200)
BEFORE = 1  # frames before the worst one, for its drag
HEADER = ("garment", "clip", "frame", "network [%]", *(f"{count} iterations [%]" for count in ITERATIONS))


@torch.no_grad()
def measure(subject: Subject, options: Namespace) -> dict[str, Any]:
    """Return, by clip, the worst frame and the shares of covered skin that show there."""
    skin = CoveredSkin(subject.scene, device=subject.device)

    def shares(take: NetworkTake, points: Floats) -> Floats:
        return np.asarray(seen(subject, skin, take.blocks(points))[0].shares)

    found: dict[str, Any] = {}
    for clip in options.clips:
        whole = NetworkTake.of(subject, clip_of(options, clip, subject))
        shown = shares(whole, whole.points)
        worst = max(int(shown.argmax()), BEFORE)
        take = whole.clip(worst - BEFORE, worst + 1)
        at: dict[str, Any] = {"frame": worst, "network": float(shown[worst])}
        for count in ITERATIONS:
            at[f"{count} iterations"] = float(shares(take, refined_points(take, count))[-1])
        found[clip] = at
    return found


def rows(garment: str, found: dict[str, Any]) -> list[list[str]]:
    """Return the lines of a garment."""
    return [
        [garment, clip, str(at["frame"]), f"{at['network']:.2%}",
         *(f"{at[f'{count} iterations']:.2%}" for count in ITERATIONS)]
        for clip, at in found.items()
    ]  # fmt: skip


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", required=True, metavar="NAME", help="clips of the motions' folder")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
