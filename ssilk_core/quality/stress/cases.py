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
    roll_out_fabric,
    roll_out_frames,
    roll_out_gravity,
    roll_out_height,
    roll_out_motion,
    roll_out_nan,
    roll_out_path,
    roll_out_precision,
    roll_out_prop,
    roll_out_random_poses,
    roll_out_rotated,
    roll_out_vertices,
    roll_out_wind,
    simulate_fabric,
    simulate_factor,
    simulate_friction,
    simulate_gravity,
    simulate_prop,
    simulate_slivers,
    simulate_wind,
    train_at_size,
    train_fabric,
    train_slivers,
    train_vertex_count,
)
from .outcome import CaseMeasurement, CaseOutcome, DoesNotApply, Verdict
from .subject import StressSubject
from .surroundings import appearing, passing, steady, switched

UPWARD, FORWARD = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Case:
    """One stress case.

    Attributes:
        group, name: its labels in the table.
        measure: runs the case; it raises `SsilkError` if the product refuses the input.
        allowed: verdicts that are acceptable.
        body: name of the body of a family that it runs on, where there are several.
        seconds: about what it takes with the cape that ships on one core, by which the time left is told [s].
    """

    group: str
    name: str
    measure: Measure
    allowed: tuple[Verdict, ...] = ("works",)
    body: str = ""
    seconds: float = 3.0

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

    def allows(self, verdict: Verdict) -> bool:
        """Return whether a verdict is acceptable."""
        return verdict in (*self.allowed, "does not apply")

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
        except DoesNotApply as error:
            return "does not apply", str(error), CaseMeasurement()
        except (RuntimeError, ValueError, ArithmeticError, IndexError, MemoryError) as error:
            return "breaks", f"{type(error).__name__}: {error}".partition("\n")[0], CaseMeasurement()
        return measured.verdict, measured.note, measured


MAY_FALL_BACK: tuple[Verdict, ...] = ("works", "falls back")
FRAME_RATES = (5, 12, 24, 60, 120, 240)
STIFFNESSES = (1e-3, 1.0, 1e3, 1e6)  # [N/m]
SLIVER_HEIGHTS = (1e-2, 1e-4, 1e-6, 1e-8, 0.0)  # ratio of height to base
VERTEX_COUNTS = (100, 10_000, 200_000)
FACTORS = (0.1, 10.0)  # of each stiffness
SIMULATED, SIMULATED_PROP, TRIED = 30.0, 320.0, 7.0  # [s]: a few steps of the simulator, with a prop, of training
LONGEST = 4e-3  # [s] of a frame of a long rollout
PRECISIONS = (torch.float64, torch.float32, torch.bfloat16, torch.float16)

CASES = (
    *(
        Case("length", f"{count:,} frames", roll_out_frames(count), seconds=LONGEST * count)
        for count in (10_000, 100_000)
    ),
    *(Case("rate", f"{fps} frames per second", bake_at_rate(fps), seconds=4 + fps / 20) for fps in FRAME_RATES),
    *(
        Case("gravity", name, roll_out_gravity(factor))
        for name, factor in (("none", 0.0), ("tenfold", 10.0), ("upwards", -1.0))
    ),
    Case("gravity", "none, simulated", simulate_gravity(0.0), MAY_FALL_BACK, seconds=SIMULATED),
    Case("gravity", "tenfold, simulated", simulate_gravity(10.0), MAY_FALL_BACK, seconds=SIMULATED),
    Case("gravity", "sideways", roll_out_rotated(FORWARD, angle=pi / 2)),
    *(Case("wind", f"{speed:g} m/s", roll_out_wind(steady(speed))) for speed in (20.0, 60.0)),
    Case("wind", "60 m/s from one frame to the next", roll_out_wind(switched(60.0))),
    Case("wind", "40 m/s with gusts of 20 m/s", roll_out_wind(steady(40.0), 20.0)),
    Case("wind", "60 m/s, simulated", simulate_wind(60.0), MAY_FALL_BACK, seconds=SIMULATED),
    Case("wind", "101 m/s", roll_out_wind(steady(101.0)), ("refuses",)),
    Case("props", "through the body at 2 m/s", roll_out_prop(passing(2.0))),
    Case("props", "in one frame amid cloth", roll_out_prop(appearing)),
    Case(
        "props",
        "through the body at 10 m/s, simulated",
        simulate_prop(passing(10.0)),
        MAY_FALL_BACK,
        seconds=SIMULATED_PROP,
    ),
    Case(
        "props", "in one frame amid cloth, simulated", simulate_prop(appearing), MAY_FALL_BACK, seconds=SIMULATED_PROP
    ),
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
    *(Case("size", f"{metres:g} m", train_at_size(metres), seconds=2 * TRIED) for metres in (1e-3, 100.0)),
    *(Case("size", f"{metres:g} m high, played", roll_out_height(metres), MAY_FALL_BACK) for metres in (0.01, 20.0)),
    *(Case("fabric", f"{stiffness:g} N/m", train_fabric(stiffness), seconds=TRIED) for stiffness in STIFFNESSES),
    *(
        Case("fabric", f"{name} times {factor:g}, played", roll_out_fabric(**{name: factor}))
        for name in ("stretch", "shear", "bending", "density", "drag")
        for factor in FACTORS
    ),
    Case("fabric", "bending times 0.001, density times 1000, played", roll_out_fabric(bending=1e-3, density=1e3)),
    Case("fabric", "no density, played", roll_out_fabric(density=0.0), ("refuses",)),
    *(
        Case(
            "slivers",
            f"{height:g} as high as long",
            train_slivers(height),
            (*MAY_FALL_BACK, "refuses"),
            seconds=TRIED,
        )
        for height in SLIVER_HEIGHTS
    ),
    *(
        Case("simulator", f"{stiffness:g} N/m", simulate_fabric(stiffness), MAY_FALL_BACK, seconds=SIMULATED)
        for stiffness in STIFFNESSES
    ),
    *(
        Case("simulator", f"{name} times {factor:g}", simulate_factor(name, factor), MAY_FALL_BACK, seconds=SIMULATED)
        for name in ("stretch", "shear", "bending", "contact", "tether", "stitch")
        for factor in FACTORS
    ),
    *(
        Case("simulator", f"friction {value:g}", simulate_friction(value), MAY_FALL_BACK, seconds=SIMULATED)
        for value in (0.0, 2.0)
    ),
    Case("simulator", "slivers 0.0001 as high as long", simulate_slivers(1e-4), MAY_FALL_BACK, seconds=SIMULATED),
    *(
        Case("vertices", f"{count:,}", train_vertex_count(count), seconds=TRIED + count / 5_000)
        for count in VERTEX_COUNTS
    ),
    Case("vertices", "50,000, played", roll_out_vertices(50_000), seconds=25.0),
    *(
        Case("precision", str(dtype).removeprefix("torch."), roll_out_precision(dtype), MAY_FALL_BACK, seconds=12.0)
        for dtype in PRECISIONS
    ),
)
