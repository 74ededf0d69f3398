# SPDX-License-Identifier: Apache-2.0
"""Bakes of some level of quality, within a budget, or of no more influences than their target takes."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ..assets import GarmentPose
from ..checkpoint import ModelFile, load_model
from ..cost import POINT, ShotBytes
from ..errors import fail
from ..events import Reporter
from ..quality import quality_named
from ..reduction import Reducer
from ._baking import Bake, open_bake
from ._quality import level_size, spent

EXCERPT = 64  # frames of a shot that are written to tell how large all of it becomes


def levelled(bake: Bake, options: argparse.Namespace, report: Reporter) -> Bake:
    """Return a bake with as much of its garment kept, and as many frames, as the options and the target ask for.

    What is kept is the best for this shot's own motion: weights and blendshapes are fitted to it.

    Raises:
        SsilkError: nothing fits the budget, or linear blend skinning is baked.
    """
    most = bake.target.influences or bake.influences
    if not (options.quality or options.budget or bake.influences > most):
        return bake
    if bake.model is None:
        fail(
            "--lbs",
            "linear blend skinning has no level of quality",
            "--quality and --budget are about the network",
            "leave one of them out",
        )
    request = bake.request
    if options.quality and request.fps is None:
        request = replace(request, fps=quality_named(options.quality).rate(bake.source.fps))
    reducer = Reducer(load_model(request.model), [bake.source])
    size = level_size(options.quality, reducer.whole)
    size = replace(size, influences=min(size.influences, most))
    if options.budget:
        at_rate = open_bake(request)

        def weight(file: ModelFile) -> float:
            size = shot_bytes(at_rate.wearing(file), options.output.suffix, body=not options.no_body)
            return size.of(at_rate.motion.frame_count)

        size = spent(options.budget, reducer, size, bake.source, weight, report).size
    return open_bake(replace(request, keep="" if size == reducer.whole else str(size)))


def shot_bytes(bake: Bake, suffix: str, *, body: bool) -> ShotBytes:
    """Return about how large a shot becomes: two excerpts are written, of some frames and of more."""
    many = min(EXCERPT * bake.request.samples, bake.motion.frame_count)
    few = max(many // 4, 1)
    first, second = (_excerpt_bytes(bake, count, suffix, body) for count in (few, many))
    frame = (second - first) / max(many - few, 1)
    points = POINT * bake.deformer.scene.garment.mesh.vertex_count if bake.as_points else 0
    return ShotBytes(second - frame * many, frame + points)


def _excerpt_bytes(bake: Bake, frames: int, suffix: str, body: bool) -> int:
    from ssilk_usd.shot import write_shot

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"shot{'.usda' if suffix == '.usda' else '.usdc'}"
        write_shot(
            path,
            bake.deformer,
            bake.motion.clip(0, frames),
            _first(bake.rollout(), frames),
            units=bake.units,
            samples_per_frame=bake.request.samples,
            include_body=body,
        )
        return path.stat().st_size


def _first(poses: Iterator[GarmentPose], frames: int) -> Iterator[GarmentPose]:
    """Yield the first so many frames of consecutive poses."""
    for pose in poses:
        count = min(pose.frame_count, frames - pose.start)
        yield GarmentPose(pose.start, pose.rotations[:count], pose.weights[:count])
        if pose.start + count == frames:
            return
