# SPDX-License-Identifier: Apache-2.0
"""How much skin shows, and how much cloth crosses itself, on whole clips: network, refined, and plain skinning.

    python benchmarks/shown_skin.py cape.safetensors --stage character.usdc --motions FOLDER --index FOLDER/index.json

Shares are means over all frames of a split, and those of its worst frame. Triangles that intersect others of the
garment are counted in every fourth frame. Stretch is the mean energy. With `--refine`
the refined network is measured on whole clips, too. It and the simulator are measured on the first `--frames` frames
of `--refined` clips.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from refine import CHUNK, Blocks, NetworkTake
from torch import Tensor

from ssilk_core.physics.intersections.cloth import IntersectionCounts
from ssilk_core.physics.intersections.figures import EVERY
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
    "intersect, mean [%]",
    "worst frame [%]",
    "stretch [J]",
)
ITERATIONS = 4


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen of a method in frames: skin that shows, cloth that crosses itself, and energies of stretch [J]."""

    skin: ShownCounts
    crossed: IntersectionCounts
    stretch: Tensor


def whole_clip(subject: Subject, skin: CoveredSkin, options: Namespace, clip: str) -> Iterator[tuple[str, Seen]]:
    """Yield each method, and what is seen of it in all frames of a clip."""
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
        yield method, seen(subject, skin, blocks(method))
    if options.refine:
        take = NetworkTake.of(subject, clip_of(options, clip, subject))
        yield f"refine {ITERATIONS}", seen(subject, skin, take.blocks(refined_points(take)))


def refined_points(take: NetworkTake, iterations: int = ITERATIONS) -> Floats:
    """Return the refined vertices of a take (F, V, 3), held where the network has them."""
    refiner = take.refiner(iterations, False, CHUNK)
    return np.stack([frame.points for frame in refiner.frames(take.motion, take.points)])


def seen(subject: Subject, skin: CoveredSkin, blocks: Blocks) -> Seen:
    """Return what is seen in all frames of blocks."""
    counts, stretch, chosen, first = [], [], [], 0
    for x, character in blocks:
        counts.append(ShownCounts.of(skin.states(x, character)))
        stretch.append(subject.energy.stretch(x).cpu())
        chosen += list(x[..., -first % EVERY :: EVERY].permute(2, 0, 1).double().cpu().numpy())
        first += x.shape[2]
    numbers = [float(EVERY * number) for number in range(len(chosen))]
    crossed = subject.dressed.intersections.counts(chosen, numbers)
    return Seen(ShownCounts.joined(counts), crossed, torch.cat(stretch))


def solved(subject: Subject, skin: CoveredSkin, options: Namespace, clip: str) -> Iterator[tuple[str, Seen]]:
    """Yield the same of the first frames of a clip: the network, refined, and the simulator."""
    take = NetworkTake.of(subject, clip_of(options, clip, subject), options.frames)
    dressed, motion = subject.dressed, take.motion
    simulation = SimulationOptions(fps=motion.fps, precision="float32")
    (simulated,) = simulate(dressed.scene, dressed.fabric, [motion], simulation, device=subject.device)
    for method, points in (
        ("network", take.points), (f"refine {ITERATIONS}", refined_points(take)), ("simulator", simulated),
    ):  # fmt: skip
        yield method, seen(subject, skin, take.blocks(points))


def figures(subject: Subject, found: list[tuple[str, Seen]]) -> dict[str, Any]:
    """Return the figures of one method over clips, each with its name and what is seen in it."""
    counts, stretch = ShownCounts.joined([own.skin for _, own in found]), torch.cat([own.stretch for _, own in found])
    worst = max(found, key=lambda each: float(each[1].skin.shares.max()))
    crossed = subject.dressed.intersections.figures([(clip, own.crossed) for clip, own in found])
    return {
        "frames": len(stretch), "mean": float(counts.shares.mean()), "worst": float(counts.shares.max()),
        "in": worst[0], "bare": float(counts.bare.mean()),
        "pierced": counts.pierced_share,
        "intersections": asdict(crossed),
        "stretch": float(stretch.mean()), "clips": {name: float(own.skin.shares.mean()) for name, own in found},
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
        methods: dict[str, list[tuple[str, Seen]]] = {}
        for clip in clips:
            for method, own in run(subject, skin, options, clip):
                methods.setdefault(method, []).append((clip, own))
        result[split] = {method: figures(subject, found) for method, found in methods.items()}
    return result


def rows(garment: str, found: dict[str, Any]) -> list[list[str]]:
    """Return the lines of a garment."""
    return [
        [garment, split, method, str(at["frames"]), f"{at['mean']:.3%}", f"{at['worst']:.2%}", at["in"],
         f"{at['bare']:.2%}", "" if at["pierced"] is None else f"{at['pierced']:.1%}",
         f"{at['intersections']['mean']:.2%}", f"{at['intersections']['worst']:.1%}", f"{at['stretch']:.3f}"]
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
