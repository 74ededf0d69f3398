# SPDX-License-Identifier: Apache-2.0
"""Roll a trained garment over a motion of any length, in constant memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
import torch
from torch import Tensor

from ..errors import fail
from ..scene.assets import Floats, GarmentPose, Motion
from ..scene.kinematics import frames_at, motion_transforms, resample, run_up, skinning_matrices, split_at_cuts
from .descriptors import pose_features
from .model.descriptors import motion_descriptors
from .model.feedback import BodyFrames
from .model.network import GarmentModel
from .sampling import sample_pose
from .settings import DIVERGENCE_BOUND, RECOVERY_FRAMES
from .start import GivenStart

CHUNK = 256  # frames decoded at once
HISTORY = 2  # earlier frames that the descriptors of a chunk need
STILL_THRESHOLD = 1e-7  # [rad, m]; a character that moves less holds still
REST_THRESHOLD = 3e-5  # change of a latent in one frame below which it is at rest

OnRecovery = Callable[[range], None]
Roller = Callable[[Motion], Iterator["RolloutBlock"]]


@dataclass(frozen=True, eq=False)
class RolloutBlock:
    """Consecutive frames of a rollout at the model's rate; tensors as `GarmentModel.pose` returns them.

    `recovered` (N,) flags frames whose state diverged: there the garment is at rest, or as its rig skins it.
    """

    start: int
    activation: Tensor
    transforms: Tensor
    recovered: Tensor


def roll(
    model: GarmentModel,
    span: Motion,
    chunk: int = CHUNK,
    *,
    pre_roll: float = 0.0,
    given: GivenStart | None = None,
) -> Iterator[RolloutBlock]:
    """Yield the garment's pose over a motion without cuts, at the model's rate, one chunk at a time.

    The garment starts at rest in the first pose, or `pre_roll` seconds earlier, in the pose of `run_up`; or as given.

    Raises:
        SsilkError: the motion is not at the model's rate.
    """
    starts = range(0, span.frame_count, chunk)
    blocks = (span.clip(start, start + chunk) for start in starts)
    if not pre_roll and given is None:
        return roll_blocks(model, blocks)
    before = run_up(span, pre_roll) if given is None else given.before
    start = () if given is None else tuple(given.states[:, None])
    steps = islice(roll_blocks(model, chain([before], blocks), start), 1, None)
    return (replace(step, start=step.start - before.frame_count) for step in steps)


@torch.no_grad()
def roll_blocks(
    model: GarmentModel, blocks: Iterable[Motion], given: Sequence[Tensor] = ()
) -> Iterator[RolloutBlock]:
    """Yield the garment's pose over each of consecutive blocks of a motion without cuts, at the model's rate.

    A motion of any length needs the memory of one block. A block in which the character holds still and the garment
    is at rest needs the work of one frame. A diverged state is replaced by the quasi-static one for `RECOVERY_FRAMES`
    frames; the rollout then continues from there.

    Args:
        given: states of the first two frames, (1, latent) each; those at rest by default.

    Raises:
        SsilkError: a block is not at the model's rate.
    """
    fps, start = model.config.fps, 0
    past: Motion | None = None
    state: list[Tensor] = []
    for block in blocks:
        if not abs(block.fps - fps) < 1e-6:
            fail(block.path, f"{block.fps:g} frames per second", f"the model steps at {fps:g}")
        seen = block if past is None else block.after(past)
        if _is_at_rest(seen, state):
            states = [state[-1]] * HISTORY
            parts = _decode(model, state[-1], torch.zeros(1, dtype=torch.bool, device=state[-1].device))
            yield RolloutBlock(start, *(part.expand(*part.shape[:-1], block.frame_count) for part in parts))
        else:
            states, diverged = _advance(model, seen, block.frame_count, start, state, given)
            yield RolloutBlock(start, *_decode(model, torch.cat(states[-block.frame_count :]), diverged))
        past, state = seen.clip(max(0, seen.frame_count - HISTORY), seen.frame_count), states[-HISTORY:]
        start += block.frame_count


def _is_at_rest(seen: Motion, state: list[Tensor]) -> bool:
    """Return whether a character holds still in all frames of `seen`, and the garment in the last of `state`."""
    given = (seen.rotations, seen.translations, *seen.felt.values())
    held = max(np.ptp(values, axis=0).max() for values in given) < STILL_THRESHOLD
    return len(state) == HISTORY and held and bool((state[-1] - state[-2]).abs().max() < REST_THRESHOLD)


def _advance(
    model: GarmentModel, seen: Motion, count: int, start: int, state: list[Tensor], given: Sequence[Tensor] = ()
) -> tuple[list[Tensor], Tensor]:
    """Return the states after those in `state`, each (1, latent), and which of the last `count` were diverged.

    The last `count` frames of `seen` are new, those before them are what descriptors look back on.
    """
    parameter, skeleton = next(model.parameters()), model.scene.character.skeleton
    world = motion_transforms(seen, skeleton.parents)
    features = pose_features(seen, skeleton, model.joints, world, model.config.descriptors)
    static, dynamic = (values[-count:] for values in motion_descriptors(features, parameter))
    rest, diverged = _replace_diverged(model.initial(static))
    rest, pose = rest.unsqueeze(1), dynamic.unsqueeze(1)
    starting = min(max(0, HISTORY - start), count)
    body = model.body_frames(seen, world)[max(0, seen.frame_count - count + starting - HISTORY) :]
    begun = given[start : start + starting] or rest[:starting]
    return _roll_and_recover(model, [*state, *begun], rest[starting:], pose[starting:], body, diverged)


def _replace_diverged(states: Tensor) -> tuple[Tensor, Tensor]:
    """Return states (N, latent) with zeros for those that are diverged, and which ones are."""
    diverged = ~(states.abs().amax(dim=1) < DIVERGENCE_BOUND)  # NaN is not less than anything
    return torch.where(diverged[:, None], torch.zeros_like(states), states), diverged


def _roll_and_recover(
    model: GarmentModel, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames, diverged: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Roll over the frames of `rest`, `pose` and `body`; after a diverged state the garment rests, then continues."""
    done = 0
    while done < len(rest):
        rolled = model.roll(states, rest[done:], pose[done:], body[done:])[len(states) :]
        bad = _replace_diverged(torch.cat(rolled))[1].nonzero()
        good = int(bad[0]) if len(bad) else len(rolled)
        first, done = done + good, min(done + good + RECOVERY_FRAMES, len(rest))
        states = [*states, *rolled[:good], *rest[first:done]]
        diverged[len(diverged) - len(rest) + first : len(diverged) - len(rest) + done] = True
    return states, diverged


def _decode(model: GarmentModel, z: Tensor, diverged: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return activations, transforms and which frames were diverged.

    A pose that is not finite becomes the rig's own.
    """
    activation, transforms = model.pose(z)
    bad = ~(activation.isfinite().all(dim=0) & transforms.isfinite().flatten(0, 2).all(dim=0))
    if bad.any():
        at_rest = torch.eye(3, 4, dtype=z.dtype, device=z.device)[:, :, None]
        activation = torch.where(bad, torch.zeros_like(activation), activation)
        transforms = torch.where(bad, at_rest, transforms)
    return activation, transforms, diverged | bad


def ignore_recovery(frames: range) -> None:
    """Ignore the frames that were recovered."""


def garment_poses(
    model: GarmentModel,
    motion: Motion,
    fps: float,
    chunk: int = CHUNK,
    on_recovery: OnRecovery = ignore_recovery,
    *,
    pre_roll: float = 0.0,
    roller: Roller | None = None,
    given: GivenStart | None = None,
) -> Iterator[GarmentPose]:
    """Yield what a shot stores, at `fps`, over a motion of any rate: the frames of `resample(motion, fps)`.

    The model rolls at its own rate; where the shot's differs, rotations are interpolated by slerp and weights by
    lines between the two nearest steps. After a cut of the motion (a root that jumps) the garment restarts from
    the initialiser, `pre_roll` seconds before (see `roll`), and nothing is interpolated across it. `on_recovery` is
    told the shot's frames of which `roll_blocks` had to take the rest state. `roller` takes the place of `roll`, with
    a run-up of its own: it yields blocks of a motion without cuts, at the model's rate. `given` is the state that
    the first of these goes on from.
    """
    first = source_frame = 0
    for span in split_at_cuts(motion, model.scene.character.skeleton):
        stop = frames_at(source_frame + span.frame_count, motion.fps, fps)
        shift = (first / fps - source_frame / motion.fps) * model.config.fps
        seen = resample(span, model.config.fps, cover=True)
        start = given if source_frame == 0 else None
        steps = roller(seen) if roller else roll(model, seen, chunk, pre_roll=pre_roll, given=start)
        poses = _file_poses(model, steps, fps / model.config.fps, shift, range(first, stop), on_recovery)
        for pose in resample_poses(poses, model.config.fps, fps, shift=shift, count=stop - first):
            yield replace(pose, start=first + pose.start)
        first, source_frame = stop, source_frame + span.frame_count


def _file_poses(
    model: GarmentModel,
    steps: Iterable[RolloutBlock],
    rate: float,
    shift: float,
    shot: range,
    on_recovery: OnRecovery,
) -> Iterator[GarmentPose]:
    """Yield what files store of steps, and tell which of the `shot` frames, at `rate` times theirs, are recovered."""
    for step in steps:
        flags = step.recovered.cpu().numpy().astype(int)
        edges = np.flatnonzero(np.diff(flags, prepend=0, append=0)) + step.start
        for start, stop in zip(edges[::2], edges[1::2]):  # all that is interpolated from a recovered frame
            low = int(np.floor((start - 1 - shift) * rate + 1e-6)) + 1
            high = int(np.ceil((stop - shift) * rate - 1e-6))
            if seen := shot[max(low, 0) : max(high, 0)]:
                on_recovery(seen)
        yield GarmentPose(step.start, *model.file_pose(step.activation, step.transforms))


def resample_poses(
    poses: Iterator[GarmentPose], source: float, target: float, *, shift: float = 0.0, count: int
) -> Iterator[GarmentPose]:
    """Yield `count` poses at rate `target` from consecutive poses at rate `source`, keeping one chunk in memory.

    The first lies `shift` source frames after the first given one; outside the given ones the nearest is held.
    """
    done, tail = 0, None
    for pose in poses:
        joined = pose if tail is None else GarmentPose.joined([tail, pose])
        last = joined.start + joined.frame_count - 1
        reached = min(int(np.floor((last - shift) * target / source + 1e-6)) + 1, count)
        position = (done + np.arange(max(reached - done, 0))) * source / target + shift
        if len(position):
            yield sample_pose(joined, position.clip(joined.start, last) - float(joined.start), done)
        done = max(reached, done)
        tail = joined.part(slice(-1, None))


@torch.no_grad()
def decode(model: GarmentModel, motion: Motion, pose: GarmentPose) -> Floats:
    """Return the decoder's own vertices [m], shape (F, V, 3), of poses as a shot stores them.

    `motion` is at the shot's rate. The decoder runs in the model's precision about the frame's root, so that a
    character far from the origin loses none; the root's position is added back in float64.
    """
    skeleton = model.scene.character.skeleton
    world = motion_transforms(motion.clip(pose.start, pose.start + pose.frame_count), skeleton.parents)
    origin = world[:, :1, :3, 3].copy()
    world[..., :3, 3] -= origin
    parameter = next(model.parameters())
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    character = torch.as_tensor(matrices.transpose(1, 2, 3, 0)).to(parameter)
    activation, transforms = (values.to(parameter) for values in model.network_pose(pose))
    x = model.decoder(activation, transforms, character)
    return x.permute(2, 0, 1).double().cpu().numpy() + origin
