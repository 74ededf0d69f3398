# SPDX-License-Identifier: Apache-2.0
"""Pose descriptors of the baselines: features of each joint by itself, made from those of a motion bank.

They have the symmetries of `ssilk_core.network.descriptors`, so that turning gravity replaces turning the character
here too. The root's orientation enters as gravity's direction in its frame. Its heading and its place do not enter.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ssilk_core.network.descriptors import RATE_TIME
from ssilk_core.training.motion_bank import MotionBank

STILL, MOVING, ROOT = 9, 12, 3
"""Features of a joint at rest and in motion, and of the root's motion."""


def split_features(pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Split dynamic descriptors (..., D) into static ones (..., 9 J), rates (..., J, 12) and the root's (..., 3)."""
    joints = (pose.shape[-1] - ROOT) // (STILL + MOVING)
    still, moving, root = pose.split([STILL * joints, MOVING * joints, ROOT], dim=-1)
    return still, moving.unflatten(-1, (joints, MOVING)), root


@dataclass(frozen=True, eq=False)
class JointBank(MotionBank):
    """A bank whose descriptors are the baselines'.

    Attributes:
        local: 6D local rotations, for roots the identity, shape (F, J, 6).
        rates: first differences of those, of the first root its rotation, and accelerations in each joint's own
            frame, shape (F, J, 9).
        turning: first differences of `down`, shape (F, J, 3, 3).
        velocity: of the first joint, in its own frame [m/s], shape (F, 3).
    """

    local: Tensor
    rates: Tensor
    turning: Tensor
    velocity: Tensor

    def static_descriptor(self, frames: Tensor, direction: Tensor) -> Tensor:
        """Return 6D rotation and gravity's direction in each joint's frame, shape (N, 9 J)."""
        return torch.cat([self.local[frames], _in_frames(self.down[frames], direction)], dim=2).flatten(1)

    def dynamic_descriptor(self, frames: Tensor, direction: Tensor) -> Tensor:
        """Return the static ones, then 12 rates of each joint (gravity's last), then the root's velocity."""
        gravity = _in_frames(self.turning[frames], direction)
        moving = torch.cat([self.rates[frames], gravity], dim=2).flatten(1)
        return torch.cat([self.static_descriptor(frames, direction), moving, self.velocity[frames]], dim=1)


def _in_frames(frames: Tensor, direction: Tensor) -> Tensor:
    """Return directions (N, 3) in the frames of joints, given as matrices (N, J, 3, 3), shape (N, J, 3)."""
    return torch.einsum("njab,nb->nja", frames, direction)


def joint_bank(bank: MotionBank, inner: Tensor, fps: float) -> JointBank:
    """Return a bank with the baselines' descriptors.

    Args:
        bank: at `fps`.
        inner: flags of the joints in view that have a parent, shape (J,).
    """
    frames, joints, count = bank.frame_count, len(inner), int(inner.sum())
    local = bank.static.new_tensor([1, 0, 0, 0, 1, 0]).repeat(frames, joints, 1)
    local[:, inner] = bank.static.unflatten(1, (count, 6))
    # A bank's rates: first and second differences, two turns of the root, then accelerations in the root's frame.
    first, _, turn, _, pushed = bank.dynamic.split([6 * count, 6 * count, 6, 6, 3 * joints], dim=1)
    rates = torch.zeros_like(local)
    rates[:, 0] = turn
    rates[:, inner] = first.unflatten(1, (count, 6))
    from_root = bank.down @ bank.down[:, :1].mT
    own = (from_root @ pushed.unflatten(1, (joints, 3, 1))).squeeze(-1)
    velocity = _differences(bank, bank.root) * fps
    return JointBank(
        **vars(bank),
        local=local,
        rates=torch.cat([rates, own], dim=2),
        turning=_differences(bank, bank.down) * fps * RATE_TIME,
        velocity=(bank.down[:, 0] @ velocity[:, :, None]).squeeze(-1),
    )


def _differences(bank: MotionBank, values: Tensor) -> Tensor:
    """Return backward differences of frames; zero in the first frame of each clip."""
    steps = torch.zeros_like(values)
    steps[1:] = values[1:] - values[:-1]
    steps[bank.starts] = 0
    return steps
