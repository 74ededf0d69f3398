# SPDX-License-Identifier: Apache-2.0
"""A garment over another: which of its triangles intersect the inner one, and where the inner one shows through.

Every pair of triangles counts, also where garments lie in one another in the bind pose: unlike a seam, that is a
fault. Points of the inner garment that the outer one covers in the bind pose show as skin does (`skin.covered_skin`):
where the outer cloth lies beneath them and none above. They are looked at along the normals away from the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...scene.assets import Floats, Mesh
from ..collision.inner_cloth import turned_away
from ..skin.covered_points import CoveredPoints
from .figures import LayerFigures
from .pairs import intersections_between

INNER_POINTS = 4000  # of the inner garment, some of which are covered


@dataclass(frozen=True, eq=False)
class LayerCounts:
    """How two garments lie over one another in N frames of one clip.

    Attributes:
        shares: share of the outer garment's triangles that intersect the inner one, shape (N,).
        shown: share of the covered points of the inner one that show, shape (N,); None where none are covered.
        frames: numbers of the frames in the clip, or their time codes, shape (N,).
    """

    shares: Floats
    shown: Floats | None
    frames: Floats

    @classmethod
    def joined(cls, parts: Sequence[LayerCounts]) -> LayerCounts:
        """Return the counts of several parts together."""
        shown = [part.shown for part in parts if part.shown is not None]
        return cls(
            np.concatenate([part.shares for part in parts]),
            np.concatenate(shown) if shown else None,
            np.concatenate([part.frames for part in parts]),
        )


class ClothLayers:
    """An outer and an inner garment of one character, in the bind pose.

    Args:
        names: of the outer and of the inner one.
        body: of the character, which tells the outside of cloth; None for the side that its own winding says.
    """

    def __init__(self, names: tuple[str, str], outer: Mesh, inner: Mesh, body: Mesh | None) -> None:
        self.names, self.outer, self.inner = names, outer, inner
        import torch

        turned = inner if body is None else replace(inner, faces=turned_away(inner, body))
        self._points = CoveredPoints(turned, outer, count=INNER_POINTS, device=torch.device("cpu"))

    @classmethod
    def by_cover(cls, one: tuple[str, Mesh], other: tuple[str, Mesh], body: Mesh | None) -> ClothLayers:
        """Return two garments, by name, of which nothing says the order: the outer covers more of the other."""
        ways = [cls((outer[0], inner[0]), outer[1], inner[1], body) for outer, inner in ((one, other), (other, one))]
        return max(ways, key=lambda each: each.covered)

    @property
    def covered(self) -> int:
        """How many of `INNER_POINTS` points of the inner garment the outer one covers."""
        return len(self._points)

    def counts(self, outer: Sequence[Floats], inner: Sequence[Floats], numbers: Sequence[float]) -> LayerCounts:
        """Return the counts of frames, from positions (V, 3) and (W, 3) [m]; a frame that is not finite counts whole.

        Args:
            numbers: of the frames in their clip.
        """
        import torch

        shares = np.array([self._share(x, y) for x, y in zip(outer, inner, strict=True)]).reshape(-1)
        shown = None
        if self.covered and len(shares):
            x, y = (torch.as_tensor(np.stack(frames, axis=-1), dtype=torch.float32) for frames in (outer, inner))
            # Rays in single precision are finest near the origin.
            middle = x.nanmean(0, keepdim=True)
            states = self._points.states(x - middle, (y - middle)[torch.as_tensor(self._points.vertices)])
            shown = states.shows.double().mean(0).numpy()
        return LayerCounts(shares, shown, np.asarray(numbers, dtype=np.float64))

    def _share(self, x: Floats, y: Floats) -> float:
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            return 1.0
        found = intersections_between(x, self.outer.faces, y, self.inner.faces)[:, 0]
        return len(np.unique(found)) / len(self.outer.faces)

    def figures(self, clips: Sequence[tuple[str, LayerCounts]]) -> LayerFigures:
        """Return the figures of clips by name.

        Raises:
            ValueError: there is no frame.
        """
        shown = LayerCounts.joined([counts for _, counts in clips]).shown
        return LayerFigures.over(
            clips,
            len(self.outer.faces),
            outer=self.names[0],
            inner=self.names[1],
            shown=None if shown is None else float(shown.mean()),
            worst_shown=None if shown is None else float(shown.max()),
        )
