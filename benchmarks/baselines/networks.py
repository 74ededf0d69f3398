# SPDX-License-Identifier: Apache-2.0
"""The networks of NCS and SNUG, sized as in their papers, with the interface of `model.network.GarmentModel`.

Both move vertices in the rest pose and leave the rest to linear blend skinning, which alone moves pinned vertices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from ssilk_core.errors import fail
from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.physics.skinning import Skinning
from ssilk_core.scene.assets import PINNED, Ints, Scene

from .descriptors import MOVING, ROOT, STILL, split_features

SHAPES = 1e-4  # [m], standard deviation of initial shapes: training starts close to linear blend skinning


@dataclass(frozen=True, kw_only=True)
class BaselineConfig:
    """A baseline's method, "ncs" or "snug", and the rate at which it steps [1/s]."""

    method: str
    fps: float = 30.0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            fail(f"baseline '{self.method}'", "no such method", f"it is one of {', '.join(METHODS)}")


class Baseline(nn.Module, ABC):
    """A recurrent network that turns poses into offsets of the rest shape.

    Args:
        scene: character, garment and rig.
        config: of `method`, which the subclass implements.
        joints: the character's joints in the descriptors.
        codes: numbers that the offsets are linear in.
    """

    rest: Tensor
    free: Tensor

    def __init__(self, scene: Scene, config: BaselineConfig, joints: Ints, codes: int) -> None:
        super().__init__()
        self.scene, self.config, self.joints = scene, config, joints
        free = np.flatnonzero(scene.classes != PINNED)
        self.register_buffer("rest", torch.tensor(scene.garment.mesh.points, dtype=torch.float32), persistent=False)
        self.register_buffer("free", torch.tensor(free), persistent=False)
        self.skin = Skinning(scene.lbs_skin)
        self.shapes = nn.Parameter(SHAPES * torch.randn(len(free), 3, codes))

    @abstractmethod
    def initial(self, static: Tensor) -> Tensor:
        """Return the states (N, S) of poses without a past, from static descriptors (N, 9 J)."""

    @abstractmethod
    def roll(self, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames | None = None) -> list[Tensor]:
        """Return `states`, of which the last counts, followed by those of the next frames; each (batch, S).

        Args:
            states: those before the first of these frames.
            rest: initial states of the frames; body: the character in them. No baseline needs these.
            pose: dynamic descriptors of the frames, shape (F, batch, D).
        """

    @abstractmethod
    def code(self, states: Tensor) -> Tensor:
        """Return what offsets are linear in (N, codes), from states (N, S)."""

    def vertices(self, states: Tensor, character: Tensor) -> Tensor:
        """Decode states (N, S) over character skinning matrices (J, 3, 4, N) to positions (V, 3, N) [m]."""
        shapes = self.shapes.new_zeros(len(self.rest), *self.shapes.shape[1:]).index_copy(0, self.free, self.shapes)
        offsets = (shapes.flatten(0, 1) @ self.code(states).T).unflatten(0, (len(self.rest), 3))
        return self.skin(self.rest, offsets, self.skin.weights, character)


class NCS(Baseline):
    """A static code of each pose plus a recurrent code of its motion, decoded together.

    The motion's encoder has no biases, which separates statics from dynamics: where nothing moves its code is zero.
    A state is both codes side by side.
    """

    width = 512

    def __init__(self, scene: Scene, config: BaselineConfig, joints: Ints) -> None:
        super().__init__(scene, config, joints, self.width)
        self.posed = relu_layers(STILL * len(joints), 64, 128, 256, self.width)
        self.moved = relu_layers(MOVING, 32, 32, bias=False)
        self.gathered = relu_layers(32 * len(joints), self.width, self.width, bias=False)
        self.memory = nn.GRU(self.width, self.width, bias=False)
        self.decoder = relu_layers(self.width, self.width, self.width, self.width)

    def initial(self, static: Tensor) -> Tensor:
        code = self.posed(static)
        return torch.cat([code, torch.zeros_like(code)], dim=1)

    def roll(self, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames | None = None) -> list[Tensor]:
        still, moving, _ = split_features(pose)
        begun = states[-1][:, self.width :].contiguous()
        motion, _ = self.memory(self.gathered(self.moved(moving).flatten(2)), begun[None])
        return [*states, *torch.cat([self.posed(still), motion], dim=2)]

    def code(self, states: Tensor) -> Tensor:
        still, motion = states.chunk(2, dim=1)
        return self.decoder(still + motion)

    @staticmethod
    def mixed(states: Tensor, count: int) -> Tensor:
        """Give the first `count` windows of states (F, batch, S) each other's motion, without gradients.

        The motion augmentation of the paper's Section 4.4: the decoder sees pairs of codes that no clip holds.
        """
        still, motion = states[:, :count].detach().chunk(2, dim=2)
        return torch.cat([torch.cat([still, motion.roll(1, dims=1)], dim=2), states[:, count:]], dim=1)


class SNUG(Baseline):
    """Four recurrent layers over poses and the root's velocity, then one dense layer to offsets of all vertices.

    A state is the hidden states of all layers, one after the other.
    """

    depth, width = 4, 256

    def __init__(self, scene: Scene, config: BaselineConfig, joints: Ints) -> None:
        super().__init__(scene, config, joints, self.width + 1)
        seen = STILL * len(joints) + ROOT
        # One by one: a stack of layers gives the hidden states of its last frame only.
        self.layers = nn.ModuleList(nn.GRU(size, self.width) for size in (seen, *[self.width] * (self.depth - 1)))

    def initial(self, static: Tensor) -> Tensor:
        seen = nn.functional.pad(static, (0, ROOT))
        return self._remembered(seen[None], seen.new_zeros(len(seen), self.depth * self.width))[0]

    def roll(self, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames | None = None) -> list[Tensor]:
        still, _, root = split_features(pose)
        return [*states, *self._remembered(torch.cat([still, root], dim=2), states[-1])]

    def _remembered(self, seen: Tensor, state: Tensor) -> Tensor:
        """Return states (F, batch, S) of inputs (F, batch, I) after `state` (batch, S)."""
        hidden = []
        for layer, begun in zip(self.layers, state.chunk(self.depth, dim=1)):
            seen, _ = layer(seen, begun.contiguous()[None])
            hidden.append(seen)
        return torch.cat(hidden, dim=2)

    def code(self, states: Tensor) -> Tensor:
        return nn.functional.pad(states[:, -self.width :], (0, 1), value=1.0)  # the last shape is the layer's bias


METHODS: dict[str, type[NCS] | type[SNUG]] = {"ncs": NCS, "snug": SNUG}


def relu_layers(*sizes: int, bias: bool = True) -> nn.Sequential:
    """Return dense layers of these sizes, each followed by a ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        linear = nn.Linear(inputs, outputs, bias=bias)
        nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
        if bias:
            nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers)


def baseline(scene: Scene, config: BaselineConfig, joints: Ints, seed: int = 0) -> Baseline:
    """Return an untrained network on the CPU.

    Args:
        scene: character, garment and rig.
        config: says which network.
        joints: character joints in the descriptors, as `ssilk_core.network.descriptors.descriptor_joints` gives them.
        seed: of the initial parameters.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return METHODS[config.method](scene, config, np.asarray(joints, dtype=np.int64))
