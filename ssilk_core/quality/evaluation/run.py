# SPDX-License-Identifier: Apache-2.0
"""The evaluation of one garment: all methods on all clips, by split."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from ...errors import fail
from ...events import Countdown, Message, Reporter, silent
from ...network.model.network import GarmentModel
from .asked import EvaluationClips, EvaluationOptions
from .bodies import LBS, SIMULATOR
from .closed_loop import closed_loop
from .figures import ClosedLoop, Figures, ResultRow, SolverErrors
from .kept_parts import NOTHING_KEPT, KeptParts
from .measured import MeasuredMethod, Probes
from .methods import (
    CachedPoints,
    EvaluatedMethod,
    EvaluationScene,
    LinearBlendSkinning,
    Network,
    Simulated,
    need_takes,
)
from .probes import joined_loop_drift, joined_minimum_errors, joined_settling
from .solver_errors import solver_errors, windows_of
from .takes import Take, takes_of
from .tally import Tally, figures, pose_novelty, reference_errors


def evaluate(
    dressed: EvaluationScene,
    methods: Sequence[EvaluatedMethod],
    playlist: EvaluationClips,
    options: EvaluationOptions | None = None,
    report: Reporter = silent,
    known: Sequence[ResultRow] = (),
    kept: KeptParts = NOTHING_KEPT,
) -> Iterator[ResultRow]:
    """Yield the figures of linear blend skinning and of the simulator, where it has played, and of each method.

    Args:
        known: the first rows, as an evaluation of the same yielded them; they are not measured again.
        kept: what an evaluation of the same measured of the others, bit for bit.

    Raises:
        SsilkError: no clip has four frames, a point cache is not of its clip, or two methods have one name.
    """
    yield from _Run(dressed, methods, playlist, options or EvaluationOptions(), report, known, kept).rows()


class _Run:
    """The rows of an evaluation, and the methods that those are measured of which are not known.

    Attributes:
        planned: method and split of each row, in order.
        figures: those of the rows so far.
    """

    def __init__(
        self,
        dressed: EvaluationScene,
        methods: Sequence[EvaluatedMethod],
        playlist: EvaluationClips,
        options: EvaluationOptions,
        report: Reporter,
        known: Sequence[ResultRow],
        kept: KeptParts,
    ) -> None:
        self.dressed, self.playlist, self.options, self.report = dressed, playlist, options, report
        self.kept = kept
        skeleton, clips = dressed.scene.character.skeleton, playlist.clips.items()
        cut = [takes_of(name, motion, skeleton, dressed.fps, options.sequence) for name, motion in clips]
        self.takes = [take for takes in cut for take in takes]
        need_takes(self.takes)
        joints, names = methods[0].joints, [LBS, SIMULATOR, *(method.name for method in methods)]
        if twice := [name for name, count in Counter(names).items() if count > 1]:
            fail("evaluation", f"several methods are called {twice[0]}", "names tell rows apart", "name each once")
        self.methods = {
            LBS: EvaluatedMethod(LBS, joints, partial(LinearBlendSkinning, dressed)),
            **({SIMULATOR: EvaluatedMethod(SIMULATOR, joints, partial(CachedPoints, playlist.read, dressed))}
               if playlist.read else {}),
            **{method.name: method for method in methods},
        }  # fmt: skip
        self.planned = [*self._planned([name for name in (LBS, SIMULATOR) if name in self.methods], by_split=True),
                        *self._planned(names[2:])]  # fmt: skip
        self.figures: dict[tuple[str, str], Figures] = {}
        for place, row in zip(self.planned, known):
            if place != (row.method, row.split):
                break
            self.figures[place] = row.figures
        left = sum(len(self._left(name)) for name in self.methods)
        total = sum(len(self._takes(name, playlist.splits)) for name in self.methods)
        self.told = Countdown(total, report, done=total - left)
        self._measured: dict[str, MeasuredMethod] = {}
        self._probes: dict[str, Probes] = {}

    def _planned(self, methods: Sequence[str], *, by_split: bool = False) -> list[tuple[str, str]]:
        """Return method and split of the rows of some methods: those for which there are takes."""
        pairs = [(method, split) for method in methods for split in self.playlist.splits]
        if by_split:  # LBS is compared with the simulator, whose row is to be kept as soon as that is measured
            pairs = [(method, split) for split in self.playlist.splits for method in methods]
        return [(method, split) for method, split in pairs if self._takes(method, [split])]

    def _takes(self, method: str, splits: Iterable[str]) -> list[Take]:
        """Return the takes of a method in some splits."""
        names = {name for split in splits for name in self.playlist.splits[split]}
        names &= self.playlist.simulated if method == SIMULATOR else names
        return [take for take in self.takes if take.clip in names]

    def _every(self, method: str) -> list[Take]:
        """Return the takes of a method in all splits, known or not: in one batch of others, digits would differ."""
        return self._takes(method, self.playlist.splits)

    def _left(self, method: str) -> list[Take]:
        """Return the takes of a method that are to be recorded."""
        missing = (split for name, split in self.planned if name == method and (name, split) not in self.figures)
        clips, records = {take.clip for take in self._takes(method, missing)}, self._records(method)
        return [take for n, take in enumerate(self._every(method)) if take.clip in clips and n not in records]

    def _records(self, method: str) -> KeptParts:
        return self.kept.of(method, "records")

    def rows(self) -> Iterator[ResultRow]:
        """Yield the rows, and let go of each method after its last."""
        for number, (method, split) in enumerate(self.planned):
            if (method, split) not in self.figures:
                self.figures[method, split] = self._row(method, split)
            yield ResultRow(self.dressed.name, method, split, self.figures[method, split])
            if method not in (name for name, _ in self.planned[number + 1 :]):
                self._measured.pop(method, None)
                self._probes.pop(method, None)

    def _row(self, method: str, split: str) -> Figures:
        """Measure a method on a split."""
        found, names = self._base(method, split), self.playlist.splits[split]
        if method == SIMULATOR:
            return replace(found, **self._rested(method, split)) if self.options.simulate else found
        measured = self._method(method)
        tally = measured.tally(names)
        found = replace(found, reference=reference_errors(tally, self._simulator(split), self.dressed.weight))
        if method == LBS:
            return found
        return replace(
            found,
            **self._rested(method, split),
            pose_novelty=pose_novelty(tally, measured.distances) if measured.distances else None,
            loop_drift=joined_loop_drift(self._probed(method).loops.of(names)),
            solver=self._solver_errors(measured, tally, self.kept.of(method, "solver", split)),
            closed_loop=self._closed_loop(measured, tally),
        )

    def _base(self, method: str, split: str) -> Figures:
        """Return the figures that every method has."""
        dressed = self.dressed
        tally, jerk = self._tally(method, split), self._lbs_jerk(split)
        return figures(tally, jerk, dressed.weight, dressed.covered, dressed.intersections)

    def _lbs_jerk(self, split: str) -> float:
        """Return the RMS jerk of linear blend skinning on a split [m/s3]."""
        known = self.figures.get((LBS, split))
        return known.jerk if known else self._tally(LBS, split).root("jerk")

    def _simulator(self, split: str) -> Figures | None:
        """Return the figures of the simulator on a split; None where it has not played."""
        if (SIMULATOR, split) not in self.planned:
            return None
        return self.figures.get((SIMULATOR, split)) or self._base(SIMULATOR, split)

    def _tally(self, method: str, split: str) -> Tally:
        return self._method(method).tally(self.playlist.splits[split])

    def _method(self, name: str) -> MeasuredMethod:
        """Return a method over all its takes."""
        if name not in self._measured:
            playlist = replace(self.playlist, read=None) if name == SIMULATOR else self.playlist
            self._measured[name] = MeasuredMethod(
                self.dressed, self.methods[name], self._every(name), playlist, self.told, self._records(name)
            )
        return self._measured[name]

    def _probed(self, name: str) -> Probes:
        """Return the probes of a method; the simulator plays stops itself, since no file has them."""
        if name not in self._probes:
            method = self.methods[name]
            if name == SIMULATOR:
                method = replace(method, on=partial(Simulated, self.dressed))
            self._probes[name] = Probes(self.dressed, method, self.takes, self.options, self.kept.of(name))
        return self._probes[name]

    def _rested(self, method: str, split: str) -> dict[str, Any]:
        """Return the figures of a method's stops in a split."""
        stops = self._probed(method).stops.of(self.playlist.splits[split])
        return {
            "settling": joined_settling([stop.settling for stop in stops]),
            "minimum": joined_minimum_errors([stop.minimum for stop in stops if stop.minimum]),
        }

    def _solver_errors(self, measured: MeasuredMethod, tally: Tally, kept: KeptParts) -> SolverErrors | None:
        """Return how far a method is from the solver on some takes; None unless asked for, or for short takes."""
        takes, take_set = list(tally.records), measured.take_set
        windows = windows_of(self.dressed, take_set, takes) if self.options.solver else []
        if not windows:
            return None
        self.report(Message(f"the solver plays {len(windows)} windows and single steps from the method's own states"))
        return solver_errors(self.dressed, take_set, measured.played, windows, self.report, kept)

    def _closed_loop(self, measured: MeasuredMethod, tally: Tally) -> ClosedLoop | None:
        """Return the closed loop of single steps on some takes; None but for networks with states of two frames."""
        method = measured.played
        if not (isinstance(method, Network) and isinstance(method.model, GarmentModel)):
            return None
        return closed_loop(method, list(tally.records), self.options.linearised)
