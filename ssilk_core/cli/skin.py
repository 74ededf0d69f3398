# SPDX-License-Identifier: Apache-2.0
"""Turn a point cache into joints and blendshapes on the character's skeleton, and verify them.

The cache is a USD file with the garment's points at each frame, from Houdini, Marvelous Designer, Blender or 'ssilk
simulate --points', say: the same mesh, its vertices in the same order, in the character's world. The shot moves the
character's joints, fits the garment's proxy joints, and gets as many blendshapes as it takes to stay within the
tolerance. The result says how many, and what the points would take.

With a model its trained weights are used, without one those of the stage, and 'ssilk rig' makes what is missing.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..delivery.targets import TARGETS
from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result, Started
from ..files import split_location
from .options.files import check_output
from .options.motions import tell_shapes, with_shapes
from .options.numbers import NumberRange
from .options.scene import STAGE, add_garment, garment_under_riders, load_scene

if TYPE_CHECKING:
    from ..delivery.bake.counted import MetWorld
    from ..scene.assets import Deformer, Motion

LARGEST = 5  # times the RMS tolerance: how far any vertex may be off


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("cache", metavar="CACHE[:/PRIM]", help="USD file with the garment's points at each frame; PRIM "
                      "is its mesh, where several have as many points")  # fmt: skip
    verb.add_argument("--stage", type=Path, required=True, help=STAGE)
    add_garment(verb)
    verb.add_argument("--model", type=Path, help="model written by 'ssilk train', whose weights are used")
    verb.add_argument("--motion", metavar="SHOT[:/PRIM]",
                      help="USD file with the character's motion (default: the cache itself)")  # fmt: skip
    verb.add_argument("-o", "--output", type=Path, required=True,
                      help="shot to write (.usdc, .usd, .usda, .usdz or .glb)")  # fmt: skip
    verb.add_argument("--tolerance", type=NumberRange(1e-3, 1e3), default=1.0, metavar="MM",
                      help=f"RMS distance from the cache in millimetres; any vertex may be {LARGEST} times as far "
                           "off (default 1)")  # fmt: skip
    verb.add_argument("--target", choices=TARGETS, default="usd", help="who receives it (default usd)")
    verb.add_argument("--no-body", action="store_true", help="leave the body meshes out")
    verb.add_argument("--no-verify", action="store_true", help="do not re-skin the written file")
    verb.add_argument("--device", default="cpu", help="where poses are fitted (default cpu)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Fit, write and verify."""
    from ssilk_usd.opening.stage import open_stage
    from ssilk_usd.reading.motion import read_motion
    from ssilk_usd.reading.visibility import read_hidden
    from ssilk_usd.shots.trajectories import MeshTrajectories
    from ssilk_usd.units import StageUnits

    from ..delivery.bake import cache_origin, motion_at, riders_of, skin_trajectories
    from ..delivery.targets import check_suffix, fit, joint_names
    from ..scene.decomposition import FitTolerance

    target, where = TARGETS[options.target], options.motion or split_location(options.cache)[0]
    check_suffix(options.output, options.target)
    inputs = (options.stage, options.model, split_location(options.cache)[0], split_location(where)[0])
    check_output(options.output, *inputs)
    deformer = _deformer(options, report)
    if (names := joint_names(deformer.scene, target)).renamed:
        report(Message(f"--target {options.target}: {names}", "warning"))
    deformer = fit(deformer, target)
    mesh = deformer.scene.garment.mesh
    points = MeshTrajectories(options.cache, mesh.vertex_count, mesh.faces)
    skeleton = deformer.scene.character.skeleton
    motion = motion_at(read_motion(where, skeleton, root=options.root), skeleton, points, options.cache)
    motion = with_shapes(options, motion, where, deformer.scene.character)
    tell_shapes(options, [motion], report)
    report(Started("skin", motion.frame_count, {"output": str(options.output)}))
    stage = open_stage(options.stage)
    own = StageUnits.of(stage)
    result = skin_trajectories(
        deformer,
        motion,
        points,
        options.output,
        units=StageUnits(target.meters_per_unit or own.meters_per_unit, target.up_axis or own.up_axis),
        origin=cache_origin(options.cache, points.mesh, options.output),
        riders=riders_of(stage, mesh, options.root, report, garment_under_riders(options, mesh)),
        met=_met(str(where), options, deformer, motion, report),
        hidden=read_hidden(where, motion, root=options.root),
        include_body=not options.no_body,
        verify=not options.no_verify,
        tolerance=FitTolerance(options.tolerance / 1000, LARGEST * options.tolerance / 1000),
        device=options.device,
        source=f"{split_location(options.cache)[0]}:{points.mesh}",
        report=report,
    )
    report(Result("skin", result.figures()))
    return EXIT_OK


def _met(
    where: str, options: argparse.Namespace, deformer: Deformer, motion: Motion, report: Reporter
) -> MetWorld | None:
    """Return what surrounds the character where its motion was read; None where nothing does."""
    from ..delivery.bake.counted import MetWorld
    from ..delivery.bake.world import ShotSurroundings

    around = ShotSurroundings(where, str(options.stage), deformer.scene, motion, None)
    world = around.seen
    around.tell(report)
    return MetWorld(world, lambda frame: frame / motion.fps) if world else None


def _deformer(options: argparse.Namespace, report: Reporter) -> Deformer:
    """Return the garment on its character: with a model's weights, or with those of the stage."""
    from ..delivery.bake import rig_deformer, trained_deformer

    if options.model is None:
        return rig_deformer(load_scene(options, report))
    for name in ("garment", "body"):
        if getattr(options, name):
            fail(f"--{name}", f"a {name} beside a model", f"the model holds its {name}", "leave one of them out")
    return trained_deformer(options.model, options.stage, options.root)
