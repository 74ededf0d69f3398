# SPDX-License-Identifier: Apache-2.0
"""Every extreme: what is done, and what may come of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import gcd, pi

import numpy as np
import torch

from ..assets import Floats, Scene
from ..errors import SsilkError
from ..fabrics import Fabric
from ..model.descriptors import GRAVITY
from ..preflight.units import FileUnits, body_size
from . import drives, worlds
from .drives import Drive
from .meter import extent, positions, precision_errors
from .outcome import Measured, Outcome, Verdict
from .subject import Subject
from .trials import Trial, simulated, trained

PATCH = 600  # vertices of what is simulated
DOWN, SIDE = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        group, name: what it is called.
        measure: does it and returns what was found; a refusal is an `SsilkError`.
        allowed: what the product may do; anything else is a fault.
    """

    group: str
    name: str
    measure: Callable[[Subject], Measured]
    allowed: tuple[Verdict, ...] = ("works",)

    def matches(self, words: Sequence[str]) -> bool:
        """Return whether the case's name contains one of some words, or there are none."""
        return not words or any(word in f"{self.group}: {self.name}" for word in words)

    def run(self, subject: Subject) -> Outcome:
        """Do it and say what came of it."""
        began = time.perf_counter()
        verdict, said, measured = self._tried(subject)
        return Outcome(self.name, self.group, verdict, said, measured, time.perf_counter() - began)

    def _tried(self, subject: Subject) -> tuple[Verdict, str, Measured]:
        try:
            measured = self.measure(subject)
        except SsilkError as error:
            return "refuses", str(error), Measured()
        except (RuntimeError, ValueError, ArithmeticError, IndexError, MemoryError) as error:
            return "breaks", f"{type(error).__name__}: {error}".partition("\n")[0], Measured()
        return measured.verdict, measured.note, measured


def driven(change: Callable[[Subject, Drive], Drive]) -> Callable[[Subject], Measured]:
    """Return what rolls the model over a changed motion."""
    return lambda subject: Measured(extent(subject.model, subject.fabric, change(subject, subject.base)))


def lasting(frames: int) -> Callable[[Subject], Measured]:
    """Return what rolls the model over so many frames."""

    def measure(subject: Subject) -> Measured:
        count = round(frames * subject.effort.frames)
        return Measured(extent(subject.model, subject.fabric, replace(subject.base, frames=count)))

    return measure


def at_rate(fps: int) -> Callable[[Subject], Measured]:
    """Return what bakes at another rate; the error is the distance from the bake at the model's rate [m]."""

    def measure(subject: Subject) -> Measured:
        base, own = subject.base, round(subject.fps)
        drive = base.lasting((base.frames - 1) / base.fps, fps)
        shared = gcd(fps, own)
        found, expected = (positions(subject.model, each) for each in (drive, base))
        found, expected = found[:: fps // shared], expected[:: own // shared]
        count = min(len(found), len(expected))
        error = float(np.linalg.norm(found[:count] - expected[:count], axis=2).max())
        return Measured(extent(subject.model, subject.fabric, drive), error, "m")

    return measure


def turned(axis: tuple[float, float, float], speed: float = 0.0, angle: float = 0.0) -> Callable[[Subject], Measured]:
    """Return what turns the character about its root, at a speed [rad/s] or by an angle [rad]."""
    turn = drives.about(axis, speed, angle)
    return driven(lambda subject, base: drives.turned(base, subject.scene.character.skeleton, turn))


def moved(path: Callable[[Floats], Floats]) -> Callable[[Subject], Measured]:
    """Return what moves the character along a path."""
    return driven(lambda subject, base: drives.carried(base, path, subject.scene.character.skeleton))


def contorted(every: float) -> Callable[[Subject], Measured]:
    """Return what turns every joint anywhere, anew every so often [s]."""
    return driven(lambda subject, base: drives.contorted(base, subject.scene.character.skeleton, every))


def weighed(factor: float) -> Callable[[Subject], Measured]:
    """Return what simulates under so many times gravity: networks know its direction alone."""
    return lambda subject: solved(subject, patch(subject), subject.fabric, factor * GRAVITY)


def solved_of(stiffness: float) -> Callable[[Subject], Measured]:
    """Return what simulates a fabric of so many N/m."""
    return lambda subject: solved(subject, patch(subject), membrane(subject.fabric, stiffness))


def solved_with(height: float) -> Callable[[Subject], Measured]:
    """Return what simulates slivers so many times as high as long."""
    return lambda subject: solved(subject, worlds.pinched(patch(subject), height), subject.fabric)


def patch(subject: Subject) -> Scene:
    """Return as much of a garment as is simulated."""
    return worlds.resized(subject.scene, min(PATCH, subject.effort.vertices))


def solved(subject: Subject, scene: Scene, fabric: Fabric, gravity: float = GRAVITY) -> Measured:
    """Simulate some frames; the error is how far out of balance the solver stopped at worst [g]."""
    motion = subject.base.motion(0, subject.effort.simulated)
    found, imbalance = simulated(scene, fabric, motion, gravity)
    return Measured(found, imbalance, "g", f"simulated, {found.recovered} of {found.frames} frames not to tolerance")


def membrane(fabric: Fabric, stiffness: float) -> Fabric:
    """Return a fabric with so many N/m for each constant of its membranes."""
    return replace(fabric, lame_mu=stiffness, lame_lambda=stiffness, stretch=stiffness, shear=stiffness)


def measured(trial: Trial, note: str = "") -> Measured:
    """Return a trial training as a measurement; the error is that of single-precision forces, relative to them."""
    undone = f"{trial.undone} of {trial.steps} steps undone" if trial.undone else ""
    return Measured(trial.extent, trial.error, "of the force", "; ".join(filter(None, (note, undone))))


def sized(metres: float) -> Callable[[Subject], Measured]:
    """Return what trains a garment of another size, with everything around it."""

    def measure(subject: Subject) -> Measured:
        scale = metres / worlds.garment_size(subject.scene)
        scene, drive = worlds.enlarged(subject.scene, scale), drives.enlarged(subject.base, scale)
        body, units = scene.character.merged_body().mesh, FileUnits("", 1.0, "Y", True, True)
        warned = "; ".join(f"inspect: {finding.found}" for finding in body_size(body, units))
        return measured(trained(scene, subject.fabric, drive, subject.effort.steps), warned)

    return measure


def made_of(stiffness: float) -> Callable[[Subject], Measured]:
    """Return what trains with a fabric of so many N/m in each of its membranes' constants."""

    def measure(subject: Subject) -> Measured:
        fabric = membrane(subject.fabric, stiffness)
        return measured(trained(subject.scene, fabric, subject.base, subject.effort.steps))

    return measure


def meshed(height: float) -> Callable[[Subject], Measured]:
    """Return what trains with slivers among the triangles, so many times as high as long."""

    def measure(subject: Subject) -> Measured:
        scene = worlds.pinched(subject.scene, height)
        return measured(trained(scene, subject.fabric, subject.base, subject.effort.steps))

    return measure


def counted(vertices: int) -> Callable[[Subject], Measured]:
    """Return what trains a garment of about so many vertices."""

    def measure(subject: Subject) -> Measured:
        scene = worlds.resized(subject.scene, min(vertices, subject.effort.vertices))
        few = scene.garment.mesh.vertex_count > 50_000
        base, steps = subject.base, min(subject.effort.steps, 4) if few else subject.effort.steps
        drive = replace(base, frames=8) if few else base
        trial = trained(scene, subject.fabric, drive, steps, windows=1 if few else 2)
        return measured(trial, f"{scene.garment.mesh.vertex_count:,} vertices")

    return measure


def in_precision(dtype: torch.dtype) -> Callable[[Subject], Measured]:
    """Return what rolls and skins in a precision; the error is the distance from float64 [m]."""

    def measure(subject: Subject) -> Measured:
        model, exact = subject.in_precision(dtype), subject.in_precision(torch.float64)
        networks, whole = precision_errors(model, exact, subject.base)
        note = f"{networks:.2g} m of that by the networks, skinned in float64"
        return Measured(extent(model, subject.fabric, subject.base), whole, "m", note)

    return measure


def jumps(times: Floats) -> Floats:
    """Return a path that is 30 m elsewhere every second [m]."""
    return 30.0 * np.outer(np.floor(times) % 2, (1, 0, 0))


def ride(times: Floats) -> Floats:
    """Return a path at 50 m/s [m]."""
    return np.outer(times, (50, 0, 0))


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
    Case("gravity", "sideways", turned(SIDE, angle=pi / 2)),
    Case("motion", "upside down", turned(SIDE, angle=pi)),
    Case("motion", "a teleport of 30 m each second", moved(jumps)),
    Case("motion", "a ride at 50 m/s", moved(ride)),
    Case("motion", "a spin of 30 rad/s", turned(DOWN, speed=30.0)),
    Case("motion", "tumbling at 30 rad/s", turned(SIDE, speed=30.0)),
    Case("motion", "a stop within one frame", driven(lambda subject, base: drives.stopping(base, base.loop / 4))),
    Case("motion", "one pose throughout", driven(lambda subject, base: drives.stopping(base, 0.0))),
    Case("motion", "poses of any joint angles", contorted(0.5)),
    Case("motion", "other such poses in each frame", contorted(1e-3)),
    Case("motion", "NaN in frame 7", driven(lambda subject, base: drives.broken(base, 7)), ("refuses",)),
    *(Case("size", f"{metres:g} m", sized(metres)) for metres in (1e-3, 100.0)),
    *(Case("fabric", f"{stiffness:g} N/m", made_of(stiffness)) for stiffness in FABRICS),
    *(Case("slivers", f"{height:g} as high as long", meshed(height), (*WIDE, "refuses")) for height in HEIGHTS),
    *(Case("simulator", f"{stiffness:g} N/m", solved_of(stiffness), WIDE) for stiffness in FABRICS),
    Case("simulator", "slivers 0.0001 as high as long", solved_with(1e-4), WIDE),
    *(Case("vertices", f"{count:,}", counted(count)) for count in COUNTS),
    *(Case("precision", str(dtype).removeprefix("torch."), in_precision(dtype), WIDE) for dtype in PRECISIONS),
)
