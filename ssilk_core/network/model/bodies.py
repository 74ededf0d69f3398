# SPDX-License-Identifier: Apache-2.0
"""`network.bodies` in PyTorch, for training: a network that sees which body of a family it is on."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ...scene.family import DressedFamily
from ..bodies import SEEING


class SeenBody(nn.Module):
    """Adds to a layer's biases (H,) what a body at coordinates `place` (K,) adds; nothing at first."""

    place: Tensor

    def __init__(self, units: int, size: int) -> None:
        super().__init__()
        self.columns = nn.Parameter(torch.zeros(units, size))
        self.register_buffer("place", torch.zeros(size), persistent=False)

    def forward(self, bias: Tensor) -> Tensor:
        """Return the biases on that body."""
        return bias + self.columns @ self.place


class WornCloth(nn.Module):
    """Where the garment and its proxies lie on each body of a family."""

    rest: Tensor
    pivots: Tensor
    cloth_moves: Tensor
    proxy_moves: Tensor

    def __init__(self, family: DressedFamily, rest: Tensor, pivots: Tensor) -> None:
        super().__init__()
        moves = {"cloth_moves": family.cloth_moves.copy(), "proxy_moves": family.proxy_moves.copy()}
        for name, values in moves.items():
            self.register_buffer(name, torch.from_numpy(values).float().to(rest.device), persistent=False)
        self.register_buffer("rest", rest.clone(), persistent=False)
        self.register_buffer("pivots", pivots.clone(), persistent=False)

    def at(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Return vertices (V, 3) and proxies (P, 3) on the body at coordinates (K,) [m]."""
        return (
            self.rest + torch.tensordot(place, self.cloth_moves, 1),
            self.pivots + torch.tensordot(place, self.proxy_moves, 1),
        )


def see_bodies(networks: nn.Module, family: DressedFamily) -> list[SeenBody]:
    """Let the networks of a model see bodies; return what each sees them by."""
    found = []
    for name in SEEING:
        network = getattr(networks, name)
        if len(network):
            seen = SeenBody(network[0].out_features, family.bodies.size)
            parametrize.register_parametrization(network[0], "bias", seen)
            found.append(seen)
    return found
