# SPDX-License-Identifier: Apache-2.0
"""The evaluation of one garment: all methods on all clips, by split."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..assets import Motion
from ..errors import fail
from ..events import Progress, Reporter, silent
from ..motion_bank import LatentModel, MotionBank, build_bank
from .figures import Figures, Holds, Hung, Loops
from .methods import CachedPoints, EvaluationScene, Method, Network, Plain, Reader, Simulated, TakeSet, reel_of
from .metrics import pose_distance
from .minimum import hung, minima
from .probes import drifted, held, joined_holds, joined_hung, joined_loops, last_frames, looped, stops
from .record import recorded
from .takes import takes_of
from .tally import Tally, against, figures, poses, takes_in

SIMULATOR = "simulator"
Stop = tuple[str, Holds, Hung | None]
"""The clip of a stop, with what happened after it."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """What is measured beside the energies.

    Attributes:
        sequence: frames after which a clip starts anew, as in the paper (512); None for whole clips.
        stops: stops in each clip after which poses are held; none for zero.
        hold: how long they are held [s].
        minimum: whether the simulator minimises the energy of held poses.
        simulate: whether it plays the stops as well, to see how it settles; both take long on a CPU.
        loop: frames that the first seconds of each clip loop for, at least; none for zero.
    """

    sequence: int | None = None
    stops: int = 2
    hold: float = 3.0
    minimum: bool = False
    simulate: bool = False
    loop: int = 2000

    def __post_init__(self) -> None:
        if not (self.sequence is None or self.sequence >= 4):
            fail("evaluation", f"sequences of {self.sequence} frames", "four at least are needed")
        if not 0 <= self.stops <= 100:
            fail("evaluation", f"{self.stops} stops in each clip", "0 to 100 are allowed")
        if not 0 < self.hold <= 600:
            fail("evaluation", f"a hold of {self.hold:g} s", "it lies between 0 and 600 s")
        if not 0 <= self.loop <= 1_000_000:
            fail("evaluation", f"loops of {self.loop} frames", "0 to 1,000,000 are allowed")


@dataclass(frozen=True, eq=False)
class EvaluatedModel:
    """A network under a name, and the character's joints that it has in view."""

    name: str
    model: LatentModel
    joints: np.ndarray


@dataclass(frozen=True, eq=False)
class EvaluationClips:
    """What is played.

    Attributes:
        clips: motions by name.
        splits: names of clips by split; a clip may be in several.
        simulated: clips that the reference simulator has played, with `read` to get its points at the models' rate.
        seen: motions that networks were trained on; none where that is not known.
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
    subjects: Sequence[EvaluatedModel],
    playlist: EvaluationClips,
    options: EvaluationOptions | None = None,
    report: Reporter = silent,
) -> Iterator[ResultRow]:
    """Yield the figures of linear blend skinning, of the simulator where it has played, and of each network, by
    split.

    Raises:
        SsilkError: no clip has four frames, or a point cache is not of its clip.
    """
    run = _Run(dressed, subjects, playlist, options or EvaluationOptions(), report)
    yield from run.rows(run.lbs, "LBS")
    yield from run.truth_rows()
    for subject in subjects:
        yield from run.network_rows(subject)


class _Run:
    """Takes of all clips, with the records of linear blend skinning and of the simulator on them."""

    def __init__(
        self,
        dressed: EvaluationScene,
        subjects: Sequence[EvaluatedModel],
        playlist: EvaluationClips,
        options: EvaluationOptions,
        report: Reporter,
    ) -> None:
        self.dressed, self.playlist, self.options, self.report = dressed, playlist, options, report
        cut = [takes_of(name, motion, dressed.fps, options.sequence) for name, motion in playlist.clips.items()]
        self.takes = [take for takes in cut for take in takes]
        self.clips = {number: take.clip for number, take in enumerate(self.takes)}
        self.simulated = takes_in(self.clips, playlist.simulated)
        self.done, self.total = 0, len(self.takes) * (len(subjects) + 1) + len(self.simulated)
        self.joints = subjects[0].joints
        reel = reel_of(self.takes, dressed, self.joints)
        read = playlist.read
        self.cache = CachedPoints(SIMULATOR, read, dressed, reel) if read else None
        self.truth = self._tally(reel, self.cache, self.simulated) if self.cache else Tally({}, self.clips)
        self.lbs = self._tally(reel, Plain(dressed, reel), list(self.clips))

    def _tally(self, reel: TakeSet, method: Method, takes: Sequence[int]) -> Tally:
        """Measure a method over takes, beside the simulator where that has played."""
        records = {}
        for take in takes:
            truth = self.cache if take in self.simulated and method is not self.cache else None
            records[take] = recorded(self.dressed, reel, method, take, truth)
            self.done += 1
            self.report(Progress(self.done, self.total))
        return Tally(records, self.clips)

    def rows(self, tally: Tally, method: str) -> Iterator[ResultRow]:
        """Yield the figures of a method that has no state of its own."""
        for split, names in self.playlist.splits.items():
            own = tally.only(takes_in(self.clips, names))
            if own.records:
                yield ResultRow(self.dressed.name, method, split, self._figures(own))

    def _figures(self, tally: Tally) -> Figures:
        takes, weight = list(tally.records), self.dressed.weight
        found = figures(tally, self.lbs.only(takes), weight)
        return replace(found, truth=against(tally, self.truth.only(takes), weight))

    def truth_rows(self) -> Iterator[ResultRow]:
        """Yield the figures of the simulator."""
        wanted = self.options.simulate and self.options.stops and self.truth.records
        stopped = self._stopped(self.joints, lambda reel: Simulated(SIMULATOR, self.dressed, reel)) if wanted else []
        for row in self.rows(self.truth, SIMULATOR):
            yield replace(row, figures=replace(row.figures, **self._rested(stopped, row.split)))

    def network_rows(self, subject: EvaluatedModel) -> Iterator[ResultRow]:
        """Yield the figures of a network."""
        reel = reel_of(self.takes, self.dressed, subject.joints)
        tally = self._tally(reel, Network(subject.name, subject.model, reel), list(self.clips))
        far, loops = self._distances(reel, subject), self._loops(subject)
        stopped = self._stopped(subject.joints, lambda reel: Network(subject.name, subject.model, reel))
        for row in self.rows(tally, subject.name):
            names = self.playlist.splits[row.split]
            found = replace(
                row.figures,
                **self._rested(stopped, row.split),
                poses=poses(tally.only(takes_in(self.clips, names)), far) if far else None,
                loops=joined_loops([loop for clip, loop in loops if clip in names]),
            )
            yield replace(row, figures=found)

    def _distances(self, reel: TakeSet, subject: EvaluatedModel) -> dict[int, Tensor]:
        """Return how far the poses of each take are from those seen in training [rad], (N,); empty if not known."""
        if not self.playlist.seen:
            return {}
        skeleton, device = self.dressed.scene.character.skeleton, self.dressed.device
        seen = build_bank(self.playlist.seen, skeleton, subject.joints, self.dressed.fps, device)
        far = pose_distance(_upright(reel.bank), _upright(seen), len(subject.joints))
        return dict(enumerate(far.split((reel.bank.stops - reel.bank.starts).tolist())))

    def _stopped(self, joints: np.ndarray, method_on: Callable[[TakeSet], Method]) -> list[Stop]:
        """Return what happens after stops, and where that is beside the minimum, with the clip of each."""
        options, dressed = self.options, self.dressed
        takes, first = stops(self.takes, dressed.fps, options.stops, options.hold)
        if not takes:
            return []
        reel = reel_of(takes, dressed, joints)
        method = method_on(reel)
        holds = held(dressed, reel, method, first)
        rested: Sequence[Hung | None] = [None] * len(takes)
        if options.minimum:
            rested = hung(minima(dressed.simulator, takes, last_frames(method, takes)), dressed.weight)
        return [(take.clip, hold, rest) for take, hold, rest in zip(takes, holds, rested)]

    def _rested(self, stopped: Sequence[Stop], split: str) -> dict[str, Any]:
        """Return the figures of the stops of a split."""
        own = [stop for stop in stopped if stop[0] in self.playlist.splits[split]]
        return {
            "holds": joined_holds([hold for _, hold, _ in own]),
            "hung": joined_hung([rest for _, _, rest in own if rest]),
        }

    def _loops(self, subject: EvaluatedModel) -> list[tuple[str, Loops]]:
        """Return how looped takes drift, with the clip of each."""
        if not self.options.loop:
            return []
        takes, lengths = looped(self.takes, self.dressed.fps, self.options.loop)
        reel = reel_of(takes, self.dressed, subject.joints)
        found = drifted(self.dressed, reel, Network(subject.name, subject.model, reel), lengths)
        return [(take.clip, loop) for take, loop in zip(takes, found)]


def _upright(bank: MotionBank) -> Tensor:
    """Return the static descriptors of all frames of a bank, gravity being where it was."""
    frames = torch.arange(bank.frame_count, device=bank.root.device)
    return bank.static_descriptor(frames, bank.root.new_tensor([0.0, -1.0, 0.0]).expand(len(frames), 3))
