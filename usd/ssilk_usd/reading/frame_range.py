# SPDX-License-Identifier: Apache-2.0
"""Which frames of a motion a shot plays: as asked for, as its stage says, or all that are sampled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd

from ssilk_core.errors import fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Motion, Skeleton

from ..opening.stage import needs_whole_files, open_stage
from .motion import find_animation, frame_rate, read_motion, sampled_span

_TOLERANCE = 1e-3  # of a frame


@dataclass(frozen=True)
class FrameRange:
    """Frames of a motion, as time codes of its stage.

    Attributes:
        first, last: of the range, without handles.
        fps: frames per second of the motion [1/s].
        step: from one frame of the motion to the next.
        before, after: frames of handles, at the rate of the shot.
        sampled: first and last sample of the motion.
        chosen: what the range comes from, for messages; empty where it is all that is sampled.
        left_out: why the range that the stage says is not played as it is; empty where it is.
    """

    first: float
    last: float
    fps: float
    step: float
    before: int
    after: int
    sampled: tuple[float, float]
    chosen: str = ""
    left_out: str = ""

    @property
    def count(self) -> int:
        """Frames of the motion from the first to the last of the range."""
        return _whole(self.last - self.first, self.step)

    @property
    def earlier(self) -> int:
        """Frames that are sampled before the range."""
        return _whole(self.first - self.sampled[0], self.step)

    @property
    def later(self) -> int:
        """Frames that are sampled after the first of the range."""
        return _whole(self.sampled[1] - self.first, self.step)

    def __str__(self) -> str:
        with_handles = f", with handles of {self.before} frames before and {self.after} after"
        handles = with_handles if self.before or self.after else ""
        span = _text((self.first, self.last))
        return f"frames {span}{self.chosen}{handles}; samples run from {_text(self.sampled)}"


@needs_whole_files
def read_frame_range(
    source: str,
    asked: tuple[float, float] | None = None,
    handles: int = 0,
    *,
    root: str | None = None,
    rate: float | None = None,
) -> FrameRange | None:
    """Return the frames of a motion that a shot plays; None for a pose without samples.

    The range is the one asked for, or that of the stage where it has one, within the samples, or else all samples.

    Args:
        source: "file[:/Prim/Path]", as for `read_motion`.
        asked: first and last time code, of the motion's stage; infinite ones for all samples.
        handles: frames of the shot before and after the range that are played as well, where they are sampled.
        root: the character, if several are animated.
        rate: frames per second of the shot; None for those of the motion.

    Raises:
        SsilkError: the range asked for is not sampled; also as `read_motion`.
    """
    file, prim = split_location(source)
    stage = open_stage(file)
    found = sampled_span(*find_animation(stage, prim, root))
    fps, second = frame_rate(stage)
    if found is None:
        if asked and np.isfinite(asked).all():
            fail(_option(asked), f"{source} is a pose without samples", "a range is one of sampled frames")
        return None
    step = second / fps
    (first, last), chosen, left_out = _range(stage, source, asked, found, step)
    last = first + step * _whole(last - first, step)
    found_range = FrameRange(first, last, fps, step, 0, 0, found, chosen, left_out)
    shown = fps / (rate or fps)  # frames of the motion from one frame of the shot to the next
    before = min(handles, _whole(found_range.earlier, shown))
    after = min(handles, _whole(found_range.later, shown) - _whole(found_range.count, shown))
    return replace(found_range, before=before, after=after)


def read_in_range(source: str, skeleton: Skeleton, asked: tuple[float, float]) -> Motion:
    """Return a motion's frames in the range asked for, which is that of `read_frame_range`.

    Raises:
        SsilkError: as `read_frame_range` and `read_motion`.
    """
    found = read_frame_range(source, asked)
    return read_motion(source, skeleton, within=(found.first, found.last) if found else None)


def _whole(length: float, step: float) -> int:
    """Return how many whole steps there are in a length; none in a negative one."""
    return max(int(length / step + _TOLERANCE), 0)


def _range(
    stage: Usd.Stage, source: str, asked: tuple[float, float] | None, found: tuple[float, float], step: float
) -> tuple[tuple[float, float], str, str]:
    """Return the first and the last time code of the range, where it comes from, and what is left out of it."""
    near = _TOLERANCE * step
    if asked is None and not stage.HasAuthoredTimeCodeRange():
        return found, "", ""
    if asked is not None:
        if not np.isfinite(asked).all():
            return found, "", ""
        if asked[0] < found[0] - near or asked[1] > found[1] + near:
            fail(_option(asked), f"{source} has samples from time code {_text(found)}", "a range lies within them")
        return asked, ", as asked", ""
    low, high = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    says = f"its stage says {_text((low, high))}, and samples run from {_text(found)}"
    if not (low <= high and low <= found[1] + near and high >= found[0] - near):
        return found, "", f"{says}; all samples are played"
    kept = max(low, found[0]), min(high, found[1])
    if low < found[0] - near or high > found[1] + near:
        return kept, ", as its stage says", f"{says}; frames without samples are left out"
    whole = kept[0] <= found[0] + near and kept[1] >= found[1] - near
    return kept, "" if whole else ", as its stage says", ""


def _text(span: tuple[float, float]) -> str:
    return f"{span[0]:.9g} to {span[1]:.9g}"


def _option(asked: tuple[float, float]) -> str:
    return f"--range {asked[0]:.9g}-{asked[1]:.9g}"
