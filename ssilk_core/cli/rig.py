# SPDX-License-Identifier: Apache-2.0
"""Give a garment weights, classes and proxy joints, written into a copy of the stage.

The proxies are joints at the end of the skeleton and can be edited by hand like any other joint. Weights, classes and
proxies that the stage already has are kept. A garment that lies in the body is settled out of it first. Where a limb
goes through it, it stays as it is, with a warning. --onto puts it on another body of the same family instead, to see
how it would lie there: the file written is that body's. With --joints that body may have any other skeleton and mesh,
such as a Mixamo, Rigify, Unreal or SMPL character: a model of the garment bakes on the file written, and a training
with it makes one for that body.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..authoring.setup.classes import USUAL
from ..authoring.setup.rig import RigOptions
from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result, Started
from ..files import split_body, split_location
from .options.bodies import need_onto, onto_place, read_member, read_onto
from .options.fabric import stated_fabric
from .options.files import check_output
from .options.numbers import NumberRange
from .options.scene import add_scene, garment_location, read_stage

if TYPE_CHECKING:
    from ..scene.assets import Character, Garment, Mesh, Scene


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    add_scene(verb)
    verb.add_argument("-o", "--output", type=Path, required=True, help="stage to write (.usdc, .usd or .usda)")
    verb.add_argument(
        "--tightness", type=NumberRange(0, 1), metavar="SHARE",
        help="how much is tight: 0 nothing, 1 all that is not pinned (default: the classes that the garment has, "
             f"else {USUAL:g}). Classes are made again by primvars:ssilk:tightness, with their proxies",
    )  # fmt: skip
    verb.add_argument(
        "--proxies",
        type=NumberRange(0, 1000, int),
        default=RigOptions.proxies,
        help="proxy joints on the loose part (default %(default)s)",
    )
    verb.add_argument(
        "--roots", type=NumberRange(1, 1000, int), default=RigOptions.roots_per_cluster, metavar="N",
        help="proxies of each connected loose part that hang from the character itself (default %(default)s)",
    )  # fmt: skip
    verb.add_argument(
        "--onto",
        type=Path,
        metavar="STAGE[:/ROOT]|SHAPES",
        help="another body of the same skeleton and topology, to put the garment on, or weights of the stage's own "
        "blendshapes, such as tall=1,heavy=0.5; with --joints any character",
    )
    verb.add_argument(
        "--joints", type=Path, metavar="MAP",
        help="which joints of --onto stand for those of the garment's character (.toml), as 'ssilk inspect --onto' "
             "proposes it",
    )  # fmt: skip
    verb.add_argument(
        "--keep-shape", action="store_true", help="leave the garment as it is, even where it lies inside the body"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Prepare the scene and write it."""
    import numpy as np
    from ssilk_usd.writing.rig import write_rigged_stage

    from ..authoring.setup.prepare import prepare_scene
    from ..scene.assets import CLASS_NAMES

    onto = onto_place(options)[0] if options.onto else None
    check_output(options.output, options.stage, garment_location(options)[0], onto)
    report(Started("rig", options.proxies))
    need_onto(options)
    character, garment, rig = read_stage(options, report)
    if garment.surface is not None:
        stated_fabric(garment.surface, report)
    settled = None if options.keep_shape else settled_garment(character, garment, report)
    scene = prepare_scene(
        character,
        settled or garment,
        rig,
        tightness=options.tightness,
        rig_options=RigOptions(proxies=options.proxies, roots_per_cluster=options.roots),
        report=report,
    )
    moved = settled.mesh.points - garment.mesh.points if settled else None
    stands_for = None
    if options.joints:
        (scene, stands_for), moved = _on_skeleton(options, scene, report), None
    elif options.onto:
        scene, moved = _on_other(options, scene, report), None
    source = onto or options.stage
    left_out = write_rigged_stage(source, scene, options.output, moved=moved, stands_for=stands_for)
    if left_out:
        report(Message(f"{options.output}: {left_out}", "warning"))
    if onto and split_body(onto)[1]:
        _tell_riders(options.output, scene.garment.mesh, report)
    counts = np.bincount(scene.classes, minlength=3)
    report(
        Result(
            "rig",
            {
                "stage": str(options.output),
                "garment": scene.garment.mesh.path,
                "proxies": scene.rig.proxy_count,
                **{f"{name} vertices": int(count) for name, count in zip(CLASS_NAMES, counts)},
            },
        )
    )
    return EXIT_OK


def _tell_riders(output: Path, garment: Mesh, report: Reporter) -> None:
    """Warn of what rides on a garment that was put on a body by shapes: it lies as on the stage's own body."""
    from ssilk_usd.reading.riders import read_riders

    riders = read_riders(output, split_location(garment.path)[1] or garment.path)
    if riders:
        names = ", ".join(split_location(rider.path)[1] or rider.name for rider in riders)
        text = f"{names} lies as on the stage's own body; move it to the garment, which it rides on"
        report(Message(f"{output}: {text}", "warning"))


def _on_other(options: argparse.Namespace, scene: Scene, report: Reporter) -> Scene:
    """Return the scene on the body of --onto, and say how far the garment moves.

    Raises:
        SsilkError: that body is none of the character's family.
    """
    import numpy as np

    from ..authoring.bodies.carry import carry
    from ..authoring.bodies.differences import differences, need_family
    from ..authoring.preflight.fit import describe_left, describe_move

    path = scene.garment.mesh.path
    file, root = onto_place(options)
    other = read_member(options, file, scene.character, report, root)
    if found := differences(scene.character, other):
        _need_map(options, scene, other, found)
    family = need_family([scene.character, other])
    carried = carry(scene, other)
    moved = np.linalg.norm(carried.scene.garment.mesh.points - scene.garment.mesh.points, axis=1)
    told = (
        f"carried onto {family.names[1]}, by {1000 * moved.mean():.0f} mm on average and {1000 * moved.max():.0f} mm"
    )
    report(Message(f"{path}: {told} at most"))
    if carried.settled.moved:
        report(Message(f"{path}: settling it there {describe_move(carried.settled, 'moves')}"))
    if left := describe_left(carried.settled, carried.unsettled, other):
        report(Message(f"{path}: {left}", "warning"))
    return carried.scene


def _need_map(options: argparse.Namespace, scene: Scene, other: Character, found: list[str]) -> None:
    """Raise `SsilkError` for a character that is found to differ, and name the verb that proposes a map of joints."""
    fail(
        other.path,
        f"it is no member of the family of {scene.character.path}: {'; '.join(found)}",
        "members of a family have the same joints, parents and order of points, and others need a map of joints",
        f"'ssilk inspect {options.stage} --onto {options.onto} --joints MAP.toml' proposes one for --joints",
    )


def _on_skeleton(options: argparse.Namespace, scene: Scene, report: Reporter) -> tuple[Scene, dict[str, str]]:
    """Return the scene on the character of --onto, by the map of --joints, and which of its joints stand for which.

    Raises:
        SsilkError: the map is not sound, or the character is bound in a pose that cannot be made out.
    """
    import numpy as np

    from ..authoring.bodies.other_skeleton import carry_onto, tell_carried
    from ..scene.joint_map import read_joint_map

    names = read_joint_map(options.joints)
    other = read_onto(options, report)
    own, skeleton = scene.character.skeleton, other.skeleton
    images = names.images(own, skeleton)
    carried = carry_onto(scene, other, images)
    tell_carried(carried, scene, report)
    others = np.array([*skeleton.joint_names, ""])
    return carried.scene, dict(zip(own.joint_names, others[images].tolist()))


def settled_garment(character: Character, garment: Garment, report: Reporter) -> Garment | None:
    """Return the garment settled out of the body, and say what moves; None if nothing of it lies in the body."""
    from ..authoring.preflight.fit import describe_left, describe_move
    from ..authoring.preflight.settle import settle

    mesh = garment.mesh
    settled = settle(mesh, character.merged_body().mesh)
    if not len(settled.before.vertices):
        return None
    deep = f"{len(settled.before.vertices)} vertices lay inside the body, up to {1000 * settled.before.depth:.1f} mm"
    if settled.moved:
        report(Message(f"{mesh.path}: {deep} deep; settling {describe_move(settled, 'moves')}"))
    left = describe_left(settled, mesh, character)
    if left:
        report(Message(f"{mesh.path}: {left}", "warning"))
    return replace(garment, mesh=replace(mesh, points=mesh.points + settled.offsets)) if settled.moved else None
