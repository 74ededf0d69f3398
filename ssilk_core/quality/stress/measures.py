# SPDX-License-Identifier: Apache-2.0
"""Measures of stress cases: each changes a garment's scene or motion and measures the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import gcd

import numpy as np
import torch

from ...authoring.preflight.units import FileUnits, body_size
from ...physics.constants import GRAVITY
from ...scene.assets import Floats, Scene
from ...scene.fabrics import Fabric
from . import drives, worlds
from .drives import ProceduralMotion
from .meter import extent, positions, precision_errors
from .outcome import CaseMeasurement
from .subject import StressSubject
from .trials import Trial, simulate_trial, train_trial

PATCH_VERTICES = 600  # size of the patch of a garment that is simulated

Measure = Callable[[StressSubject], CaseMeasurement]


def roll_out_motion(change: Callable[[StressSubject, ProceduralMotion], ProceduralMotion]) -> Measure:
    """Return a measure that rolls the model out over a modified motion."""
    return lambda subject: CaseMeasurement(extent(subject.model, subject.fabric, change(subject, subject.base)))


def roll_out_frames(frames: int) -> Measure:
    """Return a measure that rolls the model out over a number of frames."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        count = round(frames * subject.effort.frames)
        return CaseMeasurement(extent(subject.model, subject.fabric, replace(subject.base, frames=count)))

    return measure


def bake_at_rate(fps: int) -> Measure:
    """Return a measure that bakes at another rate; the error is the distance from a bake at the model's rate [m]."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        base = subject.base
        drive = base.with_duration((base.frames - 1) / base.fps, fps)
        error = rate_error(subject, drive) if subject.fps.is_integer() else None
        return CaseMeasurement(extent(subject.model, subject.fabric, drive), error, "m")

    return measure


def rate_error(subject: StressSubject, drive: ProceduralMotion) -> float:
    """Return the largest distance of a vertex from the bake at the model's rate, at their common times [m]."""
    fps, own = round(drive.fps), round(subject.fps)
    shared = gcd(fps, own)
    found, expected = (positions(subject.model, each) for each in (drive, subject.base))
    found, expected = found[:: fps // shared], expected[:: own // shared]
    count = min(len(found), len(expected))
    return float(np.linalg.norm(found[:count] - expected[:count], axis=2).max())


def roll_out_rotated(axis: tuple[float, float, float], speed: float = 0.0, angle: float = 0.0) -> Measure:
    """Return a measure that rotates the character about its root at a speed [rad/s] or by an angle [rad]."""
    turn = drives.about(axis, speed, angle)
    return roll_out_motion(
        lambda subject, base: drives.rotate_character(base, subject.scene.character.skeleton, turn)
    )


def roll_out_path(path: Callable[[Floats], Floats]) -> Measure:
    """Return a measure that moves the character along a path."""
    return roll_out_motion(
        lambda subject, base: drives.translate_character(base, path, subject.scene.character.skeleton)
    )


def roll_out_random_poses(every: float) -> Measure:
    """Return a measure that rotates every joint at random, to a new rotation after each interval [s]."""
    return roll_out_motion(
        lambda subject, base: drives.randomize_rotations(base, subject.scene.character.skeleton, every)
    )


def roll_out_nan(frame: int) -> Measure:
    """Return a measure that replaces all rotations of a frame by NaN."""
    return roll_out_motion(lambda subject, base: drives.insert_nan(base, frame))


def simulate_gravity(factor: float) -> Measure:
    """Return a measure that simulates under scaled gravity; networks receive only its direction."""
    return lambda subject: simulate_patch(subject, patch(subject), subject.fabric, factor * GRAVITY)


def simulate_fabric(stiffness: float) -> Measure:
    """Return a measure that simulates a fabric with this stiffness [N/m]."""
    return lambda subject: simulate_patch(subject, patch(subject), membrane(subject.fabric, stiffness))


def simulate_slivers(height: float) -> Measure:
    """Return a measure that simulates slivers with this ratio of height to base."""
    return lambda subject: simulate_patch(subject, worlds.add_slivers(patch(subject), height), subject.fabric)


def patch(subject: StressSubject) -> Scene:
    """Return the patch of a garment that is simulated."""
    return worlds.resize_garment(subject.scene, min(PATCH_VERTICES, subject.effort.vertices))


def simulate_patch(subject: StressSubject, scene: Scene, fabric: Fabric, gravity: float = GRAVITY) -> CaseMeasurement:
    """Simulate some frames; the error is the largest final residual of the solver [g]."""
    motion = subject.base.motion(0, subject.effort.simulated)
    found, residual = simulate_trial(scene, fabric, motion, gravity)
    return CaseMeasurement(
        found, residual, "g", f"simulated, {found.recovered} of {found.frames} frames not to tolerance"
    )


def membrane(fabric: Fabric, stiffness: float) -> Fabric:
    """Return a fabric with all membrane constants set to one stiffness [N/m]."""
    return replace(fabric, lame_mu=stiffness, lame_lambda=stiffness, stretch=stiffness, shear=stiffness)


def trial_measurement(trial: Trial, note: str = "") -> CaseMeasurement:
    """Return the measurement of a trial training; its error is the relative error of single-precision forces.

    Raises:
        ArithmeticError: most steps were undone because of values that are not finite.
    """
    undone = f"{trial.undone} of {trial.steps} steps undone" if trial.undone else ""
    if 2 * trial.undone > trial.steps:
        raise ArithmeticError(undone)
    return CaseMeasurement(trial.extent, trial.error, "of the force", "; ".join(filter(None, (note, undone))))


def train_at_size(metres: float) -> Measure:
    """Return a measure that trains a garment at another size, with the body and motion scaled alike."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scale = metres / worlds.garment_size(subject.scene)
        scene, drive = worlds.scale_scene(subject.scene, scale), drives.scale_motion(subject.base, scale)
        body, units = scene.character.merged_body().mesh, FileUnits("", 1.0, "Y", True, True)
        warned = "; ".join(f"inspect: {finding.found}" for finding in body_size(body, units))
        return trial_measurement(train_trial(scene, subject.fabric, drive, subject.effort.steps), warned)

    return measure


def train_fabric(stiffness: float) -> Measure:
    """Return a measure that trains with all membrane constants set to one stiffness [N/m]."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        fabric = membrane(subject.fabric, stiffness)
        return trial_measurement(train_trial(subject.scene, fabric, subject.base, subject.effort.steps))

    return measure


def train_slivers(height: float) -> Measure:
    """Return a measure that trains with slivers among the triangles, with this ratio of height to base."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scene = worlds.add_slivers(subject.scene, height)
        return trial_measurement(train_trial(scene, subject.fabric, subject.base, subject.effort.steps))

    return measure


def train_vertex_count(vertices: int) -> Measure:
    """Return a measure that trains a garment with about this number of vertices."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scene = worlds.resize_garment(subject.scene, min(vertices, subject.effort.vertices))
        few = scene.garment.mesh.vertex_count > 50_000
        base, steps = subject.base, min(subject.effort.steps, 4) if few else subject.effort.steps
        drive = replace(base, frames=8) if few else base
        trial = train_trial(scene, subject.fabric, drive, steps, windows=1 if few else 2)
        return trial_measurement(trial, f"{scene.garment.mesh.vertex_count:,} vertices")

    return measure


def roll_out_precision(dtype: torch.dtype) -> Measure:
    """Return a measure that rolls out and skins in `dtype`; the error is the distance from float64 [m]."""

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
