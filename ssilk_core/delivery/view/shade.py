# SPDX-License-Identifier: Apache-2.0
"""Shade points on surfaces."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Ints
from .light import KEY, OFFSET, RIM, Lighting, LitGeometry
from .trace import Hits

SHEEN = 0.16  # strength of the sheen of cloth at grazing angles
FILL = 0.10  # strength of the fill light from the camera, so that nothing is black
GLOSS = 0.10  # strength of the highlight on skin


def shade(lit: LitGeometry, hits: Hits, view: Floats, rig: Lighting, lamps: Ints) -> Floats:
    """Return the linear colours of hits, shape (N, 3).

    Args:
        lit: the geometry and the sky's light on it.
        hits: N ray hits on the geometry.
        view: unit directions of those rays, shape (N, 3).
        rig: the lamps.
        lamps: index of the key lamp's sample for each hit, shape (N,).
    """
    geometry, corners = lit.geometry, lit.geometry.faces[hits.faces]
    normals = _mixed(geometry.normals, corners, hits)
    normals /= np.sqrt(_dot(normals, normals))[:, None]
    seen_inside = _faces_away(lit, corners, view)
    thin = geometry.thin[corners[:, 0]]
    side = np.where(seen_inside & thin, np.float32(-1), np.float32(1))
    normals *= side[:, None]
    smooth = _smooth_points(lit, corners, hits, side)
    albedo = _of_side(geometry.outside, geometry.inside, seen_inside, corners, hits)
    light = _of_side(lit.sky_outside, lit.sky_inside, seen_inside & thin, corners, hits)
    light += _key_light(lit, smooth, normals, rig, lamps)[:, None] * KEY
    light += np.maximum(_dot(normals, rig.rim), 0)[:, None] * RIM
    facing = np.abs(_dot(normals, view))
    light += FILL * facing[:, None]
    grazing = (1 - facing) ** 3
    return (albedo + np.where(thin, SHEEN * grazing, GLOSS * grazing)[:, None]) * light


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("...k,...k->...", a, b)


def _mixed(values: Floats, corners: Ints, hits: Hits) -> Floats:
    """Interpolate vertex values (V, 3) over the faces that were hit, shape (N, 3)."""
    return np.einsum("nk,nkc->nc", hits.barycentric, values[corners])


def _of_side(outside: Floats, inside: Floats, seen_inside: np.ndarray, corners: Ints, hits: Hits) -> Floats:
    mixed = _mixed(outside, corners, hits)
    rows = np.flatnonzero(seen_inside)
    mixed[rows] = _mixed(inside, corners[rows], hits.where(rows))
    return mixed


def _faces_away(lit: LitGeometry, corners: Ints, view: Floats) -> np.ndarray:
    a, b, c = np.moveaxis(lit.geometry.points[corners], 1, 0)
    return _dot(np.cross(b - a, c - a), view) > 0


def _smooth_points(lit: LitGeometry, corners: Ints, hits: Hits, side: Floats) -> Floats:
    """Move hits from flat faces onto the curved surface implied by the vertex normals, shape (N, 3).

    They move towards the side that is seen, 1 for the outside and -1 for the inside (N,), where it bulges. Otherwise
    shadow rays from coarse faces hit adjacent faces, and the shadow's edge shows the triangles
    (Hanika, "Hacking the Shadow Terminator", Ray Tracing Gems II, 2021).
    """
    points = _mixed(lit.geometry.points, corners, hits)
    corner_normals = side[:, None, None] * lit.geometry.normals[corners]
    depth = np.minimum(_dot(points[:, None] - lit.geometry.points[corners], corner_normals), 0)
    return points - np.einsum("nk,nkc->nc", hits.barycentric * depth, corner_normals)


def _key_light(lit: LitGeometry, points: Floats, normals: Floats, rig: Lighting, lamps: Ints) -> Floats:
    """Return the share of the key lamp's light that reaches points with these normals, shape (N,)."""
    towards = rig.lamp[lamps]
    cosine = _dot(normals, towards)
    facing = np.flatnonzero(cosine > 0)
    blocked = lit.tracer.blocked(points[facing] + OFFSET * normals[facing], towards[facing])
    light = np.zeros(len(points), dtype=np.float32)
    light[facing] = np.where(blocked, 0, cosine[facing])
    return light
