# SPDX-License-Identifier: Apache-2.0
"""The viewer's interface to a shot, independent of its file format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ...scene.assets import Floats, Ints


class PlayerMesh(Protocol):
    """A mesh of a shot: its triangles (F, 3), whether it is or rides on cloth, and its colour in sRGB or None."""

    @property
    def name(self) -> str: ...

    @property
    def faces(self) -> Ints: ...

    @property
    def is_garment(self) -> bool: ...

    @property
    def is_rider(self) -> bool: ...

    @property
    def colour(self) -> tuple[float, float, float] | None: ...


class ShotPlayer(Protocol):
    """A shot that can be posed at each of its frames."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def frame_times(self) -> Sequence[float]:
        """The argument of `points` for each frame, in order."""

    @property
    def meshes(self) -> Sequence[PlayerMesh]: ...

    def points(self, time: float) -> Sequence[Floats]:
        """Return the vertices of every mesh at one frame time [m], y up, each (V, 3)."""
