# SPDX-License-Identifier: Apache-2.0
"""Faces of a body that several garments of a shot cover: each layer hides its own, and the shot all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from ..opening.stage import EARLIEST
from ..reading.mesh import read_mesh
from ..writing.body_faces import BODY, COVERED_HIDDEN, FULL, HiddenPolygons, hide_polygons

Masks = Mapping[str, NDArray[np.bool_]]  # of the polygons of bodies, by their names


def hidden_in(stage: Usd.Stage, bodies: Sequence[str]) -> Masks:
    """Return which polygons a garment's layer hides; empty where it hides none."""
    root = stage.GetDefaultPrim()
    variants = root.GetVariantSet(BODY)
    if COVERED_HIDDEN not in variants.GetVariantNames():
        return {}
    found: dict[str, list[list[tuple[int, ...]]]] = {name: [] for name in bodies}
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for choice in (FULL, COVERED_HIDDEN):
            variants.SetVariantSelection(choice)
            for name, polygons in found.items():
                polygons.append(_polygons(root.GetChild(name)))
        variants.ClearVariantSelection()
    return {name: ~_kept(*polygons) for name, polygons in found.items()}


def hide_together(shot: Usd.Stage, garment: Usd.Prim, covered: Sequence[Masks]) -> bool:
    """Hide on the bodies of a garment's prim what any of several garments hides; return whether their bodies are one.

    Args:
        shot: the stage to author in, which references the garment.
        covered: of each garment, what `hidden_in` says.
    """
    garment.GetVariantSets().AddVariantSet(BODY).SetVariantSelection(FULL)  # rows of faces are read from whole bodies
    names = sorted({name for masks in covered for name in masks})
    prims = [garment.GetChild(name) for name in names]
    meshes = [read_mesh(prim, np.eye(4)) for prim in prims if prim.IsA(UsdGeom.Mesh)]
    counts = {name: len(np.asarray(mesh.polygon_counts)) for name, mesh in zip(names, meshes)}
    if len(counts) < len(names) or any(
        len(mask) != counts[name] for masks in covered for name, mask in masks.items()
    ):
        garment.GetVariantSet(BODY).SetVariantSelection(COVERED_HIDDEN)
        return False
    together = [np.any([masks[name] for masks in covered if name in masks], axis=0) for name in names]
    hidden = HiddenPolygons(tuple(together), variants=True)
    hide_polygons(shot, garment.GetPath(), [prim.GetPath() for prim in prims], meshes, hidden)
    return True


def _polygons(prim: Usd.Prim) -> list[tuple[int, ...]]:
    """Return the vertices of each polygon; none where nothing of a mesh is left."""
    if not (prim and prim.IsActive()):
        return []
    mesh = UsdGeom.Mesh(prim)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(EARLIEST), dtype=np.int64)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(EARLIEST), dtype=np.int64)
    return [tuple(part.tolist()) for part in np.split(corners, np.cumsum(counts)[:-1])]


def _kept(whole: Sequence[tuple[int, ...]], left: Sequence[tuple[int, ...]]) -> NDArray[np.bool_]:
    """Return which polygons are left, bool (P,): those that are left stand in the same order."""
    found, at = np.zeros(len(whole), dtype=bool), 0
    for number, polygon in enumerate(whole):
        if at < len(left) and polygon == left[at]:
            found[number], at = True, at + 1
    return found
