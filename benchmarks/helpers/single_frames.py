# SPDX-License-Identifier: Apache-2.0
"""Time networks frame by frame, one character at a time, in PyTorch, as the paper's Table 3 does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from baselines.evaluation import method_over
from baselines.networks import Baseline
from torch import Tensor

from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.quality.evaluation.methods import Network, TakeSet
from ssilk_core.training.motion_bank import LatentModel

from .clock import now

WARM_UP = 30  # frames that are not timed


@dataclass(frozen=True)
class Times:
    """Medians and standard deviations over frames [s]: of the network alone, and of everything up to vertices."""

    model: tuple[float, float]
    full: tuple[float, float]


@torch.no_grad()
def frame_times(model: Baseline | GarmentModel, take_set: TakeSet, frames: int) -> Times:
    """Time frames of the first take; descriptors and the skeleton's matrices are there already."""
    network = method_over(model, take_set)
    taken = [_frame(network, 2 + number % (take_set.takes[0].frame_count - 2)) for number in range(WARM_UP + frames)]
    return Times(*(_spread(torch.tensor(part[WARM_UP:], dtype=torch.float64)) for part in zip(*taken)))


def _frame(network: Network, frame: int) -> tuple[float, float]:
    """Return the time of one frame up to the end of the network and to the end of all [s]."""
    model, bank, states = network.model, network.take_set.bank, network.states[0]
    index = network.take_set.frames(0, range(frame, frame + 1))
    direction = network.down.expand(1, 3)
    static, pose = bank.static_descriptor(index, direction), bank.dynamic_descriptor(index, direction)
    character, past = bank.character(index), [states[frame - 2 : frame - 1], states[frame - 1 : frame]]
    advance, decode = _parts(model, past, static, pose, bank.triples(index))
    marks = [now(static.device)]
    z = advance()
    marks.append(now(static.device))
    decode(z)
    marks.append(now(static.device))
    model.vertices(z, character)  # the network's end once more, then the rest
    marks.append(now(static.device))
    stepped, decoded, posed = (late - early for early, late in pairwise(marks))
    return stepped + decoded, stepped + posed


def _parts(
    model: LatentModel, past: list[Tensor], static: Tensor, pose: Tensor, body: BodyFrames
) -> tuple[Callable[[], Tensor], Callable[[Tensor], Tensor]]:
    """Return what advances a network by a frame, and what it ends in."""
    if isinstance(model, GarmentModel):
        return lambda: model.roll(past, model.initial(static)[None], pose[None], body)[-1], model.output
    assert isinstance(model, Baseline), type(model)
    return lambda: model.roll(past[-1:], static, pose[None])[-1], model.code


def _spread(seconds: Tensor) -> tuple[float, float]:
    return float(seconds.median()), float(seconds.std())
