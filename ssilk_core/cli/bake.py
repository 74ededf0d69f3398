# SPDX-License-Identifier: Apache-2.0
"""Bake trained garments over motions as UsdSkel, and prove it by re-skinning the files.

One garment over one motion goes into one file: joints, blendshapes and their animation, no vertex caches. A folder
takes any number of both, as layers: an asset for each garment, a small layer for each garment in each shot, and a
stage for each shot. What is there already and would come out the same is left alone.

A file that fails the proof (exit code 3) is not kept, and an older one of its name stays as it was. --lbs bakes
the same garments under linear blend skinning, to compare with.

--refine lets the simulator's solver go on from the network in every frame, for hero shots: what is inside the body
comes out, and wrinkles that no blendshape has appear. The garment is then written as time-sampled points, bound to
nothing; in a folder of layers, beside the joints, as the variant "points" of "deformation". --refined-output joints
puts it back onto joints and blendshapes, which loses much of what was refined, and says how much.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result, Started, silent
from ..files import replacing
from ..quality import quality_named
from ..targets import TARGETS
from ._quality import add_level
from .options import add_bake, check_output, is_folder, layer_tasks, tasks_of

if TYPE_CHECKING:
    from ssilk_usd.shot import ShotSummary

    from ..farm.tasks import BakeTask
    from ._baking import Bake, BakeRequest


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    add_bake(verb)
    verb.add_argument("-o", "--output", type=Path, required=True,
                      help="shot to write (.usdc, .usd, .usda or .usdz), or a folder of layers")  # fmt: skip
    add_level(verb, "2MB for the shot")
    verb.add_argument("--again", action="store_true", help="bake what is there and current, too (folders)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Bake and verify."""
    if is_folder(options.output):
        if options.quality or options.budget:
            fail(
                str(options.output),
                "a level of quality for layers",
                "their assets are the same for all shots",
                "bake models that 'ssilk reduce' made",
            )
        return _bake_layers(options, report)
    return _bake_file(options, report)


def _bake_layers(options: argparse.Namespace, report: Reporter) -> int:
    from ._layers import Wardrobe, bake_task, write_stages

    tasks, wardrobe = layer_tasks(options), Wardrobe()
    report(Started("bake", len(tasks), {"output": str(options.output)}))
    for task in tasks:
        report(Result("bake", bake_task(task, options.output, wardrobe, report, again=options.again)))
    write_stages(tasks, options.output, report)
    return EXIT_OK


def _bake_file(options: argparse.Namespace, report: Reporter) -> int:
    from ._baking import open_bake
    from ._level import levelled

    task = _one_task(options)
    bake = levelled(open_bake(_request(task, options)), options, report)
    report(Started("bake", bake.motion.frame_count, {"output": str(options.output)}))
    refined = bake.refine(report)
    summary, proof = _write_proven(bake, task, options.output, report)
    detail: dict[str, object] = {
        "shot": str(options.output),
        "frames": summary.frame_count,
        "fps": summary.fps,
        "joints": summary.joint_count,
        "proxies": summary.proxy_count,
        "blendshapes": summary.shape_count,
        "bytes": options.output.stat().st_size,
        **bake.provenance.get("reduced", {}),
        **refined,
        **proof,
        **bake.warn(report),
    }
    report(Result("bake", detail))
    return EXIT_OK


def _one_task(options: argparse.Namespace) -> BakeTask:
    """Return the only task; raise `SsilkError` where there are more, or the file cannot be what is asked for."""
    from ssilk_usd.read_stage import split_location

    tasks, suffixes = tasks_of(options), TARGETS[options.target].suffixes
    if not (len(tasks) == 1 and not options.points):
        fail(str(options.output), "one file", "it holds one garment in one shot and no point cache", "name a folder")
    if options.output.suffix not in suffixes:
        fail(
            str(options.output),
            f"the suffix is '{options.output.suffix}'",
            f"{options.target} takes {', '.join(suffixes)}",
        )
    (task,) = tasks
    check_output(options.output, task.model, task.stage, split_location(task.motion)[0])
    return task


def _write_proven(
    bake: Bake, task: BakeTask, output: Path, report: Reporter
) -> tuple[ShotSummary, dict[str, object]]:
    """Write a file that appears once it is proven; return what it holds, and figures."""
    from ssilk_usd.export import packaged

    with replacing(output) as unproven:
        with packaged(unproven) as layer:
            summary = _write(layer, bake, task, output)
        if not task.verify:
            report(Message("not verified, as asked", "warning"))
        return summary, bake.verify(unproven, report) if task.verify else {}


def _request(task: BakeTask, options: argparse.Namespace) -> BakeRequest:
    """Return what a task asks for, refined as its level of quality is where the options say nothing of it."""
    from ._baking import BakeRequest

    level = quality_named(options.quality).refine if options.quality else 0
    request = replace(BakeRequest.of(task), refine=task.refine or level)
    if options.budget and request.refine and request.refined == "points":
        fail(
            "--budget",
            "a budget for points",
            "every vertex is stored at every frame, whatever is kept of the model",
            "use --refined-output joints, or leave the budget out",
        )
    return request


def _write(layer: Path, bake: Bake, task: BakeTask, output: Path) -> ShotSummary:
    """Write a shot whose garment joints move, or one that has its points refined."""
    from ssilk_usd.points import point_cache
    from ssilk_usd.shot import write_shot

    common: dict[str, Any] = {
        "units": bake.units,
        "start": bake.start,
        "samples_per_frame": task.samples,
        "include_body": task.body,
        "hidden": bake.hidden,
        "provenance": bake.carried(output),
        "record": bake.record,
    }
    if not bake.as_points:
        return write_shot(layer, bake.deformer, bake.motion, bake.poses(), **common)
    with point_cache(layer, bake.deformer.scene, bake.motion, **common) as cache:
        for frame, points in enumerate(bake.points(silent)):
            cache.write(frame, points)
    return cache.shot
