# SPDX-License-Identifier: Apache-2.0
"""Whether UsdSkel skins a mesh that has influences. Where it does not, USD shows the mesh as it was modelled."""

from __future__ import annotations

from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import fail

from ..names import SKEL
from ..opening.stage import PRIMS, inherited, location

SCHEMA = "SkelBindingAPI"
BOUND_BY = ("skel:skeleton", *SKEL[:2])  # what a skinned mesh has, or inherits


def need_skinned(prim: Usd.Prim) -> None:
    """Raise `SsilkError` where UsdSkel does not skin a mesh in a SkelRoot that has influences and a skeleton."""
    paths = prim.GetPath().GetPrefixes()
    roots = [above for path in paths if (above := UsdSkel.Root(prim.GetStage().GetPrimAtPath(path)))]
    if not roots:  # it is to be brought into one
        return
    root, cache = roots[0], UsdSkel.Cache()  # one within another counts for nothing
    cache.Populate(root, PRIMS)
    targets = [query for found in cache.ComputeSkelBindings(root, PRIMS) for query in found.GetSkinningTargets()]
    if any(query.GetPrim() == prim and query.HasJointInfluences() for query in targets):
        return
    why, todo = _reason(prim)
    fail(location(prim), f"USD does not skin it: {why}", "a mesh with influences is skinned to its skeleton", todo)


def unapplied(prim: Usd.Prim, name: str) -> str:
    """Return in words that a prim says `name` without the schema that makes it count; empty if it has the schema."""
    return "" if prim.HasAPI(UsdSkel.BindingAPI) else f"{prim.GetPath()} says {name} and does not apply {SCHEMA}"


def _reason(prim: Usd.Prim) -> tuple[str, str]:
    """Return why UsdSkel does not skin a mesh, and what to do."""
    said = [(found.GetPrim(), name) for name in BOUND_BY if (found := inherited(prim, name))]
    if missing := next(filter(None, (unapplied(*each) for each in said)), ""):
        return missing, f"apply {SCHEMA} there, as usdfixbrokenpixarschemas does"
    above = prim.GetParent()
    while not above.IsPseudoRoot():
        if not above.IsA(UsdGeom.Imageable):
            return f"{above.GetPath()} above it is no Xform", "make it one"
        above = above.GetParent()
    return "UsdSkel finds no binding", "bind the mesh again"
