# SPDX-License-Identifier: Apache-2.0
"""How much covered skin shows on whole clips: under the network, refined by the simulator, and under plain skinning.

    python benchmarks/shown_skin.py cape.safetensors --stage character.usdc --motions FOLDER --index FOLDER/index.json

Shares are means over all frames of a split, and those of its worst frame. Stretch is the mean energy. With `--refine`
the refined network is measured on whole clips, too. It and the simulator are measured on the first `--frames` frames
of `--refined` clips.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from refine import CHUNK, Blocks, NetworkTake
from torch import Tensor

from ssilk_core.physics.simulate import SimulationOptions, simulate
from ssilk_core.physics.skin.covered_skin import CoveredSkin, ShownCounts
from ssilk_core.quality.evaluation.splits import read_index
from ssilk_core.scene.assets import Floats
from ssilk_core.training.motion_bank import roll_states

SPLITS = ("valid", "test", "flips")
HEADER = (
    "garment",
    "split",
    "method",
    "frames",
    "shows, mean [%]",
    "worst frame [%]",
    "in",
    "bare [%]",
    "limbs through [% of frames]",
    "stretch [J]",
)
ITERATIONS = 4


def whole_clip(
    subject: Subject, skin: CoveredSkin, options: Namespace, clip: str
) -> Iterator[tuple[str, ShownCounts, Tensor]]:
    """Yield method, the skin that shows and stretch energies of every frame of a clip."""
    validator = subject.validator(clip_of(options, clip, subject))
    (span,) = validator.clips
    states = roll_states(subject.model, validator.bank, [span], validator.down)[0]

    def blocks(method: str) -> Blocks:
        for start in range(0, len(span), CHUNK):
            frames = torch.arange(span[start], span[min(start + CHUNK, len(span)) - 1] + 1, device=subject.device)
            character = validator.bank.character(frames)
            at = subject.model.vertices(states[start : start + CHUNK], character)
            yield at if method == "network" else validator.lbs_vertices(character), character

    for method in ("network", "linear blend skinning"):
        yield method, *seen(subject, skin, blocks(method))
    if options.refine:
        take = NetworkTake.of(subject, clip_of(options, clip, subject))
        yield f"refine {ITERATIONS}", *seen(subject, skin, take.blocks(refined_points(take)))


def refined_points(take: NetworkTake, iterations: int = ITERATIONS) -> Floats:
    """Return the refined vertices of a take (F, V, 3), held where the network has them."""
    refiner = take.refiner(iterations, False, CHUNK)
    return np.stack([frame.points for frame in refiner.frames(take.motion, take.points)])


def seen(subject: Subject, skin: CoveredSkin, blocks: Blocks) -> tuple[ShownCounts, Tensor]:
    """Return the skin that shows and the stretch in all frames of blocks."""
    counts, stretch = [], []
    for x, character in blocks:
        counts.append(ShownCounts.of(skin.states(x, character)))
        stretch.append(subject.energy.stretch(x).cpu())
    return ShownCounts.joined(counts), torch.cat(stretch)


def solved(
    subject: Subject, skin: CoveredSkin, options: Namespace, clip: str
) -> Iterator[tuple[str, ShownCounts, Tensor]]:
    """Yield the same of the first frames of a clip: the network, refined, and the simulator."""
    take = NetworkTake.of(subject, clip_of(options, clip, subject), options.frames)
    dressed, motion = subject.dressed, take.motion
    simulation = SimulationOptions(fps=motion.fps, precision="float32")
    (simulated,) = simulate(dressed.scene, dressed.fabric, [motion], simulation, device=subject.device)
    for method, points in (
        ("network", take.points), (f"refine {ITERATIONS}", refined_points(take)), ("simulator", simulated),
    ):  # fmt: skip
        yield method, *seen(subject, skin, take.blocks(points))


def figures(found: list[tuple[str, ShownCounts, Tensor]]) -> dict[str, Any]:
    """Return the figures of one method over clips, each with its name, skin and energies."""
    counts, stretch = ShownCounts.joined([each[1] for each in found]), torch.cat([each[2] for each in found])
    worst = max(found, key=lambda each: float(each[1].shares.max()))
    return {
        "frames": len(stretch), "mean": float(counts.shares.mean()), "worst": float(counts.shares.max()),
        "in": worst[0], "bare": float(counts.bare.mean()),
        "pierced": counts.pierced_share,
        "stretch": float(stretch.mean()), "clips": {name: float(own.shares.mean()) for name, own, _ in found},
    }  # fmt: skip


@torch.no_grad()
def measure(subject: Subject, options: Namespace) -> dict[str, Any]:
    """Return the figures of a garment by split and method."""
    skin = CoveredSkin(subject.scene, device=subject.device)
    result: dict[str, Any] = {"covered": len(skin)}
    splits = {split: [entry.clip for entry in read_index(options.index) if entry.split == split] for split in SPLITS}
    runs = [(split, clips, whole_clip) for split, clips in splits.items()]
    if options.refined:
        runs.append((f"first {options.frames} frames", options.refined, solved))
    for split, clips, run in runs:
        methods: dict[str, list[tuple[str, ShownCounts, Tensor]]] = {}
        for clip in clips:
            for method, shares, stretch in run(subject, skin, options, clip):
                methods.setdefault(method, []).append((clip, shares, stretch))
        result[split] = {method: figures(found) for method, found in methods.items()}
    return result


def rows(garment: str, found: dict[str, Any]) -> list[list[str]]:
    """Return the lines of a garment."""
    return [
        [garment, split, method, str(at["frames"]), f"{at['mean']:.3%}", f"{at['worst']:.2%}", at["in"],
         f"{at['bare']:.2%}", "" if at["pierced"] is None else f"{at['pierced']:.1%}", f"{at['stretch']:.3f}"]
        for split, methods in found.items() if isinstance(methods, dict) for method, at in methods.items()
    ]  # fmt: skip


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--refine", action="store_true", help="refine the whole clips, too")
    parser.add_argument("--refined", nargs="*", default=[], metavar="CLIP", help="clips to refine and to simulate")
    parser.add_argument("--frames", type=int, default=60, help="frames of these (default 60)")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
