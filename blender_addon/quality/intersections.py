# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangles of a garment that intersect others of it, or other garments of its armature, in the frame shown.

Blender's own search finds them in single precision, so that few may differ from the exact count of `ssilk`.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from ..scene.garment import armature_of, garments_of
from ..scene.meshes import rest_points, triangles_of
from ..scene.modifiers import cage_points


def crossing_triangles(garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[np.ndarray, np.ndarray]:
    """Return which triangles intersect others of the garment, and which those of other garments, both (T,).

    Pairs of the same garment that intersect at rest do not count, as along seams.
    """
    faces = triangles_of(garment.data)
    own, tree = np.zeros((2, len(faces)), dtype=bool), _tree(cage_points(garment, depsgraph), faces)
    at_rest = _tree(rest_points(garment), faces)
    counted = set(tree.overlap(tree)) - set(at_rest.overlap(at_rest))
    own[0, [triangle for pair in counted for triangle in pair]] = True
    for other in garments_of(armature_of(garment)):
        if other != garment and other.visible_get():
            pairs = tree.overlap(_tree(cage_points(other, depsgraph), triangles_of(other.data)))
            own[1, [pair[0] for pair in pairs]] = True
    return own[0], own[1]


def _tree(points: np.ndarray, triangles: np.ndarray) -> BVHTree:
    return BVHTree.FromPolygons(points.tolist(), triangles.tolist(), all_triangles=True)
