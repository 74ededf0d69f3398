# SPDX-License-Identifier: Apache-2.0
"""What it costs the simulator to keep cloth from passing through cloth, and how far it does.

    python benchmarks/self_contact.py cape.safetensors --stage character.usdc --motions FOLDER --clips 01_14

The first frames of the clips are simulated side by side, without contact of cloth with cloth and with it, frame by
frame in turn, so that both meet the same load. The first frame, which brings the garment to rest in the first pose,
is not timed. A model gives the garment, its fabric and its rate; its network is not used.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from helpers.clock import now
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed

from ssilk_core.physics.intersections.cloth import ClothIntersections
from ssilk_core.physics.simulate import SimulatedFrame, SimulationOptions, Simulator

HEADER = ("garment", "cloth through cloth", "ms per frame and shot, median", "quartiles", "iterations",
          "within the tolerance", "triangles that intersect others, mean [%]", "worst [%]")  # fmt: skip


def measure(subject: Subject, options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of both simulations of a garment."""
    clips = [clip_of(options, name, subject) for name in options.clips]
    shots = [clip.clip(0, round(options.frames * clip.fps / subject.file.config.fps)) for clip in clips]
    runs = {}
    for name, held in (("passes", False), ("is kept apart", True)):
        settings = SimulationOptions(fps=subject.file.config.fps, batch=len(shots), self_contact=held)
        simulator = Simulator(subject.scene, subject.file.fabric, settings, device=subject.device)
        runs[name] = simulator.frames(shots)
    found: dict[str, list[list[SimulatedFrame]]] = {name: [] for name in runs}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(options.frames):
        for name, frames in runs.items():
            begun = now(subject.device)
            found[name].append([next(frames) for _ in shots])
            seconds[name].append((now(subject.device) - begun) / len(shots))
    tolerance, cloth = SimulationOptions().solver.tolerance, ClothIntersections.of(subject.scene)
    return {
        name: {
            "shots": len(shots),
            "seconds": seconds[name][1:],
            "iterations": float(np.mean([frame.iterations for step in steps[1:] for frame in step])),
            "solved": float(np.mean([frame.residual <= tolerance for step in steps[1:] for frame in step])),
            "shares": [cloth.triangles(frame.points).mean() for step in steps for frame in step],
        }
        for name, steps in found.items()
    }


def rows(garment: str, measured: dict[str, Any]) -> list[list[str]]:
    """Return the lines of a garment."""
    lines = []
    for name, found in measured.items():
        low, middle, high = 1000 * np.quantile(found["seconds"], (0.25, 0.5, 0.75))
        shares = 100 * np.asarray(found["shares"])
        lines.append([garment, name, f"{middle:.0f}", f"{low:.0f} to {high:.0f}", f"{found['iterations']:.1f}",
                      f"{found['solved']:.0%}", f"{shares.mean():.2f}", f"{shares.max():.2f}"])  # fmt: skip
    return lines


def main() -> None:
    parser = arguments(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--clips", nargs="+", default=["01_14"], help="their names (default 01_14)")
    parser.add_argument("--frames", type=int, default=12, help="of each clip (default 12)")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
