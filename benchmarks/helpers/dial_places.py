# SPDX-License-Identifier: Apache-2.0
"""The places on the dial between fast and near to the simulator: how a garment is played at each, and how fast.

Networks play as trained, or reduced as quality levels have them. The solver in latents, refinement and *Hero* take
more time for less error. The simulator ends the dial.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from helpers.clock import now
from helpers.subjects import Subject
from ssilk_core.network.checkpoint import ModelFile, network
from ssilk_core.network.latent_solver import LatentOptions
from ssilk_core.network.latent_solver.shots import LatentShots
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.runtime import Player
from ssilk_core.physics.refine import RefineOptions, Refiner
from ssilk_core.quality.cost import play_time
from ssilk_core.quality.evaluation.methods import Method, Network, SolvedNetwork, TakeSet, build_take_set
from ssilk_core.quality.evaluation.own_starts import STATES, MethodWindow, history, poses_of
from ssilk_core.quality.evaluation.takes import Take
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.quality.reduction import Reducer
from ssilk_core.quality.trade.shot_method import ShotMethod
from ssilk_core.quality.trade.variants import Variant
from ssilk_core.scene.assets import Floats, Motion

SIMULATOR = "simulator"
ALONE = 2  # shots that are timed one after the other, where they are not played at once
TIMED = 8  # frames of a shot that is timed, where they are solved one after the other
WARM_UP = 4  # frames of a first pass; a take has no fewer


@dataclass(frozen=True, kw_only=True)
class DialPlace:
    """A place on the dial: a network, as it is or reduced to a quality level, or a solver that it starts.

    Attributes:
        level: the quality level that reduces the network; None for none.
        latents: how states are solved for in latents; None where they are not.
        refine: how vertices are refined; None where they are not.
    """

    name: str
    level: str | None = None
    latents: LatentOptions | None = None
    refine: RefineOptions | None = None


FEW = [DialPlace(name=f"{n} in latents", latents=LatentOptions(iterations=n, sampled=True)) for n in (1, 2, 4)]
ALL = LatentOptions(iterations=QUALITIES["latent"].latent_iterations)
HELD, CARRIED = RefineOptions(iterations=4), RefineOptions(iterations=QUALITIES["hero"].refine, feedback=True)
NETWORK = DialPlace(name="network")
PLACES = (
    DialPlace(name="crowd", level="crowd"),
    DialPlace(name="game", level="game"),
    NETWORK,
    *FEW,
    DialPlace(name="latent", latents=ALL),
    DialPlace(name="refine 4", refine=HELD),
    DialPlace(name="hero", refine=CARRIED),
)


def refined(
    subject: Subject, take_set: TakeSet, order: Sequence[int], options: RefineOptions
) -> Iterator[dict[int, Floats]]:
    """Yield refined vertices (V, 3) in the world [m], by take: with feedback of all takes at once, else one by one.

    Args:
        order: the takes, longest first.
    """
    dressed, played = subject.dressed, Network(subject.model, take_set)
    refiner = Refiner(dressed.scene, dressed.fabric, options, fps=dressed.fps, device=dressed.device)
    motions, networks = [take_set.takes[take].motion for take in order], []
    for take, motion in zip(order, motions):
        x = played.vertices(take, range(motion.frame_count)).double().permute(2, 0, 1).cpu().numpy()
        networks.append(x + take_set.origins[take])
    if options.feedback:
        for frames in refiner.shots_at_once(motions, networks):
            yield {take: frame.points for take, frame in zip(order, frames)}
    else:
        for take, motion, network in zip(order, motions, networks):
            for frame in refiner.frames(motion, network):
                yield {take: frame.points}


class Refined:
    """A `Method`: takes of a network, refined, before they are stored as joints and blendshapes."""

    def __init__(
        self, subject: Subject, take_set: TakeSet, options: RefineOptions, advanced: Callable[[], object]
    ) -> None:
        order = sorted(range(len(take_set.takes)), key=lambda take: -take_set.takes[take].frame_count)
        frames: list[list[Floats]] = [[] for _ in order]
        for found in refined(subject, take_set, order, options):
            for take, points in found.items():
                frames[take].append(points)
            advanced()
        self.take_set, self.points = take_set, [np.stack(own) for own in frames]

    def vertices(self, take: int, frames: range) -> Tensor:
        return self.take_set.local(take, self.points[take][frames.start : frames.stop])

    def still(self, take: int, frames: range) -> None:
        return None


class Dial:
    """Plays one garment at each place.

    Args:
        motions: that the network is reduced for.
    """

    def __init__(self, subject: Subject, motions: Sequence[Motion]) -> None:
        self.subject, self.motions = subject, motions

    @cached_property
    def reducer(self) -> Reducer:
        return Reducer(self.subject.file, self.motions)

    def file(self, place: DialPlace) -> ModelFile:
        """Return the model of a place, as 'ssilk reduce' writes it where it is reduced."""
        if place.level is None:
            return self.subject.file
        level, fps = QUALITIES[place.level], self.subject.file.config.fps
        size = level.size.within(self.reducer.whole)
        packed = Variant(swept="level", name=place.name, size=size, precision="int16", fps=fps)
        return packed.in_precision(self.reducer.reduce(size).file)

    def method(self, place: DialPlace, take_set: TakeSet, advanced: Callable[[], object] = lambda: None) -> Method:
        """Return a place over takes; `advanced` is called after each frame that a solver finds."""
        subject = self.subject
        if place.latents:
            return SolvedNetwork(subject.model, subject.file.fabric, place.latents, take_set, advanced)
        if place.refine:
            return Refined(subject, take_set, place.refine, advanced)
        if place.level is None:
            return Network(subject.model, take_set)
        fps = QUALITIES[place.level].rate(subject.dressed.fps)
        return ShotMethod(place.name, Player(self.file(place)), subject.dressed, take_set, fps=fps)

    def milliseconds(self, place: DialPlace | None, shots: Sequence[Motion], *, at_once: bool) -> tuple[int, float]:
        """Time a place, or the simulator where it is None, on shots of one length.

        Shots that are not played at once are played by the numpy runtime, or solved, one after the other. Refinement
        without feedback takes them one by one in any case: it refines a shot's frames at once. The times of solvers
        on a processor are processor times.

        Returns:
            How many shots are played at once, and the mean time of a frame of one shot [ms]; without the first frame,
            in which solvers begin at rest, and without a first pass, which loads.
        """
        if place and not (place.latents or place.refine):
            if at_once:
                return len(shots), self._network_time(place, shots)
            return 1, self._player_time(place, shots)
        held = bool(place and place.refine and not place.refine.feedback)
        batches = [list(shots)] if at_once and not held else [[shot] for shot in shots[:ALONE]]
        if not held:
            batches = [[shot.clip(0, TIMED) for shot in batch] for batch in batches]
        self._timed(place, batches[0] if held else [shot.clip(0, WARM_UP) for shot in batches[0]])
        return len(batches[0]), float(np.mean([self._timed(place, batch) for batch in batches]))

    def _player_time(self, place: DialPlace, shots: Iterable[Motion]) -> float:
        """Return the time of a frame in the numpy runtime [ms]."""
        player = Player(self.file(place))
        return float(np.mean([play_time(player, shot).median for shot in shots]))

    @torch.no_grad()
    def _network_time(self, place: DialPlace, shots: Sequence[Motion]) -> float:
        """Return the time of a frame and shot of a network in PyTorch [ms], from poses to vertices."""
        subject, times = self.subject, []
        model = subject.model if place.level is None else self._network(self.file(place))
        for _ in range(3):
            begun = now(subject.device)
            takes = self._take_set(shots)
            states = torch.cat([*Network(model, takes).states])
            model.vertices(states, takes.bank.character(torch.arange(len(states), device=subject.device)))
            times.append(1000 * (now(subject.device) - begun) / len(states))
        return min(times)

    def _network(self, file: ModelFile) -> GarmentModel:
        """Return a reduced model, whose rig is its own, on the whole character."""
        return network(file, replace(file.scene, character=self.subject.scene.character)).to(self.subject.device)

    def _take_set(self, shots: Iterable[Motion]) -> TakeSet:
        model = self.subject.model
        takes = [Take(shot.path, 0, shot) for shot in shots]
        return build_take_set(takes, self.subject.dressed, model.joints, model.config.descriptors)

    def _timed(self, place: DialPlace | None, batch: Sequence[Motion]) -> float:
        """Return the mean time of a frame and shot of a solver over shots at once [ms], without the first yielded."""
        on_gpu, device = self.subject.device.type == "cuda", self.subject.device
        ends: list[float] = []
        for _ in self._frames(place, batch):
            ends.append(now(device) if on_gpu else time.process_time())
        return 1000 * (ends[-1] - ends[0]) / (len(ends) - 1) / len(batch)

    def _frames(self, place: DialPlace | None, batch: Sequence[Motion]) -> Iterator[object]:
        """Yield the frames of shots; the simulator's from the second on, as it is given two states."""
        subject, take_set = self.subject, self._take_set(batch)
        if place and place.latents:
            yield from LatentShots(subject.model, subject.file.fabric, place.latents).frames(batch)
            return
        if place and place.refine:
            yield from refined(subject, take_set, range(len(batch)), place.refine)
            return
        played = Network(subject.model, take_set)
        simulator, count = subject.dressed.simulator, batch[0].frame_count
        own = [MethodWindow(subject.dressed, take_set, played, (at, range(count))) for at in range(len(batch))]
        yield None
        past = history(simulator, [(window, STATES) for window in own]).split()
        steps = simulator.carry_on(
            past, [range(STATES, count)] * len(own), lambda at: poses_of(simulator, [(own[n], f) for n, f in at])
        )
        yield from islice(steps, len(own) - 1, None, len(own))  # so many make a frame of all shots
