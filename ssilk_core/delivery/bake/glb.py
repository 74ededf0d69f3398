# SPDX-License-Identifier: Apache-2.0
"""Shots as one glTF binary each, their parts named as in stages of USD."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...events import Message, Reporter
from ...files import split_location
from ...scene.assets import Deformer, GarmentPose, Motion
from ...scene.riders import RiderJoints
from ..gltf.shot import SET, GlbLabels, write_glb

if TYPE_CHECKING:
    from ssilk_usd.shots.shot import ShotSummary
    from ssilk_usd.writing.body_faces import HiddenPolygons


def write_glb_shot(
    path: Path,
    deformer: Deformer,
    motion: Motion,
    poses: Iterable[GarmentPose],
    *,
    start: float,
    samples_per_frame: int = 1,
    include_body: bool = True,
    riders: RiderJoints | None = None,
    hidden: Sequence[tuple[int, bool]] = (),
    hidden_polygons: HiddenPolygons | None = None,
    provenance: Mapping[str, object] | None = None,
) -> ShotSummary:
    """Write a shot in metres, y up.

    Args:
        path, deformer, motion, poses: as `ssilk_usd.shots.shot.write_shot` takes them, and all others.

    Raises:
        SsilkError: poses that do not cover the motion or do not fit it, or a file that cannot be written.
    """
    from ssilk_usd.names import shape_name
    from ssilk_usd.shots.shot import TimeSpan, checked_poses, summary
    from ssilk_usd.writing.author import prim_names, unique_names
    from ssilk_usd.writing.look import as_it_looks

    scene = deformer.scene
    looks = as_it_looks(scene.garment, split_location(scene.character.path)[0])
    scene = replace(scene, garment=looks)
    deformer = replace(deformer, scene=scene)
    bodies, ridden = scene.character.bodies, riders.bodies if riders else ()
    names = prim_names([mesh.path for mesh in (scene.garment.mesh, *(body.mesh for body in (*bodies, *ridden)))])
    labels = GlbLabels(
        character=prim_names([scene.character.path])[0],
        joints=unique_names(scene.joint_names),
        shapes=[shape_name(index) for index in range(deformer.shape_count)],
        garment=names[0],
        bodies=names[1 : 1 + len(bodies)],
        riders=names[1 + len(bodies) :],
        start=start,
        samples_per_frame=samples_per_frame,
    )
    shapes = write_glb(
        path,
        deformer,
        motion,
        checked_poses(poses, deformer, motion),
        labels,
        include_body=include_body,
        riders=ridden,
        rider_shapes=riders.shapes if riders else (),
        hidden=hidden,
        hidden_polygons=None if hidden_polygons is None else hidden_polygons.masks,
        provenance=provenance,
    )
    kept = "a glb keeps the garment's mean colour and one UV set of each mesh"
    left = f"{kept}; materials, subsets, sides, subdivision, other colours and sets are left out"
    told = summary(path, deformer, motion, TimeSpan.of(motion, start, samples_per_frame), shapes)
    return replace(told, left_out=left)


def warn_of_sets(deformer: Deformer, output: Path, report: Reporter) -> None:
    """Warn of influences beyond the first set, which many viewers do not read."""
    count = deformer.skin.indices.shape[1]
    if count > SET:
        text = f"{count} joints move a vertex; viewers that read {SET} alone, such as three.js, show it wrongly"
        report(Message(f"{output}: {text}; --target glb4 is for these", "warning"))
