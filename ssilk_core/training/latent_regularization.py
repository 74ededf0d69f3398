# SPDX-License-Identifier: Apache-2.0
"""Regularisation of distances between latents by distances between garments (paper, Eq. 13)."""

from __future__ import annotations

from math import log

import torch
from torch import Tensor

from ..model.network import GarmentModel

SMALLEST = 1e-6  # distance of latents, and of garments [m], whose logarithm is finite


def latent_irregularity(model: GarmentModel, mass: Tensor, z: Tensor, scale: float) -> Tensor:
    """Return (log(|x - x'| / (scale |z - z'|)))^2 of each latent z (N, latent) and the next one, shape (N,).

    x are garments in the bind pose, where nothing but their latents tells them apart; their distance is RMS over the
    mass of each vertex (V,) [m], and `scale` is in metres.
    """
    joints = model.scene.character.skeleton.joint_count
    still = torch.eye(3, 4, device=z.device)[None, :, :, None].expand(joints, 3, 4, len(z)).contiguous()
    x = model.vertices(z, still)
    apart = ((x - x.roll(1, dims=-1)) ** 2).sum(1)
    squared = torch.einsum("v,vn->n", mass / mass.sum(), apart)
    latent = (z - z.roll(1, dims=0)).square().sum(1)
    ratio = squared.clamp_min(SMALLEST**2) / latent.clamp_min(SMALLEST**2)
    return (0.5 * ratio.log() - log(scale)) ** 2
