# SPDX-License-Identifier: Apache-2.0
"""Energies of a model on whole clips, and those of linear blend skinning."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from math import isfinite
from pathlib import PurePath
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from ..files import split_location
from ..network.model.network import GarmentModel
from ..physics.collision import CollisionBody, Contacts
from ..physics.energy import TERMS, GarmentEnergy
from ..physics.energy.frames import FRAMES_PER_CHUNK, ContactDistances, energy_terms
from ..physics.intersections.cloth import ClothIntersections, IntersectionCounts
from ..physics.intersections.contours import IntersectionContours
from ..physics.intersections.figures import INTERSECTION, LayerFigures, SelfIntersections
from ..physics.intersections.layers import LayerCounts
from ..physics.intersections.pairs import can_find
from ..physics.skin.covered_skin import CoveredSkin, ShownCounts
from ..physics.skin.figures import ShownSkin
from ..physics.skinning import Skinning
from ..scene.assets import Motion, Scene
from .bodies import BodyWearer
from .inner_garments import InnerGarments
from .motion_bank import LatentModel, MotionBank, roll_states
from .newton_steps import NewtonSteps
from .parallel import SINGLE_PROCESS, ProcessGroup
from .step_errors import StepErrors

# On a CPU and on a GPU. Rays and Hessians take long on a CPU.
SHOWN_FRAMES = 32, 256  # in which the skin that shows is counted
MEASURED_STEPS = 16, 64
CROSSED_FRAMES = 8  # in which triangles that intersect others are counted: a quarter of a second in all


Counts = TypeVar("Counts")


@dataclass(frozen=True)
class BodyScore:
    """Means over some frames on one more body of a family, or of one more fabric.

    Energies of a fabric are divided by its factor of density, as in training.

    Attributes:
        name: of the body or the fabric.
        total: sum of the energies but that of intersections [J]; gravity is relative to linear blend skinning.
        lbs: that of linear blend skinning there [J].
        collisions: share of garment vertices inside the body.
    """

    name: str
    total: float
    lbs: float
    collisions: float


@dataclass(frozen=True)
class Score:
    """Means over all frames of all clips.

    Attributes:
        terms: each energy [J]; gravity is relative to linear blend skinning.
        collisions: share of garment vertices inside the body.
        dynamics: RMS distance between the rollout and the quasi-static states of the same poses [m].
        shown_skin: share of the covered skin that shows, in `SHOWN_FRAMES` spread evenly over all clips; None where
            the garment covers nothing.
        intersections: share of the triangles that intersect others, in `CROSSED_FRAMES` spread likewise; None without
            libigl.
        layers: how the garment lies over each inner one, in the same frames.
        step_errors: what `MEASURED_STEPS` single steps miss, spread likewise; None for linear blend skinning.
        bodies: of a family beside its first one, which all else is of, and of fabrics beside the model's own; none
            for linear blend skinning.
    """

    terms: dict[str, float]
    collisions: float
    dynamics: float = 0.0
    shown_skin: ShownSkin | None = None
    intersections: SelfIntersections | None = None
    step_errors: StepErrors | None = None
    layers: tuple[LayerFigures, ...] = ()
    bodies: tuple[BodyScore, ...] = ()

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Score:
        """Return a score from its JSON document."""
        shown, steps = document["shown_skin"], document["step_errors"]
        crossed = document.get("intersections")  # files of before lack it
        parts = {
            "shown_skin": shown and ShownSkin(**shown),
            "intersections": crossed and SelfIntersections(**crossed),
            "step_errors": steps and StepErrors(**steps),
            "layers": tuple(LayerFigures(**each) for each in document.get("layers", ())),
            "bodies": tuple(BodyScore(**each) for each in document.get("bodies", ())),
        }
        return cls(**{**document, **parts})

    @property
    def total(self) -> float:
        """Sum of all terms [J]."""
        return sum(self.terms.values())

    @property
    def judged(self) -> float:
        """Mean of the totals on all bodies and of all fabrics [J], by which the best model is chosen."""
        return (self.total + sum(body.total for body in self.bodies)) / (1 + len(self.bodies))

    def of_each(self, first: str, lbs: Score) -> tuple[BodyScore, ...]:
        """Return the scores on all bodies and of all fabrics, the first included; none where it is the only one.

        Args:
            first: what it is called.
            lbs: the scores of linear blend skinning.
        """
        own = BodyScore(first, self.total, lbs.total, self.collisions)
        return (own, *self.bodies) if self.bodies else ()


@dataclass(frozen=True, eq=False)
class ValidatedBody:
    """A body of a family that a model is validated on: its name, its coordinates (K,), and who validates there."""

    name: str
    place: Tensor
    validator: Validator

    @cached_property
    def lbs(self) -> float:
        """Energy of linear blend skinning [J]."""
        return _total(self.validator.means(None)) / self.weight

    @property
    def weight(self) -> float:
        """By which its energies are divided."""
        return 1.0

    def measured(self, model: LatentModel) -> BodyScore:
        """Return the score of a model, which is on the first body before and after."""
        wearer = cast(BodyWearer, model)
        try:
            wearer.wear(self.place)
            means = self.validator.means(model)
        finally:
            wearer.wear(torch.zeros_like(self.place))
        return BodyScore(self.name, _total(means) / self.weight, self.lbs, means["collisions"])


@dataclass(frozen=True, eq=False)
class ValidatedFabric(ValidatedBody):
    """Likewise a fabric: its name, its features (5,), and who validates with its energies."""

    density: float

    @property
    def weight(self) -> float:
        """Its factor of density."""
        return self.density

    def measured(self, model: LatentModel) -> BodyScore:
        """Return the score of a model, whose fabric is its own before and after."""
        seen = cast(GarmentModel, model).fabric
        try:
            seen.copy_(self.place)
            means = self.validator.means(model)
        finally:
            seen.zero_()
        return BodyScore(self.name, _total(means) / self.weight, self.lbs, means["collisions"])


class Validator:
    """Rolls a model over whole clips and scores it against linear blend skinning on the same frames.

    Args:
        frames: most frames of a clip.
        spans: the motions that the bank's clips were made of, which name them; numbers by default.
        contours: those of the garment, whose energy is a term where training has it.
        inner: garments beneath, all of which are worn; contact with them is part of that with the body.
        members: bodies of a family and fabrics whose energies are measured as well.
    """

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
        spans: Sequence[Motion] | None = None,
        contours: IntersectionContours | None = None,
        inner: InnerGarments | None = None,
        members: Sequence[ValidatedBody] = (),
    ) -> None:
        self.members = tuple(members)
        self.bank, self.energy, self.body, self.fps, self.group = bank, energy, body, fps, group
        self.lbs = Skinning(scene.lbs_skin).to(rest.device)
        self.contacts = Contacts(scene, energy.cloth.samples, vertices=body.vertices, device=rest.device)
        self.contours, self.inner = contours, inner
        self.rest, self.scene = rest, scene
        self.clips = [
            range(int(start), min(int(stop), int(start) + frames)) for start, stop in zip(bank.starts, bank.stops)
        ]
        self.names = [f"clip {number + 1}" for number in range(len(self.clips))]
        self.first = [0] * len(self.clips)  # frames from time zero on, at the model's rate
        if spans is not None:
            self.names = [PurePath(split_location(span.path)[0]).stem for span in spans]
            self.first = [round(span.start * fps / span.fps) for span in spans]
        self.down = torch.tensor([0.0, -1.0, 0.0], device=rest.device)

    @cached_property
    def covered(self) -> CoveredSkin:
        """The skin that the garment covers."""
        return CoveredSkin(self.scene, device=self.rest.device)

    @cached_property
    def cloth(self) -> ClothIntersections | None:
        """The garment's triangles; None without libigl."""
        if self.contours:
            return self.contours.cloth
        return ClothIntersections.of(self.scene) if can_find() else None

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
        states = self._states(self.clips[self.group.rank :: self.group.size], model)
        joined = self._joined(model, states)
        terms = {name: joined[name] for name in (*TERMS, INTERSECTION) if name in joined}
        shown, crossed = self._shown(model, states), self._crossed(model, states)
        steps = self._step_errors(model, states)
        layers, bodies = self._layers(model, states), self._bodies(model)
        return Score(terms, joined["collisions"], joined["dynamics"] ** 0.5, shown, crossed, steps, layers, bodies)

    def means(self, model: LatentModel | None) -> dict[str, float]:
        """Return the means of `frame_terms` over all clips; all processes of the group get the same."""
        return self._joined(model, self._states(self.clips[self.group.rank :: self.group.size], model))

    def _joined(self, model: LatentModel | None, states: Sequence[Tensor | None]) -> dict[str, float]:
        clips = self.clips[self.group.rank :: self.group.size]
        own = [self._clip_terms(clip, model, latents) for clip, latents in zip(clips, states)]
        dealt = self.group.gather([{name: value.cpu() for name, value in terms.items()} for terms in own])
        scores = [dealt[index % self.group.size][index // self.group.size] for index in range(len(self.clips))]
        return {name: float(torch.cat([score[name] for score in scores]).mean()) for name in scores[0]}

    def _bodies(self, model: LatentModel | None) -> tuple[BodyScore, ...]:
        """Return the scores on the other bodies of a family and of other fabrics."""
        return () if model is None else tuple(member.measured(model) for member in self.members)

    def _shown(self, model: LatentModel | None, states: Sequence[Tensor | None]) -> ShownSkin | None:
        """Return how much of the covered skin shows; all processes of the group get the same."""

        def count(x: Tensor, character: Tensor, numbers: list[int]) -> ShownCounts:
            return ShownCounts.of(self.covered.states(x, character), numbers)

        return self.covered.figures(self._counted(model, states, SHOWN_FRAMES[self.rest.is_cuda], count))

    def _crossed(self, model: LatentModel | None, states: Sequence[Tensor | None]) -> SelfIntersections | None:
        """Return how many triangles intersect others; all processes of the group get the same."""
        if (cloth := self.cloth) is None:
            return None

        def count(x: Tensor, character: Tensor, numbers: list[int]) -> IntersectionCounts:
            return cloth.counts(list(x.permute(2, 0, 1).double().cpu().numpy()), numbers)

        return cloth.figures(self._counted(model, states, CROSSED_FRAMES, count))

    @torch.no_grad()
    def _layers(self, model: LatentModel | None, states: Sequence[Tensor | None]) -> tuple[LayerFigures, ...]:
        """Return how the garment lies over each inner one; all processes of the group get the same."""
        inner = self.inner
        if inner is None:
            return ()
        own, spread = range(self.group.rank, len(self.clips), self.group.size), self._spread(CROSSED_FRAMES)
        found = dict[int, list[LayerCounts]]()
        for clip, latents in zip(own, states):
            if chosen := spread[clip]:
                numbers = [self.first[clip] + frame for frame in chosen]
                x, _ = self._posed(model, latents, self.clips[clip], chosen)
                at = torch.tensor(chosen, device=self.rest.device)
                found[clip] = inner.counts(x, self.clips[clip], self.clips, at, self.down, numbers)
        joined = {clip: each for part in self.group.gather(found) for clip, each in part.items()}
        return tuple(
            layers.figures([(self.names[clip], joined[clip][number]) for clip in sorted(joined)])
            for number, layers in enumerate(inner.layers)
        )

    @torch.no_grad()
    def _counted(
        self,
        model: LatentModel | None,
        states: Sequence[Tensor | None],
        frames: int,
        count: Callable[[Tensor, Tensor, list[int]], Counts],
    ) -> list[tuple[str, Counts]]:
        """Return what `count` finds in so many frames spread over all clips, by clip, from all processes.

        Args:
            count: takes positions (V, 3, N), skinning matrices (J, 3, 4, N) and numbers of N frames of a clip.
        """
        own, found = range(self.group.rank, len(self.clips), self.group.size), dict[int, Counts]()
        spread = self._spread(frames)
        for number, latents in zip(own, states):
            if chosen := spread[number]:
                numbers = [self.first[number] + frame for frame in chosen]
                found[number] = count(*self._posed(model, latents, self.clips[number], chosen), numbers)
        joined = {number: each for part in self.group.gather(found) for number, each in part.items()}
        return [(self.names[number], joined[number]) for number in sorted(joined)]

    def _posed(
        self, model: LatentModel | None, latents: Tensor | None, clip: range, chosen: Sequence[int]
    ) -> tuple[Tensor, Tensor]:
        """Return positions (V, 3, N) of some frames of a clip [m], and its skinning matrices there."""
        frames = torch.tensor(chosen, device=self.rest.device)
        character = self.bank.character(clip.start + frames)
        if model is None or latents is None:
            return self.lbs_vertices(character), character
        return model.vertices(latents[frames], character), character

    def _step_errors(self, model: LatentModel | None, states: Sequence[Tensor | None]) -> StepErrors | None:
        """Return what single steps of a model miss; all processes of the group get the same."""
        if model is None or self.inner:  # the solver knows no inner garments
            return None
        energy, square = self.missed_by_steps(model, states, MEASURED_STEPS[self.rest.is_cuda])
        if not len(energy):
            return None
        found = StepErrors(len(energy), float(energy.mean()), float(square.mean().sqrt()))
        return found if isfinite(found.energy) and isfinite(found.distance) else None

    @torch.no_grad()
    def missed_by_steps(
        self, model: LatentModel, states: Sequence[Tensor | None], count: int
    ) -> tuple[Tensor, Tensor]:
        """Return what `NewtonSteps` measures in so many steps, spread evenly over all clips, (N,) each.

        Args:
            states: of this process's clips; all processes of the group get the same.
        """
        own, parts = range(self.group.rank, len(self.clips), self.group.size), []
        spread = self._spread(count, first=2)
        for number, latents in zip(own, states):
            clip, chosen = self.clips[number], spread[number]
            if not chosen or latents is None:
                continue
            frames = torch.tensor(chosen, device=self.rest.device)
            path = [
                model.vertices(latents[at], self.bank.character(clip.start + at)) for at in (frames - 2, frames - 1)
            ]
            character, root = self.bank.character(clip.start + frames), self.bank.root_at(clip.start + frames)
            shift = (root - self.bank.root_at(clip.start + frames - 1)).T
            path.append(model.vertices(latents[frames], character))
            body, lbs = self.body.pose(character, exact=True), self.lbs_vertices(character)
            parts.append([values.cpu() for values in self._newton.measure(path, lbs, body, shift)])
        joined = [part for dealt in self.group.gather(parts) for part in dealt]
        energy, square = (torch.cat([part[side] for part in joined] or [torch.zeros(0)]) for side in range(2))
        return energy, square

    @cached_property
    def _newton(self) -> NewtonSteps:
        return NewtonSteps(self.scene, self.energy.fabric, self.fps, self.rest.device)

    def _spread(self, count: int, first: int = 0) -> list[list[int]]:
        """Return so many frames of each clip, spread evenly over those of all clips from the frame `first` on."""
        ends = list(accumulate((max(0, len(clip) - first) for clip in self.clips), initial=0))
        count = min(count, ends[-1])
        spread = [(2 * number + 1) * ends[-1] // (2 * count) for number in range(count)]
        return [[frame - start + first for frame in spread if start <= frame < end] for start, end in pairwise(ends)]

    def frame_terms(self, clip: range, model: LatentModel | None) -> dict[str, Tensor]:
        """Return the values that `Score` averages for each frame of a range of the bank, shape (N,).

        Without a model, linear blend skinning is scored. "dynamics" is a squared distance [m2].
        """
        return self._clip_terms(clip, model, self._states([clip], model)[0])

    def _states(self, clips: Sequence[range], model: LatentModel | None) -> Sequence[Tensor | None]:
        """Return the states of each clip; a process of a group may have no clips."""
        return roll_states(model, self.bank, clips, self.down) if model and clips else [None] * len(clips)

    def _met(self, clip: range, start: int, count: int) -> ContactDistances:
        """Return contacts with the body and with inner garments in so many frames of a range of the bank."""
        if self.inner is None:
            return self.contacts
        frames = torch.arange(start, start + count, device=self.rest.device)
        return self.inner.over(self.contacts, self.inner.held(clip, self.clips, frames, self.down))

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
            posed = self.body.pose(character, limbs=False)
            contacts = self._met(clip, start, x.shape[-1])
            terms = energy_terms(self.energy, x, lbs, contacts, posed, joined, self.fps, self.down)
            if self.contours:
                terms[INTERSECTION] = self.contours.energy(x)
            parts.append({**terms, "dynamics": ((x - still) ** 2).sum(1).mean(0)})
            tail = joined[..., -2:]
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _total(means: Mapping[str, float]) -> float:
    """Return the sum of the energies of `TERMS` [J]."""
    return sum(means[name] for name in TERMS if name in means)
