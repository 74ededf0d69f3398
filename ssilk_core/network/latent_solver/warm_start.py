# SPDX-License-Identifier: Apache-2.0
"""Where a frame's solve starts: the network's own step from the solver's past two states, or on their course."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.feedback import BodyFrames
from ..model.network import GarmentModel


@dataclass(frozen=True, eq=False)
class FrameDescriptors:
    """What the network sees of N frames' poses.

    Attributes:
        rest: quasi-static latents P(theta_t), shape (N, m).
        pose: dynamic descriptors, shape (N, D).
    """

    rest: Tensor
    pose: Tensor


@torch.no_grad()
def network_step(
    model: GarmentModel, before: Tensor, now: Tensor, seen: FrameDescriptors, body: BodyFrames
) -> Tensor:
    """Return the network's state (N, m) after two states (N, m) of any precision. Nothing else here steps it.

    Args:
        body: the character in the frames of both states and in the next one, F = 3.
    """
    dtype = seen.rest.dtype
    last, latest = before.to(dtype), now.to(dtype)
    cloth = model.seen_from(last, latest, BodyFrames(body.matrices.to(dtype), body.bend.to(dtype)))
    return model.step(last, latest, seen.rest, seen.pose, cloth).to(now.dtype)


def warm_starts(
    model: GarmentModel, before: Tensor, now: Tensor, seen: FrameDescriptors, body: BodyFrames
) -> list[Tensor]:
    """Return latents (N, m) that a frame may start from: on the course of the two states before it, which inertia
    has most often nearer, and the network's step, which knows what moves the garment."""
    return [2 * now - before, network_step(model, before, now, seen, body)]
