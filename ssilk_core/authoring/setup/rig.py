# SPDX-License-Identifier: Apache-2.0
"""Place proxy joints on the loose part of a garment (paper, Section 3.4 and Appendix A)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ... import events
from ...errors import fail
from ...scene.assets import LOOSE, Character, Floats, Garment, Ints, Mesh, ProxyRig, SkinWeights
from ...scene.kinematics import rigid
from ...scene.mesh.geodesic import Measure, distances, distances_along_edges
from ...scene.mesh.topology import vertex_areas, vertex_normals
from .clusters import (
    Cluster,
    Mask,
    Seam,
    build_cluster,
    distribute_proxies,
    find_pieces,
    find_seam,
    mirrored_cluster,
)
from .hosts import Hosts
from .mirror import Mirror, find_mirror, mates_of
from .proxy_weights import proxy_weights


@dataclass(frozen=True)
class RigOptions:
    """How proxies are placed.

    Attributes:
        proxies: number of proxies on the loose part; with 0 the garment follows the character's joints.
        max_proxies: limit up to which `proxies` is raised so that each loose cluster (each strip of a fringe)
            gets one. Beyond it the smallest clusters follow the nearest proxies of their neighbours.
        roots_per_cluster: number of proxies of a cluster whose parent is a character joint (the paper's j).
        influences: largest number of proxies per vertex.
        seam_blend: whether loose vertices near the seam keep a share of the body's weights.
        exact: whether distances along the cloth are exact; else they run along edges. As many are placed then, on the
            same pieces, but not at the same vertices.
    """

    proxies: int = 20
    max_proxies: int = 64
    roots_per_cluster: int = 4
    influences: int = 4
    seam_blend: bool = True
    exact: bool = True

    def __post_init__(self) -> None:
        for name, least in (("proxies", 0), ("max_proxies", 1), ("roots_per_cluster", 1), ("influences", 1)):
            value = getattr(self, name)
            if not value >= least:
                fail("proxy rig", f"{name} = {value}", f"it must be at least {least}")


def build_rig(
    character: Character,
    garment: Garment,
    options: RigOptions | None = None,
    *,
    report: events.Reporter = events.silent,
) -> ProxyRig:
    """Place proxy joints on the loose part of a garment and skin it to them.

    Each connected cluster of loose vertices gets a share of the proxies by its area, and at least one. They are
    farthest-point samples by geodesic distance. The first lies at the seam, where the cloth hinges. Up to
    `roots_per_cluster` of them, those nearest to the seam, are children of the character joint that carries the
    seam. A breadth-first search over adjacent regions attaches each of the others to its nearest neighbour.

    Weights fall off as exp(-(d/r)^2), where r is the mean spacing of the cluster's proxies. Unlike in the paper,
    loose vertices near the seam keep a share of the weights of the nearest vertex on it. Without this the cloth
    tears there as soon as a root rotates, because tight vertices follow only the body.

    Proxies of a garment that is symmetric to rounding are symmetric, and end on "_L" and "_R" (`mirror`); there may
    be one fewer of a piece then.

    Stitches connect the islands that lie on one another. What is carried wholly follows its host and gets no proxies.

    Args:
        garment: has weights and classes.
        report: receives progress after each proxy, and a message if the number of proxies was changed.

    Raises:
        SsilkError: the garment has no weights or classes, or an island has only loose vertices and no
            stitch holds it.
    """
    options = options or RigOptions()
    if garment.skin is None:
        fail(garment.mesh.path, "no skinning weights", "weights are needed", "transfer them from the body")
    if garment.classes is None:
        fail(garment.mesh.path, "no vertex classes", "classes are needed", "classify the vertices")
    assert garment.skin is not None and garment.classes is not None
    hosts = Hosts.of(garment.mesh)
    authored: Mask = np.equal(garment.classes, LOOSE)
    loose, joined = hosts.carry(authored), hosts.joined_mesh
    if options.proxies == 0 or not loose.any():
        return ProxyRig(garment.mesh.path, (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), garment.skin)
    body_weights = garment.skin.dense(character.skeleton.joint_count)
    measure = distances if options.exact else distances_along_edges
    seam = find_seam(joined, loose, measure)
    pieces, piece_of = find_pieces(joined, loose), np.full(joined.vertex_count, -1)
    for number, piece in enumerate(pieces):
        piece_of[piece] = number
    mirror = find_mirror(garment.mesh, piece_of, hosts.carry(np.arange(joined.vertex_count)))
    images = np.arange(len(pieces)) if mirror is None else piece_of[mirror.twin[[piece[0] for piece in pieces]]]
    clusters = _clusters(character, joined, pieces, images, body_weights, seam, measure, options, mirror, report)
    weights = proxy_weights(
        joined,
        loose,
        body_weights,
        seam,
        clusters,
        influences=options.influences,
        seam_blend=options.seam_blend,
    )
    influences = int((weights > 0).sum(axis=1).max()) + (options.influences if len(hosts.stitches) else 0)
    held = np.concatenate([body_weights, np.zeros((len(weights), weights.shape[1] - body_weights.shape[1]))], axis=1)
    weights = np.where(authored[:, None], hosts.blend(weights, authored), np.where(loose[:, None], held, weights))
    return _assemble(character, garment.mesh, clusters, weights, influences, seam, mirror)


def _clusters(
    character: Character,
    mesh: Mesh,
    pieces: Sequence[Ints],
    images: Ints,
    body_weights: Floats,
    seam: Seam,
    measure: Measure,
    options: RigOptions,
    mirror: Mirror | None,
    report: events.Reporter,
) -> list[Cluster]:
    """Return the clusters that get proxies, in the order of the pieces, whose `images` are clusters' images, too."""
    areas = vertex_areas(mesh.points, mesh.faces)
    count = _affordable(len(pieces), options, mesh.path, report)
    shares = distribute_proxies(
        np.array([areas[piece].sum() for piece in pieces]), np.array([len(piece) for piece in pieces]), count, images
    )
    parents, roots = character.skeleton.parents, options.roots_per_cluster
    placed = events.Countdown(int(shares.sum()), report)
    clusters: dict[int, Cluster] = {}
    for number in np.flatnonzero(shares).tolist():
        piece, image = pieces[number], int(images[number])
        if mirror and image in clusters:
            clusters[number] = mirrored_cluster(clusters[image], piece, mirror.twin, seam, body_weights, parents)
            for _ in clusters[number].samples:
                placed()
            continue
        twin = np.searchsorted(piece, mirror.twin[piece]) if mirror and image == number else None
        clusters[number] = build_cluster(
            mesh,
            piece,
            seam,
            body_weights,
            parents,
            proxies=int(shares[number]),
            roots=roots,
            twin=twin,
            measure=measure,
            placed=placed,
        )
    return list(clusters.values())


def _affordable(piece_count: int, options: RigOptions, path: str, report: events.Reporter) -> int:
    """Return the number of proxies, raised within the limit so that each piece gets one; report any change."""
    count = max(options.proxies, min(piece_count, options.max_proxies))
    if count > options.proxies:
        text = f"{path}: {count} proxies instead of {options.proxies}: each of {piece_count} loose pieces needs one"
        report(events.Message(text))
    if count < piece_count:
        text = (
            f"{path}: the {piece_count - count} smallest of {piece_count} loose pieces follow the proxies of others"
        )
        report(events.Message(text, "warning"))
    return count


def _assemble(
    character: Character,
    mesh: Mesh,
    clusters: list[Cluster],
    weights: Floats,
    influences: int,
    seam: Seam,
    mirror: Mirror | None,
) -> ProxyRig:
    """Return the rig of all clusters; proxies are ordered by cluster, breadth first within each."""
    skeleton = character.skeleton
    parents: list[int] = []
    for cluster in clusters:
        first = skeleton.joint_count + len(parents)
        parents += [cluster.joint if above < 0 else first + above for above in cluster.parents]
    samples = np.concatenate([cluster.samples for cluster in clusters])
    binds = _bind_transforms(mesh, samples, np.array(parents) - skeleton.joint_count, seam)
    digits = max(2, len(str(len(parents) - 1)))
    labels = [f"{number:0{digits}d}" for number in range(len(parents))]
    if mirror:
        sides = mirror.sides(binds[:, :3, 3], skeleton.joint_names, skeleton.bind_transforms[:, :3, 3])
        for proxy, mate in enumerate(mates_of(samples, mirror.twin).tolist()):
            if mate > proxy:
                binds[mate] = mirror.image(binds[proxy])
                labels[mate] = labels[proxy] + sides[mate]
                labels[proxy] += sides[proxy]
    return ProxyRig(
        mesh.path,
        _names(mesh.path, skeleton.joint_names, parents, labels),
        np.array(parents),
        binds,
        SkinWeights.from_dense(mesh.path, weights, influences),
    )


def _names(path: str, joint_names: tuple[str, ...], parents: list[int], labels: list[str]) -> tuple[str, ...]:
    """Return a USD joint path for each proxy: the path of its parent, then "<garment>_proxy_<label>"."""
    garment = re.sub(r"\W", "_", path.rstrip("/").rsplit("/", 1)[-1], flags=re.ASCII)
    stem = garment if re.match("[A-Za-z_]", garment) else f"_{garment}"
    names = list(joint_names)
    for label, parent in zip(labels, parents):
        names.append(f"{names[parent]}/{stem}_proxy_{label}")
    return tuple(names[len(joint_names) :])


def _bind_transforms(mesh: Mesh, samples: Ints, parents: Ints, seam: Seam) -> Floats:
    """Return bind transforms of proxies at `samples` (P,), shape (P, 4, 4).

    y runs along the cloth, away from the body, and z along the normal. y points to the mean of the children. A
    proxy without children continues the direction from its parent, and a root without children that from the seam.
    `parents` (P,) is negative for roots.
    """
    points = mesh.points[samples]
    came_from = np.where(parents[:, None] >= 0, points[np.maximum(parents, 0)], mesh.points[seam.nearest[samples]])
    along = points - came_from
    for proxy in np.unique(parents[parents >= 0]):
        along[proxy] = points[parents == proxy].mean(axis=0) - points[proxy]
    normals = vertex_normals(mesh.points, mesh.faces)[samples]
    return rigid(np.array([_frame(y, z) for y, z in zip(along, normals)]), points)


def _frame(along: Floats, normal: Floats) -> Floats:
    """Return the rotation with y along `along` and z as close as possible to `normal`; arbitrary if both vanish."""
    axes: list[Floats] = []
    for wanted in (along, normal, *np.eye(3)):
        rest = wanted - sum((axis * (axis @ wanted) for axis in axes), np.zeros(3))
        length = np.linalg.norm(rest)
        if len(axes) < 2 and length > 1e-6 * max(1.0, float(np.linalg.norm(wanted))):
            axes.append(rest / length)
    y, z = axes
    return np.column_stack([np.cross(y, z), y, z])
