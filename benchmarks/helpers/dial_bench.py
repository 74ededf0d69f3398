# SPDX-License-Identifier: Apache-2.0
"""One garment on its character for the dial: its windows, and the file of what was measured in them."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from helpers.dial_places import PLACES, SIMULATOR, Dial
from helpers.own_windows import STATES, spread_windows
from helpers.reports import RESULTS, rounded
from helpers.subjects import Subject, clip_of, open_subject
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import fail
from ssilk_core.events import Reporter
from ssilk_core.files import sha256
from ssilk_core.quality.evaluation.methods import TakeSet, build_take_set
from ssilk_core.quality.evaluation.own_starts import Window
from ssilk_core.quality.evaluation.splits import read_index, splits_of
from ssilk_core.quality.evaluation.takes import Take, takes_of
from ssilk_core.quality.kept_rows import UNFINISHED, KeptRows

OFF = "simulator, 1 mm off"  # the simulator that begins a millimetre beside the network, beside the simulator


@dataclass(frozen=True, kw_only=True)
class DialErrors:
    """What a place on the dial does in the windows of a split; a value for each window in which it is finite.

    Attributes:
        lost: windows in which it is not.
        distance: RMS distance from the simulator that goes on from the place's own two states, after frames [m].
        velocity: RMS error of velocity [m/s].
        total: mean energy [J].
        shown, limbs, intersecting: mean shares of the covered skin that shows, of frames in which a limb is through
            the cloth, and of triangles that intersect others.
        jitter: RMS of the third difference of positions [m].
    """

    split: str
    place: str
    lost: int
    distance: dict[str, tuple[float, ...]]
    velocity: tuple[float, ...]
    total: tuple[float, ...]
    shown: tuple[float, ...]
    limbs: tuple[float, ...]
    intersecting: tuple[float, ...]
    jitter: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class DialTime:
    """What a frame of one shot takes at a place [ms], where so many shots are played at once."""

    place: str
    device: str
    hardware: str
    shots: int
    milliseconds: float


@dataclass(frozen=True, eq=False)
class Windows:
    """Takes, of which each is a window with its lead, and the windows of each split."""

    takes: list[Take]
    windows: dict[str, list[Window]]


class DialBench:
    """One garment on its character, with its windows and its file of figures."""

    def __init__(self, options: argparse.Namespace, report: Reporter) -> None:
        self.options, self.report = options, report
        self.path = options.model or shipped_path(options.garment)
        self.subject: Subject = open_subject(self.path, options.stage, options.device)
        index = read_index(options.index or options.motions / "index.json")
        self.splits, whole = (
            {name: clips for name, clips in splits_of(index, chosen).items() if name in options.splits}
            for chosen in (options.clips, ())
        )
        if not self.splits:
            fail("clips", f"none of the splits {', '.join(options.splits)} is chosen", "one at least is needed")
        names = [clip for clips in whole.values() for clip in clips]  # networks are reduced for all of them
        self.clips = {name: clip_of(options, name, self.subject) for name in names}
        self.kept = KeptRows(
            path=options.output or RESULTS / f"dial_{self.path.stem}.json",
            verb="dial",
            kind=DialErrors,
            names=("split", "place"),
            inputs=self._inputs(),
            beside={"times": DialTime},
        )
        self.rows = self.kept.known(report)
        told = self.kept.told()
        self.document = told if told.get(self.kept.inputs_at) == self.kept.inputs else {}

    def _inputs(self) -> dict[str, Any]:
        motions = self.options.motions
        return {
            "model": sha256(self.path),
            "stage": sha256(self.options.stage),
            "motions": {name: sha256(motions / f"{name}.usdc") for name in self.clips},
            "windows": self.options.windows,
            "lead": self.options.lead,
            "after": self.options.after,
            "clips": self.splits,
        }

    @cached_property
    def windows(self) -> Windows:
        """The windows of all splits, each a take of its own with its lead."""
        skeleton, fps = self.subject.scene.character.skeleton, self.subject.file.config.fps
        takes: list[Take] = []
        windows: dict[str, list[Window]] = {}
        for split, clips in self.splits.items():
            windows[split] = []
            for clip in clips:
                own = takes_of(clip, self.clips[clip], skeleton, fps)
                spread = spread_windows(dict(enumerate(own)), self.options.windows, [max(self.options.after)])
                for number, frames in spread:
                    take, first = own[number], max(0, frames.start - self.options.lead)
                    windows[split].append((len(takes), range(frames.start - first, frames.stop - first)))
                    cut = take.motion.clip(first, frames.stop)
                    takes.append(replace(take, first=take.first + first, motion=cut))
            if not windows[split]:
                fail(split, "its clips are too short", f"{STATES + max(self.options.after)} frames are needed")
        return Windows(takes, windows)

    @cached_property
    def take_set(self) -> TakeSet:
        model = self.subject.model
        return build_take_set(self.windows.takes, self.subject.dressed, model.joints, model.config.descriptors)

    @cached_property
    def dial(self) -> Dial:
        return Dial(self.subject, list(self.clips.values()))

    @property
    def names(self) -> list[tuple[str, str]]:
        """The rows that a whole file has of all places, by split and place."""
        places = [*(place.name for place in PLACES), SIMULATOR, OFF]
        return [(split, place) for split in self.splits for place in places]

    def write(self, **told: Any) -> None:
        """Write the file; it is finished once it has all rows of errors of the places that are asked for."""
        measured = {(row.split, row.place) for row in self.rows}
        self.document = {"units": "SI, times in ms", **self.document, **told}
        inputs = (self.kept.inputs_at, self.kept.rows_at, UNFINISHED)
        plain = {name: value for name, value in self.document.items() if name not in inputs}
        rows = sorted(self.rows, key=lambda row: self.names.index((row.split, row.place)))
        figures = rounded([asdict(row) for row in rows])
        wanted = {(split, place) for split, place in self.names if place in (*self.options.places, SIMULATOR, OFF)}
        self.kept.write(plain, figures, finished=measured >= wanted)
