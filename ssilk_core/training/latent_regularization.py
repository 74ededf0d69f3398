# SPDX-License-Identifier: Apache-2.0
"""Regularisation of distances between latents by distances between garments (paper, Eq. 13)."""

from __future__ import annotations

from math import log

import torch
from torch import Tensor

from ..network.model.network import GarmentModel

# RMS distance between garments for each unit of distance between their latents [m]. The loss asks for this ratio;
# no training needed another.
LATENT_SCALE = 0.03
MIN_DISTANCE = 1e-6  # floor for distances of latents, and of garments [m], before the logarithm


def latent_distortion(model: GarmentModel, mass: Tensor, z: Tensor, scale: float) -> Tensor:
    """Return (log(|x - x'| / (scale |z - z'|)))^2 of each latent z (N, latent) and the next one, shape (N,).

    x are the garments of these latents in the bind pose; their distance is RMS, weighted by the mass of each vertex
    (V,) [m], and `scale` is in metres.
    """
    joints = model.scene.character.skeleton.joint_count
    still = torch.eye(3, 4, device=z.device)[None, :, :, None].expand(joints, 3, 4, len(z)).contiguous()
    x = model.vertices(z, still)
    apart = ((x - x.roll(1, dims=-1)) ** 2).sum(1)
    squared = torch.einsum("v,vn->n", mass / mass.sum(), apart)
    latent = (z - z.roll(1, dims=0)).square().sum(1)
    ratio = squared.clamp_min(MIN_DISTANCE**2) / latent.clamp_min(MIN_DISTANCE**2)
    return (0.5 * ratio.log() - log(scale)) ** 2
