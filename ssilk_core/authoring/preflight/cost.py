# SPDX-License-Identifier: Apache-2.0
"""Estimate the memory and time of a training, and find the joints that it ignores."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...events import format_seconds
from ...scene.assets import Motion, Scene
from ...scene.kinematics import quaternion_from_matrix
from ...training.prediction import training_seconds
from ...training.settings import Preset
from .finding import Finding, Findings, format_joints, index_tuple

LONG = 3600.0  # [s], a training that is warned of


def training_cost(scene: Scene, motions: Sequence[Motion], preset: Preset) -> Findings:
    """Yield the memory and time that training needs on this machine, and the joints that cannot affect the garment.

    If `motions` is empty, the rest pose determines which part of the body the garment can touch.
    """
    from ...physics.reach import reachable_body

    reach = reachable_body(scene, motions or [rest_motion(scene)])
    yield from memory(scene, preset, len(reach.vertices))
    yield from irrelevant_joints(scene, reach.joints)


def memory(scene: Scene, preset: Preset, body_vertices: int) -> Findings:
    """Yield the memory and time that a preset takes when the garment can touch `body_vertices` vertices."""
    from ...devices import busy_cores, kept_busy, usual_device
    from ...scene.fabrics import FABRICS
    from ...training.memory import StepMemory, decoded_frames, free_memory

    model, train, device = preset.model, preset.train, usual_device()
    free = free_memory(device)
    step = StepMemory.of(scene, model, train, FABRICS["default"], body_vertices)
    needed = step.needed(decoded_frames(train, train.batch))
    batch, pretraining_batch = step.fitting_batch(train, free)
    lowered = (batch, pretraining_batch) != (train.batch, train.pretraining_batch)
    note = (
        f"; the batch is reduced from {train.batch} to {batch} windows "
        f"and from {train.pretraining_batch} to {pretraining_batch} poses"
    )
    yield Finding(
        severity="warning" if lowered else "info",
        code="memory",
        prim=scene.garment.mesh.path,
        found=f"preset '{preset.name}' needs about {needed / 2**30:.2g} of {free / 2**30:.2g} GiB free on {device}"
        + (note if lowered else ""),
        why="training progresses more slowly per step with smaller batches" if lowered else "",
        fix="free memory, or choose another device or a smaller preset" if lowered else "",
    )
    seconds = training_seconds(step.samples, train, device)
    found = f"preset '{preset.name}' takes about {format_seconds(seconds)} on {device}" if seconds else (
        f"the time that preset '{preset.name}' takes is unknown: training has not been measured on {device}"
    )  # fmt: skip
    why = (
        "scaled by contact samples and frames from a garment on two CPU threads or several on a shared GPU; "
        "the actual time may differ by half"
    )
    if device == "cpu" and (others := kept_busy(busy_cores())):
        why += f", and {others} now, so that it takes longer as long as they do"
    long = seconds is not None and seconds > LONG
    yield Finding(
        severity="warning" if long else "info",
        code="time",
        prim=scene.garment.mesh.path,
        found=found,
        why=why if seconds else "",
        fix="take a smaller preset, give minutes instead of iterations, or train on a GPU" if long else "",
    )


def irrelevant_joints(scene: Scene, colliding: np.ndarray) -> Findings:
    """Yield the joints that neither carry the garment nor move the body where it can touch it.

    `colliding` flags the joints that move that part of the body, shape (J,).
    """
    from ...network.descriptors import model_joints

    skeleton = scene.character.skeleton
    unseen = np.setdiff1d(np.arange(skeleton.joint_count), model_joints(scene, colliding))
    if len(unseen):
        yield Finding(
            severity="info",
            code="irrelevant-joints",
            prim=skeleton.path,
            count=len(unseen),
            found=f"{format_joints(skeleton, unseen)} cannot affect the garment",
            why="they neither carry it nor move a part of the body that it can touch; the network ignores them",
            elements="joints",
            indices=index_tuple(unseen),
        )


def rest_motion(scene: Scene) -> Motion:
    """Return the rest pose as a motion of one frame."""
    rest = scene.character.skeleton.rest_transforms
    return Motion(
        scene.character.skeleton.path, 1.0, quaternion_from_matrix(rest[None, :, :3, :3]), rest[None, :, :3, 3]
    )
