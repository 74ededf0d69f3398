# SPDX-License-Identifier: Apache-2.0
"""Detection of diverging training: report skipped steps, judge them, save the last one for study."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..files import replacing
from ..network.tensors import pack_tensors
from ..scene.assets import Motion, Skeleton
from ..scene.kinematics import MAX_JOINT_SPEED
from .motion_bank import MotionBank, usable_spans
from .skipped_steps import SkippedSteps
from .state import learned_tensors
from .step import Stepper

CHECK_INTERVAL = 20  # steps between two checks
DIVERGENCE_WINDOW = 100  # steps
STATIC_INPUTS = ("frames", "directions", "fabrics")  # inputs of a static step
MAX_SKIPPED_SHARE = 0.5  # of the steps in the window; with more, training has diverged


class DivergenceMonitor:
    """Checks periodically how many steps were skipped.

    Attributes:
        count: skipped steps, as of the last check.
    """

    def __init__(self, skipped: SkippedSteps) -> None:
        self.skipped, self.count = skipped, int(skipped.count)
        self._initial_count = self.count
        self._counts = deque([self.count], maxlen=DIVERGENCE_WINDOW // CHECK_INTERVAL + 1)
        self._reported, self._reported_terms = self.count, {name: int(value) for name, value in skipped.terms.items()}

    def check(self) -> str:
        """Return a sentence about newly skipped steps, or ""; repeated ones are reported ever less often.

        It waits for the device.
        """
        self.count = int(self.skipped.count)
        self._counts.append(self.count)
        if self.count == self._reported or self.count - self._initial_count < 1.5 * (
            self._reported - self._initial_count
        ):
            return ""
        terms = {name: int(value) for name, value in self.skipped.terms.items()}
        names = [name for name, value in terms.items() if value > self._reported_terms.get(name, 0)]
        new, self._reported, self._reported_terms = self.count - self._reported, self.count, terms
        return (
            f"{new} step{'s' if new > 1 else ''} up to iteration {self.iteration} "
            f"{'were' if new > 1 else 'was'} skipped: {' and '.join(names)} not finite."
        )

    @property
    def iteration(self) -> int:
        """The iteration after the last skipped step."""
        return int(self.skipped.iteration) + 1

    @property
    def is_diverging(self) -> bool:
        """Whether too many of the last steps were skipped."""
        return self._counts[-1] - self._counts[0] > MAX_SKIPPED_SHARE * DIVERGENCE_WINDOW

    @property
    def non_finite_terms(self) -> list[str]:
        """Names of the terms that were not finite, the most frequent first."""
        counts = {name: int(value) for name, value in self.skipped.terms.items()}
        return sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])


def fault_path(model: str | Path) -> Path:
    """Return the path at which the run that writes `model` saves its last skipped step."""
    return Path(model).with_suffix(".fault.safetensors")


def save_fault(path: Path, stepper: Stepper, motions: Sequence[Motion], found: str) -> None:
    """Write the inputs of the last skipped step, with the parameters and optimiser state.

    Tensors "window.*" are the inputs of the step. The header holds under "ssilk_fault" what was found, the iteration
    after the step, and the motion and frame at which each slot of the window begins.
    """
    skipped, bank = stepper.skipped, stepper.objective.bank
    still = int(skipped.iteration) < stepper.config.static_iterations
    window = {name: value.cpu() for name, value in skipped.window.items() if (name in STATIC_INPUTS) == still}
    frames = window.get("frames" if still else "first")
    places = (
        []
        if frames is None
        else locate_frames(frames, bank, motions, stepper.model.scene.character.skeleton, stepper.model.config.fps)
    )
    document = {"found": found, "iteration": int(skipped.iteration) + 1, "places": places}
    tensors = learned_tensors(stepper) | {f"window.{name}": value.contiguous() for name, value in window.items()}
    arrays = {name: value.numpy() for name, value in tensors.items()}
    with replacing(path) as temporary:
        temporary.write_bytes(pack_tensors(arrays, {"ssilk_fault": json.dumps(document)}))


def locate_frames(
    frames: Tensor, bank: MotionBank, motions: Sequence[Motion], skeleton: Skeleton, fps: float
) -> list[dict[str, Any]]:
    """Return motion path and frame for each frame index (N,) of a bank of `motions` at `fps`."""
    spans, starts = usable_spans(motions, skeleton, fps, MAX_JOINT_SPEED), bank.starts.tolist()
    index = frames.tolist()
    clips = np.searchsorted(bank.stops.cpu().numpy(), index, side="right").tolist()
    return [
        {"motion": spans[c].path, "frame": round(spans[c].start + (i - starts[c]) * spans[c].fps / fps, 3)}
        for c, i in zip(clips, index)
    ]
