# SPDX-License-Identifier: Apache-2.0
"""Whether a network's own past comes back louder: the closed loop of single steps, linearised. It needs no reference.

A step maps the two states before it to the next one, z_t = F(z_{t-2}, z_{t-1}), under the pose at t. What S sees of
the cloth is decoded from these states too and belongs to F. With S2 = dF/dz_{t-2} and S1 = dF/dz_{t-1}, a small
disturbance of both states goes on as

    (dz_{t-1}, dz_t) = [[0, I], [S2, S1]] (dz_{t-2}, dz_{t-1})

The spectral radius of this matrix is its growth in one step once the same step is repeated for ever. Above one the
loop is unstable there; far below one it forgets its past at once, as heavily damped cloth does. Poses change from
step to step, and the matrix is not symmetric, so a rollout may grow for a while where each radius is below one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...network.model.feedback import BodyFrames
from ...training.motion_bank import LatentModel
from .figures import ClosedLoop
from .methods import Network

LOOK_BACK = 2  # states that a step follows from


def step_derivatives(
    model: LatentModel, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor, body: BodyFrames
) -> tuple[Tensor, Tensor]:
    """Return dz_t/dz_{t-2} and dz_t/dz_{t-1} of one step, each of shape (m, m).

    Args:
        before, now: z_{t-2} and z_{t-1}, shape (m,).
        rest: quasi-static latents at t, shape (m,).
        pose: dynamic descriptor at t, shape (D,).
        body: one character in the frames t - 2, t - 1 and t.
    """
    size = len(now)
    alike = BodyFrames(
        *(values.expand(*values.shape[:-1], size) for values in (body.matrices.detach(), body.bend.detach()))
    )
    with torch.enable_grad():
        # A copy of the step for each latent, so that one pass backward gives all rows.
        states = [z.detach().expand(size, -1).clone().requires_grad_(True) for z in (before, now)]
        found = model.roll(states, rest.detach().expand(1, size, -1), pose.detach().expand(1, size, -1), alike)[-1]
        if not found.requires_grad:  # a scheme without a past
            return torch.zeros_like(states[0]).detach(), torch.zeros_like(states[1]).detach()
        own = found.diagonal().sum()
        by_before, by_now = torch.autograd.grad(own, states, allow_unused=True, materialize_grads=True)
    return by_before, by_now


def spectral_radius(by_before: Tensor, by_now: Tensor) -> float:
    """Return the largest absolute value of the eigenvalues of [[0, I], [S2, S1]]; infinite unless S1, S2 are finite.

    Args:
        by_before, by_now: S2 and S1, shape (m, m).
    """
    size = len(by_now)
    loop = torch.zeros(2 * size, 2 * size, dtype=torch.float64)
    loop[:size, size:] = torch.eye(size)
    loop[size:, :size], loop[size:, size:] = by_before.double().cpu(), by_now.double().cpu()
    if not bool(loop.isfinite().all()):
        return float("inf")
    return float(torch.linalg.eigvals(loop).abs().max())


def closed_loop(network: Network, takes: Sequence[int], count: int) -> ClosedLoop | None:
    """Linearise the steps of a network's own rollouts, in frames that are spread over takes.

    Args:
        count: of frames, at most.

    Returns:
        None where no take has a third frame.
    """
    every = [(take, frame) for take in takes for frame in range(LOOK_BACK, network.take_set.takes[take].frame_count)]
    if not (every and count):
        return None
    places = np.unique(((np.arange(count) + 0.5) / count * len(every)).astype(int))
    radii = [_radius(network, *every[place]) for place in places]
    return ClosedLoop(states=len(radii), median_radius=float(np.median(radii)), max_radius=max(radii))


@torch.no_grad()
def _radius(network: Network, take: int, frame: int) -> float:
    model, bank, states = network.model, network.take_set.bank, network.states[take]
    at = network.take_set.frames(take, range(frame, frame + 1))
    down = network.down.expand(1, 3)
    rest, pose = model.initial(bank.static_descriptor(at, down))[0], bank.dynamic_descriptor(at, down)[0]
    return spectral_radius(
        *step_derivatives(model, states[frame - 2], states[frame - 1], rest, pose, bank.triples(at))
    )
