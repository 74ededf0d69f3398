# SPDX-License-Identifier: Apache-2.0
"""Whether refinement frees the limbs that a network lets through loose cloth.

    python benchmarks/limbs.py cape.safetensors --stage character.usdc --motions FOLDER --clips 05_12

Of each clip the stretch of `--frames` frames is refined in which limbs are through the cloth most often, by few and
by more iterations of the solver. What is counted are the frames with any limb through the cloth.
"""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import numpy as np
import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from refine import NetworkTake
from shown_skin import refined_points, seen

from ssilk_core.physics.skin.covered_skin import CoveredSkin
from ssilk_core.scene.assets import Floats

ITERATIONS = (4, 16)
HEADER = ("garment", "clip", "first frame", "network", *(f"{count} iterations" for count in ITERATIONS),
          "stretch [J]")  # fmt: skip


@torch.no_grad()
def measure(subject: Subject, options: Namespace) -> dict[str, Any]:
    """Return, by clip, the frames with limbs through the cloth and the mean energy of stretch, of each method."""
    skin = CoveredSkin(subject.scene, device=subject.device)

    def figures(take: NetworkTake, points: Floats) -> dict[str, Any]:
        own = seen(subject, skin, take.blocks(points))
        assert own.skin.pierced is not None
        return {"through": int(own.skin.pierced.any(0).sum()), "stretch": float(own.stretch.mean())}

    found: dict[str, Any] = {}
    for clip in options.clips:
        whole = NetworkTake.of(subject, clip_of(options, clip, subject))
        counts = seen(subject, skin, whole.blocks(whole.points)).skin
        assert counts.pierced is not None
        through = np.convolve(counts.pierced.any(0), np.ones(options.frames), mode="valid")
        first = int(through.argmax())
        take = whole.clip(first, first + options.frames)
        at: dict[str, Any] = {"first frame": first, "frames": options.frames, "network": figures(take, take.points)}
        for count in ITERATIONS:
            at[f"{count} iterations"] = figures(take, refined_points(take, count))
        found[clip] = at
    return found


def rows(garment: str, found: dict[str, Any]) -> list[list[str]]:
    """Return the lines of a garment."""
    methods = ("network", *(f"{count} iterations" for count in ITERATIONS))
    return [
        [garment, clip, str(at["first frame"]), *(f"{at[method]['through']} of {at['frames']}" for method in methods),
         " / ".join(f"{at[method]['stretch']:.3f}" for method in methods)]
        for clip, at in found.items()
    ]  # fmt: skip


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", required=True, metavar="NAME", help="clips of the motions' folder")
    parser.add_argument("--frames", type=int, default=16, help="frames of each stretch (default 16)")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
