# SPDX-License-Identifier: GPL-3.0-or-later
"""Valid USD names for the names of Blender's objects and bones."""

from __future__ import annotations

import re
from collections.abc import Iterable


def identifiers(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return a unique ASCII identifier for each name, the name itself where it is one and free."""
    used, found = set(taken), []
    for name in names:
        stem = re.sub(r"^(?=\d|$)", "_", re.sub(r"[^A-Za-z0-9_]", "_", name))
        unique, copy = stem, 1
        while unique in used:
            copy += 1
            unique = f"{stem}_{copy}"
        used.add(unique)
        found.append(unique)
    return found


def joint_paths(names: Iterable[str], parents: Iterable[int]) -> tuple[str, ...]:
    """Return UsdSkel joint paths ("Hips/Spine"), with leaf names that are unique among all joints.

    Args:
        parents: index of each joint's parent, which comes before it; -1 for roots.
    """
    paths: list[str] = []
    for leaf, parent in zip(identifiers(names), parents):
        paths.append(f"{paths[parent]}/{leaf}" if parent >= 0 else leaf)
    return tuple(paths)
