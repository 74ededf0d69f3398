# SPDX-License-Identifier: Apache-2.0
"""Lay the mesh of one body onto the surface of another of any topology, in the same pose.

Joints carry it there first, by linear blend skinning with a scale for each joint. It is then drawn to the nearest
surface that faces the same way, and neighbours are held to move alike, softer in each round (non-rigid iterative
closest points, after Amberg, Romdhani and Vetter 2007, with displacements in place of affine maps). What finds no
such surface near it follows its neighbours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...scene.assets import Body, Floats, Mesh, Skeleton
from ...scene.mesh.laplacian import laplacian
from ...scene.mesh.topology import edges, face_normals, vertex_areas, vertex_normals

STIFFNESS = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1)  # of the edges in each round, relative to the pull of the surface
REACH = 0.15  # [m] farther than which a surface does not pull
FACING = 0.4  # least cosine between normals of surfaces that face the same way
OVER = 0.002  # [m] over a face, where it is looked whether that is within the body
SCALES = (0.4, 2.5)  # of joints


def fitted_body(body: Body, skeleton: Skeleton, binds: Floats, onto: Mesh) -> Body:
    """Return a body on the surface of another one.

    Args:
        body: of the skeleton, in its bind pose.
        binds: where the skeleton's joints are on the other body, in the same pose, shape (J, 4, 4).
        onto: the other body in that pose.
    """
    mesh = body.mesh
    points = _carried(body, skeleton, binds)
    areas = vertex_areas(mesh.points, mesh.faces)
    pull = areas / areas.mean()
    begun, onto = points.copy(), _outer(onto)
    facing = face_normals(onto.points, onto.faces)
    for stiffness in STIFFNESS:
        targets, found = _nearest(points, mesh, onto, facing)
        weights = np.where(found, pull, 0.0)
        points = begun + _smooth_moves(mesh, weights, targets - begun, stiffness)
    return replace(body, mesh=replace(mesh, points=points))


def _outer(mesh: Mesh) -> Mesh:
    """Return a body without faces that lie within it, such as joints of a mannequin beneath its shell."""
    import igl

    over = mesh.points[mesh.faces].mean(axis=1) + OVER * face_normals(mesh.points, mesh.faces)
    within = np.asarray(igl.fast_winding_number(mesh.points, mesh.faces.astype(np.int64), over)).reshape(-1) > 0.5
    return mesh if within.all() else Mesh(mesh.path, mesh.points, mesh.faces[~within])


def _carried(body: Body, skeleton: Skeleton, binds: Floats) -> Floats:
    """Return a body's points as joints carry them to other places, each scaled as the bones about it are (V, 3)."""
    before, after = skeleton.bind_transforms[:, :3, 3], binds[:, :3, 3]
    size = float(np.ptp(after[:, 1]) / max(np.ptp(before[:, 1]), 1e-9))
    scales = np.full(skeleton.joint_count, size)
    for joint in range(skeleton.joint_count):
        near = [
            *np.flatnonzero(skeleton.parents == joint),
            *filter(lambda each: each >= 0, [skeleton.parents[joint]]),
        ]
        lengths = [[np.linalg.norm(at[each] - at[joint]) for each in near] for at in (before, after)]
        if near and sum(lengths[0]) > 1e-3:
            scales[joint] = sum(lengths[1]) / sum(lengths[0])
    scales = scales.clip(size * SCALES[0], size * SCALES[1])
    found = np.zeros_like(body.mesh.points)
    for index, weight in zip(body.skin.indices.T, body.skin.weights.T):
        found += weight[:, None] * (after[index] + scales[index, None] * (body.mesh.points - before[index]))
    return found


def _nearest(points: Floats, mesh: Mesh, onto: Mesh, facing: Floats) -> tuple[Floats, np.ndarray]:
    """Return the nearest points of a surface (V, 3), and which of them are near and face the same way (V,).

    Args:
        facing: normals of that surface's triangles, shape (F, 3).
    """
    import igl

    square, face, nearest = igl.point_mesh_squared_distance(points, onto.points, onto.faces.astype(np.int64))
    alike = (vertex_normals(points, mesh.faces) * facing[np.asarray(face).reshape(-1)]).sum(axis=1) > FACING
    return np.asarray(nearest), alike & (np.sqrt(np.asarray(square).reshape(-1)) < REACH)


def _smooth_moves(mesh: Mesh, weights: Floats, wanted: Floats, stiffness: float) -> Floats:
    """Return the moves (V, 3) that differ least from those wanted, weighted (V,), and from those of neighbours."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    links = laplacian(edges(mesh.faces), 1.0, len(weights))
    # A little of each vertex holds pieces that no surface pulls.
    system = (diags(weights + 1e-6) + stiffness * links).tocsc()
    return splu(system).solve(weights[:, None] * wanted)
