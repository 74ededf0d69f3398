# SPDX-License-Identifier: Apache-2.0
"""Stress cases of a garment, and the verdicts that each may have."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import torch

from ...errors import SsilkError
from .drives import freeze_after
from .measures import (
    Measure,
    bake_at_rate,
    jumps,
    ride,
    roll_out_frames,
    roll_out_motion,
    roll_out_nan,
    roll_out_path,
    roll_out_precision,
    roll_out_random_poses,
    roll_out_rotated,
    simulate_fabric,
    simulate_gravity,
    simulate_slivers,
    train_at_size,
    train_fabric,
    train_slivers,
    train_vertex_count,
)
from .outcome import CaseMeasurement, CaseOutcome, Verdict
from .subject import StressSubject

UPWARD, FORWARD = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Case:
    """One stress case.

    Attributes:
        group, name: its labels in the table.
        measure: runs the case; it raises `SsilkError` if the product refuses the input.
        allowed: verdicts that are acceptable.
        body: name of the body of a family that it runs on, where there are several.
    """

    group: str
    name: str
    measure: Measure
    allowed: tuple[Verdict, ...] = ("works",)
    body: str = ""

    @property
    def label(self) -> str:
        """What messages and `ssilk stress --only` call the case."""
        return f"{self._placed}: {self.name}"

    @property
    def _placed(self) -> str:
        """The group, with the body in front where there are several: "heavy/rate"."""
        return f"{self.body}/{self.group}" if self.body else self.group

    def matches(self, words: Sequence[str]) -> bool:
        """Return whether the case's name contains one of `words`; True if there are none."""
        return not words or any(word in self.label for word in words)

    def run(self, subject: StressSubject) -> CaseOutcome:
        """Run the case and return its outcome."""
        began = time.perf_counter()
        verdict, said, measured = self._tried(subject)
        return CaseOutcome(self.name, self._placed, verdict, said, measured, time.perf_counter() - began)

    def _tried(self, subject: StressSubject) -> tuple[Verdict, str, CaseMeasurement]:
        try:
            measured = self.measure(subject)
        except SsilkError as error:
            return "refuses", str(error), CaseMeasurement()
        except (RuntimeError, ValueError, ArithmeticError, IndexError, MemoryError) as error:
            return "breaks", f"{type(error).__name__}: {error}".partition("\n")[0], CaseMeasurement()
        return measured.verdict, measured.note, measured


MAY_FALL_BACK: tuple[Verdict, ...] = ("works", "falls back")
FRAME_RATES = (5, 12, 24, 60, 120, 240)
STIFFNESSES = (1e-3, 1.0, 1e3, 1e6)  # [N/m]
SLIVER_HEIGHTS = (1e-2, 1e-4, 1e-6, 1e-8, 0.0)  # ratio of height to base
VERTEX_COUNTS = (100, 10_000, 200_000)
PRECISIONS = (torch.float64, torch.float32, torch.bfloat16, torch.float16)

CASES = (
    *(Case("length", f"{count:,} frames", roll_out_frames(count)) for count in (10_000, 100_000)),
    *(Case("rate", f"{fps} frames per second", bake_at_rate(fps)) for fps in FRAME_RATES),
    Case("gravity", "none", simulate_gravity(0.0), MAY_FALL_BACK),
    Case("gravity", "tenfold", simulate_gravity(10.0), MAY_FALL_BACK),
    Case("gravity", "sideways", roll_out_rotated(FORWARD, angle=pi / 2)),
    Case("motion", "upside down", roll_out_rotated(FORWARD, angle=pi)),
    Case("motion", "a teleport of 30 m each second", roll_out_path(jumps)),
    Case("motion", "a ride at 50 m/s", roll_out_path(ride)),
    Case("motion", "a spin of 30 rad/s", roll_out_rotated(UPWARD, speed=30.0)),
    Case("motion", "tumbling at 30 rad/s", roll_out_rotated(FORWARD, speed=30.0)),
    Case(
        "motion", "a stop within one frame", roll_out_motion(lambda subject, base: freeze_after(base, base.loop / 4))
    ),
    Case("motion", "one pose throughout", roll_out_motion(lambda subject, base: freeze_after(base, 0.0))),
    Case("motion", "poses of any joint angles", roll_out_random_poses(0.5)),
    Case("motion", "other such poses in each frame", roll_out_random_poses(1e-3)),
    Case("motion", "NaN in frame 7", roll_out_nan(7), ("refuses",)),
    *(Case("size", f"{metres:g} m", train_at_size(metres)) for metres in (1e-3, 100.0)),
    *(Case("fabric", f"{stiffness:g} N/m", train_fabric(stiffness)) for stiffness in STIFFNESSES),
    *(
        Case("slivers", f"{height:g} as high as long", train_slivers(height), (*MAY_FALL_BACK, "refuses"))
        for height in SLIVER_HEIGHTS
    ),
    *(
        Case("simulator", f"{stiffness:g} N/m", simulate_fabric(stiffness), MAY_FALL_BACK)
        for stiffness in STIFFNESSES
    ),
    Case("simulator", "slivers 0.0001 as high as long", simulate_slivers(1e-4), MAY_FALL_BACK),
    *(Case("vertices", f"{count:,}", train_vertex_count(count)) for count in VERTEX_COUNTS),
    *(
        Case("precision", str(dtype).removeprefix("torch."), roll_out_precision(dtype), MAY_FALL_BACK)
        for dtype in PRECISIONS
    ),
)
