# SPDX-License-Identifier: Apache-2.0
"""Latents whose cloth is nearest to given cloth, from which a rollout goes on (Levenberg-Marquardt)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..scene.assets import Floats, Motion
from ..scene.kinematics import motion_transforms
from .descriptors import pose_features
from .model.descriptors import motion_descriptors
from .model.network import GarmentModel

ITERATIONS = 24
STEP = 1e-2  # of a latent, by which derivatives are taken
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e6  # relative to the mean of the normal matrix's diagonal
ENOUGH = 1e-6  # relative gain of a step below which there is no more to gain


@dataclass(frozen=True, eq=False)
class GivenStart:
    """The state that a rollout goes on from, in place of the garment at rest.

    Attributes:
        before: the character one step before the first frame, one frame at the model's rate.
        states: latents there and in the first frame, shape (2, latent).
        left: RMS distance of the first frame's vertices from those that were given, and the largest [m].
    """

    before: Motion
    states: Tensor
    left: tuple[float, float]


def fitted_start(model: GarmentModel, before: Motion, first: Motion, points: Floats) -> GivenStart:
    """Return the start whose cloth is nearest to given cloth.

    Args:
        before, first: one frame each at the model's rate, one step before the first frame and in it.
        points: vertices of the garment in these in world space [m], shape (2, V, 3).
    """
    both = first.after(before)
    skeleton, like = model.scene.character.skeleton, model.decoder.shapes
    world = motion_transforms(both, skeleton.parents)
    features = pose_features(both, skeleton, model.joints, world, model.config.descriptors)
    rest = model.initial(motion_descriptors(features, like)[0]).detach()
    body, origins = model.body_frames(both, world), world[:, skeleton.hub, :3, 3]
    targets = [torch.as_tensor(frame - origin).to(like) for frame, origin in zip(points, origins)]
    now, left = _fitted(model, targets[1], body.matrices[1], rest[1])
    earlier, _ = _fitted(model, targets[0], body.matrices[0], now)
    distance = left.norm(dim=1).double()
    return GivenStart(
        before, torch.stack([earlier, now]), (float(distance.square().mean().sqrt()), float(distance.max()))
    )


@torch.no_grad()
def _fitted(model: GarmentModel, target: Tensor, character: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return the latent (latent,) whose vertices are nearest to `target` (V, 3), and what is left there (V, 3).

    Args:
        character: of the frame, shape (J, 3, 4, 1), about the origin that the target is of.
        start: where the search begins, shape (latent,).
    """
    size, bound = len(start), model.config.latent_bound or np.inf
    repeated = character.expand(*character.shape[:-1], size + 1).contiguous()

    def vertices(z: Tensor) -> Tensor:
        return model.vertices(z, repeated[..., : len(z)].contiguous())

    def missed(z: Tensor) -> tuple[Tensor, float]:
        off = target - vertices(z[None])[..., 0]
        return off, float(off.double().square().sum())

    z, damping = start.clamp(-bound, bound), DAMPING
    off, error = missed(z)
    for _ in range(ITERATIONS):
        steps = torch.cat([z[None], z + STEP * torch.eye(size, dtype=z.dtype, device=z.device)])
        x = vertices(steps).flatten(0, 1).double()
        slopes = (x[:, 1:] - x[:, :1]) / STEP
        normal, pull = slopes.T @ slopes, slopes.T @ off.flatten().double()
        scale, before = normal.diagonal().mean().clamp_min(1e-12), error
        while damping < MOST_DAMPING:
            damped = normal + damping * scale * torch.eye(size, dtype=normal.dtype, device=z.device)
            tried = (z + torch.linalg.solve(damped, pull).to(z)).clamp(-bound, bound)
            found, size_of = missed(tried)
            if size_of < error:
                z, off, error, damping = tried, found, size_of, max(damping / 5, LEAST_DAMPING)
                break
            damping *= 5
        if before - error <= ENOUGH * before:
            break
    return z, off
