# SPDX-License-Identifier: Apache-2.0
"""The part of the body that a garment can touch; nothing else is posed or searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.assets import LOOSE, TIGHT, Floats, Ints, Motion, Scene, SkinWeights
from ..scene.kinematics import motion_transforms, skin_points, skinning_matrices
from ..scene.mesh import topology
from ..scene.mesh.geodesic import edge_graph
from ..scene.mesh.stitches import find_stitches, joined_mesh

REACH_MARGIN = 0.08  # [m]; allowance for blendshapes and stretch
SAMPLED_POSES = 200


@dataclass(frozen=True, eq=False)
class ReachableBody:
    """The part of the body that a garment can touch: its vertices, and flags of the joints that move them."""

    vertices: Ints
    joints: Floats


def reachable_body(scene: Scene, motions: Sequence[Motion]) -> ReachableBody:
    """Find the body vertices that come within reach of the garment in any of `SAMPLED_POSES` poses.

    A loose vertex hangs from its anchor, the nearest pinned or tight vertex along the cloth and its stitches, and
    stays within the length between them. Tight vertices stay within `REACH_MARGIN` of linear blend skinning. Pinned
    vertices do not count, because nothing moves them.
    """
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    body, skeleton, garment = scene.character.merged_body(), scene.character.skeleton, scene.garment.mesh
    tight = np.flatnonzero(scene.classes == TIGHT)
    anchors, lengths = _tethers(scene)
    reached = np.zeros(body.mesh.vertex_count, dtype=bool)
    for frame in _spread_frames(motions) if len(tight) or len(anchors) else ():
        matrices = skinning_matrices(motion_transforms(frame, skeleton.parents), skeleton.bind_transforms)
        posed = skin_points(body.mesh.points, body.skin, matrices)[0]
        lbs = skin_points(garment.points, scene.lbs_skin, matrices)[0]
        if len(tight):
            reached |= cKDTree(lbs[tight]).query(posed)[0] < REACH_MARGIN
        reached |= (cdist(lbs[anchors], posed) < lengths[:, None] + REACH_MARGIN).any(axis=0)
    vertices = np.flatnonzero(reached)
    joints = np.zeros(skeleton.joint_count, dtype=bool)
    joints[body.skin.indices[vertices][body.skin.weights[vertices] > 0.05]] = True
    return ReachableBody(vertices, joints)


def reachable_cloth(scene: Scene, inner: Scene, motions: Sequence[Motion]) -> NDArray[np.bool_]:
    """Tell which vertices of an inner garment the garment of a scene can touch, in the poses of `reachable_body`.

    Both hang as a garment does there, so that each has its own reach. Pinned vertices of the inner garment can be
    touched, those of the outer one touch nothing.

    Args:
        scene, inner: the outer and the inner garment on one character.

    Returns:
        Shape (W,).
    """
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    skeleton, (anchors, lengths) = scene.character.skeleton, _tethers(scene)
    tight = np.flatnonzero(scene.classes == TIGHT)
    source, hangs = _hangs_from(inner)
    hung = inner.garment.mesh.points[source]
    skin = SkinWeights(inner.lbs_skin.path, inner.lbs_skin.indices[source], inner.lbs_skin.weights[source])
    reach, reached = hangs + 2 * REACH_MARGIN, np.zeros(len(hung), dtype=bool)
    for frame in _spread_frames(motions) if len(tight) or len(anchors) else ():
        matrices = skinning_matrices(motion_transforms(frame, skeleton.parents), skeleton.bind_transforms)
        left = np.flatnonzero(~reached)
        posed = skin_points(hung, skin, matrices)[0][left]
        lbs = skin_points(scene.garment.mesh.points, scene.lbs_skin, matrices)[0]
        near = (cdist(lbs[anchors], posed) < lengths[:, None] + reach[left]).any(axis=0)
        if len(tight):
            near |= cKDTree(lbs[tight]).query(posed)[0] < reach[left]
        reached[left[near]] = True
        if reached.all():
            break
    return reached


def _hangs_from(scene: Scene) -> tuple[Ints, Floats]:
    """Return the anchor of each vertex (V,), and how far along the cloth it hangs from it [m].

    Pinned and tight vertices are their own, at zero. So are loose ones that nothing holds, at infinity.
    """
    from scipy.sparse.csgraph import dijkstra

    mesh, held = scene.garment.mesh, np.flatnonzero(scene.classes != LOOSE)
    source, distance = np.arange(mesh.vertex_count), np.where(scene.classes == LOOSE, np.inf, 0.0)
    if len(held) and len(held) < mesh.vertex_count:
        graph = edge_graph(mesh.points, topology.edges(joined_mesh(mesh, find_stitches(mesh)).faces))
        along, _, found = dijkstra(graph, directed=False, indices=held, min_only=True, return_predecessors=True)
        tied = np.isfinite(along)
        source[tied], distance[tied] = found[tied], along[tied]
    return source, distance


def _tethers(scene: Scene) -> tuple[Ints, Floats]:
    """Return anchors (A,) and for each the longest distance along the cloth to a loose vertex that hangs from it [m].

    Paths follow edges and are never shorter than the geodesic, so that no reachable vertex is missed.
    """
    source, distance = _hangs_from(scene)
    tied = (scene.classes == LOOSE) & (scene.classes[source] != LOOSE)
    anchors, group = np.unique(source[tied], return_inverse=True)
    longest = np.zeros(len(anchors))
    np.maximum.at(longest, group, distance[tied])
    return anchors, longest


def _spread_frames(motions: Sequence[Motion]) -> list[Motion]:
    """Return about `SAMPLED_POSES` single frames, spread evenly over all motions."""
    ends = np.cumsum([motion.frame_count for motion in motions])
    picks = np.unique(np.linspace(0, ends[-1] - 1, SAMPLED_POSES).astype(int))
    clip = np.searchsorted(ends, picks, side="right")
    starts = ends - [motion.frame_count for motion in motions]
    return [motions[c].clip(p - starts[c], p - starts[c] + 1) for c, p in zip(clip, picks)]
