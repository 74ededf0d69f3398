# SPDX-License-Identifier: GPL-3.0-or-later
"""Penetration and stretch of a garment as it is seen now, and as colours on its mesh."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from .. import heat
from ..errors import SetupError, need
from .garment import armature_of, bodies_of
from .shapes import rest_points

ATTRIBUTE = "SSILK Heat"
PENETRATION, STRETCH = "PENETRATION", "STRETCH"


@dataclass(frozen=True, eq=False)
class Measured:
    """A garment in one frame.

    Attributes:
        kind: PENETRATION or STRETCH.
        values: of each vertex: depth inside the body [m], negative outside, or elongation; shape (V,).
    """

    kind: str
    values: np.ndarray

    @property
    def most(self) -> float:
        return float(self.values.max())

    def told(self) -> str:
        """Return the worst of it in words."""
        if self.kind == STRETCH:
            return f"{self.most:.0%} longer at most"
        inside = int((self.values > 0).sum())
        return f"{inside} vertices inside, {1000 * self.most:.1f} mm at most" if inside else "Nothing is inside"


def measure(garment: bpy.types.Object, kind: str, depsgraph: bpy.types.Depsgraph) -> Measured:
    """Measure a garment in the frame that is shown.

    Raises:
        SetupError: it has no body, or its modifiers change how many vertices there are.
    """
    _need_same_vertices(garment, depsgraph)
    points = _world_points(garment.evaluated_get(depsgraph))
    if kind == STRETCH:
        world = np.array(garment.matrix_world)[:3, :3]
        rest = rest_points(garment) @ world.T
        return Measured(kind, heat.elongations(rest, points, _triangles(garment.data)))
    bodies = bodies_of(garment, armature_of(garment))
    depths = [_depths(points, body.evaluated_get(depsgraph)) for body in bodies]
    return Measured(kind, bpy.context.scene.unit_settings.scale_length * np.max(depths, axis=0))


def show(garment: bpy.types.Object, kind: str, red: float, depsgraph: bpy.types.Depsgraph) -> Measured:
    """Colour a garment by what is measured now, and at each frame from now on; return what was measured.

    Args:
        red: the value that is red, in metres or as a share.

    Raises:
        SetupError: as `measure` does; nothing is coloured then.
    """
    measured = measure(garment, kind, depsgraph)
    garment.ssilk.heat, garment.ssilk.heat_red = kind, red
    _paint(garment.data, measured, red)
    return measured


def show_again(garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Bring the colours of a garment that shows heat up to date; hide them where it cannot be measured any more."""
    try:
        _paint(garment.data, measure(garment, garment.ssilk.heat, depsgraph), garment.ssilk.heat_red)
    except SetupError:
        hide(garment)


def hide(garment: bpy.types.Object) -> None:
    """Remove the colours."""
    garment.ssilk.heat, colors = "", garment.data.color_attributes
    if ATTRIBUTE in colors:
        colors.remove(colors[ATTRIBUTE])


def _paint(mesh: bpy.types.Mesh, measured: Measured, red: float) -> None:
    layer = mesh.color_attributes.get(ATTRIBUTE) or mesh.color_attributes.new(ATTRIBUTE, "FLOAT_COLOR", "POINT")
    colors = heat.colors_of(measured.values, red).astype(np.float32)
    layer.data.foreach_set("color_srgb", colors.reshape(-1))
    mesh.color_attributes.active_color = layer
    mesh.update()


def _need_same_vertices(garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    shown, count = len(garment.evaluated_get(depsgraph).data.vertices), len(garment.data.vertices)
    need(
        shown == count,
        f"A modifier gives '{garment.name}' {shown} vertices where its mesh has {count}; switch it off in viewports.",
    )


def _world_points(thing: bpy.types.Object) -> np.ndarray:
    """Return the vertices of an evaluated object in the world, shape (V, 3)."""
    points = np.empty(len(thing.data.vertices) * 3, dtype=np.float32)
    thing.data.vertices.foreach_get("co", points)
    world = np.array(thing.matrix_world)
    return points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def _triangles(mesh: bpy.types.Mesh) -> np.ndarray:
    mesh.calc_loop_triangles()
    triangles = np.empty(len(mesh.loop_triangles) * 3, dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles)
    return triangles.reshape(-1, 3)


def _depths(points: np.ndarray, body: bpy.types.Object) -> np.ndarray:
    """Return how deep points lie inside an evaluated body, by its nearest triangles, in world units, shape (V,).

    In the world: what is nearest to a scaled object is not what is nearest before it is scaled.
    """
    triangles = _triangles(body.data)
    if body.matrix_world.determinant() < 0:  # mirrored, and so are its faces
        triangles = triangles[:, ::-1]
    surface = _world_points(body)
    tree = BVHTree.FromPolygons(surface.tolist(), triangles.tolist())
    found = [tree.find_nearest(point) for point in points.tolist()]
    places, nearest = (np.array([each[part] for each in found]) for part in (0, 2))
    return heat.depths(points, places, nearest, surface, triangles)
