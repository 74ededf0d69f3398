# SPDX-License-Identifier: Apache-2.0
"""What networks of several sizes cost, in joints, shapes, bytes and times, and what they reach.

    OMP_NUM_THREADS=1 python benchmarks/sizes.py cape_s.safetensors cape_m.safetensors --motion 02_04.usdc \\
        --trained-on "2 x NVIDIA H200, six trainings on each"

The learning curve of each model lies beside it. Its lowest total on the clips that it was validated on counts, and
what single steps miss there then. Times are those of numpy on one processor thread, medians over repeats of a clip.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from curves import read_run
from helpers.playing import SKINNING, measured, with_numpy
from helpers.reports import table, write_results
from ssilk_usd.reading.motion import read_motion

from ssilk_core.network.checkpoint import load_model
from ssilk_core.network.runtime import Player
from ssilk_core.scene.kinematics import resample

HEADER = ("model", "proxies", "shapes", "latent", "MB", "network [µs]", "frame [µs]", "best [J]", "last [J]",
          "stretch [J]", "step [mJ]", "step [mm]")  # fmt: skip


def measure(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of one model."""
    file, run = load_model(path), read_run(str(path))
    player = Player(file)
    motion = resample(read_motion(options.motion, file.scene.character.skeleton), file.config.fps)
    times = measured({"numpy": lambda clip: with_numpy(player, clip)}, motion, options.repeats)["numpy"]
    best = int(run.values["total"].argmin())
    return {
        "proxies": file.scene.rig.proxy_count,
        "shapes": file.config.shapes,
        "latent": file.config.latent,
        "widths": list(file.config.widths),
        "bytes": path.stat().st_size,
        "network": times["model"][0],
        "frame": times["full, poses included"][0],
        "skinning": times[SKINNING][0],
        "iterations": [int(run.iterations[at]) for at in (best, -1)],
        "total": [float(run.values["total"][at]) for at in (best, -1)],
        **{name: float(run.values[name][best]) for name in ("stretch", "step energy", "step distance", "shows")},
    }


def row(name: str, found: dict[str, Any]) -> list[str]:
    """Return the line of a model."""
    counts = (str(found[key]) for key in ("proxies", "shapes", "latent"))
    times = (f"{found[key]:.0f}" for key in ("network", "frame"))
    energies = (f"{value:.4f}" for value in (*found["total"], found["stretch"]))
    steps = f"{1000 * found['step energy']:.1f}", f"{1000 * found['step distance']:.1f}"
    return [name, *counts, f"{found['bytes'] / 1e6:.1f}", *times, *energies, *steps]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="files written by 'ssilk train'")
    parser.add_argument("--motion", type=Path, required=True, help="clip that is played")
    parser.add_argument("--trained-on", required=True, help="the device of the trainings")
    parser.add_argument("--repeats", type=int, default=20, help="of the clip (default 20)")
    parser.add_argument("--name", default="sizes", help="of the result file (default sizes)")
    options = parser.parse_args()
    options.device, options.threads = "cpu", 1
    found = {path.stem: measure(path, options) for path in options.models}
    write_results(options, table(HEADER, [row(name, each) for name, each in found.items()]), found)


if __name__ == "__main__":
    main()
