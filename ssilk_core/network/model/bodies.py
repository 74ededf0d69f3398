# SPDX-License-Identifier: Apache-2.0
"""`network.bodies` in PyTorch, for training: a network that sees which body of a family it is on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ...scene.family import DressedFamily
from ..bodies import SEEING


class SeenBody(nn.Module):
    """What a layer of H outputs sees of a body at coordinates `place` (K,); nothing at first."""

    place: Tensor

    def __init__(self, outputs: int, size: int) -> None:
        super().__init__()
        self.columns = nn.Parameter(torch.zeros(outputs, size))
        self.register_buffer("place", torch.zeros(size), persistent=False)


class SeenByWeights(SeenBody):
    """Multiplies the rows of a layer's weights (H, inputs)."""

    def forward(self, weight: Tensor) -> Tensor:
        """Return the weights on that body."""
        return (1 + self.columns @ self.place)[:, None] * weight


class SeenByBiases(SeenBody):
    """Adds to a layer's biases (H,)."""

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


def see_bodies(networks: nn.Module, family: DressedFamily) -> None:
    """Let all layers but the last ones of a model's networks see bodies: first ones by biases alone."""
    for name in SEEING:
        for place, layer in enumerate(list(getattr(networks, name))[:-1]):
            if isinstance(layer, nn.Linear):
                outputs, size = layer.out_features, family.bodies.size
                if place > 0:
                    parametrize.register_parametrization(layer, "weight", SeenByWeights(outputs, size))
                if layer.bias is not None:
                    parametrize.register_parametrization(layer, "bias", SeenByBiases(outputs, size))


@contextmanager
def on_one_body(networks: nn.Module) -> Iterator[None]:
    """Compute weights and biases on the body that is worn once, for all uses within."""
    with parametrize.cached():
        for module in networks.modules():
            if parametrize.is_parametrized(module):
                for name in module.parametrizations:  # type: ignore[union-attr]
                    getattr(module, name)  # with its gradient: the first use may have none
        yield
