# SPDX-License-Identifier: Apache-2.0
"""Split the loose part of a garment into connected clusters, each with a hierarchy of proxies (paper, Appendix A)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.geodesic import Measure, distances, farthest_points, nearest_sources, submesh
from ...scene.mesh.topology import components, edges, vertex_areas, vertex_mask
from .mirror import mates_of, mirrored_points

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Seam:
    """The seam between loose cloth and the rest.

    Attributes:
        distance: geodesic distance of each vertex to the nearest one that is not loose [m], shape (V,).
        nearest: that nearest vertex, shape (V,).
    """

    distance: Floats
    nearest: Ints


@dataclass(frozen=True, eq=False)
class Cluster:
    """A connected piece of the loose part, with its proxies in breadth-first order.

    Attributes:
        vertices: garment vertices of the piece, ascending, shape (M,).
        at_seam: whether an edge joins each of them to the rest of the garment, shape (M,).
        samples: garment vertices at which the proxies are placed, shape (S,).
        distances: geodesic distance of each piece vertex to each sample [m], shape (S, M).
        parents: index of each proxy's parent among `samples`, -1 for roots, shape (S,).
        joint: character joint that is the parent of the roots.
    """

    vertices: Ints
    at_seam: Mask
    samples: Ints
    distances: Floats
    parents: Ints
    joint: int


def find_seam(mesh: Mesh, loose: Mask, measure: Measure = distances) -> Seam:
    """Return the distance of every vertex to those that are not `loose` (V,), by a measure of distances.

    Raises:
        SsilkError: all vertices of an island are loose, or a loose vertex belongs to no face.
    """
    seam = Seam(*nearest_sources(mesh.points, mesh.faces, np.flatnonzero(~loose), measure))
    falling = seam.nearest < 0
    lone = np.flatnonzero(falling & ~vertex_mask(mesh.faces, mesh.vertex_count))
    if len(lone):
        fail(
            mesh.path,
            f"{len(lone)} loose vertices belong to no face (the first is {lone[0]})",
            "they have no mass, and nothing holds them",
            "delete them, as 'ssilk inspect --fix' does",
        )
    if falling.any():
        fail(
            mesh.path,
            f"{np.count_nonzero(falling)} loose vertices (the first is {np.flatnonzero(falling)[0]}) lie on islands "
            "without a pinned or tight vertex",
            "every island needs one, or it falls off",
            "paint primvars:ssilk:class",
        )
    return seam


def find_pieces(mesh: Mesh, loose: Mask) -> list[Ints]:
    """Return the vertices of each connected piece of `loose` (V,), in descending order of area."""
    faces, kept = submesh(mesh.faces, loose)
    label = components(edges(faces), len(kept))
    areas = np.bincount(label, vertex_areas(mesh.points, mesh.faces)[kept])
    return [kept[label == number] for number in np.argsort(-areas, kind="stable")]


def distribute_proxies(areas: Floats, sizes: Ints, count: int, images: Ints) -> Ints:
    """Distribute `count` proxies among pieces in proportion to `areas` (N,).

    Each piece gets one proxy first, in order, until none is left. A piece gets no more proxies than it has
    vertices: `sizes`, shape (N,). Of those left, pieces that are `images` of each other, (N,), get as many, so that
    one may stay; others are images of themselves.
    """
    shares, alone = (np.arange(len(areas)) < count).astype(int), images == np.arange(len(areas))
    while (left := min(count, int(sizes.sum())) - int(shares.sum())) > 0:
        fitting = (shares > 0) & (shares < sizes) & (alone | (left > 1))
        if not fitting.any():
            break
        chosen = int(np.argmax(np.where(fitting, areas, -1.0) / np.maximum(shares, 1)))
        shares[np.unique([chosen, images[chosen]])] += 1
    return shares


def build_cluster(
    mesh: Mesh,
    vertices: Ints,
    seam: Seam,
    body_weights: Floats,
    parents: Ints,
    *,
    proxies: int,
    roots: int,
    twin: Ints | None = None,
    measure: Measure = distances,
    placed: Callable[[], object] = lambda: None,
) -> Cluster:
    """Sample `proxies` vertices of a loose piece and connect them to the character's joints.

    The first sample is the seam vertex nearest to the mean of all of them: the cloth hinges there. The others are
    farthest points by geodesic distance within the piece.

    Args:
        vertices: vertices of the piece, ascending, shape (M,).
        body_weights: LBS weights of all garment vertices over the character's joints, shape (V, J).
        parents: parents of the character's joints, shape (J,).
        twin: of each vertex of a symmetric piece, its image among these: proxies are symmetric too then, and may be
            one fewer, shape (M,).
        measure: of the distance between proxies.
        placed: called after each proxy.
    """
    inside = np.zeros(mesh.vertex_count, dtype=bool)
    inside[vertices] = True
    faces, _ = submesh(mesh.faces, inside)
    at_seam = _at_seam(mesh, inside)[vertices]
    points = mesh.points[vertices]
    off_middle = np.linalg.norm(points - points[at_seam].mean(axis=0), axis=1)
    first = np.where(at_seam, off_middle, np.inf)
    samples: Ints
    mates: Ints
    if twin is None or proxies == 1:
        samples, spread = farthest_points(
            points, faces, int(first.argmin()), proxies, measure=measure, sampled=placed
        )
        mates = np.arange(len(samples))
    else:
        samples, spread = mirrored_points(points, faces, twin, first, proxies, measure, placed)
        mates = mates_of(samples, twin)
    order, above = hierarchy(spread, samples, seam.distance[vertices], at_seam, edges(faces), roots, mates)
    joint = carrying_joint(body_weights[seam.nearest[vertices[at_seam]]].sum(axis=0), parents)
    return Cluster(vertices, at_seam, vertices[samples[order]], spread[order], above, joint)


def mirrored_cluster(
    cluster: Cluster, vertices: Ints, twin: Ints, seam: Seam, body_weights: Floats, parents: Ints
) -> Cluster:
    """Return the image of a cluster in the piece of the garment that is the image of its own.

    Args:
        vertices: of that piece, ascending, shape (M,).
        twin: image of each vertex of the garment, shape (V,).
        seam, body_weights, parents: as for `build_cluster`.
    """
    own = np.searchsorted(cluster.vertices, twin[vertices])
    at_seam = cluster.at_seam[own]
    joint = carrying_joint(body_weights[seam.nearest[vertices[at_seam]]].sum(axis=0), parents)
    return Cluster(vertices, at_seam, twin[cluster.samples], cluster.distances[:, own], cluster.parents, joint)


def _at_seam(mesh: Mesh, inside: Mask) -> Mask:
    """Return the vertices of `inside` (V,) that an edge joins to a vertex outside it, shape (V,)."""
    pairs = edges(mesh.faces)
    result = np.zeros(mesh.vertex_count, dtype=bool)
    result[pairs[inside[pairs[:, 0]] != inside[pairs[:, 1]]]] = True
    return result & inside


def carrying_joint(weights: Floats, parents: Ints) -> int:
    """Return the deepest joint that has, together with its descendants, more than half of `weights` (J,).

    The paper takes the heaviest joint of the nearest vertex. But all vertices of a seam are equally near, and a
    skirt whose seam lies half on each thigh must hang from the hips. Where one joint dominates, both rules agree.
    """
    carried = np.array(weights, dtype=np.float64)
    for joint in range(len(parents) - 1, 0, -1):
        if parents[joint] >= 0:
            carried[parents[joint]] += carried[joint]
    return int(np.flatnonzero(carried > 0.5 * carried.max())[-1])


def hierarchy(
    spread: Floats, samples: Ints, to_seam: Floats, at_seam: Mask, pairs: Ints, roots: int, mates: Ints
) -> tuple[Ints, Ints]:
    """Order proxies breadth first along the adjacency of their regions.

    The region of a proxy is its geodesic Voronoi cell in the piece. The roots are the `roots` proxies nearest to
    the seam among those whose regions reach it. The others follow level by level. The parent of each is its
    nearest neighbour on the level above. Of two proxies that are images of each other, the parents are too.

    Args:
        spread: distance of every piece vertex to each sample [m], shape (S, M).
        samples: piece vertices of the samples, shape (S,).
        to_seam: distance of every piece vertex to the seam [m], shape (M,).
        at_seam: whether each piece vertex lies at the seam, shape (M,).
        pairs: edges of the piece, shape (E, 2).
        mates: sample that is the image of each, itself without one, shape (S,).

    Returns:
        The samples in order, shape (S,), and the position of each one's parent in that order, -1 for roots, (S,).
    """
    count, region = len(samples), spread.argmin(axis=0)
    touching = np.zeros((count, count), dtype=bool)
    touching[tuple(region[pairs].T)] = touching[tuple(region[pairs[:, ::-1]].T)] = True
    touching |= touching[np.ix_(mates, mates)]
    between = np.where(touching, spread[:, samples], np.inf)
    hinged = np.unique(np.append(region[at_seam], mates[region[at_seam]]))
    order = _whole_pairs(hinged[np.argsort(to_seam[samples[hinged]], kind="stable")], roots, mates)
    above = [-1] * len(order)
    while len(order) < count:
        rest = np.setdiff1d(np.arange(count), order)
        reach = between[np.ix_(np.array(order), rest)]
        level = np.flatnonzero(np.isfinite(reach.min(axis=0)))
        level = level[np.argsort(reach.min(axis=0)[level], kind="stable")]
        parents = dict(zip(rest[level].tolist(), reach.argmin(axis=0)[level].tolist()))
        for proxy, mate in zip(rest[level].tolist(), mates[rest[level]].tolist()):
            if mate < proxy:
                parents[proxy] = order.index(mates[order[parents[mate]]])
        above += parents.values()
        order += parents.keys()
    return np.array(order), np.array(above)


def _whole_pairs(ordered: Ints, count: int, mates: Ints) -> list[int]:
    """Return the first `count` of proxies in an order, without one whose image has no place; one at least."""
    chosen: list[int] = []
    for proxy in ordered.tolist():
        pair = list(dict.fromkeys((proxy, int(mates[proxy]))))
        if proxy not in chosen and (len(chosen) + len(pair) <= count or not chosen):
            chosen += pair
    return chosen
