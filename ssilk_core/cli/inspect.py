# SPDX-License-Identifier: Apache-2.0
"""Check a character, a garment and motions before training (preflight).

Every finding names the prim, the count, what was found, why it matters and what to do. --fix writes a copy of the
garment's file with all safe repairs made, and reports what is left. The exit code is 2 when there are errors, and 0
otherwise. --family also says whether further characters are bodies of one family with the first, or what differs.
--onto proposes which joints of another character stand for those of this one, as 'ssilk rig --onto' takes them:
--joints names the file that gets the proposal, to be edited, or the edited file, which is then checked.
--over also finds where the garment starts inside others that it is worn over, and --fix settles it off these.

A list as 'ssilk wardrobe' takes it (.toml) in place of the stage is inspected garment by garment, inner ones first,
each over what it names with 'over'. --fix then takes a folder: it gets a repaired copy of each garment, and of the
list, which names these copies.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import SsilkError, fail
from ..events import Reporter, Result, format_count, silent
from ..files import replacing, split_location
from ..scene.shape_weights import bodies_within
from ..training.settings import PRESETS, preset_named
from ._inspected import Inspected
from .options.bodies import members, need_onto, read_member, read_onto
from .options.files import LIST, MODEL, check_output
from .options.motions import tell_shapes
from .options.scene import STAGE, add_garment, garment_location, read_stage

if TYPE_CHECKING:
    from ssilk_usd.units import StageUnits

    from ..authoring.preflight.finding import Finding
    from ..authoring.preflight.inspection import PreflightInput
    from ..authoring.preflight.motion import MotionFile
    from ..authoring.preflight.units import FileUnits
    from ..scene.assets import Character, Mesh, Motion, Skeleton


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("stage", type=Path, metavar="STAGE|LIST", help=STAGE + ", or a list of garments (.toml)")
    add_garment(verb)
    verb.add_argument(
        "--over", action="append", default=[], metavar="FILE[:/PRIM]|PRIM|MODEL",
        help="a garment that is worn beneath this one (repeatable): a file of its own, a mesh of the stage, or a "
             "trained model",
    )  # fmt: skip
    verb.set_defaults(over_names=None)  # what findings call them, where a list has names
    verb.add_argument(
        "--motion", type=Path, nargs="+", default=[], metavar="PATH", help="motion files or folders to check too"
    )
    verb.add_argument(
        "--preset",
        choices=PRESETS,
        help="training to estimate memory and time for (default: draft on a CPU, else preview)",
    )
    verb.add_argument(
        "--family", type=Path, nargs="*", metavar="STAGE|SHAPES",
        help="other characters to compare: bodies of one skeleton and topology, which one model can dress, as 'ssilk "
             "train' takes them",
    )  # fmt: skip
    verb.add_argument(
        "--onto", type=Path, metavar="STAGE[:/ROOT]",
        help="a character with another skeleton, to put the garment on: which of its joints stand for which",
    )  # fmt: skip
    verb.add_argument(
        "--joints", type=Path, metavar="MAP",
        help="map of joints for --onto (.toml): written where there is no such file, else checked",
    )  # fmt: skip
    verb.add_argument(
        "--fix", type=Path, metavar="OUT",
        help="write a repaired copy of the garment's file (.usdc, .usd or .usda); of a list, a folder of copies",
    )  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Inspect; return 0, or 2 when there are errors."""
    from ._inspect_list import inspect_list

    if options.stage.suffix == LIST:
        return inspect_list(options, report, _inspect)
    found = _inspect(options, report)
    if options.json:
        report(Result("inspect", found.detail(options.fix)))
    else:
        print(found.text(options.fix))
    return found.code


def _inspect(options: argparse.Namespace, report: Reporter) -> Inspected:
    """Inspect a garment, or the repaired copy of it that is written first where one is asked for."""
    from ..authoring.preflight.inspection import inspect

    inputs, repaired = _read(options, report), None
    if options.fix:
        repaired = _fix(options, inputs)
        inputs = _read(_moved(options, options.fix), silent)
    others = (*_on_family(options, inputs, report), *_on_skeleton(options, inputs, report))
    return Inspected([*inspect(inputs), *others], repaired)


def _read(options: argparse.Namespace, report: Reporter) -> PreflightInput:
    """Read everything that is inspected."""
    from ssilk_usd.opening.trial import tried

    plain = argparse.Namespace(**{name: value for name, value in vars(options).items() if name != "parser"})
    with tried(_read_inputs, plain, silent) as ending:  # one process for all files, which most are whole
        inputs = None if ending else _read_inputs(options, report)
    inputs = inputs or _read_inputs(options, report)  # else one for each, to name the one that is not
    return replace(inputs, preset=preset_named(options.preset or _default_preset()))


def _read_inputs(options: argparse.Namespace, report: Reporter) -> PreflightInput:
    """Read everything that is inspected, with the preset "draft" where none is asked for."""
    from ssilk_usd.opening.shaped import body_parameters
    from ssilk_usd.opening.stage import open_stage
    from ssilk_usd.writing.repair import repair_lock

    from ..authoring.preflight.inspection import PreflightInput

    character, garment, rig = read_stage(options, report)
    file, prim = garment_location(options)
    motions, unread = _readable(options.motion, character.skeleton)
    tell_shapes(options, motions, report, trained=character)
    known = body_parameters(open_stage(options.stage)).items()
    return PreflightInput(
        character=character, garment=garment, rig=rig, character_units=_units(options.stage),
        garment_units=_units(file), locked=repair_lock(file, prim, options.root), motions=motions,
        preset=preset_named(options.preset or "draft"), unread=unread,
        files=[_facts(motion, character.skeleton) for motion in motions],
        inner=_inner(options, character), body_ranges={name: (of.low, of.high) for name, of in known if of.is_marked},
    )  # fmt: skip


def _inner(options: argparse.Namespace, character: Character) -> dict[str, Mesh]:
    """Return the garments of --over in the bind pose, by name.

    Raises:
        SsilkError: one cannot be read, is of another character, or has the name of another one.
    """
    from ssilk_usd.reading.scene import read_scene

    found: dict[str, Mesh] = {}
    for name, location in zip(options.over_names or options.over, options.over, strict=True):
        if location.endswith(MODEL):
            from ..network.checkpoint import load_model
            from ..training.inner_garments import other_character

            scene = load_model(location).scene
            if differs := other_character(scene.character.skeleton, character.skeleton):
                allowed = "garments of an outfit are of one character"
                fail(f"--over {location}", differs, allowed, f"name one that was trained on {character.path}")
            mesh = scene.garment.mesh
        else:
            mesh = read_scene(options.stage, root=options.root, bodies=options.body, garment=location)[1].mesh
        if name in found:
            fail(f"--over {name}", "it is named twice", "each garment beneath is named once", "leave one out")
        found[name] = mesh
    return found


def _on_family(options: argparse.Namespace, inputs: PreflightInput, report: Reporter) -> list[Finding]:
    """Return what there is to say of the characters of --family beside this one."""
    if options.family is None:
        return _parameters(inputs)
    from ..authoring.bodies.differences import family_findings

    others = [read_member(options, member, inputs.character, report) for member in members(options, report)]
    return list(family_findings([inputs.character, *others]))


def _parameters(inputs: PreflightInput) -> list[Finding]:
    """Return which shapes of the character its stage marks as body parameters, where it marks some."""
    from ..authoring.preflight.finding import Finding

    if not inputs.body_ranges:
        return []
    marked = [f"{name} ({low:g} to {high:g})" for name, (low, high) in inputs.body_ranges.items()]
    found = f"shapes are marked as body parameters: {', '.join(marked)}"
    alone, combined = bodies_within(inputs.body_ranges)
    bodies = format_count(len(alone) + len(combined), "bodies")
    fix = f"--family without a word takes {bodies} of them, single and combined; --family tall=1 names one by weights"
    return [Finding(severity="info", code="body-parameters", prim=inputs.character.path, found=found, fix=fix)]


def _on_skeleton(options: argparse.Namespace, inputs: PreflightInput, report: Reporter) -> list[Finding]:
    """Return what there is to say of the joints of --onto; write the map of --joints where there is none yet."""
    need_onto(options)
    if not options.onto:
        return []
    from ..authoring.bodies.joint_findings import joint_findings
    from ..authoring.bodies.joint_names import propose
    from ..scene.joint_map import read_joint_map, write_joint_map

    other = read_onto(options, report)
    if options.joints and options.joints.exists():
        return list(joint_findings(read_joint_map(options.joints), inputs.character, other, inputs.garment))
    found = propose(inputs.character.skeleton, other.skeleton, str(options.joints or options.onto))
    if options.joints:
        check_output(options.joints, options.stage, split_location(str(options.onto))[0])
        write_joint_map(options.joints, found, _about_map(options))
    return list(joint_findings(found, inputs.character, other, inputs.garment))


def _about_map(options: argparse.Namespace) -> str:
    name = Path(split_location(str(options.onto))[0]).name
    return (
        f'Which joint of {name} stands for each joint of {options.stage.name}; "" for none.\n'
        "Edit it, check it with 'ssilk inspect', and give it to 'ssilk rig --onto' as --joints."
    )


def _readable(paths: Sequence[Path], skeleton: Skeleton) -> tuple[list[Motion], dict[str, str]]:
    """Return the motions that can be read, and what is wrong with each other one by its file.

    Raises:
        SsilkError: a file or a folder is missing.
    """
    from ssilk_usd.reading.motion import motion_sources, read_motion

    found, unread = [], {}
    for source in motion_sources(paths):
        try:
            found.append(read_motion(source, skeleton))
        except SsilkError as error:
            unread[str(source)] = str(error)
    return found, unread


def _facts(motion: Motion, skeleton: Skeleton) -> MotionFile:
    from ssilk_usd.reading.facts import animated
    from ssilk_usd.reading.motion import clip_posture

    from ..authoring.preflight.motion import MotionFile

    joints, times = animated(motion, skeleton)
    posture = clip_posture(motion, skeleton)
    if posture is None:
        return MotionFile(motion.path, joints, times)
    upright = (posture.by_file, posture.by_character)[:: 1 if posture.is_of_file else -1]
    return MotionFile(motion.path, joints, times, (upright[0], upright[1]), posture.is_of_file)


def _default_preset() -> str:
    """Return the preset that 'ssilk train' takes here; without torch, which nothing is estimated without, "draft"."""
    from ..devices import default_preset

    return default_preset("auto") if find_spec("torch") else "draft"


def _units(path: Path) -> FileUnits:
    from ssilk_usd.reading.facts import stage_facts

    from ..authoring.preflight.units import FileUnits

    facts = stage_facts(path)
    return FileUnits(
        facts.path, facts.units.meters_per_unit, facts.units.up_axis, facts.meters_authored, facts.axis_authored
    )


def _fix(options: argparse.Namespace, inputs: PreflightInput) -> list[str]:
    """Write the repaired copy; return what was repaired."""
    from ssilk_usd.writing.repair import write_repaired, write_with_units

    from ..authoring.preflight.repair import plan_repair

    file, prim = garment_location(options)
    units, stated = _corrected_units(inputs)
    if options.fix.exists() and options.fix.samefile(file):
        fail(str(options.fix), "this is the file to repair", "--fix writes a copy", "name another file")
    check_output(options.fix, options.stage)
    with replacing(options.fix) as half_done:
        # Units first: everything else is measured in them.
        write_with_units(file, half_done, units)
        inputs = _read(_moved(options, half_done), silent)
        repair = plan_repair(
            inputs.character,
            inputs.garment,
            inputs.rig,
            topology=not inputs.locked,
            inner=list(inputs.inner.values()),
        )
        skeleton = inputs.character.skeleton
        write_repaired(half_done, half_done, repair, garment=prim, root=options.root, skeleton=skeleton)
    return [*stated, *repair.done]


def _corrected_units(inputs: PreflightInput) -> tuple[StageUnits, list[str]]:
    """Return the units that the garment's file should state, and in words those that it did not."""
    from ssilk_usd.units import StageUnits

    from ..authoring.preflight.fit import find_unit_correction
    from ..authoring.preflight.units import find_upright_units

    body, old = inputs.character.merged_body().mesh, inputs.garment_units
    shared_file = inputs.character_units == old
    units = old.corrected(
        find_upright_units(body) if shared_file else find_unit_correction(inputs.garment.mesh, body)
    )
    told = [] if units == old else [f"metersPerUnit {units.meters_per_unit:g} and upAxis {units.up_axis} stated"]
    return StageUnits(units.meters_per_unit, units.up_axis), told


def _moved(options: argparse.Namespace, copy: Path) -> argparse.Namespace:
    """Return the options with a repaired copy in place of the file that it was made from."""
    file, prim = garment_location(options)
    own: dict[str, object] = {} if file == options.stage else {"garment": f"{copy}:{prim}" if prim else str(copy)}
    return argparse.Namespace(**{**vars(options), **(own or {"stage": copy})})
