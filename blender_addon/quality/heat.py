# SPDX-License-Identifier: GPL-3.0-or-later
"""Penetration, stretch, skin that shows, intersections and what Push Out moved, as colours on meshes.

They are those of the frame that is shown. Measuring comes a little at a time: to find what is nearest to 20,000
vertices takes a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import TypeVar

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from ssilk_core.physics.skin.figures import COVER_REACH, SHOW_DEPTH

from ..arrays import heat
from ..errors import SetupError
from ..scene.garment import armature_of, bodies_of, rest_world
from ..scene.linked import give_own_mesh, is_override, need_local
from ..scene.masks import need_unmasked
from ..scene.meshes import rest_points, triangles_of, world_points
from ..scene.modifiers import cage_points, is_refined
from ..scene.objects import need_enabled
from ..scene.shapes import mixed_points
from .intersections import crossing_triangles
from .repairs import displacements
from .sewn import sewn_points

ATTRIBUTE = "SSILK Heat"
IN_FRONT_BEFORE = "ssilk_in_front"  # custom property of a garment that is drawn over the skin: whether it was before
ACTIVE_BEFORE = "ssilk_active_color"  # custom property of a coloured mesh: its active colour attribute before
PENETRATION, STRETCH, SKIN, PUSHED_OUT = "PENETRATION", "STRETCH", "SKIN", "PUSHED_OUT"
INTERSECTIONS = "INTERSECTIONS"
CHUNK = 1000  # vertices at a time

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class HeatMap:
    """A garment in one frame.

    Attributes:
        kind: PENETRATION, STRETCH, SKIN, PUSHED_OUT or INTERSECTIONS.
        values: of each vertex: depth inside the body [m], negative outside; elongation; or how far it was pushed out
            of the body [m]; or 1 where its triangles intersect others; shape (V,). For SKIN those of
            `heat.shown_depths` [m], of all bodies' vertices.
        shares: of the triangles that intersect others of the garment, and other garments; for INTERSECTIONS.
    """

    kind: str
    values: np.ndarray
    shares: tuple[float, float] = (0.0, 0.0)

    @property
    def most(self) -> float:
        return float(self.values.max())

    @property
    def badness(self) -> float:
        """What frames are compared by: the share of the covered skin that shows, or of what intersects, or the
        largest value."""
        if self.kind == INTERSECTIONS:
            return sum(self.shares)
        if self.kind != SKIN:
            return self.most
        return self._share(self.values > 0)

    @property
    def bare(self) -> float:
        """Share of the covered skin without cloth near; for SKIN."""
        return self._share(self.values == heat.BARE)

    def _share(self, chosen: np.ndarray) -> float:
        return float(chosen.sum() / max(1, (self.values != heat.UNCOVERED).sum()))

    def summary(self) -> str:
        """Return the worst value in words."""
        if self.kind == STRETCH:
            return f"{self.most:.0%} longer at most"
        if self.kind == PUSHED_OUT:
            return f"{int((self.values > 0).sum())} vertices were pushed out, {1000 * self.most:.1f} mm at most"
        if self.kind == SKIN:
            shows = f"{self.badness:.2%} of the covered skin shows" if self.badness else "No skin shows"
            return f"{shows}, {self.bare:.2%} is bare" if self.bare else shows
        if self.kind == INTERSECTIONS:
            names = "others", "other garments"
            found = [f"{share:.2%} intersect {name}" for share, name in zip(self.shares, names) if share]
            return f"Of the triangles {', '.join(found)}" if found else "Nothing intersects"
        inside = int((self.values > 0).sum())
        return f"{inside} vertices inside, {1000 * self.most:.1f} mm at most" if inside else "Nothing is inside"


def measuring(
    garment: bpy.types.Object, kind: str, depsgraph: bpy.types.Depsgraph
) -> Generator[float, None, HeatMap]:
    """Measure a garment in the frame that is shown, yielding the part that is done; return what was measured.

    All that it needs of the frame is read before the first yield.

    Raises:
        SetupError: it has no body, one with hidden skin, or one that is disabled in viewports, was not pushed out,
            or modifiers change how many vertices there are before bones move them.
    """
    if kind == PUSHED_OUT:
        return HeatMap(kind, displacements(garment))
    if kind == SKIN:
        return HeatMap(kind, (yield from _shown(garment, depsgraph)))
    if kind == INTERSECTIONS:
        found = crossing_triangles(garment, depsgraph)
        values = np.zeros(len(garment.data.vertices))
        values[triangles_of(garment.data)[found[0] | found[1]]] = 1.0
        return HeatMap(kind, values, (float(found[0].mean()), float(found[1].mean())))
    points = cage_points(garment, depsgraph)
    if kind == STRETCH:
        return HeatMap(kind, heat.elongations(sewn_points(garment), points, triangles_of(garment.data)))
    scale, depths = bpy.context.scene.unit_settings.scale_length, []
    bodies = bodies_of(garment, armature_of(garment))
    need_unmasked(bodies)
    need_enabled(bodies)
    surfaces = [_surface(body.evaluated_get(depsgraph)) for body in bodies]
    for number, surface in enumerate(surfaces):
        steps = depths_in(points, *surface)
        depths.append((yield from scaled(steps, number / len(surfaces), 1 / len(surfaces))))
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
        if thing.ssilk.heat == kind and thing.mode == "OBJECT" and _fits(thing, measured):
            _paint(thing, measured, thing.ssilk.heat_red)


def show(garment: bpy.types.Object, measured: HeatMap, red: float) -> None:
    """Colour a garment, or for SKIN its bodies, by what was measured, and again at each frame from now on.

    For PENETRATION the garment is drawn over the skin in which it lies.

    Args:
        red: the value that is red, in metres or as a share.

    Raises:
        SetupError: it has other vertices by now.
    """
    for thing in _coloured(garment, measured.kind):
        if is_override(garment) and thing == garment:
            give_own_mesh(garment)
        need_local(thing)
    if not _fits(garment, measured):
        raise SetupError(f"'{garment.name}' was edited while it was measured; look again.")
    hide(garment)
    garment.ssilk.heat, garment.ssilk.heat_red = measured.kind, red
    if measured.kind == PENETRATION:
        garment[IN_FRONT_BEFORE], garment.show_in_front = garment.show_in_front, True
    _paint(garment, measured, red)


def hide(garment: bpy.types.Object) -> None:
    """Remove the colours of a garment, and those that it gave its bodies."""
    kind, garment.ssilk.heat, garment.ssilk.heat_told = garment.ssilk.heat, "", ""
    if IN_FRONT_BEFORE in garment:
        garment.show_in_front = garment.pop(IN_FRONT_BEFORE)
    for thing in (garment, *(_coloured(garment, kind) if kind == SKIN else ())):
        colors, before = thing.data.color_attributes, thing.data.pop(ACTIVE_BEFORE, "")
        if ATTRIBUTE in colors:
            colors.remove(colors[ATTRIBUTE])
        if before in colors:
            colors.active_color = colors[before]


def _coloured(garment: bpy.types.Object, kind: str) -> list[bpy.types.Object]:
    """Return the meshes that are coloured: for SKIN the bodies, none where the garment has lost them."""
    if kind != SKIN:
        return [garment]
    try:
        return bodies_of(garment, armature_of(garment))
    except SetupError:
        return []


def _fits(garment: bpy.types.Object, measured: HeatMap) -> bool:
    return sum(len(thing.data.vertices) for thing in _coloured(garment, measured.kind)) == len(measured.values)


def _paint(garment: bpy.types.Object, measured: HeatMap, red: float) -> None:
    garment.ssilk.heat_told = measured.summary()
    colors = heat.colors_of(measured.values, red).astype(np.float32)
    for thing in _coloured(garment, measured.kind):
        mesh, count = thing.data, len(thing.data.vertices)
        layer = mesh.color_attributes.get(ATTRIBUTE)
        if layer is None:
            mesh[ACTIVE_BEFORE] = mesh.color_attributes.active_color_name
            layer = mesh.color_attributes.new(ATTRIBUTE, "FLOAT_COLOR", "POINT")
        layer.data.foreach_set("color_srgb", colors[:count].reshape(-1))
        mesh.color_attributes.active_color = layer
        mesh.update()
        colors = colors[count:]


def _surface(body: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of an evaluated body in the world, shape (V, 3), and its triangles, outward, shape (T, 3)."""
    triangles = triangles_of(body.data)
    if body.matrix_world.determinant() < 0:  # mirrored, and so are its faces
        triangles = triangles[:, ::-1]
    return world_points(body), triangles


def _cage(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of an object's own mesh as `_surface` does, beneath modifiers that refine it."""
    if not is_refined(thing, depsgraph):
        return _surface(thing.evaluated_get(depsgraph))
    triangles = triangles_of(thing.data)
    return cage_points(thing, depsgraph), triangles[:, ::-1] if thing.matrix_world.determinant() < 0 else triangles


def _shown(garment: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Generator[float, None, np.ndarray]:
    """Find how far beneath the skin the cloth is where skin shows [m], as `heat.shown_depths`, of all bodies."""
    bodies, scale = bodies_of(garment, armature_of(garment)), bpy.context.scene.unit_settings.scale_length
    need_unmasked(bodies)
    need_enabled(bodies)
    cloth, triangles = _cage(garment, depsgraph)
    trees = [
        BVHTree.FromPolygons(points.tolist(), triangles.tolist(), all_triangles=True)
        for points in (_at_rest(garment, rest_points(garment)), cloth)
    ]
    skins = [(_at_rest(body, mixed_points(body)), *_cage(body, depsgraph)) for body in bodies]
    found = []
    for number, (rest, now, faces) in enumerate(skins):
        steps = _shown_on(rest, now, faces, *trees, 1 / scale)
        found.append((yield from scaled(steps, number / len(skins), 1 / len(skins))))
    return np.concatenate([np.where(values > 0, scale * values, values) for values in found])


def _shown_on(
    rest: np.ndarray, now: np.ndarray, faces: np.ndarray, cloth_at_rest: BVHTree, cloth: BVHTree, metre: float
) -> Generator[float, None, np.ndarray]:
    """Return `heat.shown_depths` of one body's vertices, at rest and now, in world units; a metre is so many."""
    normals = heat.corner_normals(rest, faces)
    above = yield from scaled(_distances(cloth_at_rest, rest, normals, COVER_REACH * metre), 0.0, 1 / 3)
    covered = np.isfinite(above)
    outward, reached = heat.corner_normals(now, faces)[covered], np.full((2, len(now)), np.inf)
    for row, (side, reach) in enumerate(((1, COVER_REACH), (-1, SHOW_DEPTH))):
        steps = _distances(cloth, now[covered], side * outward, reach * metre)
        reached[row, covered] = yield from scaled(steps, (1 + row) / 3, 1 / 3)
    return heat.shown_depths(covered, *reached)


def _distances(
    tree: BVHTree, points: np.ndarray, directions: np.ndarray, reach: float
) -> Generator[float, None, np.ndarray]:
    """Return how far a surface is along a direction from each point, infinity where beyond reach, shape (N,)."""
    found = np.full(len(points), np.inf)
    for start in range(0, len(points), CHUNK):
        yield start / len(points)
        rays = zip(points[start : start + CHUNK].tolist(), directions[start : start + CHUNK].tolist())
        hits = [tree.ray_cast(*ray, reach)[3] for ray in rays]
        found[start : start + CHUNK] = [np.inf if distance is None else distance for distance in hits]
    return found


def _at_rest(thing: bpy.types.Object, points: np.ndarray) -> np.ndarray:
    world = np.array(rest_world(thing))
    return points @ world[:3, :3].T + world[:3, 3]


def depths_in(points: np.ndarray, surface: np.ndarray, triangles: np.ndarray) -> Generator[float, None, np.ndarray]:
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
