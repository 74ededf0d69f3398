# SPDX-License-Identifier: Apache-2.0
"""All energies of consecutive frames, for validation and evaluation."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from ..collision import PosedBody
from ..constants import GRAVITY
from .garment import GarmentEnergy

FRAMES_PER_CHUNK = 256  # frames in memory at once


class ContactDistances(Protocol):
    """What tells distances to what a garment lies on, as `Contacts` does."""

    def distances(self, x: Tensor, body: PosedBody, /) -> tuple[Tensor, Tensor]: ...


def energy_terms(
    energy: GarmentEnergy,
    x: Tensor,
    lbs: Tensor,
    contacts: ContactDistances,
    body: PosedBody,
    joined: Tensor,
    fps: float,
    down: Tensor,
) -> dict[str, Tensor]:
    """Return each of `TERMS` [J], and the share of vertices inside the body as "collisions", shape (N,).

    The share counts vertices inside any part of the body, also where the energy lets them touch only one part.

    Args:
        x, lbs: positions (V, 3, N); gravity is that of `x` minus that of `lbs`, and tethers end at `lbs`.
        joined: up to two earlier frames, then `x`. Inertia is zero where two earlier frames are missing.
        down: direction of gravity, shape (3,).
    """
    contact_distance, body_distance = contacts.distances(energy.cloth.positions(x), body)
    inertia = energy.inertia(joined[..., 2:], 2 * joined[..., 1:-1] - joined[..., :-2], 1 / fps)
    return {
        "stretch": energy.stretch(x),
        "bending": energy.bending(x),
        "gravity": energy.gravity(x - lbs, GRAVITY * down[:, None]),
        "inertia": torch.cat([inertia.new_zeros(x.shape[-1] - len(inertia)), inertia]),
        "collision": energy.collision_at(contact_distance),
        "tether": energy.tether(x, lbs[energy.tethered]),
        "stitch": energy.stitch(x),
        "collisions": (body_distance[: len(x)] < 0).double().mean(0),
    }
