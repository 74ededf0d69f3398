# SPDX-License-Identifier: Apache-2.0
"""A method over clips, of which each is measured when a row first needs it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import torch
from torch import Tensor

from ...training.motion_bank import MotionBank, build_bank
from .asked import EvaluationClips, EvaluationOptions
from .figures import LoopDrift, MinimumErrors, Settling
from .kept_parts import KeptParts
from .methods import CachedPoints, EvaluatedMethod, EvaluationScene, build_take_set
from .metrics import pose_distance
from .minimum import minima, minimum_errors
from .probes import last_frames, loop_drift, looped_takes, settling, stopped_takes
from .record import TakeRecord, recorded
from .takes import Take
from .tally import Tally, takes_in

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Stop:
    """What is measured after a stop."""

    settling: Settling
    minimum: MinimumErrors | None


class ByClip(Generic[T]):
    """What is measured of clips: of each once, and together of those that are asked for at once.

    Args:
        takes: of the clips.
        measure: yields what it measures of some takes, each with its clip.
        kind: of what is measured of a clip.
        kept: what was measured before.
    """

    def __init__(
        self,
        takes: Sequence[Take],
        measure: Callable[[list[Take]], Iterator[tuple[str, T]]],
        kind: type[list[T]],
        kept: KeptParts,
    ) -> None:
        self._takes, self._measure, self._kind, self._kept = takes, measure, kind, kept
        self._found: dict[str, list[T]] = {}

    def of(self, clips: Collection[str]) -> list[T]:
        """Return what is measured of some clips, in the order of the takes."""
        own = [clip for clip in dict.fromkeys(take.clip for take in self._takes) if clip in clips]
        before = {clip: self._kept.get(clip, self._kind) for clip in own if clip not in self._found}
        self._found |= {clip: found for clip, found in before.items() if found is not None}
        new = [take for take in self._takes if take.clip in clips and take.clip not in self._found]
        measured: dict[str, list[T]] = {take.clip: [] for take in new}
        for clip, value in self._measure(new) if new else ():
            measured[clip].append(value)
        for clip, values in measured.items():
            self._kept.put(clip, values)
        self._found |= measured
        return [value for clip in own for value in self._found[clip]]


class MeasuredMethod:
    """A method over takes, in one batch.

    Args:
        playlist: says which clips the simulator has played, which the method is compared with, and what was seen.
        told: is called after each take.
        kept: records of takes that were measured before.
    """

    def __init__(
        self,
        dressed: EvaluationScene,
        method: EvaluatedMethod,
        takes: Sequence[Take],
        playlist: EvaluationClips,
        told: Callable[[], None],
        kept: KeptParts,
    ) -> None:
        self.dressed, self.joints, self._seen, self._told = dressed, method.joints, playlist.seen, told
        self._kept = kept
        self.take_set = build_take_set(takes, dressed, method.joints, method.descriptors)
        self._descriptors = method.descriptors
        self.clips = {number: take.clip for number, take in enumerate(takes)}
        self.played = method.on(self.take_set)
        self._cache = CachedPoints(playlist.read, dressed, self.take_set) if playlist.read else None
        self._simulated = takes_in(self.clips, playlist.simulated) if self._cache else []
        self._records: dict[int, TakeRecord] = {}

    def tally(self, clips: Collection[str]) -> Tally:
        """Return the records of some clips, with errors where the simulator has played."""
        takes = takes_in(self.clips, clips)
        for take in takes:
            if take not in self._records:
                self._records[take] = self._kept.get(take, TakeRecord) or self._measured(take)
        return Tally({take: self._records[take] for take in takes}, self.clips)

    def _measured(self, take: int) -> TakeRecord:
        reference = self._cache if take in self._simulated else None
        found = recorded(self.dressed, self.take_set, self.played, take, reference)
        self._kept.put(take, found)
        self._told()
        return found

    @cached_property
    def distances(self) -> dict[int, Tensor]:
        """The distances of each take's poses from the training's [rad], (N,); empty where those are not known."""
        if not self._seen:
            return {}
        skeleton, bank = self.dressed.scene.character.skeleton, self.take_set.bank
        known = build_bank(
            self._seen, skeleton, self.joints, self.dressed.fps, self.dressed.device, kind=self._descriptors
        )
        far = pose_distance(_upright(bank), _upright(known), len(self.joints))
        return dict(enumerate(far.split((bank.stops - bank.starts).tolist())))


class Probes:
    """A method after stops, and in loops."""

    def __init__(
        self,
        dressed: EvaluationScene,
        method: EvaluatedMethod,
        takes: Sequence[Take],
        options: EvaluationOptions,
        kept: KeptParts,
    ) -> None:
        self._dressed, self._method, self._takes, self._options = dressed, method, takes, options
        self._kept = kept

    @cached_property
    def stops(self) -> ByClip[Stop]:
        """What is measured after each stop."""
        return ByClip(self._takes, self._stopped, list[Stop], self._kept.of("stops"))

    @cached_property
    def loops(self) -> ByClip[LoopDrift]:
        """How looped takes drift."""
        return ByClip(self._takes, self._looped, list[LoopDrift], self._kept.of("loops"))

    def _stopped(self, takes: list[Take]) -> Iterator[tuple[str, Stop]]:
        options, dressed = self._options, self._dressed
        held, first = stopped_takes(takes, dressed.fps, options.stops, options.hold)
        if not held:
            return
        take_set = build_take_set(held, dressed, self._method.joints, self._method.descriptors)
        method = self._method.on(take_set)
        settled = settling(dressed, take_set, method, first)
        rested: Sequence[MinimumErrors | None] = [None] * len(held)
        if options.minimum:
            rested = minimum_errors(minima(dressed.simulator, held, last_frames(method, held)), dressed.weight)
        yield from ((take.clip, Stop(own, lowest)) for take, own, lowest in zip(held, settled, rested))

    def _looped(self, takes: list[Take]) -> Iterator[tuple[str, LoopDrift]]:
        if not self._options.loop:
            return
        looped, lengths = looped_takes(takes, self._dressed.fps, self._options.loop)
        take_set = build_take_set(looped, self._dressed, self._method.joints, self._method.descriptors)
        found = loop_drift(self._dressed, take_set, self._method.on(take_set), lengths)
        yield from ((take.clip, loop) for take, loop in zip(looped, found))


def _upright(bank: MotionBank) -> Tensor:
    """Return the static descriptors of all frames of a bank, gravity being where it was."""
    frames = torch.arange(bank.frame_count, device=bank.root.device)
    return bank.static_descriptor(frames, bank.root.new_tensor([0.0, -1.0, 0.0]).expand(len(frames), 3))
