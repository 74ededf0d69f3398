# SPDX-License-Identifier: Apache-2.0
"""The training of a baseline, with the energies, schedule, bounds and averages of a `GarmentModel`'s training."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssilk_core.errors import fail
from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.training.objective import Objective, Terms, total
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

from .descriptors import JointBank
from .networks import NCS, Baseline


class BaselineObjective(Objective):
    """Energies of the last frames of windows that start from static states.

    The frames before them only fill the memory, as in both papers.

    Args:
        judged: frames at the end of a window that energies are computed of.
        mixed: share of windows that NCS decodes with the motion of another one; no inertia is computed of them.
    """

    model: Baseline  # type: ignore[assignment]  # the energies need no more of a model than a baseline has
    bank: JointBank

    def __init__(
        self,
        model: Baseline,
        energy: GarmentEnergy,
        body: CollisionBody | None,
        bank: JointBank,
        surface: bool,
        *,
        judged: int,
        mixed: float = 0.0,
    ) -> None:
        super().__init__(model, energy, body, bank, surface)  # type: ignore[arg-type]
        self.judged, self.mixed = judged, mixed
        if not 0 <= mixed < 1:
            fail("training", f"a share of {mixed:g} windows mixed", "it lies between 0 and 1")
        where = f"baseline '{model.config.method}'"
        if not (not mixed or isinstance(model, NCS)):
            fail(where, "mixed windows", "only NCS tells motion from pose")

    def rolled(self, sampler: WindowSampler) -> Terms:
        """Return every term of the judged frames of each slot's window, in order of time, (judged * batch,)."""
        bank, length, batch = self.bank, sampler.config.window, len(sampler.first)
        times = (sampler.first + torch.arange(length, device=sampler.first.device)[:, None]).reshape(-1)
        down = sampler.direction.repeat(length, 1)
        first = slice(0, 2 * batch)
        rest = self.model.initial(bank.static_descriptor(times[first], down[first])).unflatten(0, (2, batch))
        pose = bank.dynamic_descriptor(times[2 * batch :], down[2 * batch :]).unflatten(0, (-1, batch))
        states = torch.stack(self.model.roll([*rest], pose, pose))
        if count := int(self.mixed * batch):
            states = NCS.mixed(states, count)
        terms = self._judged(states.flatten(0, 1), times, down, batch)
        own = torch.arange(batch, device=times.device).repeat(self.judged) >= count
        for name in ("inertia", "drag"):
            terms[name] = terms[name] * own * (batch / (batch - count))
        return terms

    def _judged(self, states: Tensor, times: Tensor, down: Tensor, batch: int) -> Terms:
        """Return the terms of the last frames of windows (length * batch, S), the past of which has no gradient."""
        now, before = slice(-self.judged * batch, None), slice(-(self.judged + 2) * batch, -self.judged * batch)
        with torch.no_grad():
            past = self.model.vertices(states[before], self.bank.character(times[before]))
        character = self.bank.character(times[now])
        x = self.model.vertices(states[now], character)
        terms = self.quasi_static_terms(x, down[now], character)
        path = torch.cat([past, x[..., : len(times[now]) - batch].detach()], dim=-1)
        root = self.bank.root[times].T[:, -(self.judged + 1) * batch :]
        terms["inertia"], terms["drag"] = self.energy.inertia_and_drag(
            x, path[..., batch:], path[..., :-batch], root[:, batch:] - root[:, :-batch], self.dt
        )
        return terms


class BaselineStepper(Stepper):
    """Trains a baseline as `Stepper` trains a model."""

    objective: BaselineObjective
    ema_model: Baseline  # type: ignore[assignment]

    def __init__(self, objective: BaselineObjective, config: TrainConfig, generator: torch.Generator) -> None:
        if not config.window >= objective.judged + 2:
            fail(
                "training",
                f"a window of {config.window} poses of which {objective.judged} are judged",
                "inertia needs two before them",
            )
        sampler = WindowSampler(objective.bank, config, 0, generator)  # no state goes from window to window
        super().__init__(objective.model, objective, sampler, config)  # type: ignore[arg-type]
        for module in self.ema_model.modules():
            if isinstance(module, nn.GRU):
                module.flatten_parameters()  # a copy's are scattered

    def dynamic_step(self) -> None:
        """Train everything on one window of every slot."""
        terms = self.objective.rolled(self.sampler)
        means = {name: value.mean() for name, value in terms.items()}
        self._descend(total(terms, self._half), means, self.sampler.window())
        self.sampler.advance(self.sampler.latents)
