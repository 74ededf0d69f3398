# SPDX-License-Identifier: Apache-2.0
"""What passes between the parts of one training step, gradients cut."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.physics.collision import PosedBody
from ssilk_core.training.step import Stepper

Tensors = tuple[Tensor, ...]


class Moment:
    """The windows of a stepper as they stand, carried through a step: each part takes what those before it made."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model, self.sampler = stepper, stepper.model, stepper.sampler
        self.decoder, self.objective, self.bank = stepper.model.decoder, stepper.objective, stepper.objective.bank
        self.batch, self.window, self.static_batch = (
            stepper.config.batch,
            stepper.config.window,
            stepper.config.static_batch,
        )
        with torch.no_grad():
            self._seen()
            self._decoded()
            self._met()

    def _seen(self) -> None:
        steps, given = torch.arange(self.window, device=self.sampler.first.device)[:, None], 2 * self.batch
        self.times = (self.sampler.first + steps).reshape(-1)
        self.down = self.sampler.direction.repeat(self.window, 1)
        self.single, self.single_down, _ = self.sampler.poses(self.static_batch)
        self.static, self.pose, self.quiet = self.descriptors()
        self.frames = torch.cat([self.times[given:], self.single])
        self.direction = torch.cat([self.down[given:], self.single_down])
        self.character = self.bank.character(self.frames)

    def _decoded(self) -> None:
        self.target = self.targets()
        self.z = torch.cat([self.target[2 * self.batch :], self.model.initial(self.quiet)])
        self.activation, self.turns = self.decoder.split(self.model.output(self.z))
        self.matrices = self.decoder.matrices(self.turns, self.character)
        self.offsets = self.blendshapes(self.activation)
        self.x = self.skinned(self.offsets, self.matrices)

    def _met(self) -> None:
        self.body = self.posed()
        self.sampled = self.objective.energy.cloth.positions(self.x)
        self.normal, self.offset = self.planes()
        self.first = self.decoded_first()
        path = self.path()
        self.last, self.before = path[..., self.batch :], path[..., : -self.batch]

    @property
    def count(self) -> int:
        """Frames that are decoded for their energy."""
        return len(self.frames)

    def sample(self) -> Tensors:
        noise, poses = self.sampler.noise(), self.sampler.poses(self.static_batch)
        self.sampler.advance(self.sampler.latents + noise)
        return self.sampler.first, self.sampler.direction, self.sampler.latents, *poses

    def descriptors(self) -> Tensors:
        static = self.bank.static_descriptor(self.times, self.down)
        pose = self.bank.described(static, self.times, self.down)
        return static, pose, self.bank.static_descriptor(self.single, self.single_down)

    @torch.no_grad()
    def targets(self) -> Tensor:
        return self.model.initial(self.static)

    def body_frames(self) -> BodyFrames:
        return self.bank.body(self.times.reshape(self.window, self.batch))

    @torch.no_grad()
    def seen(self) -> Tensor:
        """What S sees of the cloth in all steps at once, from quasi-static states."""
        before, now = self.target[: -2 * self.batch], self.target[self.batch : -self.batch]
        return self.model.seen_from(before, now, self.bank.triples(self.times[2 * self.batch :]))

    @torch.no_grad()
    def rolled(self) -> Tensors:
        rest, pose = (value.reshape(self.window, self.batch, -1) for value in (self.target, self.pose))
        return tuple(self.model.roll([rest[0], rest[1]], rest[2:], pose[2:], self.body_frames())[2:])

    @torch.no_grad()
    def decoded_first(self) -> Tensor:
        first = slice(0, 2 * self.batch)
        return self.model.vertices(self.target[first], self.bank.character(self.times[first]))

    def blendshapes(self, activation: Tensor) -> Tensor:
        offsets = self.decoder._offsets(activation)
        assert offsets is not None
        return offsets

    def skinned(self, offsets: Tensor, matrices: Tensor) -> Tensor:
        return self.decoder.skin(self.decoder.rest, offsets, self.decoder._influence_weights(), matrices)

    def path(self) -> Tensor:
        return torch.cat([self.first, self.x[..., : (self.window - 3) * self.batch]], dim=-1)

    def posed(self) -> PosedBody:
        assert self.objective.body is not None
        return self.objective.body.pose(self.character)

    def surface(self) -> Tensors:
        body = self.posed()
        return body.points, body.normals

    def planes(self, *, surface: bool = True) -> tuple[Tensor, Tensor]:
        body = self.body if surface else replace(self.body, rings=None)
        return self.objective.contacts.planes(self.sampled, body)

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
