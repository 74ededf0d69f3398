# SPDX-License-Identifier: Apache-2.0
"""`network.fabrics` in PyTorch, for training: networks that see the fabric of each frame."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..fabrics import SEEING


def see_fabrics(networks: nn.Module, size: int, states: int) -> None:
    """Let P and S of a model see K features of the fabric before all others of the pose; they count nothing yet.

    Args:
        states: inputs of S before its features of the pose.
    """
    for name in SEEING:
        network = getattr(networks, name)
        if len(network):
            first, place = network[0], states if name == "stepper" else 0
            weight: Tensor = first.weight.detach()
            blank = weight.new_zeros(len(weight), size)
            first.weight = nn.Parameter(torch.cat([weight[:, :place], blank, weight[:, place:]], dim=1))
            first.in_features += size
