# SPDX-License-Identifier: Apache-2.0
"""Classify garment vertices as pinned, tight or loose, from the body under the garment (paper, Section 3.4).

The paper paints the classes by hand. Here a vertex is tight where the body is near and either supports the cloth
from below or is enclosed by it. Cloth that only hangs close to the back is not tight, nor is cloth around two limbs
together, such as a skirt below the crotch: limbs part, and it cannot follow both. The band along the border from
which an island hangs is pinned. All other vertices are loose. An island that is near the body nowhere hangs from its
top where a single joint carries the garment, as a bone carries what an artist parents to it. An island that lies on
another one, wholly, has the classes beneath it; stitches hold one that lies on others in part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import LOOSE, UP, Character, Floats, Ints, Mesh, SkinWeights, classes_at
from ...scene.mesh.geodesic import distances, within, within_of
from ...scene.mesh.topology import adrift, components, edge_use, edges, islands, smooth, vertex_areas
from .hosts import Hosts
from .limbs import LimbRays
from .surface import closest_on_surface

Mask = NDArray[np.bool_]
HANG_RADIUS = 0.06  # [m] neighbourhood of a border vertex; it must reach past a collar that curls towards the neck
HANG_DROP = 0.005  # [m] least height of a border that carries the cloth, above the mean of that neighbourhood
FOLD = 0.5  # cosine between the normals of two faces below which closed cloth has its border between them
USUAL = 0.5  # tightness at which the thresholds below hold as they are
LADDER = np.arange(1, 20) / 20  # of tightness, on which vertices become tight one after another
RANGE = 4.0  # the factor of the distances from the usual tightness to the ends


@dataclass(frozen=True)
class ClassOptions:
    """Thresholds of `hold_levels`.

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


def held_classes(mesh: Mesh, levels: Floats, tightness: float) -> NDArray[np.int8]:
    """Return the classes at a tightness in [0, 1], shape (V,), of the levels that `hold_levels` returns, shape (V,).

    Raises:
        SsilkError: an island of the garment is all loose at that tightness, and no stitch holds it.
    """
    classes = classes_at(levels, tightness)
    _need_held(
        classes != LOOSE, mesh, Hosts.of(mesh).joined_islands, f"are all loose at tightness {tightness:g}",
        "raise the tightness, pin some of each island, or paint primvars:ssilk:class",
    )  # fmt: skip
    return classes


def hold_levels(
    character: Character,
    mesh: Mesh,
    skin: SkinWeights,
    options: ClassOptions | None = None,
    *,
    ladder: Sequence[float] = tuple(LADDER),
    carried: bool = False,
    pins: Mask | None = None,
) -> Floats:
    """Return the least tightness in (0, 1] at which each vertex is tight, 0 where it is pinned, shape (V,).

    At 0 only what is pinned is held, at 1 all of the garment is. In between distances grow from a quarter of those of
    the options to four times as much. Above the usual tightness less of the body needs to be enclosed, and cloth may
    be tight where limbs part, the nearest first.

    Args:
        mesh: the garment at the character's bind pose.
        skin: its skinning weights for LBS. Unsmoothed weights show most clearly where limbs part.
        ladder: tightnesses that are tried.
        carried: whether an island that is near the body nowhere hangs from its top.
        pins: what is pinned, shape (V,), in place of the band from which islands hang.

    Raises:
        SsilkError: an island of the garment rests nowhere on the body, no stitch holds it, and `pins` do not say
            what does.
    """
    options, hosts = options or ClassOptions(), Hosts.of(mesh)
    pairs, island = edges(mesh.faces), islands(mesh.faces, mesh.vertex_count)
    body = closest_on_surface(mesh.points, character.merged_body().mesh)
    tears = _tear_rate(mesh, skin.dense(character.skeleton.joint_count), pairs) > options.tear_rate
    torn = _band(mesh, tears, options.tear_width)
    rays = LimbRays.through(character, mesh, body, options.thickness)
    rim = _hanging_border(mesh, body.distance < options.pinned_distance, island, options.pinned_length)
    strips, band = _strips(mesh, options.strip_width), _band(mesh, rim, options.pinned_width)
    yoke = _band(mesh, rim, options.yoke_width)
    supported = body.normals @ UP > options.support

    def held_at(tightness: float) -> Mask:
        scale = RANGE ** (tightness / USUAL - 1)
        near = body.distance < scale * np.where(torn, options.torn_distance, options.tight_distance)
        enough = options.wrapped * min(1.0, 2 - tightness / USUAL)
        forgiven = body.distance < RANGE * options.tight_distance * max(0.0, tightness / USUAL - 1) ** 2
        enclosed = (rays.hits(near) > enough) & ~strips & (~rays.parting | forgiven)
        held = near & (supported | enclosed | yoke)
        held = smooth(held[:, None].astype(float), pairs, options.rounds)[:, 0] > 0.5
        held = _with_specks(held, mesh, pairs, options.speck_reach)
        return ~_with_specks(~held, mesh, pairs, options.speck_reach) | band

    held, asked = held_at(USUAL), pins
    if carried:
        held |= _tops(mesh, ~held, np.isin(island, island[held]), island, options)
    if pins is None:
        _need_held(
            hosts.carry(held), mesh, hosts.joined_islands, "rest nowhere on the body",
            "move the garment onto the body, or paint primvars:ssilk:class",
        )  # fmt: skip
        pins = held & _band(mesh, rim | _tops(mesh, held, rim, island, options), options.pinned_width)
    levels = np.where(pins, 0.0, _levels(held, held_at, sorted(step for step in ladder if 0 < step < 1)))
    levels = hosts.carry(levels)
    return levels if asked is None else np.where(asked, 0.0, levels)


def _levels(usual: Mask, held_at: Callable[[float], Mask], ladder: Sequence[float]) -> Floats:
    """Return the least tightness of a ladder at which each vertex is held, 1 where none is enough, shape (V,).

    What is held at one tightness is so at all above: smoothing, which could take it away again, is not believed.
    """
    levels = np.where(usual, USUAL, 1.0)
    looser, tighter = usual, usual
    for tightness in reversed([step for step in ladder if step < USUAL]):
        looser = looser & held_at(tightness)
        levels[looser] = tightness
    for tightness in (step for step in ladder if step > USUAL):
        added = held_at(tightness) & ~tighter
        levels[added], tighter = tightness, tighter | added
    return levels


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


def _with_specks(kind: Mask, mesh: Mesh, pairs: Ints, reach: float) -> Mask:
    """Return `kind` (V,) and the patches outside it, such as specks and hems, that stay within `reach` [m] of it."""
    if kind.all() or not kind.any():
        return kind
    patch = components(pairs[~kind[pairs].any(axis=1)], mesh.vertex_count)
    near = within_of(mesh.points, mesh.faces, kind, reach)
    beyond = np.zeros(mesh.vertex_count, dtype=bool)
    np.logical_or.at(beyond, patch, ~near)
    return kind | ~beyond[patch]


def _need_held(held: Mask, mesh: Mesh, island: Ints, otherwise: str, todo: str) -> None:
    falling = adrift(mesh.faces, island, held)
    if len(falling):
        lost = np.isin(island, falling)
        fail(
            mesh.path,
            f"{len(falling)} of {len(np.unique(island[mesh.faces]))} islands "
            f"({np.count_nonzero(lost)} vertices, the first {np.flatnonzero(lost)[0]}) {otherwise}",
            "every island needs a pinned or tight vertex, or it falls off",
            todo,
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

    Stretches shorter than `shortest` [m], such as the lower half of an armhole, carry nothing. Cloth whose layers
    close around its thickness has its border where it folds.
    """
    pairs, uses = edge_use(mesh.faces)
    border = pairs[uses == 1]
    folds = _folds(mesh)
    closed = ~np.isin(island[folds[:, 0]], island[border[:, 0]])
    rims = np.concatenate([border, folds[closed]])
    rims = rims[near[rims].all(axis=1)]
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


def _folds(mesh: Mesh) -> Ints:
    """Return the edges at which two faces meet at more than `FOLD`, shape (N, 2)."""
    sides = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(mesh.faces)), 3)
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    order = np.lexsort(sides.T)
    sides, owner = sides[order], owner[order]
    same = (sides[1:] == sides[:-1]).all(axis=1)
    cosine = np.einsum("nc,nc->n", normals[owner[1:]], normals[owner[:-1]])
    return sides[1:][same & (cosine < FOLD)]


def _drops(mesh: Mesh, vertices: Ints) -> Floats:
    """Return the height of `vertices` (N,) above the mean of the cloth around them [m], shape (N,)."""
    from scipy.spatial import cKDTree

    areas, height = vertex_areas(mesh.points, mesh.faces), mesh.points @ UP
    around = cKDTree(mesh.points).query_ball_point(mesh.points[vertices], HANG_RADIUS)
    means = [np.average(height[near], weights=areas[near] + 1e-12) for near in around]
    return height[vertices] - np.array(means)
