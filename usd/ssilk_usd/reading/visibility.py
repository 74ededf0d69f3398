# SPDX-License-Identifier: Apache-2.0
"""Read when a character is hidden in its shot."""

from __future__ import annotations

from pxr import Usd, UsdGeom

from ssilk_core.files import split_location
from ssilk_core.scene.assets import Motion

from ..opening.stage import needs_whole_files, open_stage
from .motion import find_animation


@needs_whole_files
def read_hidden(source: str, motion: Motion, *, root: str | None = None) -> list[tuple[int, bool]]:
    """Return the frames at which the character becomes hidden (True) or visible (False); empty if always visible.

    Args:
        source: "file[:/Prim/Path]", as for `read_motion`.
        motion: gives the frames and their rate.
        root: the character, if several are animated.

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
    """Return whether the visibility of a prim or one of its ancestors changes over time."""
    while prim and not prim.IsPseudoRoot():
        if UsdGeom.Imageable(prim) and UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying():
            return True
        prim = prim.GetParent()
    return False
