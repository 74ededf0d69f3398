# SPDX-License-Identifier: Apache-2.0
"""What a page about a shot opens with: in words, whether something is wrong with a garment, where and when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from ...physics.intersections.figures import EVERY, SelfIntersections
from ...physics.skin.figures import MOST_MEAN, MOST_WORST, ShownSkin
from ...physics.world.sunk import DEPTH, MOST_SUNK, SunkCloth
from ...scene.assets import Floats
from .page import Section
from .terms import SHARE, SHOWN, STRETCH

STRETCHED = 15.0  # stretch of 99 triangles in 100 beyond which the eye finds it at once [%]
LEAST = 0.1  # below it a share has more digits [%]: one vertex is no 0.0 %
COUNTED = (
    "Covered skin is the skin that the cloth covers in the bind pose. It shows where cloth lies beneath it, and is "
    "bare where no cloth is near: of a cape, which swings away, that is no fault. Where other parts, such as hands, "
    "push through the cloth, it counts as vertices inside the body."
)
CLOCK = "Frames are time codes of the shot. Seconds count from its first frame."
INSIDE = 10.0  # share of the vertices inside the body in one frame [%]


def verdict(
    name: str,
    values: Mapping[str, Floats],
    shown_skin: ShownSkin | None,
    intersections: SelfIntersections,
    frame_times: Sequence[float],
    fps: float,
    sunk: SunkCloth | None = None,
) -> Section:
    """Return the section of a garment.

    Args:
        values: of each frame, by the names of `terms.UNITS`.
        shown_skin: None where the garment covers nothing.
        intersections: of the same frames.
        sunk: what its bake counted inside colliders; None where there were none.
    """

    def when(frame: int) -> str:
        return f"in frame {frame_times[frame]:g}, at {frame / fps:.2f} s"

    faults, words = [], []
    lost = np.flatnonzero(~np.isfinite(values[STRETCH]))
    if len(lost):
        faults.append("it is lost")
        words.append(f"It is not finite in {len(lost)} of {len(frame_times)} frames, first {when(int(lost[0]))}.")
    if shown_skin:
        shown, worst = values[SHOWN], int(np.nanargmax(values[SHOWN]))
        if shown.mean() > 100 * MOST_MEAN or shown[worst] > 100 * MOST_WORST:
            faults.append("skin shows through")
        where = f", most at {shown_skin.where}" if shown_skin.where else ""
        share = f"{shown.mean():.3f} % of the covered skin shows on average"
        seen = f"{share}, and {shown[worst]:.2f} % {when(worst)}{where}"
        bare = f"{100 * shown_skin.bare:.1f} % is bare, {100 * shown_skin.worst_bare:.1f} % at most."
        words.append(f"{seen if shown[worst] else 'No covered skin shows'}; {bare}")
        if shown_skin.pierced is not None:
            words.append(f"{_limbs(shown_skin.pierced, shown_skin.limbs)}, as its bake counted.")
    else:
        words.append("Skin was not measured, because the garment covers none.")
    if intersections.worst:
        most = f"{intersections.worst:.1%} in frame {intersections.frame:g}".replace("%", " %")
        share = f"{100 * intersections.mean:.2f} % of its triangles intersect others of it on average, and {most}"
        known = ", and one that is not finite as 100 %" if len(lost) else ""
        words.append(f"{share}. One frame in {EVERY} is counted{known}.")
    if len(lost) < len(frame_times):
        worst = int(np.nanargmax(values[STRETCH]))
        if values[STRETCH][worst] > STRETCHED:
            faults.append("the cloth stretches")
        middle, most = np.nanmedian(values[STRETCH]), values[STRETCH][worst]
        words.append(
            f"99 triangles in 100 stretch by at most {middle:.0f} % as a rule, and by {most:.0f} % {when(worst)}."
        )
        inside = int(np.nanargmax(values[SHARE]))
        if values[SHARE][inside] > INSIDE:
            faults.append("it is inside the body")
        if values[SHARE][inside]:
            share = values[SHARE][inside]
            most = f"{share:.1f}" if share >= LEAST else f"{share:.1g}"
            words.append(f"At most {most} % of its vertices are inside the body, {when(inside)}.")
    if sunk:
        if sunk.mean > MOST_SUNK:
            faults.append("it is inside colliders")
        most = f", {sunk.worst:.1%} at most, in frame {sunk.frame:g} ({sunk.where})" if sunk.worst else ""
        share = f"{sunk.mean:.2%} of its vertices were more than {1000 * DEPTH:g} mm inside colliders"
        words.append(f"{share} on average{most}, as its bake counted.".replace("%", " %"))
    first = (
        f"Look at {name}: {' and '.join(faults)}." if faults else f"{name} holds: nothing that the eye would find."
    )
    lines = "".join(f"<li>{escape(each)}</li>" for each in words)
    note = f'<p class="note">{f"{COUNTED} " if shown_skin else ""}{CLOCK}</p>'
    return Section(f"{name}: verdict", f"<p><strong>{escape(first)}</strong></p><ul>{lines}</ul>{note}")


def _limbs(pierced: float, limbs: Mapping[str, float]) -> str:
    """Return in how many frames a limb is through the cloth, and which."""
    if not pierced:
        return "No limb is through the cloth"
    most = ", ".join(f"{joint} in {100 * share:.1f} %" for joint, share in limbs.items())
    return f"A limb is through the cloth in {100 * pierced:.1f} % of the frames ({most})"
