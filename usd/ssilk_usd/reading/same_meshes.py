# SPDX-License-Identifier: Apache-2.0
"""Which meshes of a shot are those of a character."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence

import numpy as np
from pxr import Usd, UsdGeom

from ..opening.stage import PRIMS, value
from .mesh import is_rider
from .skeleton import bound_skeleton
from .spaces import SkelSource


def skinned_meshes(skel: SkelSource) -> Iterator[Usd.Prim]:
    """Yield the meshes that are bound to a skeleton; what rides on a garment is placed by its cloth."""
    for prim in Usd.PrimRange(skel.root, PRIMS):
        if prim.IsA(UsdGeom.Mesh) and bound_skeleton(prim) == skel.prim and not is_rider(prim):
            yield prim


def same_meshes(
    there: SkelSource, skel: SkelSource, own: Sequence[Usd.Prim], cloth: Usd.Prim | None
) -> dict[Usd.Prim, Usd.Prim]:
    """Return for meshes of a shot which of a character's own meshes they are.

    They have its path beneath the SkelRoot, its name, or its faces alone: programs add a namespace to names, or a
    number. Those that follow another Skeleton are meant where no others are, and a garment beside the SkelRoot.

    Args:
        there, skel: the skeletons of the shot and of the character.
        own: the character's meshes.
        cloth: its garment, if it has one.
    """

    def path(mesh: Usd.Prim) -> str:
        root = skel.root if mesh in own else there.root
        return str(mesh.GetPath().MakeRelativePath(root.GetPath()))

    every = [prim for prim in Usd.PrimRange.Stage(there.stage, PRIMS) if prim.IsA(UsdGeom.Mesh)]
    within = [prim for prim in every if prim.GetPath().HasPrefix(there.root.GetPath())]
    bound = [prim for prim in within if bound_skeleton(prim) == there.prim]
    free = [prim for prim in within if not bound_skeleton(prim)]
    found: dict[Usd.Prim, Usd.Prim] = {}
    for meshes in (bound, free):
        for key in (path, Usd.Prim.GetName):
            _pair(meshes, own, key, found)
    others = [prim for prim in within if prim not in bound and prim not in free]
    _pair([prim for prim in within if prim not in others], own, faces_of, found)
    for key in (path, Usd.Prim.GetName):
        _pair(others, own, key, found)
    if cloth is not None:
        _pair([prim for prim in every if prim not in within], [cloth], Usd.Prim.GetName, found)
    return found


def _pair(
    meshes: Sequence[Usd.Prim],
    own: Sequence[Usd.Prim],
    key: Callable[[Usd.Prim], Hashable],
    found: dict[Usd.Prim, Usd.Prim],
) -> None:
    """Add to `found` the meshes of a key that as many of a character's own have, in the order of their stages."""
    missing = [mesh for mesh in own if mesh not in found.values()]
    left = [mesh for mesh in meshes if missing and mesh not in found]
    for each in dict.fromkeys(map(key, missing if left else [])):
        pairs = [[mesh for mesh in some if key(mesh) == each] for some in (left, missing)]
        if len(pairs[0]) == len(pairs[1]):  # such as two shoes
            found.update(zip(*pairs))


def faces_of(prim: Usd.Prim) -> tuple[bytes, bytes]:
    """Return the faces of a mesh, to be compared."""
    values = (value(prim, name) for name in ("faceVertexCounts", "faceVertexIndices"))
    counts, indices = (np.array(each or [], dtype=np.int32).tobytes() for each in values)
    return counts, indices
