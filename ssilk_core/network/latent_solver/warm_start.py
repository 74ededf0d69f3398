# SPDX-License-Identifier: Apache-2.0
"""Where a frame's solve starts: the network's own step from the solver's past two states, or on their course.

What does not depend on the states is prepared once: for all frames what the network makes of a pose, and for all
shots the few vertices that the network looks at.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.feedback import BodyFrames, DecodedState
from ..model.network import GarmentModel
from .free_decoder import FreeDecoder

Course = tuple[DecodedState, DecodedState]  # the two states before a frame, the older one first


@dataclass(frozen=True, eq=False)
class FrameDescriptors:
    """What the network sees of N frames' poses.

    Attributes:
        rest: quasi-static latents P(theta_t), shape (N, m).
        given: what `Integrator.precompute` returns for them, N rows each.
    """

    rest: Tensor
    given: tuple[Tensor, ...]


class NetworkSteps:
    """Steps of a model, which may be trained further without effect here, from states of any precision."""

    @torch.no_grad()
    def __init__(self, model: GarmentModel) -> None:
        self.model, parameter = model, next(model.parameters())
        self.dtype, rows = parameter.dtype, model.feedback.points.rows
        self._points = FreeDecoder(model, rows, self.dtype) if len(rows) else None

    @torch.no_grad()
    def described(self, rest: Tensor, pose: Tensor) -> FrameDescriptors:
        """Return what steps to N frames need of quasi-static latents (N, m) and dynamic descriptors (N, D)."""
        model = self.model
        return FrameDescriptors(rest, model.integrator.precompute(model.stepper, rest, pose, model.feedback.size))

    @torch.no_grad()
    def decoded(self, z: Tensor, matrices: Tensor) -> DecodedState:
        """Return latents (N, m) as the next steps look back on them, under a character (J, 3, 4, N)."""
        if not self.model.feedback.size:
            return DecodedState(z.new_zeros(len(z), 0), z.new_zeros(0, 3, len(z)))
        output = self.model.output(z.to(self.dtype))
        return DecodedState(output, self._placed(output, matrices))

    @torch.no_grad()
    def step(self, before: Tensor, now: Tensor, course: Course, seen: FrameDescriptors, body: BodyFrames) -> Tensor:
        """Return the network's state (N, m) after two states (N, m).

        Args:
            course: both states, decoded.
            body: the character in the next frame, F = 1.
        """
        model, cloth = self.model, seen.rest.new_zeros(len(seen.rest), 0)
        if model.feedback.size:
            body = BodyFrames(body.matrices.to(self.dtype), body.bend.to(self.dtype))
            carried = self._placed(2 * course[1].output - course[0].output, body.matrices[0])
            cloth = model.feedback.features(model.decoder, course, carried, body)
        last, latest = before.to(self.dtype), now.to(self.dtype)
        return model.integrator.step(model.stepper, last, latest, seen.given, cloth).to(now.dtype)

    def _placed(self, output: Tensor, matrices: Tensor) -> Tensor:
        if self._points is None:
            return output.new_zeros(0, 3, len(output))
        return self._points.placed(output, matrices.to(self.dtype))

    def starts(
        self, before: Tensor, now: Tensor, course: Course, seen: FrameDescriptors, body: BodyFrames
    ) -> list[Tensor]:
        """Return latents (N, m) that a frame may start from: on the course of the two states before it, which
        inertia has most often nearer, and the network's step, which knows what moves the garment."""
        return [2 * now - before, self.step(before, now, course, seen, body)]
