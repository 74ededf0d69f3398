# SPDX-License-Identifier: Apache-2.0
"""The training objective: physics energies of decoded windows and of single poses (paper, Sections 3.5, 3.6)."""

from __future__ import annotations

import torch
from torch import Tensor

from ..energy import GarmentEnergy
from ..model.body import CollisionBody
from ..model.descriptors import GRAVITY
from ..model.network import GarmentModel
from .bank import MotionBank
from .windows import WindowSampler

Terms = dict[str, Tensor]


class Objective:
    """Computes energies of a model's decoded states; each term is [J] per frame, unreduced."""

    def __init__(
        self, model: GarmentModel, energy: GarmentEnergy, body: CollisionBody, bank: MotionBank, surface: bool = True
    ) -> None:
        self.model, self.energy, self.body, self.bank = model, energy, body, bank
        self.surface = surface
        self.dt = 1 / model.config.fps

    def potential(self, x: Tensor, direction: Tensor, character: Tensor) -> Terms:
        """Return every term but inertia of positions x (V, 3, N) under gravity directions (N, 3)."""
        energy = self.energy
        root = character[0, :, 3].detach()  # keeps the value of gravity small; constant in the parameters
        return {
            "stretch": energy.stretch(x),
            "bending": energy.bending(x),
            "gravity": energy.gravity(x - root, GRAVITY * direction.T),
            "collision": energy.collision(x, self.body.posed(character, surface=self.surface)),
        }

    def static(self, frames: Tensor, direction: Tensor) -> Terms:
        """Return the terms of the initialiser's quasi-static states on single poses (Section 3.1)."""
        z = self.model.initial(self.bank.static_descriptor(frames, direction))
        character = self.bank.character(frames)
        return self.potential(self.model.vertices(z, character), direction, character)

    def window(self, sampler: WindowSampler, noise: Tensor) -> tuple[Terms, Terms, Tensor]:
        """Roll one window of every slot.

        Args:
            sampler: where the windows stand.
            noise: added to the two first latents, shape (2, batch, latent).

        Returns:
            Terms of the frames from the third on, terms of the initialiser on the first two frames, and the
            last two latents (2, batch, latent) for the next window.
        """
        model, bank, length = self.model, self.bank, sampler.config.window
        batch = len(sampler.first)
        frames = (sampler.first + torch.arange(length, device=sampler.first.device)[:, None]).reshape(-1)
        direction = sampler.direction.repeat(length, 1)
        static = bank.static_descriptor(frames, direction)
        pose = torch.cat([static, bank.dynamic[frames]], dim=1).reshape(length, batch, -1)
        rest = model.initial(static)
        # Detached: the initialiser learns rest states from their own energy, not what helps the next frames.
        target = rest.detach().reshape(length, batch, -1)
        start = torch.where(sampler.carried[None, :, None], sampler.latents, target[:2])
        with torch.set_grad_enabled(sampler.config.through_time):
            z = model.roll([*(start + noise)], target[2:], pose[2:])
        rolled = torch.cat(z[2:])
        if not sampler.config.through_time:
            # The same steps once more, all at once, from states that carry no gradient.
            states = torch.cat(z)
            rolled = model.step(
                states[: -2 * batch], states[batch:-batch], *(v[2:].flatten(0, 1) for v in (target, pose))
            )
        quiet = rest[: 2 * batch]
        with torch.no_grad():
            past = model.vertices(torch.cat(z[:2]), bank.character(frames[: 2 * batch]))
        # The windows from the third frame on and the initialiser's own states share one decoding.
        seen, facing = (
            torch.cat([frames[2 * batch :], frames[: 2 * batch]]),
            torch.cat([direction[2 * batch :], direction[: 2 * batch]]),
        )
        character = bank.character(seen)
        x = model.vertices(torch.cat([rolled, quiet]), character)
        terms = self.potential(x, facing, character)
        count = (length - 2) * batch
        dynamic = {name: value[:count] for name, value in terms.items()}
        resting = {name: value[count:] for name, value in terms.items()}
        path = torch.cat([past, x[..., :count].detach()], dim=-1)
        predicted = 2 * path[..., batch:-batch] - path[..., : -2 * batch]
        dynamic["inertia"] = self.energy.inertia(x[..., :count], predicted, self.dt)
        if self.energy.fabric.drag:
            root = bank.root[frames].T
            carried = path[..., batch:-batch] + root[:, 2 * batch :] - root[:, batch:-batch]
            dynamic["drag"] = self.energy.drag(x[..., :count], carried, self.dt)
        return dynamic, resting, torch.stack(z[-2:]).detach()


def total(terms: Terms) -> Tensor:
    """Return the sum of all terms, averaged over frames [J]."""
    return sum(value.mean() for value in terms.values())  # type: ignore[return-value]
