# SPDX-License-Identifier: Apache-2.0
"""Polygons of the body that a garment covers in every frame of a shot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ...events import Countdown, Message, Reporter, silent
from ...physics.skin.hidden_faces import HiddenFaces, hidden_polygons
from ...scene.assets import Floats
from ...scene.kinematics import body_at_rest, motion_transforms, skin_points, skinning_matrices
from .rollout import BakeRollout

if TYPE_CHECKING:
    from ssilk_usd.writing.body_faces import HiddenPolygons

CHUNK = 16  # frames whose bodies are in memory at once


def hidden_polygons_of(rollout: BakeRollout, report: Reporter = silent) -> HiddenPolygons | None:
    """Return what a shot hides of each body; None where its request does not ask for it.

    Raises:
        SsilkError: as `covered_polygons` does.
    """
    return covered_polygons(rollout, report) if rollout.request.hide_covered else None


def covered_polygons(rollout: BakeRollout, report: Reporter = silent) -> HiddenPolygons:
    """Return which polygons of each body the garment covers in the bind pose and in every frame of a shot.

    Raises:
        SsilkError: the character has no body.
    """
    from ssilk_usd.writing.body_faces import HiddenPolygons

    scene = rollout.deformer.scene
    body, frames = scene.character.merged_body().mesh, rollout.motion.frame_count
    found, told = HiddenFaces(body, scene.garment.mesh), Countdown(frames, report)
    for posed, garment in zip(_posed_bodies(rollout), rollout.points(), strict=True):
        found.add(posed, garment)
        told()
    meshes = [each.mesh for each in scene.character.bodies]
    masks = hidden_polygons(found.mask(), meshes)
    hidden, total = sum(int(mask.sum()) for mask in masks), sum(len(mask) for mask in masks)
    text = f"{hidden} of {total} faces of the body are hidden, which the garment covers in every frame"
    report(Message(text if hidden else "no face of the body is covered in every frame; none is hidden"))
    return HiddenPolygons(tuple(masks), rollout.request.receiver.variants)


def _posed_bodies(rollout: BakeRollout) -> Iterator[Floats]:
    """Yield the vertices of all bodies in the world [m], shape (B, 3), in each frame."""
    character, motion = rollout.deformer.scene.character, rollout.motion
    body, skeleton = character.merged_body(), character.skeleton
    for start in range(0, motion.frame_count, CHUNK):
        part = motion.clip(start, min(start + CHUNK, motion.frame_count))
        matrices = skinning_matrices(motion_transforms(part, skeleton.parents), skeleton.bind_transforms)
        yield from np.asarray(skin_points(body_at_rest(character, part), body.skin, matrices))
