# SPDX-License-Identifier: Apache-2.0
"""Measures of extremes: each changes the world of a garment and measures what follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import gcd

import numpy as np
import torch

from ..assets import Floats, Scene
from ..constants import GRAVITY
from ..fabrics import Fabric
from ..preflight.units import FileUnits, body_size
from . import drives, worlds
from .drives import ProceduralMotion
from .meter import extent, positions, precision_errors
from .outcome import CaseMeasurement
from .subject import StressSubject
from .trials import Trial, simulated, trained

PATCH = 600  # vertices of what is simulated

Measure = Callable[[StressSubject], CaseMeasurement]


def driven(change: Callable[[StressSubject, ProceduralMotion], ProceduralMotion]) -> Measure:
    """Return a measure that rolls the model out over a changed motion."""
    return lambda subject: CaseMeasurement(extent(subject.model, subject.fabric, change(subject, subject.base)))


def lasting(frames: int) -> Measure:
    """Return a measure that rolls the model out over a number of frames."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        count = round(frames * subject.effort.frames)
        return CaseMeasurement(extent(subject.model, subject.fabric, replace(subject.base, frames=count)))

    return measure


def at_rate(fps: int) -> Measure:
    """Return a measure that bakes at another rate; the error is the distance from a bake at the model's rate [m]."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        base = subject.base
        drive = base.lasting((base.frames - 1) / base.fps, fps)
        error = rate_error(subject, drive) if subject.fps.is_integer() else None
        return CaseMeasurement(extent(subject.model, subject.fabric, drive), error, "m")

    return measure


def rate_error(subject: StressSubject, drive: ProceduralMotion) -> float:
    """Return the largest distance of a vertex from the bake at the model's rate, at the times of both [m]."""
    fps, own = round(drive.fps), round(subject.fps)
    shared = gcd(fps, own)
    found, expected = (positions(subject.model, each) for each in (drive, subject.base))
    found, expected = found[:: fps // shared], expected[:: own // shared]
    count = min(len(found), len(expected))
    return float(np.linalg.norm(found[:count] - expected[:count], axis=2).max())


def turned(axis: tuple[float, float, float], speed: float = 0.0, angle: float = 0.0) -> Measure:
    """Return a measure that turns the character about its root, at a speed [rad/s] or by an angle [rad]."""
    turn = drives.about(axis, speed, angle)
    return driven(lambda subject, base: drives.turned(base, subject.scene.character.skeleton, turn))


def moved(path: Callable[[Floats], Floats]) -> Measure:
    """Return a measure that moves the character along a path."""
    return driven(lambda subject, base: drives.carried(base, path, subject.scene.character.skeleton))


def contorted(every: float) -> Measure:
    """Return a measure that turns every joint at random, to a new rotation after each interval [s]."""
    return driven(lambda subject, base: drives.contorted(base, subject.scene.character.skeleton, every))


def interrupted(frame: int) -> Measure:
    """Return a measure that puts NaN into all rotations of a frame."""
    return driven(lambda subject, base: drives.broken(base, frame))


def weighed(factor: float) -> Measure:
    """Return a measure that simulates under a multiple of gravity; networks know only its direction."""
    return lambda subject: solved(subject, patch(subject), subject.fabric, factor * GRAVITY)


def solved_of(stiffness: float) -> Measure:
    """Return a measure that simulates a fabric of some stiffness [N/m]."""
    return lambda subject: solved(subject, patch(subject), membrane(subject.fabric, stiffness))


def solved_with(height: float) -> Measure:
    """Return a measure that simulates slivers, `height` times as high as long."""
    return lambda subject: solved(subject, worlds.pinched(patch(subject), height), subject.fabric)


def patch(subject: StressSubject) -> Scene:
    """Return the part of a garment that is simulated."""
    return worlds.resized(subject.scene, min(PATCH, subject.effort.vertices))


def solved(subject: StressSubject, scene: Scene, fabric: Fabric, gravity: float = GRAVITY) -> CaseMeasurement:
    """Simulate some frames; the error is the largest residual at which the solver stopped [g]."""
    motion = subject.base.motion(0, subject.effort.simulated)
    found, residual = simulated(scene, fabric, motion, gravity)
    return CaseMeasurement(
        found, residual, "g", f"simulated, {found.recovered} of {found.frames} frames not to tolerance"
    )


def membrane(fabric: Fabric, stiffness: float) -> Fabric:
    """Return a fabric with one stiffness [N/m] for each constant of its membranes."""
    return replace(fabric, lame_mu=stiffness, lame_lambda=stiffness, stretch=stiffness, shear=stiffness)


def measured(trial: Trial, note: str = "") -> CaseMeasurement:
    """Return a trial training as a measurement; the error is that of single-precision forces, relative to them.

    Raises:
        ArithmeticError: most steps were undone because something was not finite.
    """
    undone = f"{trial.undone} of {trial.steps} steps undone" if trial.undone else ""
    if 2 * trial.undone > trial.steps:
        raise ArithmeticError(undone)
    return CaseMeasurement(trial.extent, trial.error, "of the force", "; ".join(filter(None, (note, undone))))


def sized(metres: float) -> Measure:
    """Return a measure that trains a garment of another size, on a body and motion scaled with it."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scale = metres / worlds.garment_size(subject.scene)
        scene, drive = worlds.enlarged(subject.scene, scale), drives.enlarged(subject.base, scale)
        body, units = scene.character.merged_body().mesh, FileUnits("", 1.0, "Y", True, True)
        warned = "; ".join(f"inspect: {finding.found}" for finding in body_size(body, units))
        return measured(trained(scene, subject.fabric, drive, subject.effort.steps), warned)

    return measure


def made_of(stiffness: float) -> Measure:
    """Return a measure that trains with one stiffness [N/m] for each constant of the membranes."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        fabric = membrane(subject.fabric, stiffness)
        return measured(trained(subject.scene, fabric, subject.base, subject.effort.steps))

    return measure


def meshed(height: float) -> Measure:
    """Return a measure that trains with slivers among the triangles, `height` times as high as long."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scene = worlds.pinched(subject.scene, height)
        return measured(trained(scene, subject.fabric, subject.base, subject.effort.steps))

    return measure


def counted(vertices: int) -> Measure:
    """Return a measure that trains a garment of about a number of vertices."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scene = worlds.resized(subject.scene, min(vertices, subject.effort.vertices))
        few = scene.garment.mesh.vertex_count > 50_000
        base, steps = subject.base, min(subject.effort.steps, 4) if few else subject.effort.steps
        drive = replace(base, frames=8) if few else base
        trial = trained(scene, subject.fabric, drive, steps, windows=1 if few else 2)
        return measured(trial, f"{scene.garment.mesh.vertex_count:,} vertices")

    return measure


def in_precision(dtype: torch.dtype) -> Measure:
    """Return a measure that rolls out and skins in a precision; the error is the distance from float64 [m]."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        model, exact = subject.in_precision(dtype), subject.in_precision(torch.float64)
        networks, whole = precision_errors(model, exact, subject.base)
        note = f"{networks:.2g} m of that by the networks, skinned in float64"
        return CaseMeasurement(extent(model, subject.fabric, subject.base), whole, "m", note)

    return measure


def jumps(times: Floats) -> Floats:
    """Return a path that jumps by 30 m every second [m]."""
    return 30.0 * np.outer(np.floor(times) % 2, (1, 0, 0))


def ride(times: Floats) -> Floats:
    """Return a path at 50 m/s [m]."""
    return np.outer(times, (50, 0, 0))
