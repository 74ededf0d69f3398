# SPDX-License-Identifier: Apache-2.0
"""Which part of the body a garment can ever touch, so that nothing else is posed or searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..assets import LOOSE, TIGHT, Floats, Ints, Motion, Scene
from ..kinematics import motion_transforms, skin_points, skinning_matrices
from ..mesh import topology
from ..mesh.geodesic import edge_graph

SLACK = 0.08  # [m] play that blendshapes and stretch add to the geometric reach
POSES = 200  # poses that the reach is measured on


@dataclass(frozen=True, eq=False)
class Reach:
    """The part of the body that can be touched: its vertices, and flags of the joints that move them."""

    vertices: Ints
    joints: Floats


def reachable_body(scene: Scene, motions: Sequence[Motion]) -> Reach:
    """Find the body vertices that come within reach of the garment in any of a spread of poses.

    A loose vertex hangs from its anchor, the nearest pinned or tight vertex along the cloth, and stays within
    the length of cloth between them; tight vertices stay within `SLACK` of linear blend skinning. Where pinned ones
    are cannot be helped, so that they touch nothing.
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
            reached |= cKDTree(lbs[tight]).query(posed)[0] < SLACK
        reached |= (cdist(lbs[anchors], posed) < lengths[:, None] + SLACK).any(axis=0)
    vertices = np.flatnonzero(reached)
    joints = np.zeros(skeleton.joint_count, dtype=bool)
    joints[body.skin.indices[vertices][body.skin.weights[vertices] > 0.05]] = True
    return Reach(vertices, joints)


def _tethers(scene: Scene) -> tuple[Ints, Floats]:
    """Return anchors (A,) and, for each, the longest run of cloth to a loose vertex that hangs from it [m].

    Edge paths are used, which are never shorter than the geodesic: the reach errs on the safe side.
    """
    from scipy.sparse.csgraph import dijkstra

    mesh = scene.garment.mesh
    held, loose = np.flatnonzero(scene.classes != LOOSE), np.flatnonzero(scene.classes == LOOSE)
    if not len(held) or not len(loose):
        return np.zeros(0, dtype=int), np.zeros(0)
    graph = edge_graph(mesh.points, topology.edges(mesh.faces))
    distance, _, source = dijkstra(graph, directed=False, indices=held, min_only=True, return_predecessors=True)
    tied = loose[np.isfinite(distance[loose])]
    anchors, group = np.unique(source[tied], return_inverse=True)
    longest = np.zeros(len(anchors))
    np.maximum.at(longest, group, distance[tied])
    return anchors, longest


def _spread_frames(motions: Sequence[Motion]) -> list[Motion]:
    """Return about `POSES` single frames, spread evenly over all motions."""
    ends = np.cumsum([motion.frame_count for motion in motions])
    picks = np.unique(np.linspace(0, ends[-1] - 1, POSES).astype(int))
    clip = np.searchsorted(ends, picks, side="right")
    starts = ends - [motion.frame_count for motion in motions]
    return [motions[c].clip(p - starts[c], p - starts[c] + 1) for c, p in zip(clip, picks)]
