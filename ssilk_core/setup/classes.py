# SPDX-License-Identifier: Apache-2.0
"""Which vertices of a garment are pinned, tight and loose, found from the body under it (paper, Section 3.4).

The paper paints these by hand. Here a vertex is held, and so tight, where the body is near and either carries
the cloth from below or is wrapped in it; cloth that merely hangs close to a back is not held. Pinned is the band
along the border from which an island hangs. All the rest is loose.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ssilk_core.assets import LOOSE, PINNED, TIGHT, UP, Character, Floats, Ints, Mesh, SkinWeights
from ssilk_core.errors import fail, need
from ssilk_core.mesh.geodesic import distances
from ssilk_core.mesh.topology import components, edge_use, edges, islands, smooth, vertex_areas
from ssilk_core.setup.surface import SurfacePoints, closest_on_surface

Mask = NDArray[np.bool_]
HANG_ROUNDS = 30  # of averaging heights over the cloth: looks past a collar that curls in towards the neck


@dataclass(frozen=True)
class ClassOptions:
    """Thresholds of `classify`.

    Attributes:
        tight_distance: farthest that held cloth lies from the body [m].
        tear_rate: change of skinning weights along an edge, half the sum of absolute differences per length
            [1/m], above which plain skinning tears; bodies themselves stay below about 30.
        torn_distance: farthest that held cloth lies from the body where skinning tears [m].
        support: least upward part of the body's normal where it carries cloth (cosine with up).
        wrapped: least share of rays into the body that must meet the garment again where it is wrapped.
        thickness: length of those rays in which the garment is not looked for, to clear folds nearby [m].
        strip_width: cloth narrower than this hangs free, as fringes do, and wraps nothing [m].
        rounds: rounds of averaging with the neighbours that tidy the border between held and loose.
        speck_area: patches smaller than this join what surrounds them [m2].
        pinned_width: width of the pinned band, along the cloth [m].
        pinned_distance: farthest that a border lies from the body and still pins the garment [m].
        yoke_width: width of the band below that border, along the cloth, in which it holds near cloth [m].
    """

    tight_distance: float = 0.05
    tear_rate: float = 30.0
    torn_distance: float = 0.025
    support: float = 0.5
    wrapped: float = 0.3
    thickness: float = 0.05
    strip_width: float = 0.08
    rounds: int = 4
    speck_area: float = 0.012
    pinned_width: float = 0.025
    pinned_distance: float = 0.03
    yoke_width: float = 0.08

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            need(value >= 0, "classes", f"{item.name} = {value}", "it must not be negative")


def classify(
    character: Character, mesh: Mesh, skin: SkinWeights, options: ClassOptions | None = None
) -> NDArray[np.int8]:
    """Return PINNED, TIGHT or LOOSE for each garment vertex, shape (V,).

    Args:
        mesh: the garment at the character's bind pose.
        skin: its plain weights; unsmoothed ones show best where limbs part.

    Raises:
        SsilkError: an island of the garment is held nowhere.
    """
    options = options or ClassOptions()
    pairs, island = edges(mesh.faces), islands(mesh.faces, mesh.vertex_count)
    body = closest_on_surface(mesh.points, character.merged_body().mesh)
    tears = _tear_rate(mesh, skin.dense(character.skeleton.joint_count), pairs) > options.tear_rate
    near = body.distance < np.where(tears, options.torn_distance, options.tight_distance)
    rim = _hanging_border(mesh, body.distance < options.pinned_distance, island)
    held = near & _holding(mesh, body, near, rim, options)
    held = smooth(held[:, None].astype(float), pairs, options.rounds)[:, 0] > 0.5
    held = _without_specks(held | rim, mesh, pairs, options.speck_area)
    _need_held(held, mesh, island)
    classes = np.where(held, TIGHT, LOOSE).astype(np.int8)
    classes[held & _band(mesh, rim | _tops(mesh, held, rim, island, options), options.pinned_width)] = PINNED
    return classes


def _holding(mesh: Mesh, body: SurfacePoints, near: Mask, rim: Mask, options: ClassOptions) -> Mask:
    """Return where the body or the rim holds the cloth: it carries it, is wrapped in it, or the rim is near, (V,)."""
    carried = body.normals @ UP > options.support
    wrapped = _wrapped(mesh, body.normals, near, options.thickness) > options.wrapped
    strips = _strips(mesh, options.strip_width)
    return carried | (wrapped & ~strips) | _band(mesh, rim, options.yoke_width)


def _strips(mesh: Mesh, width: float) -> Mask:
    """Return the vertices of strips narrower than `width` [m] on islands that are wider elsewhere, shape (V,).

    What lies too far from all cloth that has half the width around it (a morphological opening).
    """
    pairs, uses = edge_use(mesh.faces)
    to_border = distances(mesh.points, mesh.faces, np.unique(pairs[uses == 1]))
    to_middle = distances(mesh.points, mesh.faces, np.flatnonzero(to_border > width / 2))
    return np.isfinite(to_middle) & (to_middle > 0.8 * width)  # a corner of 90 degrees is 0.71 away


def _band(mesh: Mesh, seeds: Mask, width: float) -> Mask:
    """Return the vertices within `width` [m] of `seeds` (V,) along the cloth, shape (V,)."""
    return distances(mesh.points, mesh.faces, np.flatnonzero(seeds)) <= width


def _tear_rate(mesh: Mesh, weights: Floats, pairs: Ints) -> Floats:
    """Return the fastest change of `weights` (V, J) along an edge at each vertex [1/m], shape (V,)."""
    low, high = pairs.T
    length = np.linalg.norm(mesh.points[low] - mesh.points[high], axis=1)
    rate = 0.5 * np.abs(weights[low] - weights[high]).sum(axis=1) / np.maximum(length, 1e-6)
    result = np.zeros(mesh.vertex_count)
    np.maximum.at(result, low, rate)
    np.maximum.at(result, high, rate)
    return result


def _wrapped(mesh: Mesh, normals: Floats, near: Mask, thickness: float) -> Floats:
    """Return the share of rays through the body that meet `near` (V,) cloth on the other side, shape (V,).

    From each vertex one ray runs against the body's normal (V, 3) and four lean 45 degrees off it.
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
        rays = lean - normals
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        face, _, _ = tree.intersect_ray_first(mesh.points, mesh.faces, mesh.points + thickness * rays, rays)
        hits += (face >= 0) & near[mesh.faces[face]].all(axis=1)
    return hits / 5


def _without_specks(held: Mask, mesh: Mesh, pairs: Ints, smallest: float) -> Mask:
    """Turn patches of `held` (V,) and of its opposite that are smaller than `smallest` [m2] into the other kind.

    Smallest first, so that a speck within a speck joins what surrounds both. An island of one kind is no speck.
    """
    areas, held = vertex_areas(mesh.points, mesh.faces), held.copy()
    while True:
        across = held[pairs[:, 0]] != held[pairs[:, 1]]
        patch = components(pairs[~across], mesh.vertex_count)
        size = np.bincount(patch, areas)
        size[np.setdiff1d(patch, patch[pairs[across]])] = np.inf
        if size.min() >= smallest:
            return held
        held[patch == size.argmin()] ^= True


def _need_held(held: Mask, mesh: Mesh, island: Ints) -> None:
    adrift = np.setdiff1d(island, island[held])
    if len(adrift):
        lost = np.isin(island, adrift)
        fail(
            mesh.path,
            f"{len(adrift)} of {island.max() + 1} islands ({np.count_nonzero(lost)} vertices, the first "
            f"{np.flatnonzero(lost)[0]}) rest nowhere on the body",
            "every island needs some pinned or tight vertices, or it falls off",
            "move the garment to the body, or paint primvars:ssilk:class",
        )


def _tops(mesh: Mesh, held: Mask, rim: Mask, island: Ints, options: ClassOptions) -> Mask:
    """Return the highest held vertices of each island that has no rim to hang from, such as a closed hood, (V,)."""
    result = np.zeros(mesh.vertex_count, dtype=bool)
    for number in np.setdiff1d(island, island[rim]):
        height = np.where(held & (island == number), mesh.points @ UP, -np.inf)
        result |= height > height.max() - options.pinned_width
    return result


def _hanging_border(mesh: Mesh, near: Mask, island: Ints) -> Mask:
    """Return, for each island, the highest stretch of `near` border that stands above the cloth around it, (V,)."""
    pairs, uses = edge_use(mesh.faces)
    rims, height = pairs[uses == 1], mesh.points @ UP
    hangs = near & (height > smooth(height[:, None], pairs, HANG_ROUNDS)[:, 0])
    hangs &= np.isin(np.arange(mesh.vertex_count), rims)
    stretch = components(rims[hangs[rims].all(axis=1)], mesh.vertex_count)
    mean_height = np.bincount(stretch, height) / np.bincount(stretch)
    result = np.zeros(mesh.vertex_count, dtype=bool)
    for number in np.unique(island[hangs]):
        here = stretch[hangs & (island == number)]
        result |= stretch == here[mean_height[here].argmax()]
    return result
