# SPDX-License-Identifier: Apache-2.0
"""The motions of a training run or evaluation as tensors on one device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ..errors import fail
from ..network.descriptors import pose_features
from ..network.model.descriptors import gravity_features, seen_gravity, turned_vectors
from ..network.model.feedback import BodyFrames
from ..scene.assets import Motion, Skeleton
from ..scene.kinematics import centred_matrices, resample, split_at_cuts


@dataclass(frozen=True, eq=False)
class MotionBank:
    """Concatenated motions at the model's rate.

    Attributes:
        matrices: skinning matrices of every frame, shape (F, J * 12), translated so that each clip's root starts at
            the origin, where single precision is finest.
        root: position of the skeleton's hub in the same coordinates [m], shape (F, 3).
        static, dynamic, down, earlier: see `descriptors.PoseFeatures`.
        starts, stops: first frame and end of each clip, shape (clips,).
    """

    matrices: Tensor
    root: Tensor
    static: Tensor
    dynamic: Tensor
    down: Tensor
    earlier: Tensor
    starts: Tensor
    stops: Tensor

    @property
    def frame_count(self) -> int:
        return len(self.static)

    @property
    def is_absolute(self) -> bool:
        """Whether the descriptors are those of the paper."""
        return self.earlier.shape[1] > 0

    @property
    def joint_count(self) -> int:
        return self.matrices.shape[1] // 12

    def matrices_at(self, frames: Tensor) -> Tensor:
        """Return skinning matrices (..., J * 12) of frame indices (...,)."""
        return self.matrices[frames]

    def root_at(self, frames: Tensor | slice) -> Tensor:
        """Return the hub's positions (N, 3) in frames (N,) [m]."""
        return self.root[frames]

    def dynamic_at(self, frames: Tensor) -> Tensor:
        """Return what `dynamic` has of frames (N,), shape (N, D)."""
        return self.dynamic[frames]

    def character(self, frames: Tensor) -> Tensor:
        """Return skinning matrices (J, 3, 4, N) of frame indices (N,)."""
        return self.matrices_at(frames).T.reshape(-1, 3, 4, len(frames))

    def body(self, frames: Tensor) -> BodyFrames:
        """Return the character in frames (F, N) of N clips, F consecutive ones of each, about each clip's origin."""
        matrices = self.matrices_at(frames).reshape(*frames.shape, -1, 3, 4).permute(0, 2, 3, 4, 1)
        return BodyFrames(matrices, matrices.new_zeros(len(frames), 3, frames.shape[1]))

    def triples(self, frames: Tensor) -> BodyFrames:
        """Return the character in the two frames before each of `frames` (N,) and in itself, F = 3."""
        return self.body(frames + torch.arange(-2, 1, device=frames.device)[:, None])

    def static_descriptor(self, frames: Tensor, gravity: Tensor) -> Tensor:
        """Return static descriptors (N, S) of frames (N,) under gravity and wind (N, 3) [g]."""
        return torch.cat([self.static[frames], gravity_features(self.down[frames], seen_gravity(gravity))], dim=1)

    def dynamic_descriptor(self, frames: Tensor, gravity: Tensor) -> Tensor:
        """Return dynamic descriptors (N, D) of frames (N,) under gravity and wind (N, 3) [g]."""
        return self.described(self.static_descriptor(frames, gravity), frames, gravity)

    def described(self, static: Tensor, frames: Tensor, gravity: Tensor, heading: Tensor | None = None) -> Tensor:
        """Return dynamic descriptors (N, D) from static ones (N, S) of the same frames and gravity.

        Args:
            heading: of absolute ones, where a motion is turned (`turned_vectors`); as it is without.
        """
        dynamic = self.dynamic_at(frames)
        if heading is not None:
            dynamic = turned_vectors(dynamic, gravity, heading)
        earlier = gravity_features(self.earlier[frames], seen_gravity(gravity))
        return torch.cat([static, earlier, dynamic], dim=1)


def build_bank(
    motions: Sequence[Motion],
    skeleton: Skeleton,
    joints: np.ndarray,
    fps: float,
    device: torch.device,
    *,
    max_joint_speed: float = np.inf,
    kind: str = "relative",
) -> MotionBank:
    """Resample the spans of `usable_spans` to `fps` and copy them to a device, with descriptors of a kind.

    Raises:
        SsilkError: there is no motion.
    """
    spans = needed_spans(motions, skeleton, fps, max_joint_speed)
    return MotionBank(
        **bank_tensors((arrays_of(resample(span, fps), skeleton, joints, kind) for span in spans), device)
    )


def needed_spans(
    motions: Sequence[Motion], skeleton: Skeleton, fps: float, max_joint_speed: float = np.inf
) -> list[Motion]:
    """Return the result of `usable_spans`; raise `SsilkError` where there is none."""
    if not motions:
        fail("motions", "none given", "at least one is needed", "name motion files with --motions")
    spans = usable_spans(motions, skeleton, fps, max_joint_speed)
    if not spans:
        fail(motions[0].path, "every motion is shorter than four frames", "longer ones are needed")
    return spans


def bank_tensors(clips: Iterable[dict[str, np.ndarray]], device: torch.device) -> dict[str, Tensor]:
    """Return what a bank has, from what each of its clips has in single precision, by name."""
    # Clip by clip: a large bank in double precision does not fit a host.
    parts = list(clips)
    ends = np.cumsum([len(part["root"]) for part in parts])
    starts = np.concatenate([[0], ends[:-1]])

    def joined(name: str) -> Tensor:
        return torch.as_tensor(np.concatenate([part.pop(name) for part in parts]), device=device)

    found = {name: joined(name) for name in [*parts[0]]}
    return {
        **found,
        "starts": torch.as_tensor(starts, device=device),
        "stops": torch.as_tensor(ends, device=device),
    }


def arrays_of(clip: Motion, skeleton: Skeleton, joints: np.ndarray, kind: str) -> dict[str, np.ndarray]:
    """Return what a `MotionBank` has of the frames of one clip, by name, in single precision."""
    features = pose_features(clip, skeleton, joints, kind=kind)
    matrices, root = skinned(clip, skeleton)
    values = {
        "matrices": matrices[:, :, :3].reshape(len(matrices), -1),
        "root": root,
        "static": features.static,
        "dynamic": features.dynamic,
        "down": features.down,
        "earlier": features.earlier,
    }
    return {name: value.astype(np.float32) for name, value in values.items()}


def skinned(clip: Motion, skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Return skinning matrices (F, J, 4, 4) about where the root starts, and the hub's positions (F, 3) [m]."""
    matrices = centred_matrices(clip, skeleton)[0]
    hub = matrices[:, skeleton.hub]
    return matrices, hub[:, :3, :3] @ skeleton.bind_transforms[skeleton.hub, :3, 3] + hub[:, :3, 3]


def usable_spans(
    motions: Sequence[Motion], skeleton: Skeleton, fps: float, max_joint_speed: float = np.inf
) -> list[Motion]:
    """Return the clips of a bank: spans between cuts with at least four frames at `fps`.

    Motions are cut where the hub jumps, and where a joint turns faster than `max_joint_speed` [rad/s].
    """
    spans = [span for motion in motions for span in split_at_cuts(motion, skeleton, max_joint_speed=max_joint_speed)]
    return [span for span in spans if (span.frame_count - 1) * fps >= 3 * span.fps]


class LatentModel(Protocol):
    """A model that can be scored: `GarmentModel`, or another with states of shape (N, S) and these methods."""

    def initial(self, static: Tensor) -> Tensor: ...

    def roll(self, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames) -> list[Tensor]: ...

    def vertices(self, z: Tensor, character: Tensor, /) -> Tensor: ...


@torch.no_grad()
def roll_states(model: LatentModel, bank: MotionBank, clips: Sequence[range], down: Tensor) -> list[Tensor]:
    """Roll out a model over ranges of a bank in parallel, each from its quasi-static start.

    Returns:
        For each range its states, shape (frames, latent).
    """
    offset = torch.arange(max(map(len, clips)), device=down.device)[:, None]
    first, last = (torch.tensor([clip[end] for clip in clips], device=down.device) for end in (0, -1))
    frames = torch.minimum(first + offset, last)  # shorter ranges repeat their last frame
    direction = down.expand(frames.numel(), 3)
    static = bank.static_descriptor(frames.reshape(-1), direction)
    pose = bank.dynamic_descriptor(frames.reshape(-1), direction)
    rest, pose = (values.reshape(*frames.shape, -1) for values in (model.initial(static), pose))
    states = torch.stack(model.roll([*rest[:2]], rest[2:], pose[2:], bank.body(frames)))
    return [states[: len(clip), index] for index, clip in enumerate(clips)]
