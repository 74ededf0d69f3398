# SPDX-License-Identifier: Apache-2.0
"""Measures of stress cases: each changes a garment's scene or motion and measures the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import gcd

import numpy as np
import torch

from ...authoring.preflight.units import FileUnits, body_size
from ...network.checkpoint import ModelFile, network
from ...physics.constants import GRAVITY
from ...physics.world.colliders import carried_points
from ...scene.assets import LOOSE, Floats, Motion, Scene, ShotWorld
from ...scene.fabric_range import FACTORS, fabric_with, inputs_of
from ...scene.fabrics import Fabric
from ...scene.kinematics import split_at_cuts
from ...scene.mesh.stitches import find_stitches
from . import drives, surroundings, worlds
from .drives import ProceduralMotion
from .meter import MAX_LBS_DISTANCE, Extent, extent, positions, precision_errors
from .outcome import CaseMeasurement, DoesNotApply
from .subject import StressSubject
from .surroundings import LAST, PERIOD, WINDWARD, Prop, PropOver, Wind, surrounded, windy
from .trials import Trial, simulate_trial, train_trial

MAX_ELASTIC_DISTANCE = 1e4  # [garment sizes] that the softest fabric may stretch physically
SAME = 1e-4  # [garment sizes] within which a model that was scaled or refined is at rest where it was
FORGOTTEN = 0.05  # [garment sizes] (RMS) that a prop may leave cloth away from where it would be
CONTACT = {"surface": ("contact", "loose_contact"), "vertex": ("collision",)}

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


def gravity_world(factor: float) -> ShotWorld:
    """Return a world of scaled gravity."""
    return ShotWorld(1.0, gravity=np.array([[0.0, -factor * GRAVITY, 0.0]]))


def roll_out_gravity(factor: float) -> Measure:
    """Return a measure that rolls the model out under scaled gravity."""
    return lambda subject: CaseMeasurement(
        extent(subject.model, subject.fabric, surrounded(subject, subject.base, gravity_world(factor)))
    )


def roll_out_wind(wind: Wind, gusts: float = 0.0) -> Measure:
    """Return a measure that rolls the model out in wind; the error is how far that moves loose cloth along it [m].

    It raises `ArithmeticError` where cloth goes against the wind.
    """

    def measure(subject: StressSubject) -> CaseMeasurement:
        drive = surrounded(subject, subject.base, windy(subject.base.motion(), wind, gusts))
        loose = subject.scene.classes == LOOSE
        if not loose.any():
            raise DoesNotApply("no cloth is loose")
        moved = positions(subject.model, drive)[:, loose] - subject.free[:, loose]
        along = float((moved @ WINDWARD).mean())
        if not along > 0:
            raise ArithmeticError(f"wind moves loose cloth by {along:.3g} m along it")
        return CaseMeasurement(extent(subject.model, subject.fabric, drive), along, "m along it")

    return measure


def roll_out_prop(over: PropOver) -> Measure:
    """Return a measure that rolls the model out with a prop; the error is how far it leaves cloth off [m] (RMS).

    It raises `ArithmeticError` where as much cloth is inside as without seeing it, or where it leaves cloth away from
    where it would be. That is looked for in a pose that is held: in flips the least touch changes all that follows.
    """

    def measure(subject: StressSubject) -> CaseMeasurement:
        prop, drive, met = _met(subject, subject.base, subject.free, over)
        seen, unseen = prop.share_inside(met), prop.share_inside(subject.free)
        if not seen < unseen:
            raise ArithmeticError(f"{seen:.2%} of the cloth are inside, and {unseen:.2%} where it is not seen")
        held = drives.freeze_after(subject.base, 0.0)
        free = positions(subject.model, held)
        _, _, found = _met(subject, held, free, over)
        late = np.arange(held.frames) / held.fps % PERIOD > PERIOD - LAST
        away = float(np.sqrt(((found - free)[late] ** 2).sum(axis=2).mean()))
        if not away < FORGOTTEN * worlds.garment_size(subject.scene):
            raise ArithmeticError(f"it leaves cloth {away:.3g} m away from where it would be")
        note = f"{seen:.2%} of the cloth inside, {unseen:.2%} where it is not seen"
        return CaseMeasurement(extent(subject.model, subject.fabric, drive), away, "m afterwards", note)

    return measure


def _met(
    subject: StressSubject, drive: ProceduralMotion, free: Floats, over: PropOver
) -> tuple[Prop, ProceduralMotion, Floats]:
    """Return a prop over a motion, the motion that sees it, and where cloth is then, which without it is `free`."""
    motion = drive.motion()
    prop = over(subject.scene, motion, free)
    drive = surrounded(subject, drive, prop.world(motion.fps))
    return prop, drive, positions(subject.model, drive)


def roll_out_fabric(**factors: float) -> Measure:
    """Return a measure that rolls the model out in a fabric by `fabric_range.FACTORS`; the error is how far that
    moves cloth at most [m].

    It raises `ArithmeticError` where the network sees another fabric, and nobody is told.
    """

    def measure(subject: StressSubject) -> CaseMeasurement:
        file, known = subject.file, subject.file.fabrics
        if known is None:
            raise DoesNotApply("the network knows one fabric")
        asked = np.array([factors.get(name, 1.0) for name in FACTORS])
        fabric = fabric_with(file.fabric, asked, "asked")
        told = known.range.beyond(asked)
        if not told and not np.allclose(known.range.seen(asked), inputs_of(asked)):
            raise ArithmeticError("the network sees another fabric, and nothing is told")
        model = network(file.on_fabric(fabric), subject.scene)
        apart = float(np.linalg.norm(positions(model, subject.base) - subject.free, axis=2).max())
        return CaseMeasurement(extent(model, fabric, subject.base), apart, "m", f"beyond: {told}" if told else "")

    return measure


def roll_out_height(metres: float) -> Measure:
    """Return a measure that rolls the model out on its character at another height [m], with the motion scaled."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        scale = metres / float(np.ptp(subject.scene.character.merged_body().mesh.points[:, 1]))
        changed = worlds.scale_model(subject.file, subject.scene, scale)
        return roll_out_changed(subject, *changed, drives.scale_motion(subject.base, scale), scale)

    return measure


def roll_out_vertices(count: int) -> Measure:
    """Return a measure that rolls the model out on a finer mesh of about so many vertices."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        changed = worlds.refine_model(subject.file, subject.scene, min(count, subject.effort.vertices))
        return roll_out_changed(subject, *changed, subject.base)

    return measure


def roll_out_changed(
    subject: StressSubject, file: ModelFile, scene: Scene, drive: ProceduralMotion, scale: float = 1.0
) -> CaseMeasurement:
    """Roll out a model that was scaled or refined; the error is how far it is off in the first frame, at rest [m].

    Raises:
        ArithmeticError: it rests elsewhere than the model that it was made of, or restarts elsewhere.
    """
    model, own = network(file, scene), subject.free[0]
    rest = positions(model, replace(drive, frames=1))[0, : len(own)]
    off = float(np.linalg.norm(rest - scale * own, axis=1).max())
    if not off < SAME * worlds.garment_size(scene):
        raise ArithmeticError(f"at rest it is {off:.3g} m off")
    starts, was = (
        len(split_at_cuts(each.motion(), subject.scene.character.skeleton)) for each in (drive, subject.base)
    )
    note = f"{scene.garment.mesh.vertex_count:,} vertices"
    if starts != was:
        note = f"{note}; steps of {starts - was} frames are taken for cuts, at which cloth starts anew"
    return CaseMeasurement(extent(model, subject.fabric, drive), off, "m at rest", note)


def simulate_gravity(factor: float) -> Measure:
    """Return a measure that simulates under scaled gravity."""
    return lambda subject: simulate(subject, subject.cloth, subject.fabric, gravity_world(factor))


def simulate_fabric(stiffness: float) -> Measure:
    """Return a measure that simulates a fabric with this stiffness [N/m]."""
    return lambda subject: simulate(
        subject, subject.cloth, membrane(subject.fabric, stiffness), most=MAX_ELASTIC_DISTANCE
    )


def simulate_factor(name: str, factor: float) -> Measure:
    """Return a measure that simulates the fabric with one of its stiffnesses multiplied."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        fabric = subject.fabric
        if name in FACTORS:
            fabric = fabric_with(fabric, np.where(np.array(FACTORS) == name, factor, 1.0))
        else:
            names = CONTACT[fabric.contact_model] if name == "contact" else (name,)
            fabric = replace(fabric, **{each: factor * getattr(fabric, each) for each in names})
        if name == "stitch" and not len(find_stitches(subject.cloth.garment.mesh)):
            raise DoesNotApply("nothing is stitched")
        return simulate(subject, subject.cloth, fabric)

    return measure


def simulate_friction(coefficient: float) -> Measure:
    """Return a measure that simulates with Coulomb friction."""
    return lambda subject: simulate(subject, subject.cloth, replace(subject.fabric, friction=coefficient))


def simulate_wind(speed: float) -> Measure:
    """Return a measure that simulates in an even wind [m/s]."""

    def measure(subject: StressSubject) -> CaseMeasurement:
        if not subject.fabric.drag:
            raise DoesNotApply("the fabric has no drag, by which wind moves cloth")
        world = windy(simulated_motion(subject), surroundings.steady(speed), 0.0)
        return simulate(subject, subject.cloth, subject.fabric, world)

    return measure


def simulate_prop(over: PropOver) -> Measure:
    """Return a measure that simulates with a prop, which is placed by linear blend skinning.

    It raises `ArithmeticError` where no less cloth is inside than under linear blend skinning.
    """

    def measure(subject: StressSubject) -> CaseMeasurement:
        scene, motion = subject.cloth, simulated_motion(subject)
        roots = surroundings.roots(scene, motion)[:, None]
        carried = carried_points(motion, scene, np.arange(scene.garment.mesh.vertex_count)) - roots
        prop = over(scene, motion, carried)
        found, residual, points = simulate_trial(scene, subject.fabric, motion, prop.world(motion.fps))
        met, skinned = prop.share_inside(points - roots), prop.share_inside(carried)
        if skinned and not met < skinned:
            raise ArithmeticError(f"{met:.2%} of the cloth are inside, and {skinned:.2%} under skinning")
        note = f"{met:.2%} of the cloth inside, {skinned:.2%} under skinning"
        return CaseMeasurement(found, residual, "g", f"{simulated_words(found)}; {note}")

    return measure


def simulate_slivers(height: float) -> Measure:
    """Return a measure that simulates slivers with this ratio of height to base."""
    return lambda subject: simulate(subject, worlds.add_slivers(subject.cloth, height), subject.fabric)


def simulated_motion(subject: StressSubject) -> Motion:
    """Return the frames that are simulated."""
    return subject.base.motion(0, subject.effort.simulated)


def simulate(
    subject: StressSubject,
    scene: Scene,
    fabric: Fabric,
    world: ShotWorld | None = None,
    most: float = MAX_LBS_DISTANCE,
) -> CaseMeasurement:
    """Simulate some frames in a world; the error is the largest final residual of the solver [g].

    The garment is bounded within `most` times its size.
    """
    found, residual, _ = simulate_trial(scene, fabric, simulated_motion(subject), world, most)
    return CaseMeasurement(found, residual, "g", simulated_words(found))


def simulated_words(found: Extent) -> str:
    """Return how many frames the solver did not solve."""
    return f"simulated, {found.recovered} of {found.frames} frames not to tolerance"


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
