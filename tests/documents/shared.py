# SPDX-License-Identifier: Apache-2.0
"""What several documents say of measurements: text with figures, made from the files that these come from."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median

from ssilk_core.config import Preset

from .measured import default, document, result

Text = Iterator[str]


def frame_time() -> float:
    """Return the time from pose to vertices on one processor thread with numpy [ms]."""
    return result("runtime")["models"]["cape"]["numpy"]["full, poses included"][0] / 1000


def cache_share() -> float:
    """Return how many times a point cache is larger than the animation of the same shot."""
    (shot,) = (line for line in result("compact")["rows"] if line["name"] == "anim.usdc, the shot")
    return result("compact")["cache"] / shot["bytes"]


def preset_minutes(preset: Preset) -> float:
    """Return how long a preset's iterations take, at the pace of the shipped cape on one H200 [min]."""
    cape = result("curves")["cape"]
    return preset.train.iterations * cape["seconds"][-1] / cape["iterations"][-1] / 60


def two_gpus(case: str, batch: int) -> float:
    """Return how many times as fast two GPUs train a batch as one."""
    one, two = (result("scaling")[case][f"{count} processes, batch {batch}"] for count in (1, 2))
    return median(one["times"]["windows"]) / median(two["times"]["windows"])


def extremes() -> str:
    return f"{len(document('stress_cape')['outcomes'])} extremes"


def model_size() -> str:
    sizes = [shape["model_bytes"] for shape in document("trade_cape")["points"] if shape["precision"] == "int16"]
    return f"{sizes[0] / 1e6:.1f} MB"


def default_step() -> str:
    """Return the time of one training step with the default windows."""
    case = result("training")["cases"]["batch 256, window 6, resting 256"]
    size = case["size"]
    assert (size["batch"], size["window"]) == (default("batch"), default("window"))
    poses = size["batch"] * (size["window"] - 2)
    return f"{case['kernels']['steps [ms]']['windows']:.1f} ms for {poses:,} new poses"
