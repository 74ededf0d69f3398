# SPDX-License-Identifier: Apache-2.0
"""The evaluation of one garment: all methods on all clips, by split."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...events import Countdown, Message, Reporter, silent
from ...network.model.network import GarmentModel
from ...scene.assets import Motion
from ...training.motion_bank import MotionBank, build_bank
from .closed_loop import closed_loop
from .figures import ClosedLoop, Figures, LoopDrift, MinimumErrors, Settling, SolverErrors
from .methods import (
    CachedPoints,
    EvaluatedMethod,
    EvaluationScene,
    LinearBlendSkinning,
    Method,
    Network,
    Reader,
    Simulated,
    TakeSet,
    build_take_set,
)
from .metrics import pose_distance
from .minimum import minima, minimum_errors
from .probes import (
    joined_loop_drift,
    joined_minimum_errors,
    joined_settling,
    last_frames,
    loop_drift,
    looped_takes,
    settling,
    stopped_takes,
)
from .record import recorded
from .solver_errors import solver_errors, windows_of
from .takes import takes_of
from .tally import Tally, figures, pose_novelty, reference_errors, takes_in

SIMULATOR = "simulator"
Stop = tuple[str, Settling, MinimumErrors | None]
"""The clip of a stop, and what was measured after it."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """What is measured besides the energies.

    Attributes:
        sequence: frames after which a clip restarts, as in the paper (512); None for whole clips.
        stops: stops in each clip after which poses are held; none for zero.
        hold: how long they are held [s].
        minimum: whether the simulator minimises the energy of held poses.
        simulate: whether it plays the stops as well, to see how it settles.
        solver: whether it simulates from the methods' own states. These three take long on a CPU.
        loop: frames that the first seconds of each clip loop for, at least; none for zero.
        linearised: states of each split about which a network's steps are linearised, at most; none for zero.
    """

    sequence: int | None = None
    stops: int = 2
    hold: float = 3.0
    minimum: bool = False
    simulate: bool = False
    solver: bool = False
    loop: int = 2000
    linearised: int = 16

    def __post_init__(self) -> None:
        if not (self.sequence is None or self.sequence >= 4):
            fail("evaluation", f"sequences of {self.sequence} frames", "four at least are needed")
        if not 0 <= self.stops <= 100:
            fail("evaluation", f"{self.stops} stops in each clip", "0 to 100 are allowed")
        if not 0 < self.hold <= 600:
            fail("evaluation", f"a hold of {self.hold:g} s", "it lies between 0 and 600 s")
        if not 0 <= self.loop <= 1_000_000:
            fail("evaluation", f"loops of {self.loop} frames", "0 to 1,000,000 are allowed")
        if not 0 <= self.linearised <= 10_000:
            fail("evaluation", f"{self.linearised} states to linearise about", "0 to 10,000 are allowed")


@dataclass(frozen=True, eq=False)
class EvaluationClips:
    """What is played.

    Attributes:
        clips: motions by name.
        splits: names of clips by split; a clip may be in several.
        simulated: clips that there are shots of the reference simulator of; `read` returns its points at the
            methods' rate.
        seen: training motions; none where they are not known.
    """

    clips: Mapping[str, Motion]
    splits: Mapping[str, Sequence[str]]
    simulated: frozenset[str] = frozenset()
    read: Reader | None = None
    seen: Sequence[Motion] = ()


@dataclass(frozen=True)
class ResultRow:
    """Figures of one method on one split."""

    garment: str
    method: str
    split: str
    figures: Figures


def evaluate(
    dressed: EvaluationScene,
    methods: Sequence[EvaluatedMethod],
    playlist: EvaluationClips,
    options: EvaluationOptions | None = None,
    report: Reporter = silent,
) -> Iterator[ResultRow]:
    """Yield the figures of linear blend skinning, of the simulator where it has played, and of each method, by split.

    Raises:
        SsilkError: no clip has four frames, or a point cache is not of its clip.
    """
    run = _Run(dressed, methods, playlist, options or EvaluationOptions(), report)
    yield from run.rows(run.lbs, "LBS")
    yield from run.simulator_rows()
    for method in methods:
        yield from run.method_rows(method)


class _Run:
    """Takes of all clips, with the records of linear blend skinning and of the simulator."""

    def __init__(
        self,
        dressed: EvaluationScene,
        methods: Sequence[EvaluatedMethod],
        playlist: EvaluationClips,
        options: EvaluationOptions,
        report: Reporter,
    ) -> None:
        self.dressed, self.playlist, self.options, self.report = dressed, playlist, options, report
        skeleton, clips = dressed.scene.character.skeleton, playlist.clips.items()
        cut = [takes_of(name, motion, skeleton, dressed.fps, options.sequence) for name, motion in clips]
        self.takes = [take for takes in cut for take in takes]
        self.clips = {number: take.clip for number, take in enumerate(self.takes)}
        self.simulated = takes_in(self.clips, playlist.simulated)
        self.told = Countdown(len(self.takes) * (len(methods) + 1) + len(self.simulated), report)
        self.joints = methods[0].joints
        take_set = build_take_set(self.takes, dressed, self.joints)
        read = playlist.read
        self.cache = CachedPoints(read, dressed, take_set) if read else None
        self.simulator = self._tally(take_set, self.cache, self.simulated) if self.cache else Tally({}, self.clips)
        self.lbs = self._tally(take_set, LinearBlendSkinning(dressed, take_set), list(self.clips))

    def _tally(self, take_set: TakeSet, method: Method, takes: Sequence[int]) -> Tally:
        """Measure a method over takes, with its errors where the simulator has played."""
        records = {}
        for take in takes:
            reference = self.cache if take in self.simulated and method is not self.cache else None
            records[take] = recorded(self.dressed, take_set, method, take, reference)
            self.told()
        return Tally(records, self.clips)

    def rows(self, tally: Tally, method: str) -> Iterator[ResultRow]:
        """Yield the figures of a method that has no state of its own."""
        for split, names in self.playlist.splits.items():
            own = tally.only(takes_in(self.clips, names))
            if own.records:
                yield ResultRow(self.dressed.name, method, split, self._figures(own))

    def _figures(self, tally: Tally) -> Figures:
        takes, weight = list(tally.records), self.dressed.weight
        found = figures(tally, self.lbs.only(takes), weight, self.dressed.covered)
        return replace(found, reference=reference_errors(tally, self.simulator.only(takes), weight))

    def simulator_rows(self) -> Iterator[ResultRow]:
        """Yield the figures of the simulator."""
        wanted = self.options.simulate and self.options.stops and self.simulator.records
        stopped = self._stopped(self.joints, partial(Simulated, self.dressed)) if wanted else []
        for row in self.rows(self.simulator, SIMULATOR):
            yield replace(row, figures=replace(row.figures, **self._rested(stopped, row.split)))

    def method_rows(self, method: EvaluatedMethod) -> Iterator[ResultRow]:
        """Yield the figures of a method."""
        take_set = build_take_set(self.takes, self.dressed, method.joints)
        played = method.on(take_set)
        tally = self._tally(take_set, played, list(self.clips))
        distances, loops = self._distances(take_set, method.joints), self._loops(method)
        stopped = self._stopped(method.joints, method.on)
        for row in self.rows(tally, method.name):
            names = self.playlist.splits[row.split]
            found = replace(
                row.figures,
                **self._rested(stopped, row.split),
                pose_novelty=pose_novelty(tally.only(takes_in(self.clips, names)), distances) if distances else None,
                loop_drift=joined_loop_drift([loop for clip, loop in loops if clip in names]),
                solver=self._solver_errors(take_set, played, takes_in(self.clips, names)),
                closed_loop=self._closed_loop(played, takes_in(self.clips, names)),
            )
            yield replace(row, figures=found)

    def _solver_errors(self, take_set: TakeSet, method: Method, takes: Sequence[int]) -> SolverErrors | None:
        """Return how far a method is from the solver on some takes; None unless asked for, or for short takes."""
        windows = windows_of(self.dressed, take_set, takes) if self.options.solver else []
        if not windows:
            return None
        self.report(Message(f"the solver plays {len(windows)} windows and single steps from the method's own states"))
        return solver_errors(self.dressed, take_set, method, windows, self.report)

    def _closed_loop(self, method: Method, takes: Sequence[int]) -> ClosedLoop | None:
        """Return the closed loop of single steps on some takes; None but for networks with states of two frames."""
        if not (isinstance(method, Network) and isinstance(method.model, GarmentModel)):
            return None
        return closed_loop(method, takes, self.options.linearised)

    def _distances(self, take_set: TakeSet, joints: np.ndarray) -> dict[int, Tensor]:
        """Return the distances of each take's poses from the training's [rad], (N,); empty if those are not known."""
        if not self.playlist.seen:
            return {}
        skeleton, device = self.dressed.scene.character.skeleton, self.dressed.device
        seen = build_bank(self.playlist.seen, skeleton, joints, self.dressed.fps, device)
        far = pose_distance(_upright(take_set.bank), _upright(seen), len(joints))
        return dict(enumerate(far.split((take_set.bank.stops - take_set.bank.starts).tolist())))

    def _stopped(self, joints: np.ndarray, method_on: Callable[[TakeSet], Method]) -> list[Stop]:
        """Return what was measured after each stop."""
        options, dressed = self.options, self.dressed
        takes, first = stopped_takes(self.takes, dressed.fps, options.stops, options.hold)
        if not takes:
            return []
        take_set = build_take_set(takes, dressed, joints)
        method = method_on(take_set)
        settled = settling(dressed, take_set, method, first)
        rested: Sequence[MinimumErrors | None] = [None] * len(takes)
        if options.minimum:
            rested = minimum_errors(minima(dressed.simulator, takes, last_frames(method, takes)), dressed.weight)
        return [(take.clip, after, errors) for take, after, errors in zip(takes, settled, rested)]

    def _rested(self, stopped: Sequence[Stop], split: str) -> dict[str, Any]:
        """Return the figures of the stops of a split."""
        own = [stop for stop in stopped if stop[0] in self.playlist.splits[split]]
        return {
            "settling": joined_settling([after for _, after, _ in own]),
            "minimum": joined_minimum_errors([errors for _, _, errors in own if errors]),
        }

    def _loops(self, method: EvaluatedMethod) -> list[tuple[str, LoopDrift]]:
        """Return how looped takes drift, with the clip of each."""
        if not self.options.loop:
            return []
        takes, lengths = looped_takes(self.takes, self.dressed.fps, self.options.loop)
        take_set = build_take_set(takes, self.dressed, method.joints)
        found = loop_drift(self.dressed, take_set, method.on(take_set), lengths)
        return [(take.clip, loop) for take, loop in zip(takes, found)]


def _upright(bank: MotionBank) -> Tensor:
    """Return the static descriptors of all frames of a bank, gravity being where it was."""
    frames = torch.arange(bank.frame_count, device=bank.root.device)
    return bank.static_descriptor(frames, bank.root.new_tensor([0.0, -1.0, 0.0]).expand(len(frames), 3))
