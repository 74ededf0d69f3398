# SPDX-License-Identifier: Apache-2.0
"""Train a garment on motions and write a model.

Where the stage lacks weights, classes or a proxy rig, they are made as 'ssilk rig' makes them by default.
Ctrl-C stops the training after the current step, or inside one that takes longer than ten seconds, and keeps the best
model and the state. --resume continues from there. A warning at the end says where few of the preset's iterations
were done, or where skin shows, and how to go on. A model that is worse than linear blend skinning on the validation
motions is kept and warned of, and so is one whose minutes ended before dynamic training began; the exit code is 5.
torchrun ends with its own code 1 then, and names this one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..devices import default_preset, select_device
from ..errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_WORSE, fail, fail_unknown
from ..events import Message, Reporter, Result, TextReporter, format_count, format_seconds, silent
from ..files import split_body
from ..network.settings import ModelConfig, apply_overrides, setting_names
from ..scene.fabric_range import FACTORS, FabricRange
from ..scene.fabrics import FRICTION
from ..training.settings import PRESETS, TrainConfig, preset_named
from ..training.wardrobe.training import WORSE_FIGURE
from .options.bodies import members, read_member
from .options.fabric import add_fabric, asked_fabric, garment_fabric
from .options.files import check_output
from .options.motions import tell_shapes
from .options.numbers import NumberRange
from .options.scene import add_scene, garment_location, load_scene

if TYPE_CHECKING:
    from ..scene.assets import Character, Motion, Scene
    from ..scene.family import DressedFamily
    from ..training.job import TrainJob


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    add_scene(verb)
    verb.add_argument(
        "--motions", type=Path, nargs="+", required=True, metavar="PATH", help="motion files or folders to train on"
    )
    verb.add_argument(
        "--valid",
        type=Path,
        nargs="+",
        default=[],
        metavar="PATH",
        help="motions to validate on (default: every fifth of --motions)",
    )
    verb.add_argument(
        "-o", "--output", type=Path, required=True, metavar="MODEL", help="model to write (.safetensors)"
    )
    verb.add_argument(
        "--preset",
        choices=PRESETS,
        help="schedule and size of the network (default: draft on a CPU, else preview); 'paper' is the paper's own "
        "model and training, with its fabric",
    )
    verb.add_argument(
        "--minutes",
        type=NumberRange(1e-3, 1e6),
        metavar="M",
        help="wall time after the setup, in place of the preset's iterations: a few steps are timed, and the "
        "schedule is scaled to the number that fits; one seed gives one model only for one such number. With "
        "--resume, they are those of the whole run: what it has had counts",
    )
    onward = verb.add_mutually_exclusive_group()
    onward.add_argument(
        "--start-from",
        type=Path,
        metavar="MODEL",
        help="train all networks of a trained model of this scene on, with the size that they have: with other "
        "motion, or with intersection_weight",
    )
    onward.add_argument(
        "--stepper-of",
        type=Path,
        metavar="MODEL",
        help="keep the initialiser and decoder of a trained model of this scene, and train its stepper on, or a new "
        "one where it steps otherwise: for other motion, in a third of the time",
    )
    verb.add_argument(
        "--over",
        type=Path,
        action="append",
        default=[],
        metavar="MODEL",
        help="a trained garment that is worn beneath this one, on the same character (repeatable): it plays along "
        "while this one learns to lie on it, and to be worn without",
    )
    verb.add_argument(
        "--family", type=Path, nargs="*", metavar="STAGE|SHAPES",
        help="other bodies of the character's skeleton and topology, which the model is to dress as well: stages, or "
             "the stage's own blendshapes with weights, such as tall=1,heavy=0.5 (default: the ends of the ranges of "
             "those that are marked by ssilk:weightRange, alone and combined). Steps are done on bodies drawn "
             "among these",
    )  # fmt: skip
    verb.add_argument(
        "--graded", action="store_true",
        help="with --family: grade the garment to each body, as a pattern is by sizes, so that its rest shape is "
             "where it lies there (default: one garment for all, tight on a heavy body and loose on a slight one)",
    )  # fmt: skip
    add_fabric(verb)
    verb.add_argument(
        "--fabrics", nargs="*", metavar="PRESET|FACTOR",
        help="train for a range of fabrics, in any of which the model then bakes: from 1/FACTOR to FACTOR times each "
             f"of {', '.join(FACTORS)} of the own fabric, and all that presets have (default: 4)",
    )  # fmt: skip
    verb.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1, ... (default auto)")
    verb.add_argument("--resume", action="store_true", help="continue from the state beside the model")
    verb.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="settings",
        help="change one setting of the preset, such as iterations=20000 or seed=1 (repeatable)",
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Train; return 0 when finished, 5 when the model is worse than linear blend skinning, 130 when interrupted."""
    from ..training.parallel import join_process_group
    from ..training.run import train
    from ..training.signals import PATIENCE, stop_on_signals
    from ..training.verdict import (
        is_worse,
        lower_by,
        percent,
        shortcomings,
        worse_bodies,
        worse_message,
        worst_body,
    )

    if options.output.suffix != ".safetensors":
        fail(str(options.output), "not a name for a model", "it ends in .safetensors")
    check_output(options.output)
    if isinstance(report, TextReporter):
        report.since = time.monotonic()
    with ExitStack() as running:
        group, device = running.enter_context(join_process_group(options.device))
        # A process of a group that stops inside a step would leave the others waiting.
        stop = running.enter_context(stop_on_signals(report, PATIENCE if group.size == 1 else None))
        report = report if group.is_first else silent
        job = training_job(options, device, report)
        trained = train(job, report, stop, group)
    share, shown = lower_by(trained.score, trained.lbs), trained.score.shown_skin
    missed, worst = trained.score.step_errors, worst_body(trained.score.of_each(_first_of(job), trained.lbs))
    worse = is_worse(trained.score, trained.lbs)
    if worse:
        report(worse_message(str(options.output), trained.score, trained.lbs))
    for message in worse_bodies(str(options.output), trained.score):
        report(message)
    report(
        Result(
            "train",
            {
                "model": str(options.output),
                "iterations": trained.iterations,
                "the model is of iteration": trained.model_iteration,
                "total [J]": round(trained.score.total, 5),
                "linear blend skinning [J]": round(trained.lbs.total, 5),
                ("lower by" if share >= 0 else "higher by"): percent(share),
                **({WORSE_FIGURE: True} if worse else {}),
                "collisions": f"{trained.score.collisions:.2%}",
                **(shown.summary() if shown else {}),
                **(missed.summary() if missed else {}),
                **({f"{body.name} [J]": round(body.total, 5) for body in trained.score.bodies}),
                **({_worst_of(job): f"{worst.name}, {_compared(worst.total, worst.lbs)}"} if worst else {}),
                **{name: value for part in trained.score.layers for name, value in part.summary().items()},
                **{f"{k} [J]": round(v, 5) for k, v in trained.score.terms.items()},
            },
        )
    )
    if not trained.finished:
        report(Message(f"stopped at iteration {trained.iterations}; --resume continues from there."))
        return EXIT_INTERRUPTED
    done, asked = trained.iterations, job.train.iterations
    lacking = shortcomings(str(options.output), trained.score, done, asked, trained.seconds, trained.moves)
    if lacking and job.is_trainable and group.size == 1:  # several processes take no minutes
        report(lacking)
    return EXIT_OK if trained.moves and not worse else EXIT_WORSE


def _worst_of(job: TrainJob) -> str:
    """Return what the worst of several is one of, in words."""
    return " or ".join([*(["worst body"] if job.family else []), *(["worst fabric"] if job.fabrics else [])])


def _first_of(job: TrainJob) -> str:
    """Return what the first of several is called, on which and of which most is measured."""
    return job.family.bodies.names[0] if job.family else "the garment's own fabric"


def _compared(total: float, lbs: float) -> str:
    """Return in words how an energy compares with that of linear blend skinning."""
    from ..training.verdict import percent, share_below

    share = share_below(total, lbs)
    return f"{percent(share)} {'below' if share >= 0 else 'above'} linear blend skinning"


def training_job(options: argparse.Namespace, device: str, report: Reporter):  # type: ignore[no-untyped-def]  # its type is heavy
    """Read everything that the options name; return it as a `TrainJob` on a device."""
    from ssilk_usd.reading.motion import motion_files

    from ..files import sha256
    from ..network.checkpoint import load_model
    from ..training.inner_garments import InnerModel
    from ..training.job import TrainJob

    if not options.preset:
        options.preset = default_preset(device)
        report(Message(f"preset '{options.preset}' is taken, the default on {select_device(device).type}"))
    model, train = configured(options)
    _take_fabric(options, report)
    scene = load_scene(options, report)
    scene = replace(scene, garment=replace(scene.garment, graded=options.graded))
    fabric = garment_fabric(options, scene.garment, report)
    if fabric.friction:
        report(Message(f"friction = {fabric.friction:g} is left out; {FRICTION}", "warning"))
    fabrics = None if options.fabrics is None else FabricRange.of(fabric, options.fabrics)
    if fabrics:
        report(Message(f"fabrics are drawn as factors of '{fabric.name}': {fabrics.words()}"))
    motions, held = _read_motions(options, scene.character, report)
    trained = options.stepper_of or options.start_from
    base = load_model(trained) if trained else None
    if base:
        _need_settings_of(base.config, model, train, options)
        if options.stepper_of and train.collider_fraction and not base.config.proximity_points:
            text = "it sees no colliders, and the first pose of --stepper-of stays as it is: obstacles are left out"
            report(Message(f"{trained}: {text}; --start-from trains all of it, and lets it see them", "warning"))
    if base and base.bodies and base.scene.garment.graded != options.graded:
        was, now = "one garment for all bodies", "graded to each"
        if not options.graded:
            was, now = now, was
        report(Message(f"{trained}: it was trained as {was}, and goes on as {now}", "warning"))
    over = InnerModel.load_all(options.over, options.output)
    others = members(options, report)
    family = _family(options, others, scene, report) if others else None
    files = {options.stage, garment_location(options)[0], *motion_files([*options.motions, *options.valid])}
    files |= {trained} if base else set()
    files |= {*options.over, *(Path(split_body(member)[0]) for member in others)}
    files = {Path(split_body(str(path))[0]) for path in files}
    return TrainJob(
        scene=scene,
        motions=motions,
        held_out=held,
        model=model,
        train=train,
        fabric=fabric,
        output=options.output,
        device=device,
        resume=options.resume,
        inputs={str(path): sha256(path) for path in sorted(files)},
        minutes=options.minutes,
        base=base,
        whole=options.start_from is not None,
        over=over,
        family=family,
        fabrics=fabrics,
    )


def _read_motions(
    options: argparse.Namespace, character: Character, report: Reporter
) -> tuple[list[Motion], list[Motion]]:
    """Read the motions to train on and those to validate on, and tell which are named twice."""
    from ssilk_usd.reading.motion import distinct, motion_sources, read_motions

    from ..training.job import split_motions

    report(Message("the motions are read"))
    named, held_out = motion_sources(options.motions), motion_sources(options.valid)
    known = distinct(named)
    if len(named) > len(known):
        report(Message(f"--motions names {len(known)} motions, some of them twice: each counts once", "warning"))
    if both := len(known.keys() & distinct(held_out).keys()):
        found = f"--valid names {format_count(both, 'motions')} that --motions has"
        report(Message(f"{found}: on these a validation does not tell how unseen motion will look", "warning"))
    motions, held = (read_motions(sources, character.skeleton) for sources in (named, held_out))
    tell_shapes(options, (*motions, *held), report, trained=character)
    if not held:
        motions, held = split_motions(motions)
        report(Message(f"validating on {len(held)} of {len(motions) + len(held)} motions, training on the rest"))
    return motions, held


def _family(options: argparse.Namespace, others: Sequence[str], scene: Scene, report: Reporter) -> DressedFamily:
    """Return the scene's garment on the bodies of --family, and say what of it stays in one.

    Raises:
        SsilkError: a body is none of the character's family.
    """
    from ..authoring.bodies.carry import dressed_family
    from ..authoring.bodies.differences import need_family
    from ..authoring.preflight.fit import describe_left

    characters = [read_member(options, other, scene.character, report) for other in others]
    bodies = need_family([scene.character, *characters], trained=True)
    how = ", and graded to each" if options.graded else ""
    report(Message(f"the garment is carried onto {len(characters)} more bodies, along {bodies.size} directions{how}"))
    started = time.monotonic()
    dressed, carried = dressed_family(scene, bodies, characters)
    report(Message(f"it was carried onto them in {format_seconds(time.monotonic() - started)}"))
    for one, other in zip(carried, characters):
        if left := describe_left(one.settled, one.unsettled, other):
            report(Message(f"{other.path}: {left}", "warning"))
    return dressed


def _need_settings_of(base: ModelConfig, model: ModelConfig, train: TrainConfig, options: argparse.Namespace) -> None:
    """Raise `SsilkError` where a setting is asked for that training which goes on from a model cannot take."""
    from ..training.job import STEPPER_SETTINGS

    kept = set(setting_names(ModelConfig)) - (set() if options.start_from else set(STEPPER_SETTINGS))
    for setting in options.settings:
        name, where = setting.partition("=")[0], f"--set {setting}"
        if name in kept and getattr(model, name) != (own := getattr(base, name)):
            fail(where, f"the given model has {own}", "it is trained on as large as it is", "leave it out")
        if name == "static_fraction" and train.static_fraction:
            what = "training that goes on from a model has no static part"
            fail(where, what, "0 is allowed", "leave it out")
        blind = options.stepper_of and not base.proximity_points
        if name == "collider_fraction" and train.collider_fraction and blind:
            what = "the given model sees no colliders, and its stepper alone cannot learn to"
            fail(where, what, "0 is allowed", "leave it out, or give --start-from in place of --stepper-of")


def _take_fabric(options: argparse.Namespace, report: Reporter) -> None:
    """Take the fabric that a preset means, where the options name none."""
    preset = preset_named(options.preset)
    if preset.fabric and not options.fabric:
        options.fabric, options.material = preset.fabric, [*preset.material, *options.material]
        text = " ".join([f"fabric '{preset.fabric}'", *(["with", *preset.material] if preset.material else [])])
        report(Message(f"{text} is taken, which preset '{preset.name}' means"))


def configured(options: argparse.Namespace) -> tuple[ModelConfig, TrainConfig]:
    """Return the network and the schedule that the options ask for; check what they ask of the fabric, too.

    Raises:
        SsilkError: a setting or a word of --fabrics that does not exist, or a value that it cannot have; or --graded
            without --family.
    """
    if options.graded and options.family is None:
        fail("--graded", "no --family", "garments are graded to further bodies", "name these, or leave it out")
    preset = preset_named(options.preset or default_preset(options.device))
    fabric = asked_fabric(options)
    if options.fabrics is not None:
        FabricRange.of(fabric, options.fabrics)
    return _settings(options.settings, preset.model, preset.train)


def _settings(settings: list[str], model: ModelConfig, train: TrainConfig) -> tuple[ModelConfig, TrainConfig]:
    """Apply "name=value" settings to whichever of the two has the name."""
    known = [*setting_names(ModelConfig), *setting_names(TrainConfig)]
    for setting in settings:
        name, where = setting.partition("=")[0], f"--set {setting}"
        if name not in known:
            fail_unknown(where, "no such setting", name, known)
    own = [setting for setting in settings if setting.partition("=")[0] in setting_names(ModelConfig)]
    others = [setting for setting in settings if setting not in own]
    return apply_overrides(model, own), apply_overrides(train, others)
