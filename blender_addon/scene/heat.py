# SPDX-License-Identifier: GPL-3.0-or-later
"""Penetration and stretch of a garment in the frame that is shown, what was pushed out, and colours on its mesh.

Both come a little at a time: to find what is nearest to 20,000 vertices takes a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import TypeVar

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from .. import heat
from ..errors import SetupError
from .garment import armature_of, bodies_of
from .repairs import displacements
from .shapes import rest_points

ATTRIBUTE = "SSILK Heat"
PENETRATION, STRETCH, PUSHED_OUT = "PENETRATION", "STRETCH", "PUSHED_OUT"
CHUNK = 1000  # vertices at a time

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class HeatMap:
    """A garment in one frame.

    Attributes:
        kind: PENETRATION, STRETCH or PUSHED_OUT.
        values: of each vertex: depth inside the body [m], negative outside; elongation; or how far it was pushed out
            of the body [m]; shape (V,).
    """

    kind: str
    values: np.ndarray

    @property
    def most(self) -> float:
        return float(self.values.max())

    def summary(self) -> str:
        """Return the worst value in words."""
        if self.kind == STRETCH:
            return f"{self.most:.0%} longer at most"
        if self.kind == PUSHED_OUT:
            return f"{int((self.values > 0).sum())} vertices were pushed out, {1000 * self.most:.1f} mm at most"
        inside = int((self.values > 0).sum())
        return f"{inside} vertices inside, {1000 * self.most:.1f} mm at most" if inside else "Nothing is inside"


def measuring(
    garment: bpy.types.Object, kind: str, depsgraph: bpy.types.Depsgraph
) -> Generator[float, None, HeatMap]:
    """Measure a garment in the frame that is shown, yielding the part that is done; return what was measured.

    All that it needs of the frame is read before the first yield.

    Raises:
        SetupError: it has no body, was not pushed out, or its modifiers change how many vertices there are.
    """
    _need_same_vertices(garment, depsgraph)
    points = _world_points(garment.evaluated_get(depsgraph))
    if kind == PUSHED_OUT:
        return HeatMap(kind, displacements(garment))
    if kind == STRETCH:
        world = np.array(garment.matrix_world)[:3, :3]
        rest = rest_points(garment) @ world.T
        return HeatMap(kind, heat.elongations(rest, points, _triangles(garment.data)))
    scale, depths = bpy.context.scene.unit_settings.scale_length, []
    surfaces = [_surface(body.evaluated_get(depsgraph)) for body in bodies_of(garment, armature_of(garment))]
    for surface in surfaces:
        depths.append((yield from scaled(_depths(points, *surface), len(depths) / len(surfaces), 1 / len(surfaces))))
    return HeatMap(kind, scale * np.max(depths, axis=0))


def scaled(steps: Generator[float, None, Result], start: float, share: float) -> Generator[float, None, Result]:
    """Take steps that are a share of others; return what they return."""
    while True:
        try:
            yield start + share * next(steps)
        except StopIteration as end:
            return end.value


def showing(garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Iterator[float]:
    """Bring the colours of a garment that shows heat up to date; hide them where it cannot be measured any more."""
    uid, kind = garment.session_uid, garment.ssilk.heat
    try:
        measured = yield from measuring(garment, kind, depsgraph)
    except SetupError:  # before the first yield: the garment is still there
        hide(garment)
        return
    for thing in [thing for thing in bpy.data.objects if thing.session_uid == uid]:  # none if it was deleted
        if thing.ssilk.heat == kind and thing.mode == "OBJECT" and len(thing.data.vertices) == len(measured.values):
            _paint(thing.data, measured, thing.ssilk.heat_red)


def show(garment: bpy.types.Object, measured: HeatMap, red: float) -> None:
    """Colour a garment by what was measured, and again at each frame from now on.

    Args:
        red: the value that is red, in metres or as a share.

    Raises:
        SetupError: it has other vertices by now.
    """
    same = len(garment.data.vertices) == len(measured.values)
    if not same:
        raise SetupError(f"'{garment.name}' was edited while it was measured; look again.")
    garment.ssilk.heat, garment.ssilk.heat_red = measured.kind, red
    _paint(garment.data, measured, red)


def hide(garment: bpy.types.Object) -> None:
    """Remove the colours."""
    garment.ssilk.heat, colors = "", garment.data.color_attributes
    if ATTRIBUTE in colors:
        colors.remove(colors[ATTRIBUTE])


def _paint(mesh: bpy.types.Mesh, measured: HeatMap, red: float) -> None:
    layer = mesh.color_attributes.get(ATTRIBUTE) or mesh.color_attributes.new(ATTRIBUTE, "FLOAT_COLOR", "POINT")
    colors = heat.colors_of(measured.values, red).astype(np.float32)
    layer.data.foreach_set("color_srgb", colors.reshape(-1))
    mesh.color_attributes.active_color = layer
    mesh.update()


def _need_same_vertices(garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    shown, count = len(garment.evaluated_get(depsgraph).data.vertices), len(garment.data.vertices)
    if shown != count:
        raise SetupError(
            f"A modifier gives '{garment.name}' {shown} vertices where its mesh has {count}; switch it off in "
            "viewports."
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


def _surface(body: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of an evaluated body in the world, shape (V, 3), and its triangles, outward, shape (T, 3)."""
    triangles = _triangles(body.data)
    if body.matrix_world.determinant() < 0:  # mirrored, and so are its faces
        triangles = triangles[:, ::-1]
    return _world_points(body), triangles


def _depths(points: np.ndarray, surface: np.ndarray, triangles: np.ndarray) -> Generator[float, None, np.ndarray]:
    """Find how deep points lie inside a body, by its nearest triangles, in world units, shape (V,).

    In the world: what is nearest to a scaled object is not what is nearest before it is scaled.
    """
    tree = BVHTree.FromPolygons(surface.tolist(), triangles.tolist(), all_triangles=True)
    places, nearest = np.empty((len(points), 3)), np.empty(len(points), dtype=int)
    for start in range(0, len(points), CHUNK):
        yield start / len(points)
        found = [tree.find_nearest(point) for point in points[start : start + CHUNK].tolist()]
        places[start : start + CHUNK] = [each[0] for each in found]
        nearest[start : start + CHUNK] = [each[2] for each in found]
    yield 1.0
    return heat.depths(points, places, nearest, surface, triangles)
