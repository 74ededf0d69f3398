# SPDX-License-Identifier: Apache-2.0
"""The extremes that a garment is tested under, and the outcomes that each may have."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import torch

from ..errors import SsilkError
from .drives import stopping
from .measures import (
    Measure,
    at_rate,
    contorted,
    counted,
    driven,
    in_precision,
    interrupted,
    jumps,
    lasting,
    made_of,
    meshed,
    moved,
    ride,
    sized,
    solved_of,
    solved_with,
    turned,
    weighed,
)
from .outcome import CaseMeasurement, CaseOutcome, Verdict
from .subject import StressSubject

UPWARD, FORWARD = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        group, name: of the table's line.
        measure: runs the case; it raises `SsilkError` to refuse.
        allowed: verdicts that are no fault.
    """

    group: str
    name: str
    measure: Measure
    allowed: tuple[Verdict, ...] = ("works",)

    def matches(self, words: Sequence[str]) -> bool:
        """Return whether the case's name contains one of some words, or there are none."""
        return not words or any(word in f"{self.group}: {self.name}" for word in words)

    def run(self, subject: StressSubject) -> CaseOutcome:
        """Run the case and return its outcome."""
        began = time.perf_counter()
        verdict, said, measured = self._tried(subject)
        return CaseOutcome(self.name, self.group, verdict, said, measured, time.perf_counter() - began)

    def _tried(self, subject: StressSubject) -> tuple[Verdict, str, CaseMeasurement]:
        try:
            measured = self.measure(subject)
        except SsilkError as error:
            return "refuses", str(error), CaseMeasurement()
        except (RuntimeError, ValueError, ArithmeticError, IndexError, MemoryError) as error:
            return "breaks", f"{type(error).__name__}: {error}".partition("\n")[0], CaseMeasurement()
        return measured.verdict, measured.note, measured


WIDE: tuple[Verdict, ...] = ("works", "falls back")
RATES = (5, 12, 24, 60, 120, 240)
FABRICS = (1e-3, 1.0, 1e3, 1e6)  # [N/m]
HEIGHTS = (1e-2, 1e-4, 1e-6, 1e-8, 0.0)  # of slivers, to their base
COUNTS = (100, 10_000, 200_000)
PRECISIONS = (torch.float64, torch.float32, torch.bfloat16, torch.float16)

CASES = (
    *(Case("length", f"{count:,} frames", lasting(count)) for count in (10_000, 100_000)),
    *(Case("rate", f"{fps} frames per second", at_rate(fps)) for fps in RATES),
    Case("gravity", "none", weighed(0.0), WIDE),
    Case("gravity", "tenfold", weighed(10.0), WIDE),
    Case("gravity", "sideways", turned(FORWARD, angle=pi / 2)),
    Case("motion", "upside down", turned(FORWARD, angle=pi)),
    Case("motion", "a teleport of 30 m each second", moved(jumps)),
    Case("motion", "a ride at 50 m/s", moved(ride)),
    Case("motion", "a spin of 30 rad/s", turned(UPWARD, speed=30.0)),
    Case("motion", "tumbling at 30 rad/s", turned(FORWARD, speed=30.0)),
    Case("motion", "a stop within one frame", driven(lambda subject, base: stopping(base, base.loop / 4))),
    Case("motion", "one pose throughout", driven(lambda subject, base: stopping(base, 0.0))),
    Case("motion", "poses of any joint angles", contorted(0.5)),
    Case("motion", "other such poses in each frame", contorted(1e-3)),
    Case("motion", "NaN in frame 7", interrupted(7), ("refuses",)),
    *(Case("size", f"{metres:g} m", sized(metres)) for metres in (1e-3, 100.0)),
    *(Case("fabric", f"{stiffness:g} N/m", made_of(stiffness)) for stiffness in FABRICS),
    *(Case("slivers", f"{height:g} as high as long", meshed(height), (*WIDE, "refuses")) for height in HEIGHTS),
    *(Case("simulator", f"{stiffness:g} N/m", solved_of(stiffness), WIDE) for stiffness in FABRICS),
    Case("simulator", "slivers 0.0001 as high as long", solved_with(1e-4), WIDE),
    *(Case("vertices", f"{count:,}", counted(count)) for count in COUNTS),
    *(Case("precision", str(dtype).removeprefix("torch."), in_precision(dtype), WIDE) for dtype in PRECISIONS),
)
