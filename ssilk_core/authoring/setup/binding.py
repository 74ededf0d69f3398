# SPDX-License-Identifier: Apache-2.0
"""Fit skinning weights so that held cloth stays over the skin that it lies on in the bind pose, whatever the pose.

Weights copied from the closest body point move with the skin where they vary little. Where a joint bends, a body
triangle is a chord between its corners, and linear blend skinning of a point above it is not: cloth goes through.
Here the weights are those that best keep each vertex where it lay on the skin, over sampled poses of the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Body, Character, Floats, Ints, Skeleton
from ...scene.kinematics import (
    local_transforms,
    matrix_from_quaternion,
    rigid,
    skin_points,
    skinning_matrices,
    world_transforms,
)
from ...scene.mesh.topology import vertex_normals
from .surface import SurfacePoints, closest_on_surface

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

POSES = 64
LARGEST_TURN = np.radians(80)  # of each joint, about a random axis
TANGENT_SHARE = 0.3  # weight of squared distances along the skin, relative to those along its normal
BELOW_FACTOR = 100.0  # additional weight of squared distances below the clearance
CLEARANCE = 0.005  # [m] above the skin that is kept, or the rest distance where that is smaller
FAR = 0.03  # [m] from the skin at which a vertex counts half
SMOOTHING = 1.5e-6  # [m4] weight of the squared gradient of skinning weights, relative to squared distances
REWEIGHTINGS = 5  # times that vertices below their clearance are found again
ITERATIONS = 30  # of projected gradient descent after each


@dataclass(frozen=True, eq=False)
class _Offsets:
    """Where each of K candidate joints alone would put V vertices, from their targets in N poses.

    Attributes:
        square: the products of every two candidates' offsets, summed over the poses [m2], shape (V, K, K).
        normal: the offsets along the normal of the skin [m], float32, shape (V, K, N).
    """

    square: Floats
    normal: NDArray[np.float32]


def bind_to_skin(
    character: Character, points: Floats, areas: Floats, pairs: Ints, weights: Floats, influences: int
) -> Floats:
    """Return skinning weights that keep `points` over the skin beneath them, rows sum to one, shape (V, J).

    The target of a vertex is its place on the skin: the closest body point in the bind pose, posed, and the offset
    from it in the posed frame of the skin. Minimised is the weighted sum of squared distances to the targets, over
    `POSES` random poses of all joints and over the area of the cloth, with a penalty for ending below the clearance
    (by reweighted least squares) and one on the squared gradient of the weights, which strains the cloth. Weights
    of a vertex stay on the probability simplex of its candidates (accelerated projected gradient descent). The same
    input gives the same result.

    Args:
        points: distinct positions at the bind pose [m], shape (V, 3).
        areas: area of the cloth around each [m2], shape (V,).
        pairs: undirected edges between them, shape (E, 2).
        weights: initial weights, shape (V, J). The largest of each row, up to `influences`, are the candidates.
    """
    body = character.merged_body()
    under = closest_on_surface(points, body.mesh)
    candidates = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    start = np.take_along_axis(weights, candidates, axis=1)
    poses = sample_poses(character.skeleton, POSES)
    matrices = skinning_matrices(poses, character.skeleton.bind_transforms)
    gap = np.einsum("vc,vc->v", points - _on_skin(body.mesh.points, under), under.normals)
    offsets = _offsets(body, points, under, gap, candidates, matrices)
    importance = areas / (1 + (gap / FAR) ** 2)
    couplings = SMOOTHING * laplacian(points, areas, pairs)
    fitted = _fit(start, candidates, offsets, np.maximum(gap - CLEARANCE, 0), importance, couplings)
    result = np.zeros_like(weights)
    np.put_along_axis(result, candidates, fitted, axis=1)
    return result


def sample_poses(skeleton: Skeleton, count: int) -> Floats:
    """Return transforms from joint to world of random poses, the same at every call, shape (count, J, 4, 4).

    Each joint is turned from its bind pose, about a random axis, by up to `LARGEST_TURN`. Whole bodies come out
    contorted, but the skin around a joint depends on few of them. Joints above the hub stay.
    """
    inner = np.setdiff1d(np.arange(skeleton.joint_count), skeleton.hub_path[:-1])
    random = np.random.default_rng(0)
    axis = random.normal(size=(count, len(inner), 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    half = random.uniform(0, LARGEST_TURN / 2, size=(count, len(inner), 1))
    turns = np.tile(np.eye(3), (count, skeleton.joint_count, 1, 1))
    turns[:, inner] = matrix_from_quaternion(np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1))
    bind = local_transforms(skeleton.bind_transforms, skeleton.parents)
    return world_transforms(bind @ rigid(turns, np.zeros(turns.shape[:-1])), skeleton.parents)


def to_simplex(values: Floats) -> Floats:
    """Return the points of the probability simplex nearest to the rows of `values`, shape (V, K)."""
    descending = -np.sort(-values, axis=1)
    excess = (np.cumsum(descending, axis=1) - 1) / np.arange(1, values.shape[1] + 1)
    last = np.count_nonzero(descending > excess, axis=1) - 1
    return np.maximum(values - np.take_along_axis(excess, last[:, None], axis=1), 0)


def _on_skin(values: Floats, under: SurfacePoints) -> Floats:
    """Interpolate values (B, C) of the body's vertices, shape (V, C)."""
    return np.einsum("vk,vkc->vc", under.barycentric, values[under.corners])


def _offsets(
    body: Body, points: Floats, under: SurfacePoints, gap: Floats, candidates: Ints, matrices: Floats
) -> _Offsets:
    """Return the offsets from the targets under skinning matrices (N, J, 4, 4); `gap` (V,) is along the normal."""
    vertices, count = candidates.shape
    square = np.zeros((vertices, count, count))
    along = np.empty((vertices, count, len(matrices)), np.float32)
    own = _on_skin(body.skin.dense(matrices.shape[1]), under)
    aside = points - _on_skin(body.mesh.points, under) - gap[:, None] * under.normals
    for number, pose in enumerate(matrices):
        posed = skin_points(body.mesh.points, body.skin, pose[None])[0]
        normals = _on_skin(vertex_normals(posed, body.mesh.faces), under)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        turned = np.einsum("vj,jab,vb->va", own, pose[:, :3, :3], aside, optimize=True)
        target = _on_skin(posed, under) + gap[:, None] * normals + turned
        moved = (pose[candidates, :3, :3] @ points[:, None, :, None])[..., 0] + pose[candidates, :3, 3]
        away = moved - target[:, None]
        square += away @ away.transpose(0, 2, 1)
        along[..., number] = (away * normals[:, None]).sum(axis=-1)
    return _Offsets(square, along)


def laplacian(points: Floats, areas: Floats, pairs: Ints) -> csr_matrix:
    """Return the matrix L (V, V) of which w^T L w is the integral of the squared gradient of w over the cloth [1]."""
    from scipy.sparse import coo_matrix, diags

    low, high = pairs.T
    square = np.maximum(((points[low] - points[high]) ** 2).sum(axis=1), 1e-12)
    share = (areas[low] + areas[high]) / 3 / square  # exact for linear w in regular meshes, of three edges a vertex
    count = len(points)
    matrix = coo_matrix((share, (low, high)), shape=(count, count)).tocsr()
    matrix = matrix + matrix.T
    return (diags(np.asarray(matrix.sum(axis=1)).ravel()) - matrix).tocsr()


def _fit(
    start: Floats, candidates: Ints, offsets: _Offsets, slack: Floats, importance: Floats, couplings: csr_matrix
) -> Floats:
    """Return the weights of the candidates, shape (V, K).

    As weights sum to one, a blended offset is the weighted sum of the candidates' offsets: a quadratic form.
    """
    allowed = start > 0
    weights = to_simplex(np.where(allowed, start / start.sum(axis=1, keepdims=True), -np.inf))
    normal = offsets.normal
    scale = (importance / normal.shape[2])[:, None, None]
    base = TANGENT_SHARE * offsets.square + (1 - TANGENT_SHARE) * normal @ normal.transpose(0, 2, 1)
    lifted = normal + slack.astype(np.float32)[:, None, None]  # from the clearance instead of the target
    for _ in range(REWEIGHTINGS):
        below = np.where((weights[:, None] @ lifted) < 0, lifted, 0)
        form = scale * (base + BELOW_FACTOR * below @ below.transpose(0, 2, 1))
        weights = _descend(weights, allowed, candidates, form, couplings)
    return weights


def _descend(
    weights: Floats, allowed: NDArray[np.bool_], candidates: Ints, form: Floats, couplings: csr_matrix
) -> Floats:
    """Minimise w^T form w + tr(W^T couplings W) over the simplex of the `allowed` candidates, from `weights` (V, K).

    W (V, J) holds w of each vertex at its candidates. This is FISTA (Beck and Teboulle 2009) with a step for each
    vertex: Gershgorin bounds the couplings by twice their diagonal.
    """
    step = 1 / np.maximum(np.linalg.eigvalsh(form)[:, -1] + 2 * couplings.diagonal(), 1e-30)[:, None]
    ahead, momentum = weights, 1.0
    matrix = np.zeros((len(weights), candidates.max() + 1))
    for _ in range(ITERATIONS):
        np.put_along_axis(matrix, candidates, ahead, axis=1)
        slope = (form @ ahead[..., None])[..., 0] + np.take_along_axis(couplings @ matrix, candidates, axis=1)
        previous, weights = weights, to_simplex(np.where(allowed, ahead - step * slope, -np.inf))
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead, momentum = weights + (momentum - 1) / following * (weights - previous), following
    return weights
