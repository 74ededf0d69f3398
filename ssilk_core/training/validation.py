# SPDX-License-Identifier: Apache-2.0
"""Energies of a model on whole clips, and those of linear blend skinning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..assets import Scene
from ..collision import CollisionBody, Contacts
from ..energy import TERMS, GarmentEnergy
from ..energy.frames import FRAMES_PER_CHUNK, energy_terms
from ..motion_bank import LatentModel, MotionBank, roll_states
from ..skinning import Skinning
from .parallel import SINGLE_PROCESS, ProcessGroup


@dataclass(frozen=True)
class Score:
    """Means over all frames of all clips.

    Attributes:
        terms: each energy [J]; gravity is relative to linear blend skinning.
        collisions: share of garment vertices inside the body.
        dynamics: RMS distance between the rollout and the quasi-static states of the same poses [m].
    """

    terms: dict[str, float]
    collisions: float
    dynamics: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all terms [J]."""
        return sum(self.terms.values())


class Validator:
    """Rolls a model over whole clips and scores it against linear blend skinning on the same frames."""

    def __init__(
        self,
        bank: MotionBank,
        energy: GarmentEnergy,
        body: CollisionBody,
        scene: Scene,
        rest: Tensor,
        fps: float,
        frames: int,
        group: ProcessGroup = SINGLE_PROCESS,
    ) -> None:
        self.bank, self.energy, self.body, self.fps, self.group = bank, energy, body, fps, group
        self.lbs = Skinning(scene.lbs_skin).to(rest.device)
        self.contacts = Contacts(scene, energy.cloth.samples, vertices=body.vertices, device=rest.device)
        self.rest = rest
        self.clips = [
            range(int(start), min(int(stop), int(start) + frames)) for start, stop in zip(bank.starts, bank.stops)
        ]
        self.down = torch.tensor([0.0, -1.0, 0.0], device=rest.device)

    def lbs_vertices(self, character: Tensor) -> Tensor:
        """Return linear blend skinning's positions (V, 3, N) [m]."""
        return self.lbs(self.rest, None, self.lbs.weights, character)

    def score(self, model: LatentModel) -> Score:
        """Return the mean score of a model over all clips."""
        return self._mean(model)

    def lbs_score(self) -> Score:
        """Return the mean score of linear blend skinning over all clips."""
        return self._mean(None)

    def _mean(self, model: LatentModel | None) -> Score:
        """Return the mean over all clips, distributed over the processes of the group; all get the same score."""
        clips = self.clips[self.group.rank :: self.group.size]
        states = self._states(clips, model)
        own = [self._clip_terms(clip, model, latents) for clip, latents in zip(clips, states)]
        dealt = self.group.gather([{name: value.cpu() for name, value in terms.items()} for terms in own])
        scores = [dealt[index % self.group.size][index // self.group.size] for index in range(len(self.clips))]
        joined = {name: float(torch.cat([score[name] for score in scores]).mean()) for name in scores[0]}
        return Score({name: joined[name] for name in TERMS}, joined["collisions"], joined["dynamics"] ** 0.5)

    def frame_terms(self, clip: range, model: LatentModel | None) -> dict[str, Tensor]:
        """Return the values that `Score` averages for each frame of a range of the bank, shape (N,).

        Without a model, linear blend skinning is scored. "dynamics" is a squared distance [m2].
        """
        return self._clip_terms(clip, model, self._states([clip], model)[0])

    def _states(self, clips: Sequence[range], model: LatentModel | None) -> Sequence[Tensor | None]:
        """Return the states of each clip; a process of a group may have no clips."""
        return roll_states(model, self.bank, clips, self.down) if model and clips else [None] * len(clips)

    @torch.no_grad()
    def _clip_terms(self, clip: range, model: LatentModel | None, states: Tensor | None) -> dict[str, Tensor]:
        frames = torch.arange(clip.start, clip.stop, device=self.rest.device)
        parts, tail = [], None
        for start in range(0, len(frames), FRAMES_PER_CHUNK):
            window = slice(start, start + FRAMES_PER_CHUNK)
            character = self.bank.character(frames[window])
            lbs = self.lbs_vertices(character)
            x, still = lbs, lbs
            if model is not None and states is not None:
                x = model.vertices(states[window], character)
                direction = self.down.expand(len(frames[window]), 3)
                quiet = model.initial(self.bank.static_descriptor(frames[window], direction))
                still = model.vertices(quiet, character)
            joined = x if tail is None else torch.cat([tail, x], dim=-1)
            posed = self.body.pose(character)
            terms = energy_terms(self.energy, x, lbs, self.contacts, posed, joined, self.fps, self.down)
            parts.append({**terms, "dynamics": ((x - still) ** 2).sum(1).mean(0)})
            tail = joined[..., -2:]
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
