# SPDX-License-Identifier: Apache-2.0
"""Looking after the steps that are undone because something was not finite: telling, judging, keeping for study."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..assets import Motion
from ..files import replacing
from ..motion_bank import MOST_TURN, MotionBank, usable_spans
from .faults import Faults
from .state import learned
from .step import Stepper

EVERY = 20  # steps between two looks
SPAN = 100  # steps that are judged together
POSES = ("frames", "directions")  # what a step of the warm start is computed from
LIMIT = 0.5  # of the steps in a span; with more of them undone, training is not going anywhere


class DivergenceMonitor:
    """Looks now and then at the steps that a stepper has undone.

    Attributes:
        count: steps undone, as of the last look.
    """

    def __init__(self, faults: Faults) -> None:
        self.faults, self.count = faults, int(faults.count)
        self._initial_count = self.count
        self._counts = deque([self.count], maxlen=SPAN // EVERY + 1)
        self._told, self._blamed = self.count, {name: int(value) for name, value in faults.terms.items()}

    def look(self) -> str:
        """Return one sentence when steps were undone; of many, ever fewer are told of. It waits for the device."""
        self.count = int(self.faults.count)
        self._counts.append(self.count)
        if self.count == self._told or self.count - self._initial_count < 1.5 * (self._told - self._initial_count):
            return ""
        blamed = {name: int(value) for name, value in self.faults.terms.items()}
        names = [name for name, value in blamed.items() if value > self._blamed.get(name, 0)]
        new, self._told, self._blamed = self.count - self._told, self.count, blamed
        return (
            f"{new} step{'s' if new > 1 else ''} up to iteration {self.iteration} "
            f"{'were' if new > 1 else 'was'} undone: {' and '.join(names)} not finite."
        )

    @property
    def iteration(self) -> int:
        """The iteration that the last undone step led to."""
        return int(self.faults.iteration) + 1

    @property
    def is_diverging(self) -> bool:
        """Whether too many of the last steps were undone."""
        return self._counts[-1] - self._counts[0] > LIMIT * SPAN

    @property
    def non_finite_terms(self) -> list[str]:
        """Names of what was not finite, the most frequent first."""
        counts = {name: int(value) for name, value in self.faults.terms.items()}
        return sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])


def fault_path(model: str | Path) -> Path:
    """Return where the run that writes `model` keeps what was not finite."""
    return Path(model).with_suffix(".fault.safetensors")


def save_fault(path: Path, stepper: Stepper, motions: Sequence[Motion], found: str) -> None:
    """Write the window of the last step that was undone, beside what was learned until then.

    Tensors "window.*" are what the step was computed from; the header says under "ssilk_fault" what was found, the
    iteration that the step led to, and the motion and frame that each slot of the window begins at.
    """
    from safetensors.torch import save

    faults, bank = stepper.faults, stepper.objective.bank
    still = int(faults.iteration) < stepper.config.static_iterations
    window = {name: value.cpu() for name, value in faults.window.items() if (name in POSES) == still}
    frames = window.get("frames" if still else "first")
    places = [] if frames is None else places_of(frames, bank, motions, stepper.model.config.fps)
    document = {"found": found, "iteration": int(faults.iteration) + 1, "places": places}
    tensors = learned(stepper) | {f"window.{name}": value.contiguous() for name, value in window.items()}
    with replacing(path) as temporary:
        temporary.write_bytes(save(tensors, {"ssilk_fault": json.dumps(document)}))


def places_of(frames: Tensor, bank: MotionBank, motions: Sequence[Motion], fps: float) -> list[dict[str, Any]]:
    """Return for frames (N,) of a bank of `motions` at `fps` which motion they are in, and its own frame there."""
    spans, starts = usable_spans(motions, fps, MOST_TURN), bank.starts.tolist()
    index = frames.tolist()
    clips = np.searchsorted(bank.stops.cpu().numpy(), index, side="right").tolist()
    return [
        {"motion": spans[c].path, "frame": round(spans[c].start + (i - starts[c]) * spans[c].fps / fps, 3)}
        for c, i in zip(clips, index)
    ]
