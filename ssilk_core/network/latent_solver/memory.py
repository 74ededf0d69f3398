# SPDX-License-Identifier: Apache-2.0
"""Solved frames that are kept, so that a motion which changes from some frame on is solved again only from there.

Each frame follows from those before it alone. What the next one needs is large, some 0.2 MB for 2,700 vertices, and
therefore kept of the latest frame and of one in `APART`. From the last such frame before a change a shot goes on to
the same bits that it would have come to from its beginning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from ...scene.assets import Motion
from .shots import LatentFrame, LatentShots, Sampled

APART = 16  # frames between two that may be gone on from


@dataclass(eq=False)
class _KeptSpan:
    """What was solved of a motion without cuts.

    Attributes:
        frames: without what follows from them.
        ends: by their numbers, frames that may be gone on from.
    """

    motion: Motion
    frames: list[LatentFrame] = field(default_factory=list)
    ends: dict[int, LatentFrame] = field(default_factory=dict)

    def follow(self, motion: Motion) -> LatentFrame | None:
        """Forget all from where another motion differs on; return the frame to go on from, None to begin."""
        same = self.motion.same_frames(motion)
        self.motion = motion
        self.ends = {number: frame for number, frame in self.ends.items() if number < same}
        last = max(self.ends, default=-1)
        del self.frames[last + 1 :]
        return self.ends.get(last)

    def add(self, frame: LatentFrame) -> None:
        """Keep the frame after those that are kept."""
        before = frame.number - 1
        if before % APART:
            self.ends.pop(before, None)
        self.ends[frame.number] = frame
        solution = replace(frame.solution, x=frame.solution.x[:0])
        self.frames.append(replace(frame, solution=solution, past=None))


class LatentMemory:
    """Keeps what was solved of the motion that is played, one span without cuts after the other.

    Few elements are those that were chosen for the first span of all.
    """

    def __init__(self) -> None:
        self._spans: list[_KeptSpan] = []
        self._elements: Sampled | None = None
        self._next = 0

    def begin(self) -> None:
        """Let the next span be the first one of a motion, which may differ from the one that is kept."""
        self._next = 0

    def frames(self, shots: LatentShots, motion: Motion) -> Iterator[tuple[LatentFrame, bool]]:
        """Yield the frames of the next span, and whether each was solved just now; others are as they were kept.

        Args:
            motion: of the span, at the model's rate.
        """
        if self._next == len(self._spans):
            self._spans.append(_KeptSpan(motion))
        kept = self._spans[self._next]
        self._next += 1
        if shots.options.sampled and self._elements is None:
            self._elements = shots.sampled([motion])
        after = kept.follow(motion)
        for frame in list(kept.frames):
            yield frame, False
        if after is None or after.number + 1 < motion.frame_count:
            for frame in shots.frames([motion], after, self._elements):
                kept.add(frame)
                yield frame, True
