# SPDX-License-Identifier: Apache-2.0
"""Roll a trained garment over a motion of any length, in constant memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from .assets import Floats, GarmentPose, Motion
from .errors import need
from .kinematics import frames_at, motion_transforms, resample, skinning_matrices, slerp, split_at_cuts
from .model.descriptors import gravity_features, pose_features
from .model.network import GarmentModel

CHUNK = 256  # frames decoded at once
HISTORY = 2  # frames before a chunk that its descriptors look back on
DOWN = (0.0, -1.0, 0.0)


@dataclass(frozen=True, eq=False)
class Step:
    """Consecutive frames of a rollout at the model's rate; tensors as `GarmentModel.pose` returns them."""

    start: int
    activation: Tensor
    rotations: Tensor


@torch.no_grad()
def roll(model: GarmentModel, span: Motion, chunk: int = CHUNK) -> Iterator[Step]:
    """Yield the garment's pose over a motion without cuts, at the model's rate, some frames at a time.

    Raises:
        SsilkError: the motion is not at the model's rate.
    """
    fps = model.config.fps
    need(abs(span.fps - fps) < 1e-6, span.path, f"{span.fps:g} frames per second", f"the model steps at {fps:g}")
    state: list[Tensor] = []
    for start in range(0, span.frame_count, chunk):
        stop = min(start + chunk, span.frame_count)
        states = _advance(model, span, start, stop, state)
        state = states[-2:]
        yield Step(start, *model.pose(torch.cat(states[-(stop - start) :])))


def _advance(model: GarmentModel, span: Motion, start: int, stop: int, state: list[Tensor]) -> list[Tensor]:
    """Return the states up to frame `stop`, each (1, latent), after those in `state`."""
    before = min(start, HISTORY)
    device = next(model.parameters()).device
    features = pose_features(span.clip(start - before, stop), model.scene.character.skeleton, model.joints)

    def tensor(values: Floats) -> Tensor:
        return torch.as_tensor(values[before:], dtype=torch.float32, device=device)

    down = torch.tensor(DOWN, device=device).expand(stop - start, 3)
    static = torch.cat([tensor(features.static), gravity_features(tensor(features.down), down)], dim=1)
    dynamic = torch.cat([static, tensor(features.dynamic)], dim=1)
    rest, pose = model.initial(static).unsqueeze(1), dynamic.unsqueeze(1)
    resting = max(0, HISTORY - start)
    return model.roll([*state, *rest[:resting]], rest[resting:], pose[resting:])


def garment_poses(model: GarmentModel, motion: Motion, fps: float, chunk: int = CHUNK) -> Iterator[GarmentPose]:
    """Yield what a shot stores, at `fps`, over a motion of any rate: the frames of `resample(motion, fps)`.

    The model rolls at its own rate; where the shot's differs, rotations are interpolated by slerp and weights by
    lines between the two nearest steps. After a cut of the motion (a root that jumps) the garment starts anew from
    the initialiser, and nothing is interpolated across it.
    """
    first = source_frame = 0
    for span in split_at_cuts(motion):
        stop = frames_at(source_frame + span.frame_count, motion.fps, fps)
        steps = roll(model, resample(span, model.config.fps, cover=True), chunk)
        poses = (GarmentPose(step.start, *model.file_pose(step.activation, step.rotations)) for step in steps)
        shift = (first / fps - source_frame / motion.fps) * model.config.fps
        for pose in resample_poses(poses, model.config.fps, fps, shift=shift, count=stop - first):
            yield replace(pose, start=first + pose.start)
        first, source_frame = stop, source_frame + span.frame_count


def resample_poses(
    poses: Iterator[GarmentPose], source: float, target: float, *, shift: float = 0.0, count: int
) -> Iterator[GarmentPose]:
    """Yield `count` poses at rate `target` from consecutive poses at rate `source`, keeping one chunk in memory.

    The first lies `shift` source frames after the first given one; outside the given ones the nearest is held.
    """
    done, tail = 0, None
    for pose in poses:
        joined = pose if tail is None else _joined(tail, pose)
        last = joined.start + joined.frame_count - 1
        reached = min(int(np.floor((last - shift) * target / source + 1e-6)) + 1, count)
        position = (done + np.arange(max(reached - done, 0))) * source / target + shift
        if len(position):
            yield _sampled(joined, position.clip(joined.start, last) - float(joined.start), done)
        done = max(reached, done)
        tail = GarmentPose(last, joined.rotations[-1:], joined.weights[-1:])


def _joined(a: GarmentPose, b: GarmentPose) -> GarmentPose:
    return GarmentPose(a.start, np.concatenate([a.rotations, b.rotations]), np.concatenate([a.weights, b.weights]))


def _sampled(pose: GarmentPose, position: Floats, start: int) -> GarmentPose:
    low = np.minimum(position.astype(int), pose.frame_count - 1)
    high = np.minimum(low + 1, pose.frame_count - 1)
    t = position - low
    rotations = slerp(pose.rotations[low], pose.rotations[high], t[:, None])
    weights = pose.weights[low] * (1 - t[:, None]) + pose.weights[high] * t[:, None]
    return GarmentPose(start, rotations, weights.clip(0, 1))


@torch.no_grad()
def decode(model: GarmentModel, motion: Motion, pose: GarmentPose) -> Floats:
    """Return the decoder's own vertices [m], shape (F, V, 3), of poses as a shot stores them.

    `motion` is at the shot's rate. The decoder runs in float32 about the frame's root, so that a character far
    from the origin loses no precision; the root's position is added back in float64.
    """
    skeleton = model.scene.character.skeleton
    world = motion_transforms(motion.clip(pose.start, pose.start + pose.frame_count), skeleton.parents)
    origin = world[:, :1, :3, 3].copy()
    world[..., :3, 3] -= origin
    device = next(model.parameters()).device
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    character = torch.as_tensor(matrices.transpose(1, 2, 3, 0), dtype=torch.float32, device=device)
    x = model.decoder(*model.network_pose(pose), character)
    return x.permute(2, 0, 1).double().cpu().numpy() + origin
