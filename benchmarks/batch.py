# SPDX-License-Identifier: Apache-2.0
"""Time playing one garment in many shots at once, one frame of all in each call.

    python benchmarks/batch.py --device cuda

The garment is the synthetic cloak, with the default network. A call copies the poses of its frame, advances all
latents and decodes them; on a GPU it is one CUDA graph. "Latency" waits for each call to end; "throughput" only for
the last one of a clip.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from helpers import synthetic
from helpers.reports import table, write_results

from ssilk_core.devices import select_device
from ssilk_core.network.model.batch import BatchPlayer, MotionInputs, motion_inputs
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig

SHOTS = (1, 8, 64, 512, 2048)
FRAMES = 128
SIZE = synthetic.Size(vertices=2500, body=600, proxies=20, shapes=64, batch=1, window=3, static_batch=0)


def build(device: torch.device) -> tuple[GarmentModel, MotionInputs]:
    """Return an untrained network, and one shot."""
    scene, config = synthetic.scene(SIZE), ModelConfig(shapes=SIZE.shapes)
    model = GarmentModel(scene, config, np.arange(synthetic.JOINTS)).to(device).eval()
    motion = synthetic.motion(scene.character.skeleton, config.fps, 0).clip(0, FRAMES)
    return model, motion_inputs(model, [motion])


def repeated(shot: MotionInputs, shots: int) -> MotionInputs:
    """Return the same shot many times; rows of matrices share memory until they are copied."""
    return MotionInputs(
        shot.rest.expand(-1, shots, -1),
        shot.pose.expand(-1, shots, -1),
        shot.character.expand(-1, -1, -1, -1, shots),
        shot.bend.expand(-1, -1, shots),
        shot.planes.expand(-1, -1, -1, shots),
        shot.origins.expand(-1, -1, shots),
        shot.begins.expand(-1, shots, -1),
    )


def wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def latencies(player: BatchPlayer, shots: MotionInputs, device: torch.device) -> list[float]:
    """Return the time of each call by itself [s]."""
    taken = []
    for frame in range(FRAMES):
        wait(device)
        start = time.perf_counter()
        player.step(shots, frame)
        wait(device)
        taken.append(time.perf_counter() - start)
    return taken


def throughput(player: BatchPlayer, shots: MotionInputs, device: torch.device) -> float:
    """Return frames of all shots per second, over a clip."""
    wait(device)
    start = time.perf_counter()
    for frame in range(FRAMES):
        player.step(shots, frame)
    wait(device)
    return FRAMES * shots.rest.shape[1] / (time.perf_counter() - start)


def measured(model: GarmentModel, shot: MotionInputs, shots: int, vertices: bool, repeats: int) -> dict[str, float]:
    """Return median and 95th percentile of a call [us], and the best throughput [1/s]."""
    device, many = shot.rest.device, repeated(shot, shots)
    torch.compiler.reset()  # or else the ninth size would no longer be compiled
    player = BatchPlayer(model, many, vertices=vertices)
    latencies(player, many, device)
    taken = np.concatenate([latencies(player, many, device) for _ in range(repeats)])
    median, late = (1e6 * np.percentile(taken, (50, 95))).tolist()
    rate = max(throughput(player, many, device) for _ in range(repeats))
    return {"median [us]": median, "95th percentile [us]": late, "frames per second": rate}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="auto", help="where everything runs (default: a GPU if there is one)")
    parser.add_argument("--threads", type=int, default=1, help="processor threads (default 1)")
    parser.add_argument("--shots", type=int, nargs="+", default=SHOTS, help=f"shots at once (default {SHOTS})")
    parser.add_argument("--repeats", type=int, default=10, help="of each clip (default 10)")
    parser.add_argument("--name", default=Path(__file__).stem, help="of the result files (default: the script's)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    model, shot = build(select_device(options.device))
    found = {
        f"{shots} {'with vertices' if vertices else 'network alone'}": measured(
            model, shot, shots, vertices, options.repeats
        )
        for vertices in (False, True)
        for shots in options.shots
    }
    rows = [[name, *(f"{value:,.0f}" for value in row.values())] for name, row in found.items()]
    write_results(options, table(("shots at once", *next(iter(found.values()))), rows), found)


if __name__ == "__main__":
    main()
