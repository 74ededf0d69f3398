# SPDX-License-Identifier: Apache-2.0
"""What a deformer misses of given vertices, in the rest pose: through the inverse of linear blend skinning.

A posed vertex is y = A p + t, with A and t blended from its joints. Where the wanted vertex is x, the rest point
lacks u = A^-1 (x - y), which is a blendshape's offset. A is a convex combination of rotations, so |A u| <= |u|: what
is within a tolerance in the rest pose is within it in the world.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..assets import Deformer, Floats, GarmentPose, Ints, Motion, SkinWeights
from ..kinematics import combined_transforms, skinning_matrices

FRAMES_PER_BLOCK = 32  # 10 MB of blended matrices for 3,000 vertices
# Where influences oppose each other, A is nearly singular: this bounds |u| to 5000 |x - y|.
SINGULAR = 1e-8


def rest_residuals(
    deformer: Deformer,
    motion: Motion,
    pose: GarmentPose,
    points: Sequence[Floats],
    vertices: Ints | None = None,
) -> Iterator[tuple[slice, Floats]]:
    """Yield blocks of frames, and the offsets u that these lack in the rest pose [m], shape (F, V, 3).

    Args:
        motion: of the character over the whole shot.
        pose: all frames of the shot.
        points: garment vertices of each frame in world space [m], shape (V, 3).
        vertices: those that are looked at; None for all.
    """
    chosen = slice(None) if vertices is None else vertices
    skin = SkinWeights(deformer.skin.path, deformer.skin.indices[chosen], deformer.skin.weights[chosen])
    rest, shapes = deformer.scene.garment.mesh.points[chosen], deformer.shapes[:, chosen].astype(np.float64)
    for start in range(0, pose.frame_count, FRAMES_PER_BLOCK):
        part = slice(start, min(start + FRAMES_PER_BLOCK, pose.frame_count))
        some = pose.part(part)
        world = combined_transforms(deformer, motion, some)
        origin = motion.translations[part, :1]  # so that nothing is lost far from the origin
        world[..., :3, 3] -= origin
        blended = _blended(skin, skinning_matrices(world, deformer.scene.bind_transforms)[:, :, :3])
        canonical = rest + np.einsum("fk,kvc->fvc", some.weights.astype(np.float64), shapes)
        linear = blended[..., :3]
        posed = (linear @ canonical[..., None])[..., 0] + blended[..., 3]
        wanted = np.stack([points[frame][chosen] for frame in range(part.start, part.stop)]) - origin
        yield part, _unposed(linear, wanted - posed)


def turns(deformer: Deformer, motion: Motion, pose: GarmentPose) -> Floats:
    """Return the linear part of the blended skinning of each vertex in the frames of a pose, shape (F, V, 3, 3)."""
    world = combined_transforms(deformer, motion, pose)
    matrices = skinning_matrices(world, deformer.scene.bind_transforms)[:, :, :3]
    return _blended(deformer.skin, matrices)[..., :3]


def _blended(skin: SkinWeights, matrices: Floats) -> Floats:
    """Return skinning matrices (F, J, 3, 4), blended for each vertex, shape (F, V, 3, 4)."""
    dense = skin.dense(matrices.shape[1])
    used = np.flatnonzero(dense.any(axis=0))
    blended = dense[:, used] @ matrices[:, used].reshape(len(matrices), len(used), 12)
    return blended.reshape(len(matrices), -1, 3, 4)


def _unposed(linear: Floats, away: Floats) -> Floats:
    """Return A^T (A A^T + SINGULAR)^-1 of each vertex times its distance (F, V, 3)."""
    transposed = np.swapaxes(linear, -1, -2)
    solved = np.linalg.solve(linear @ transposed + SINGULAR * np.eye(3), away[..., None])
    return np.asarray(transposed @ solved, dtype=np.float64)[..., 0]
