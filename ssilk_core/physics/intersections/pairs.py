# SPDX-License-Identifier: Apache-2.0
"""Pairs of triangles that intersect, by libigl's exact predicates.

Triangles without a common vertex intersect where they have a point in common. With a common vertex they do where the
edge of one that is opposite to it meets the other, and with a common edge where one is folded flat onto the other.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import Floats, Ints
from .figures import LIBIGL


def can_find() -> bool:
    """Return whether libigl is installed, of a version that has these predicates."""
    return find_spec("igl") is not None and find_spec("igl.predicates") is not None


def libigl_version() -> str | None:
    """Return the version of libigl that is installed; None without one."""
    try:
        return version("libigl")
    except PackageNotFoundError:
        return None


def need_predicates() -> None:
    """Check that pairs can be found, before work that ends in counting them.

    Raises:
        SsilkError: libigl is missing, or too old.
    """
    if not can_find():
        found = libigl_version()
        fail(
            "libigl",
            f"version {found} is installed" if found else "it is not installed",
            f"{LIBIGL} or newer is needed, which counts the triangles that intersect others",
            f"pip install 'libigl>={LIBIGL}'",
        )


def self_intersections(points: Floats, faces: Ints) -> NDArray[np.int64]:
    """Return the pairs of triangles of one mesh that intersect, each once in ascending order, shape (P, 2).

    Args:
        points: finite positions [m], shape (V, 3).
        faces: shape (F, 3). Neighbours are wound alike; others with a common edge are taken to share a vertex alone.
    """
    from igl.predicates import find_self_intersections

    found = find_self_intersections(*_as_asked(points, faces))[1]
    return _in_order(np.sort(found.reshape(-1, 2), axis=1))


def intersections_between(first: Floats, first_faces: Ints, second: Floats, second_faces: Ints) -> NDArray[np.int64]:
    """Return which triangles of a mesh intersect which of another, each pair once in ascending order, shape (P, 2).

    Args:
        first, second: finite positions [m], shapes (V, 3) and (W, 3).
        first_faces, second_faces: shapes (F, 3) and (G, 3).
    """
    from igl.predicates import find_intersections

    found = find_intersections(*_as_asked(first, first_faces), *_as_asked(second, second_faces))[1]
    return _in_order(found.reshape(-1, 2))


def _as_asked(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    return np.ascontiguousarray(points, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64)


def _in_order(pairs: Ints) -> NDArray[np.int64]:
    """Return pairs in ascending order; threads of the library find them in any."""
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.int64)
