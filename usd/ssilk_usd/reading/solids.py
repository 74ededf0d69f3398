# SPDX-License-Identifier: Apache-2.0
"""Planes, cubes, spheres, capsules, cylinders and cones of UsdGeom as triangles.

What is round has `AROUND` sides: at most 0.13 % of its radius is cut off.
"""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Ints

from ..opening.stage import location, value
from ..opening.times import change_times

AROUND = 64
SIZES = {
    "Plane": ("width", "length", "axis"),
    "Cube": ("size",),
    "Sphere": ("radius",),
    "Capsule": ("radius", "height", "axis"),
    "Cylinder": ("radius", "height", "axis"),
    "Cone": ("radius", "height", "axis"),
}
"""Types of prims, and the attributes that say their size."""


def solid(prim: Usd.Prim) -> tuple[Floats, Ints]:
    """Return the points (P, 3) in the prim's own space, and the triangles (T, 3), of a prim of a type in `SIZES`.

    Raises:
        SsilkError: a size changes over time, or is not positive.
    """
    kind, sizes = str(prim.GetTypeName()), SIZES[str(prim.GetTypeName())]
    if change_times([prim.GetAttribute(name) for name in sizes]):
        found, allowed = f"the size of this {kind} changes", "colliders move and turn, and keep their size"
        fail(location(prim), found, allowed, "animate its xforms, or make it a mesh")
    lengths = [float(value(prim, name)) for name in sizes if name != "axis"]
    if not all(0 < length < np.inf for length in lengths):
        fail(location(prim), f"{', '.join(sizes[: len(lengths)])} of {lengths}", "each must be positive")
    points, faces = _along_z(kind, lengths)
    axis = str(value(prim, "axis")) if "axis" in sizes else UsdGeom.Tokens.z
    if kind == "Plane" and axis != UsdGeom.Tokens.z:  # its width lies along x for Y, and along z for X
        turn = [[0, 0, 1], [0, 1, 0], [1, 0, 0]] if axis == UsdGeom.Tokens.x else [[1, 0, 0], [0, 0, 1], [0, 1, 0]]
        return points @ np.array(turn, dtype=float).T, faces
    return np.roll(points, {"X": 1, "Y": 2}.get(axis, 0), axis=1), faces


def _along_z(kind: str, lengths: list[float]) -> tuple[Floats, Ints]:
    if kind == "Plane":
        width, length = lengths
        corners = 0.5 * np.array([[-width, -length, 0], [width, -length, 0], [width, length, 0], [-width, length, 0]])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])
    if kind == "Cube":
        corners = 0.5 * lengths[0] * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return corners, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    radius = lengths[0]
    half = 0.5 * lengths[1] if len(lengths) > 1 else 0.0
    bow = np.linspace(0, np.pi / 2, AROUND // 4 + 1)[:-1]
    if kind in ("Sphere", "Capsule"):
        upper = np.stack([radius * np.cos(bow), half + radius * np.sin(bow)], axis=1)
        lower = upper[::-1] * [1, -1]
        rings = np.concatenate([lower[: -1 if half == 0 else None], upper])
        ends = -half - radius, half + radius
    else:
        rings = np.array([[radius, -half], [radius, half]] if kind == "Cylinder" else [[radius, -half]])
        ends = -half, half
    return _lathed(rings, *ends)


def _lathed(rings: Floats, low: float, high: float) -> tuple[Floats, Ints]:
    """Return a closed surface around z through rings of radius and height (R, 2), and a point at both ends."""
    angle = np.arange(AROUND) / AROUND * 2 * np.pi
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = [np.column_stack([radius * circle, np.full(AROUND, height)]) for radius, height in rings]
    first, count = np.arange(AROUND), len(rings) * AROUND
    after = np.roll(first, -1)
    faces = [np.stack([np.full(AROUND, count), after, first], axis=1)]
    for ring in range(len(rings) - 1):
        at = ring * AROUND
        faces += [
            np.stack([first + at, after + at, after + at + AROUND], axis=1),
            np.stack([first + at, after + at + AROUND, first + at + AROUND], axis=1),
        ]
    at = count - AROUND
    faces.append(np.stack([np.full(AROUND, count + 1), first + at, after + at], axis=1))
    return np.concatenate([*points, [[0, 0, low], [0, 0, high]]]), np.concatenate(faces)
