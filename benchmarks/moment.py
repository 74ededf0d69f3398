# SPDX-License-Identifier: Apache-2.0
"""What passes between the parts of one training step, gradients cut."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ssilk_core.energy.collision import nearest_planes
from ssilk_core.training.step import Stepper

Tensors = tuple[Tensor, ...]


class Moment:
    """The windows of a stepper as they stand, carried through a step: each part takes what those before it made."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model, self.sampler = stepper, stepper.model, stepper.sampler
        self.decoder, self.objective, self.bank = stepper.model.decoder, stepper.objective, stepper.objective.bank
        self.batch, self.window = stepper.config.batch, stepper.config.window
        with torch.no_grad():
            self._seen()
            self._decoded()
            self._met()

    def _seen(self) -> None:
        steps = torch.arange(self.window, device=self.sampler.first.device)[:, None]
        self.frames = (self.sampler.first + steps).reshape(-1)
        self.direction = self.sampler.direction.repeat(self.window, 1)
        self.static, self.pose = self.descriptors()
        self.character = self.bank.character(self.frames)

    def _decoded(self) -> None:
        self.z = self.model.initial(self.static)
        self.activation, self.turns = self.decoder._split(self.model.output(self.z))
        self.matrices = self.decoder._matrices(self.turns, self.character)
        self.offsets = self.blendshapes(self.activation)
        self.x = self.skinned(self.offsets, self.matrices)

    def _met(self) -> None:
        self.body = self.objective.body.posed(self.character)
        self.normal, self.offset = self.planes()
        self.first = self.decoded_first()
        path = self.path()
        self.last, self.before = path[..., self.batch :], path[..., : -self.batch]

    @property
    def count(self) -> int:
        """Frames that are decoded."""
        return len(self.frames)

    def sample(self) -> Tensors:
        self.sampler.advance(self.sampler.latents + self.sampler.noise())
        return self.sampler.first, self.sampler.direction, self.sampler.latents

    def descriptors(self) -> Tensors:
        static = self.bank.static_descriptor(self.frames, self.direction)
        return static, torch.cat([static, self.bank.dynamic[self.frames]], dim=1)

    @torch.no_grad()
    def rolled(self) -> Tensors:
        rest, pose = (value.reshape(self.window, self.batch, -1) for value in (self.z, self.pose))
        return tuple(self.model.roll([rest[0], rest[1]], rest[2:], pose[2:])[2:])

    @torch.no_grad()
    def decoded_first(self) -> Tensor:
        first = slice(0, 2 * self.batch)
        return self.model.vertices(self.z[first], self.bank.character(self.frames[first]))

    def blendshapes(self, activation: Tensor) -> Tensor:
        offsets = self.decoder._offsets(activation)
        assert offsets is not None
        return offsets

    def skinned(self, offsets: Tensor, matrices: Tensor) -> Tensor:
        return self.decoder.skin(self.decoder.rest, offsets, self.decoder._influence_weights(), matrices)

    def path(self) -> Tensor:
        return torch.cat([self.first, self.x[..., : -3 * self.batch]], dim=-1)

    def surface(self) -> Tensors:
        body = self.objective.body.posed(self.character)
        return body.points, body.normals

    def planes(self, *, surface: bool = True) -> tuple[Tensor, Tensor]:
        body = self.body if surface else replace(self.body, rings=None)
        return nearest_planes(self.x, body, self.objective.blocks)

    def update(self) -> Callable[[], Tensors]:
        """Return what gives the parameters known gradients, in one copy, and moves them."""
        parameters = tuple(self.model.parameters())
        gradients = torch.cat([torch.full_like(value, 1e-3).flatten() for value in parameters])

        class Known(torch.autograd.Function):
            @staticmethod
            def forward(ctx: object, *values: Tensor) -> Tensor:
                return values[0].new_zeros(())

            @staticmethod
            def backward(ctx: object, *upstream: Tensor) -> Tensors:
                pieces = gradients.clone().split([value.numel() for value in parameters])
                return tuple(piece.view_as(value) for piece, value in zip(pieces, parameters))

        def run() -> Tensors:
            loss = Known.apply(*parameters)
            self.stepper._descend(loss, {"loss": loss}, self.sampler.window())
            return parameters

        return run
