# SPDX-License-Identifier: Apache-2.0
"""Where a garment comes to rest when its character stands still.

Energies of a moving garment hardly tell whether it will: a stepper that holds cloth up for ever, in a state of its
own making, costs little while the clip moves on. Holding poses for a few seconds shows it, for the price of one
decoding of each.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..model.network import GarmentModel
from .bank import MotionBank

HOLD = 3.0  # [s]


@torch.no_grad()
def rest_distance(
    model: GarmentModel, bank: MotionBank, frames: Tensor, states: tuple[Tensor, Tensor], *, seconds: float = HOLD
) -> Tensor:
    """Return the RMS distance of the garment from its quasi-static state [m] after poses were held, shape (N,).

    Zero is a garment that comes to rest where the initialiser has it (Eq. 1), whatever it came from.

    Args:
        bank: at the model's rate.
        frames: the poses to hold, indices into the bank (N,).
        states: latents of the frame before and of the frame itself, each (N, latent): a rollout's own, or any others.
        seconds: how long poses are held.
    """
    down = states[1].new_tensor([0.0, -1.0, 0.0]).expand(len(frames), 3)
    static = bank.static_descriptor(frames, down)
    still = torch.cat([static, torch.zeros_like(bank.dynamic[frames])], dim=1)
    rest, steps = model.initial(static), round(seconds * model.config.fps)
    *_, last = model.roll([*states], rest.expand(steps, *rest.shape), still.expand(steps, *still.shape))
    character = bank.character(frames)
    return (model.vertices(last, character) - model.vertices(rest, character)).square().sum(1).mean(0).sqrt()


def spread_poses(
    clips: Sequence[range], states: Sequence[Tensor], count: int
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Choose `count` frames of each clip, evenly spread, for `rest_distance` to hold.

    Args:
        clips: ranges of a bank.
        states: latents of each clip's rollout (frames, latent), as `validation.roll_states` returns them.

    Returns:
        Indices of the frames (N,), and the latents before and at them, each (N, latent).
    """
    places = [torch.linspace(1, len(clip) - 1, count, device=own.device).long() for clip, own in zip(clips, states)]
    frames = torch.cat([clip.start + place for clip, place in zip(clips, places)])
    before, now = (torch.cat([own[place - back] for own, place in zip(states, places)]) for back in (1, 0))
    return frames, (before, now)
