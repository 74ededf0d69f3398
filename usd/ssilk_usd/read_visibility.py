# SPDX-License-Identifier: Apache-2.0
"""When a character is hidden in its shot."""

from __future__ import annotations

from pxr import Usd, UsdGeom

from ssilk_core.assets import Motion

from .read_motion import find_animation
from .read_stage import needs_whole_files, open_stage, split_location


@needs_whole_files
def read_hidden(source: str, motion: Motion, *, root: str | None = None) -> list[tuple[int, bool]]:
    """Return from which frames on the character is hidden (True) or seen (False); empty where it is seen throughout.

    Args:
        source: "file[:/Prim/Path]", as `read_motion` read it.
        motion: frames and rate to say it in.
        root: the character, where several are animated.

    Raises:
        SsilkError: as `read_motion`.
    """
    file, prim = split_location(source)
    stage = open_stage(file)
    _, placed = find_animation(stage, prim, root)
    if placed is None:
        return []
    imageable, second = UsdGeom.Imageable(placed), stage.GetTimeCodesPerSecond()
    frames = range(motion.frame_count) if _varies(placed) else range(1)
    codes = [(motion.start + frame) / motion.fps * second for frame in frames]
    hidden = [imageable.ComputeVisibility(Usd.TimeCode(code)) == UsdGeom.Tokens.invisible for code in codes]
    changes = [(frame, gone) for frame, gone in enumerate(hidden) if frame == 0 or gone != hidden[frame - 1]]
    return changes if any(hidden) else []


def _varies(prim: Usd.Prim) -> bool:
    """Return whether the visibility of a prim, or of what it is in, changes over time."""
    while prim and not prim.IsPseudoRoot():
        if UsdGeom.Imageable(prim) and UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying():
            return True
        prim = prim.GetParent()
    return False
