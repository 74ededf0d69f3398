# SPDX-License-Identifier: Apache-2.0
"""Classify garment vertices as pinned, tight or loose, from the body under the garment (paper, Section 3.4).

The paper paints the classes by hand. Here a vertex is tight where the body is near and either supports the cloth
from below or is enclosed by it. Cloth that only hangs close to the back is not tight. The band along the border
from which an island hangs is pinned. All other vertices are loose. An island that is near the body nowhere hangs
from its top where a single joint carries the garment, as a bone carries what an artist parents to it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..assets import LOOSE, PINNED, TIGHT, UP, Character, Floats, Ints, Mesh, SkinWeights
from ..errors import fail
from ..mesh.geodesic import distances, within
from ..mesh.topology import components, edge_use, edges, islands, smooth, vertex_areas
from .surface import SurfacePoints, closest_on_surface

Mask = NDArray[np.bool_]
HANG_RADIUS = 0.06  # [m] neighbourhood of a border vertex; it must reach past a collar that curls towards the neck
HANG_DROP = 0.005  # [m] least height of a border that carries the cloth, above the mean of that neighbourhood
TILT = (1.3e-3, -0.7e-3, 1.1e-3)  # tilts rays off the axes, where they slip through edges of regular meshes


@dataclass(frozen=True)
class ClassOptions:
    """Thresholds of `classify`.

    Attributes:
        tight_distance: largest distance of tight cloth from the body [m].
        tear_rate: rate of change of skinning weights along an edge (half the sum of absolute differences, per
            length) above which linear blend skinning tears the cloth [1/m]. Bodies stay below about 30.
        tear_width: distance along the cloth within which vertices around a tear count as torn [m].
        torn_distance: largest distance of torn cloth from the body at which it is still tight [m].
        support: least cosine between the body's normal and up where the body supports the cloth.
        wrapped: least share of rays into the body that hit the garment again where it encloses the body.
        thickness: initial length of those rays that is skipped, to pass folds nearby [m].
        strip_width: cloth narrower than this, such as a fringe, hangs freely and encloses nothing [m].
        rounds: rounds of averaging with the neighbours, which smooth the border between tight and loose.
        speck_reach: a patch that stays within this distance of its surroundings takes their class [m].
        pinned_width: width of the pinned band, along the cloth [m].
        pinned_distance: largest distance from the body of a border that pins the garment [m].
        pinned_length: shortest border from which a garment hangs [m]. Without one, its top is pinned.
        yoke_width: width of the band below that border, along the cloth, in which near cloth is tight [m].
    """

    tight_distance: float = 0.05
    tear_rate: float = 30.0
    tear_width: float = 0.04
    torn_distance: float = 0.035
    support: float = 0.5
    wrapped: float = 0.3
    thickness: float = 0.05
    strip_width: float = 0.08
    rounds: int = 4
    speck_reach: float = 0.04
    pinned_width: float = 0.025
    pinned_distance: float = 0.03
    pinned_length: float = 0.25
    yoke_width: float = 0.08

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value >= 0:
                fail("classes", f"{item.name} = {value}", "it must not be negative")


def classify(
    character: Character,
    mesh: Mesh,
    skin: SkinWeights,
    options: ClassOptions | None = None,
    *,
    carried: bool = False,
) -> NDArray[np.int8]:
    """Return PINNED, TIGHT or LOOSE for each garment vertex, shape (V,).

    Args:
        mesh: the garment at the character's bind pose.
        skin: its skinning weights for LBS. Unsmoothed weights show most clearly where limbs part.
        carried: whether an island that is near the body nowhere hangs from its top.

    Raises:
        SsilkError: an island of the garment has no pinned or tight vertex.
    """
    options = options or ClassOptions()
    pairs, island = edges(mesh.faces), islands(mesh.faces, mesh.vertex_count)
    body = closest_on_surface(mesh.points, character.merged_body().mesh)
    tears = _tear_rate(mesh, skin.dense(character.skeleton.joint_count), pairs) > options.tear_rate
    torn = _band(mesh, tears, options.tear_width)
    near = body.distance < np.where(torn, options.torn_distance, options.tight_distance)
    rim = _hanging_border(mesh, body.distance < options.pinned_distance, island, options.pinned_length)
    held = near & _holding(mesh, body, near, rim, options)
    held = smooth(held[:, None].astype(float), pairs, options.rounds)[:, 0] > 0.5
    held = _with_specks(held, mesh, pairs, options.speck_reach)
    held = ~_with_specks(~held, mesh, pairs, options.speck_reach) | _band(mesh, rim, options.pinned_width)
    if carried:
        held |= _tops(mesh, ~held, np.isin(island, island[held]), island, options)
    _need_held(held, mesh, island)
    classes = np.where(held, TIGHT, LOOSE).astype(np.int8)
    classes[held & _band(mesh, rim | _tops(mesh, held, rim, island, options), options.pinned_width)] = PINNED
    return classes


def _holding(mesh: Mesh, body: SurfacePoints, near: Mask, rim: Mask, options: ClassOptions) -> Mask:
    """Return where the body supports the cloth or is enclosed by it, or the rim is near, shape (V,)."""
    carried = body.normals @ UP > options.support
    wrapped = _wrapped(mesh, body.normals, near, options.thickness) > options.wrapped
    strips = _strips(mesh, options.strip_width)
    return carried | (wrapped & ~strips) | _band(mesh, rim, options.yoke_width)


def _strips(mesh: Mesh, width: float) -> Mask:
    """Return the vertices of strips narrower than `width` [m] on islands that are wider elsewhere, shape (V,).

    This is a morphological opening: a strip is too far from any cloth that has half the width on every side.
    """
    pairs, uses = edge_use(mesh.faces)
    to_border = distances(mesh.points, mesh.faces, np.unique(pairs[uses == 1]))
    to_middle = distances(mesh.points, mesh.faces, np.flatnonzero(to_border > width / 2))
    return np.isfinite(to_middle) & (to_middle > 0.8 * width)  # a 90-degree corner is at 0.71 of the width


def _band(mesh: Mesh, seeds: Mask, width: float) -> Mask:
    """Return the vertices within `width` [m] of `seeds` (V,) along the cloth, shape (V,)."""
    return within(mesh.points, mesh.faces, np.flatnonzero(seeds), width)


def _tear_rate(mesh: Mesh, weights: Floats, pairs: Ints) -> Floats:
    """Return the largest rate of change of `weights` (V, J) along the edges of each vertex [1/m], shape (V,)."""
    low, high = pairs.T
    length = np.linalg.norm(mesh.points[low] - mesh.points[high], axis=1)
    rate = 0.5 * np.abs(weights[low] - weights[high]).sum(axis=1) / np.maximum(length, 1e-6)
    result = np.zeros(mesh.vertex_count)
    np.maximum.at(result, low, rate)
    np.maximum.at(result, high, rate)
    return result


def _wrapped(mesh: Mesh, normals: Floats, near: Mask, thickness: float) -> Floats:
    """Return the share of rays through the body that meet `near` (V,) cloth on the other side, shape (V,).

    From each vertex one ray runs against the body's normal (V, 3), and four are inclined by 45 degrees to it.
    """
    import igl

    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    across = np.cross(normals, least)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(normals, across)
    tree = igl.AABB()
    tree.init(mesh.points, mesh.faces)
    hits = np.zeros(mesh.vertex_count)
    for lean in (np.zeros_like(along), across, -across, along, -along):
        rays = lean - normals + TILT
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        face, _, _ = tree.intersect_ray_first(mesh.points, mesh.faces, mesh.points + thickness * rays, rays)
        hits += (face >= 0) & near[mesh.faces[face]].all(axis=1)
    return hits / 5


def _with_specks(kind: Mask, mesh: Mesh, pairs: Ints, reach: float) -> Mask:
    """Return `kind` (V,) and the patches outside it, such as specks and hems, that stay within `reach` [m] of it."""
    away = distances(mesh.points, mesh.faces, np.flatnonzero(kind))
    patch = components(pairs[~kind[pairs].any(axis=1)], mesh.vertex_count)
    farthest = np.zeros(mesh.vertex_count)
    np.maximum.at(farthest, patch, away)
    return kind | (farthest[patch] <= reach)


def _need_held(held: Mask, mesh: Mesh, island: Ints) -> None:
    adrift = np.setdiff1d(island, island[held])
    if len(adrift):
        lost = np.isin(island, adrift)
        fail(
            mesh.path,
            f"{len(adrift)} of {island.max() + 1} islands ({np.count_nonzero(lost)} vertices, the first "
            f"{np.flatnonzero(lost)[0]}) rest nowhere on the body",
            "every island needs a pinned or tight vertex, or it falls off",
            "move the garment onto the body, or paint primvars:ssilk:class",
        )


def _tops(mesh: Mesh, held: Mask, rim: Mask, island: Ints, options: ClassOptions) -> Mask:
    """Return the highest `held` vertices of each island without a rim, such as a closed hood, shape (V,)."""
    result = np.zeros(mesh.vertex_count, dtype=bool)
    for number in np.setdiff1d(island, island[rim]):
        height = np.where(held & (island == number), mesh.points @ UP, -np.inf)
        result |= height > height.max() - options.pinned_width
    return result


def _hanging_border(mesh: Mesh, near: Mask, island: Ints, shortest: float) -> Mask:
    """Return the highest stretch of `near` border of each island that lies above the cloth around it, shape (V,).

    Stretches shorter than `shortest` [m], such as the lower half of an armhole, carry nothing.
    """
    pairs, uses = edge_use(mesh.faces)
    rims = pairs[(uses == 1) & near[pairs].all(axis=1)]
    border, index = np.unique(rims, return_inverse=True)
    rims = rims[(_drops(mesh, border) > HANG_DROP)[index.reshape(-1, 2)].all(axis=1)]
    stretch = components(rims, mesh.vertex_count)
    height = np.bincount(stretch, mesh.points @ UP) / np.bincount(stretch)
    lengths = np.linalg.norm(mesh.points[rims[:, 0]] - mesh.points[rims[:, 1]], axis=1)
    long = (np.bincount(stretch[rims[:, 0]], lengths, minlength=len(height)) >= shortest)[stretch]
    result = np.zeros(mesh.vertex_count, dtype=bool)
    for number in np.unique(island[long]):
        here = stretch[long & (island == number)]
        result |= stretch == here[height[here].argmax()]
    return result


def _drops(mesh: Mesh, vertices: Ints) -> Floats:
    """Return the height of `vertices` (N,) above the mean of the cloth around them [m], shape (N,)."""
    from scipy.spatial import cKDTree

    areas, height = vertex_areas(mesh.points, mesh.faces), mesh.points @ UP
    around = cKDTree(mesh.points).query_ball_point(mesh.points[vertices], HANG_RADIUS)
    means = [np.average(height[near], weights=areas[near] + 1e-12) for near in around]
    return height[vertices] - np.array(means)
