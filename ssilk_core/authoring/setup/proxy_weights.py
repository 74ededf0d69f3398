# SPDX-License-Identifier: Apache-2.0
"""Initial skinning weights of a garment over character joints and proxies (paper, Appendix A)."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Mesh
from ...scene.mesh.geodesic import nearest_sources
from .clusters import Cluster, Mask, Seam

MIN_BODY_SHARE = 1e-3  # least share of the body's weights on a loose vertex; smaller shares become zero


def proxy_weights(
    mesh: Mesh,
    loose: Mask,
    body_weights: Floats,
    seam: Seam,
    clusters: list[Cluster],
    *,
    influences: int,
    seam_blend: bool,
) -> Floats:
    """Return dense weights over the character's joints, then the proxies of all clusters, shape (V, J + P).

    Vertices that are not loose keep `body_weights` (V, J). Loose vertices follow up to `influences` proxies of
    their cluster. With `seam_blend`, those near the seam also follow up to `influences` joints of the body.
    """
    joint_count = body_weights.shape[1]
    proxy_count = sum(len(cluster.samples) for cluster in clusters)
    matrix = np.concatenate([body_weights, np.zeros((len(body_weights), proxy_count))], axis=1)
    first = joint_count
    for cluster in clusters:
        rows, last = cluster.vertices, first + len(cluster.samples)
        kept = seam_share(cluster, seam)[:, None] if seam_blend else np.zeros((len(rows), 1))
        matrix[rows, :joint_count] = kept * _largest(body_weights[seam.nearest[rows]], influences)
        matrix[rows, first:last] = (1 - kept) * falloff(cluster.distances.T, spacing(cluster), influences)
        first = last
    _follow_neighbours(mesh, loose, clusters, matrix)
    return matrix


def spacing(cluster: Cluster) -> float:
    """Return the mean distance of a cluster's proxies to their nearest neighbours [m].

    For a single proxy it is the distance to the farthest vertex of the cluster.
    """
    columns = np.searchsorted(cluster.vertices, cluster.samples)
    between = cluster.distances[:, columns] + np.diag(np.full(len(columns), np.inf))
    mean = between.min(axis=1).mean() if len(columns) > 1 else cluster.distances.max()
    return max(float(mean), 1e-6)


def falloff(distance: Floats, radius: float, influences: int) -> Floats:
    """Return weights exp(-(distance/radius)^2) of at most `influences` proxies, rows normalised, shape (M, S).

    The largest weight that is dropped is subtracted from those that stay. So weights do not jump where the
    selection changes.
    """
    nearest = distance.min(axis=1, keepdims=True)
    # The common factor exp(-(nearest/radius)^2) leaves the ratios and keeps far rows from vanishing.
    weights = _largest(np.exp((nearest**2 - distance**2) / radius**2), influences)
    return weights / weights.sum(axis=1, keepdims=True)


def seam_share(cluster: Cluster, seam: Seam) -> Floats:
    """Return the share of the body's weights that each vertex of a cluster keeps, exp(-(d/r)^2), shape (M,).

    d is the distance to the seam. A proxy that rotates pulls the cloth at the seam apart in proportion to the
    distance from its pivot. So r is twice the mean distance of the seam to the nearest proxy: wide for a cape,
    about a finger's width for a fringe.
    """
    radius = 2 * cluster.distances[:, cluster.at_seam].min(axis=0).mean()
    share = np.exp(-((seam.distance[cluster.vertices] / max(radius, 1e-6)) ** 2))
    return np.where(share < MIN_BODY_SHARE, 0, share)


def _largest(weights: Floats, count: int) -> Floats:
    """Keep at most `count` entries of each row (M, N), minus the largest one dropped, rescaled to the row's sum."""
    if weights.shape[1] <= count:
        return weights
    cut = np.partition(weights, -count - 1, axis=1)[:, -count - 1, None]
    kept = np.maximum(weights - cut, 0)
    total = kept.sum(axis=1, keepdims=True)
    # Where more than `count` entries are equally large, the subtraction leaves none: keep the first of them.
    kept = np.where(total > 0, kept, np.eye(weights.shape[1])[weights.argmax(axis=1)])
    return kept * (weights.sum(axis=1, keepdims=True) / kept.sum(axis=1, keepdims=True))


def _follow_neighbours(mesh: Mesh, loose: Mask, clusters: list[Cluster], matrix: Floats) -> None:
    """Give loose vertices of pieces without proxies the row of the geodesically nearest vertex that has some."""
    covered = np.concatenate([cluster.vertices for cluster in clusters])
    left = np.setdiff1d(np.flatnonzero(loose), covered)
    if len(left):
        nearest = nearest_sources(mesh.points, mesh.faces, covered)[1][left]
        matrix[left[nearest >= 0]] = matrix[nearest[nearest >= 0]]
