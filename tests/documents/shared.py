# SPDX-License-Identifier: Apache-2.0
"""What several documents say of measurements: text with figures, made from the files that these come from."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median
from typing import Any

from ssilk_core.training.settings import Preset

from .measured import document, result

Text = Iterator[str]

LARGE_STEP = "batch 256, window 6, static_batch 256"
"""The case of `training.py` with the most windows."""

SCALING = {32: "scaling_32", 6: "scaling"}
"""Results of `scaling.py` by the poses in a window."""


def frame_time() -> float:
    """Return the time from pose to vertices on one processor thread with numpy [ms]."""
    return result("runtime")["models"]["cape"]["numpy"]["full, poses included"][0] / 1000


def compact_row(name: str) -> dict[str, Any]:
    """Return size and errors of one way to store a shot."""
    (found,) = (line for line in result("compact")["rows"] if line["name"] == name)
    return found


def shot_row() -> dict[str, Any]:
    return compact_row("anim.usdc, the shot")


def cache_share() -> str:
    """Return how large an animation is, relative to a point cache of the same shot."""
    return f"1/{result('compact')['cache'] / shot_row()['bytes']:.0f}"


def preset_minutes(preset: Preset) -> float:
    """Return how long a preset takes, at the pace of a cape on an H200 that three trainings share [min]."""
    cape = result("long_decay_training")["cape_half_rate_decay"]
    return preset.train.iterations * cape["seconds"][-1] / cape["iterations"][-1] / 60


def step_time(window: int, processes: int, batch: str) -> float:
    """Return the time of a training step on windows that processes share [s]."""
    case = {"step": "windows", "processes": processes, "batch": batch}
    (times,) = (found["times"] for found in result(SCALING[window])["cases"] if case.items() <= found.items())
    return median(times)


def two_gpus(window: int, batch: int) -> float:
    """Return how many times as fast two GPUs train a batch as one."""
    one, two = (step_time(window, count, str(batch)) for count in (1, 2))
    return one / two


def extremes() -> str:
    return f"{len(document('stress_cape')['outcomes'])} extremes"


def large_step_size() -> dict[str, int]:
    size: dict[str, int] = result("training")["cases"][LARGE_STEP]["size"]
    return size


def large_step() -> str:
    """Return the time of one training step of that size."""
    size, case = large_step_size(), result("training")["cases"][LARGE_STEP]
    poses = size["batch"] * (size["window"] - 2)
    return f"{case['kernels']['steps [ms]']['windows']:.1f} ms for {poses:,} new poses in {size['batch']} windows"
