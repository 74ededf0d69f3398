# SPDX-License-Identifier: Apache-2.0
"""Blendshapes and linear blend skinning, in blocks of vertices and frames that fit into the cache.

Each tile of consecutive vertices blends only the joints that move any of them, with one dense matrix product per
tile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import PINNED, Floats, Ints, Scene
from .networks import Parameters

TILE = 512  # vertices
FEWEST, MOST, AT_ONCE = 16, 64, 2**19  # frames that are skinned together, and vertices in all of these


def vertex_block(vertices: int) -> int:
    """Return how many frames of so many vertices are computed together: they share the reading of blendshapes."""
    return min(max(AT_ONCE // max(vertices, 1), FEWEST), MOST)


@dataclass(frozen=True, eq=False)
class Tile:
    """T consecutive vertices of a mesh.

    Attributes:
        vertices: their indices.
        shapes: blendshapes, then the rest shape [m], shape (K + 1, 3 T).
        joints: indices of the joints that move them, shape (U,).
        weights: skinning weights of these joints, shape (U, T).
    """

    vertices: slice
    shapes: NDArray
    joints: NDArray
    weights: NDArray

    def skin(self, activations: NDArray, matrices: NDArray) -> NDArray:
        """Return positions (F, 3, T) of activations (F, K + 1), the last one 1, and matrices (J + P, 3, 4, F)."""
        frames, count = len(activations), self.weights.shape[1]
        points = (activations @ self.shapes).reshape(frames, 1, 3, count)
        chosen = matrices[self.joints].transpose(3, 1, 2, 0).reshape(frames * 12, -1)
        blended = (chosen @ self.weights).reshape(frames, 3, 4, count)
        blended[:, :, :3] *= points
        return blended.sum(axis=2)


def skin_garment(garment: list[Tile], activations: NDArray, matrices: NDArray, origins: Floats) -> Floats:
    """Return vertices in world space [m], shape (F, V, 3).

    Args:
        garment: all its tiles.
        activations: of the blendshapes, shape (K, F); matrices: of all joints relative to the root, (J + P, 3, 4, F).
        origins: positions of the root [m], shape (F, 3).
    """
    frames = len(origins)
    activations = np.vstack([activations, np.ones((1, frames), np.float32)]).T
    points = np.empty((frames, sum(tile.weights.shape[1] for tile in garment), 3))
    for tile in garment:
        local = tile.skin(activations, matrices)
        for axis in range(3):  # five times as fast as one addition that transposes
            np.add(local[:, axis], origins[:, axis, None], out=points[:, tile.vertices, axis])
    return points


def tiles(scene: Scene, parameters: Parameters) -> list[Tile]:
    """Return a garment's tiles, with the trained blendshapes and weights."""
    count = scene.garment.mesh.vertex_count
    free = scene.classes != PINNED
    trained = parameters["decoder.shapes"]
    shapes = np.zeros((trained.shape[2] + 1, 3, count), dtype=np.float32)
    shapes[:-1, :, free] = trained.transpose(2, 1, 0)
    shapes[-1] = scene.garment.mesh.points.T
    if "decoder.offset" in parameters:
        shapes[-1][:, free] += parameters["decoder.offset"].T
    return tiles_of(shapes, scene.rig.skin.indices, trained_weights(scene, parameters))


def tiles_of(shapes: NDArray, indices: NDArray, weights: NDArray) -> list[Tile]:
    """Return tiles of blendshapes, then the rest shape [m], (K + 1, 3, V), and of influences, (V, I) each."""
    return [
        _tile(slice(start, start + TILE), shapes, indices[start : start + TILE], weights[start : start + TILE])
        for start in range(0, len(indices), TILE)
    ]


def picked(garment: list[Tile], rows: Ints) -> Tile:
    """Return some vertices (M,) of a garment as one tile, in their order, of which `vertices` counts them."""
    number, column = np.divmod(rows, TILE)
    joints = np.unique(np.concatenate([garment[tile].joints for tile in np.unique(number)]))
    shapes = np.empty((len(garment[0].shapes), 3, len(rows)), dtype=np.float32)
    weights = np.zeros((len(joints), len(rows)), dtype=np.float32)
    for tile in np.unique(number):
        here, whole = number == tile, garment[tile]
        shapes[..., here] = whole.shapes.reshape(len(shapes), 3, -1)[..., column[here]]
        weights[np.ix_(np.searchsorted(joints, whole.joints), here)] = whole.weights[:, column[here]]
    return Tile(slice(0, len(rows)), shapes.reshape(len(shapes), -1), joints, weights)


def trained_weights(scene: Scene, parameters: Parameters) -> NDArray:
    """Return the weights of each influence (V, I): a softmax over each vertex's support.

    Pinned rows are not trained.
    """
    factor = np.ones(scene.rig.skin.weights.shape)
    offset = parameters["decoder.skin_offset"].astype(np.float64)
    factor[scene.classes != PINNED] = np.exp(offset - offset.max(axis=1, keepdims=True))
    weights = scene.rig.skin.weights * factor
    return weights / weights.sum(axis=1, keepdims=True)


def weights_of_joints(scene: Scene, parameters: Parameters, rows: Ints) -> NDArray:
    """Return the skinning weights of some vertices as a matrix over all joints (M, J + P)."""
    dense = np.zeros((len(rows), len(scene.joint_names)))
    indices = scene.rig.skin.indices[rows]
    np.add.at(dense, (np.arange(len(rows))[:, None], indices), trained_weights(scene, parameters)[rows])
    return dense


def _tile(vertices: slice, shapes: NDArray, indices: NDArray, weights: NDArray) -> Tile:
    joints = np.unique(indices[weights > 0])
    dense = np.zeros((len(joints), len(indices)), dtype=np.float32)
    row, influence = np.nonzero(weights)
    np.add.at(dense, (np.searchsorted(joints, indices[row, influence]), row), weights[row, influence])
    own = np.ascontiguousarray(shapes[:, :, vertices]).reshape(len(shapes), -1)
    return Tile(vertices, own, joints, dense)
