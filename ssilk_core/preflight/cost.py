# SPDX-License-Identifier: Apache-2.0
"""What a training will ask of the machine, and which joints it will look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..assets import Motion, Scene
from ..config import Preset, TrainConfig
from ..events import format_seconds
from ..kinematics import quaternion_from_matrix
from .finding import Finding, Findings, joint_leaves, listing

# Seconds that one vertex in one frame takes, in a whole optimiser step of a garment of 2,700 vertices. Measured:
# "draft", 64 frames, 0.2 s on two CPU threads; "preview", 1,280 frames, 3.7 ms on one H100. Devices that nobody has
# measured are not listed.
SECONDS_PER_VERTEX = {"cpu": 0.2 / (2700 * 64), "cuda": 0.0037 / (2700 * 1280)}


def training_cost(scene: Scene, motions: Sequence[Motion], preset: Preset) -> Findings:
    """Yield what training needs in memory and time here, and the joints that cannot matter to the garment.

    `motions` may be empty; the reach of the garment is then that of the rest pose.
    """
    from ..collision import reachable_body

    reach = reachable_body(scene, motions or [rest_motion(scene)])
    yield from memory(scene, preset, len(reach.vertices))
    yield from irrelevant_joints(scene, reach.joints)


def memory(scene: Scene, preset: Preset, body_vertices: int) -> Findings:
    """Yield how much memory and time a preset takes with a garment that reaches `body_vertices`."""
    from ..devices import select_device
    from ..memory import decoded_frames, fitting_batch, free_memory, step_memory

    model, train, device = preset.model, preset.train, select_device("auto")
    free = free_memory(device)
    needed = step_memory(scene, model, decoded_frames(train, train.batch), body_vertices)
    batch, pretraining_batch = fitting_batch(scene, model, train, body_vertices, free)
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
        why="smaller batches learn more slowly for each step" if lowered else "",
        fix="free memory, take another device, or a smaller preset" if lowered else "",
    )
    seconds = training_seconds(scene.garment.mesh.vertex_count, train, device.type)
    found = f"preset '{preset.name}' takes about {format_seconds(seconds)} on {device}" if seconds else (
        f"the time that preset '{preset.name}' takes is not known: training was never measured on {device}"
    )  # fmt: skip
    why = (
        "scaled by vertices and frames from a garment of 2,700 vertices on two CPU threads or one H100; "
        "yours may differ by half"
    )
    yield Finding(severity="info", code="time", prim=scene.garment.mesh.path, found=found, why=why if seconds else "")


def training_seconds(vertices: int, train: TrainConfig, device: str) -> float | None:
    """Return how long a training takes [s], by measured speed; None for a device that was not measured."""
    if device not in SECONDS_PER_VERTEX:
        return None
    trained = (
        train.batch * (train.window - 2) + train.static_batch
    )  # frames of a step, those that windows begin at left out
    proper = (train.iterations - train.static_iterations) * trained
    return SECONDS_PER_VERTEX[device] * vertices * (train.static_iterations * train.pretraining_batch + proper)


def irrelevant_joints(scene: Scene, colliding: np.ndarray) -> Findings:
    """Yield the joints that neither carry the garment nor move the body that it reaches (flags `colliding`, (J,))."""
    from ..model.network import model_joints

    skeleton = scene.character.skeleton
    unseen = np.setdiff1d(np.arange(skeleton.joint_count), model_joints(scene, colliding))
    if len(unseen):
        yield Finding(
            severity="info",
            code="irrelevant-joints",
            prim=skeleton.path,
            count=len(unseen),
            found=f"{joint_leaves(skeleton, unseen)} cannot matter to the garment",
            why="they neither carry it nor move a part of the body that it reaches; the network does not see them",
            elements="joints",
            indices=listing(unseen),
        )


def rest_motion(scene: Scene) -> Motion:
    """Return the rest pose as a motion of one frame."""
    rest = scene.character.skeleton.rest_transforms
    return Motion(
        scene.character.skeleton.path, 1.0, quaternion_from_matrix(rest[None, :, :3, :3]), rest[None, :, :3, 3]
    )
