# SPDX-License-Identifier: Apache-2.0
"""A rollout as one glTF binary, named as the stages of USD are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..assets import GarmentPose
from .rollout import BakeRollout

if TYPE_CHECKING:
    from ssilk_usd.body_faces import HiddenPolygons
    from ssilk_usd.shot import ShotSummary


def write_glb_shot(
    path: Path,
    rollout: BakeRollout,
    poses: Iterable[GarmentPose],
    include_body: bool,
    hidden: HiddenPolygons | None,
    provenance: Mapping[str, object],
) -> ShotSummary:
    """Write a rollout's poses, and its character.

    Args:
        provenance: where the shot came from; looked at once the poses are taken.

    Raises:
        SsilkError: poses that do not cover the motion, or a file that cannot be written.
    """
    from ssilk_usd.author import prim_names, unique_names
    from ssilk_usd.names import shape_name
    from ssilk_usd.shot import TimeSpan, checked_poses, summary

    from ..gltf.shot import GlbLabels, write_glb

    deformer, motion, samples = rollout.deformer, rollout.motion, rollout.request.samples_per_frame
    scene = deformer.scene
    garment, *bodies = prim_names([scene.garment.mesh.path, *(body.mesh.path for body in scene.character.bodies)])
    labels = GlbLabels(
        character=prim_names([scene.character.path])[0],
        joints=unique_names(scene.joint_names),
        shapes=[shape_name(index) for index in range(deformer.shape_count)],
        garment=garment,
        bodies=bodies,
        animation=Path(rollout.request.motion).stem,
        start=rollout.start,
        samples_per_frame=samples,
    )
    shapes = write_glb(
        path,
        deformer,
        motion,
        checked_poses(poses, deformer, motion),
        labels,
        include_body=include_body,
        hidden=rollout.hidden,
        hidden_polygons=None if hidden is None else hidden.masks,
        provenance=provenance,
    )
    return summary(path, deformer, motion, TimeSpan.of(motion, rollout.start, samples), shapes)
