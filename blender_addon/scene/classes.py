# SPDX-License-Identifier: GPL-3.0-or-later
"""The class attribute of a mesh, and the colours that artists paint.

The truth is an integer for each point. It is not of 8 bits: Blender's USD importer makes 32, and edit mode reads
no others from Python. Colours are made from it and taken up into it; nothing does so behind the artist's back.
In edit mode the attributes live in a BMesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import bmesh
import bpy
import numpy as np

from ssilk_core.scene.assets import TIGHT, classes_at

from ..arrays import classes as palette
from ..arrays.classes import COLOR_ATTRIBUTE, COLORS
from ..errors import SetupError


def read_classes(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the class of each vertex, shape (V,); None where the mesh has none, or in edit mode 8 bits each.

    Raises:
        SetupError: the attribute is no integer for each point, or holds other values.
    """
    attribute = mesh.attributes.get(palette.ATTRIBUTE)
    if attribute is None:
        return None
    if attribute.domain != "POINT" or attribute.data_type not in {"INT", "INT8"}:
        raise SetupError(
            f"The attribute '{palette.ATTRIBUTE}' of '{mesh.name}' is {attribute.data_type} on {attribute.domain}; "
            "integers on points are needed: remove it and paint again."
        )
    if mesh.is_editmode:  # the attribute itself is empty then
        values = edited_classes(mesh)
    else:
        values = np.empty(len(mesh.vertices), dtype=np.int32)
        attribute.data.foreach_get("value", values)
    if values is not None and not palette.in_range(values):
        raise SetupError(
            f"The attribute '{palette.ATTRIBUTE}' of '{mesh.name}' holds values besides 0, 1 and 2; paint these "
            "again."
        )
    return values


def write_classes(mesh: bpy.types.Mesh, values: np.ndarray) -> None:
    """Set the class of each vertex, shape (V,), and the colours with them where there are any. Not in edit mode."""
    attribute = mesh.attributes.get(palette.ATTRIBUTE)
    if attribute and (attribute.domain, attribute.data_type) != ("POINT", "INT"):
        mesh.attributes.remove(attribute)
        attribute = None
    attribute = attribute or mesh.attributes.new(palette.ATTRIBUTE, "INT", "POINT")
    attribute.data.foreach_set("value", np.ascontiguousarray(values, dtype=np.int32))
    if palette.COLOR_ATTRIBUTE in mesh.attributes:
        show_classes(mesh)
    mesh.update()


def write_levels(mesh: bpy.types.Mesh, levels: np.ndarray | None) -> None:
    """Keep the least tightness at which each vertex is tight, shape (V,), or forget it. Not in edit mode."""
    if palette.LEVELS in mesh.attributes:
        mesh.attributes.remove(mesh.attributes[palette.LEVELS])
    if levels is not None:
        attribute = mesh.attributes.new(palette.LEVELS, "FLOAT", "POINT")
        attribute.data.foreach_set("value", np.ascontiguousarray(levels, dtype=np.float32))


def tighten(mesh: bpy.types.Mesh, tightness: float) -> None:
    """Make classes again at another tightness, where they were found automatically. Not in edit mode."""
    attribute = mesh.attributes.get(palette.LEVELS)
    if attribute is None or (attribute.domain, attribute.data_type) != ("POINT", "FLOAT"):
        return
    levels = np.empty(len(mesh.vertices), dtype=np.float32)
    attribute.data.foreach_get("value", levels)
    write_classes(mesh, classes_at(levels, tightness))


def show_classes(mesh: bpy.types.Mesh) -> None:
    """Make the active colours of a mesh those of its classes; all is tight where there are none yet."""
    values = read_classes(mesh)
    if values is None:
        values = np.full(len(mesh.vertices), TIGHT, dtype=np.int32)
        write_classes(mesh, values)
    layer = mesh.color_attributes.get(palette.COLOR_ATTRIBUTE)
    if layer and layer.domain != "POINT":
        mesh.color_attributes.remove(layer)
        layer = None
    layer = layer or mesh.color_attributes.new(palette.COLOR_ATTRIBUTE, "BYTE_COLOR", "POINT")
    layer.data.foreach_set("color_srgb", palette.colors_of(values).astype(np.float32).reshape(-1))
    mesh.color_attributes.active_color = mesh.color_attributes[palette.COLOR_ATTRIBUTE]
    mesh.update()


def painted_classes(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the class whose colour each vertex is nearest to, shape (V,); None without colours."""
    if mesh.is_editmode:
        colors = edited_colors(mesh)
        return None if colors is None else palette.nearest(colors)
    layer = mesh.color_attributes.get(palette.COLOR_ATTRIBUTE)
    if layer is None:
        return None
    colors = np.empty(len(layer.data) * 4, dtype=np.float32)
    layer.data.foreach_get("color_srgb", colors)
    colors = colors.reshape(-1, 4)
    if layer.domain == "CORNER":  # another tool converted it
        points = np.empty(len(mesh.loops), dtype=np.int32)
        mesh.loops.foreach_get("vertex_index", points)
        colors = palette.point_colors(colors, points, len(mesh.vertices))
    return palette.nearest(colors)


def take_up_painting(mesh: bpy.types.Mesh) -> int:
    """Make classes of the colours, and the colours pure again; return how many vertices changed class."""
    painted, before = painted_classes(mesh), read_classes(mesh)
    if painted is None:
        return 0
    write_classes(mesh, painted)
    return len(painted) if before is None else int(np.count_nonzero(painted != before))


def current_classes(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the classes as the artist sees them: as painted where there are colours, else the attribute."""
    painted = painted_classes(mesh)
    return read_classes(mesh) if painted is None else painted


def fill_selected(mesh: bpy.types.Mesh, value: int) -> int:
    """Give the selected vertices a class, and its colour where there are colours; return how many there are.

    All others are tight if the mesh had no classes.
    """
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.int.get(palette.ATTRIBUTE)
    selected = [vertex.index for vertex in edited.verts if vertex.select]
    if not selected:
        return 0
    if layer is None:
        layer = edited.verts.layers.int.new(palette.ATTRIBUTE)
        for vertex in edited.verts:
            vertex[layer] = TIGHT
    colors = edited.verts.layers.color.get(palette.COLOR_ATTRIBUTE)
    edited.verts.ensure_lookup_table()
    for index in selected:
        edited.verts[index][layer] = value
        if colors:
            edited.verts[index][colors] = (*palette.COLORS[value], 1.0)
    bmesh.update_edit_mesh(mesh, loop_triangles=False, destructive=False)
    return len(selected)


def edited_classes(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the class attribute of each vertex, shape (V,); None without one, or where Python cannot read it."""
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.int.get(palette.ATTRIBUTE)  # 8 bits are no layer that Python knows
    return None if layer is None else np.array([vertex[layer] for vertex in edited.verts], dtype=np.int32)


def edited_colors(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the painted sRGB colour of each vertex, shape (V, 4); None without."""
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.color.get(palette.COLOR_ATTRIBUTE)
    return None if layer is None else np.array([vertex[layer] for vertex in edited.verts]).reshape(-1, 4)


def offer_palette(context: bpy.types.Context) -> None:
    """Show the palette of classes in vertex paint, made if there is none, and brush with its last colour."""
    palette = bpy.data.palettes.get(COLOR_ATTRIBUTE) or bpy.data.palettes.new(COLOR_ATTRIBUTE)
    while palette.colors:
        palette.colors.remove(palette.colors[0])
    for color in COLORS:
        palette.colors.new().color = color
    context.tool_settings.vertex_paint.palette = palette
    if context.tool_settings.vertex_paint.brush:
        choose_color(context, COLORS[-1])


def choose_color(context: bpy.types.Context, color: Sequence[float]) -> None:
    """Make brushes of vertex paint brush with a colour, fully and without blending modes."""
    paint = context.tool_settings.vertex_paint
    brush = paint.brush
    brush.blend, brush.color = "MIX", color
    _shared(context).color = color


def is_chosen(context: bpy.types.Context, color: Sequence[float]) -> bool:
    """Return whether the brush of vertex paint brushes with a colour; not in other modes."""
    brush = context.tool_settings.vertex_paint.brush if context.mode == "PAINT_VERTEX" else None
    if brush is None:
        return False
    shared = _shared(context)
    return np.allclose(shared.color if shared.use_unified_color else brush.color, color, atol=1e-3)


def _shared(context: bpy.types.Context) -> bpy.types.UnifiedPaintSettings:
    """Return the settings that brushes share: Blender 5 has them in each mode, earlier versions in one place."""
    settings = context.tool_settings
    return getattr(settings.vertex_paint, "unified_paint_settings", None) or settings.unified_paint_settings
