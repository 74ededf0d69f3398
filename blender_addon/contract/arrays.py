# SPDX-License-Identifier: GPL-3.0-or-later
"""A dressed character as arrays, between Blender's data and the stage.

Everything stands in Blender's world space: its units, z up, column vectors, the armature in its rest position.
Joint indices run over the character's joints first, then over the garment's proxies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Joints:
    """Joints of an armature, parents before children, the proxies of the garment last.

    Attributes:
        names: of the bones, length J.
        parents: index of each joint's parent, -1 for roots, shape (J,).
        binds: joint to world at rest, rigid, shape (J, 4, 4).
        proxy_count: how many of the last joints are proxies.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    binds: np.ndarray
    proxy_count: int = 0

    @property
    def character_count(self) -> int:
        return len(self.names) - self.proxy_count


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh at rest.

    Attributes:
        name: of the object.
        points: shape (V, 3).
        counts, corners: corners of each polygon, and the points of all corners.
        inside_out: whether the object's transform mirrors, so that its faces turn the other way.
        uvs: (u, v) for each corner, shape (len(corners), 2), or None.
        weights: over all joints, shape (V, J), or None where the mesh is not bound.
    """

    name: str
    points: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    inside_out: bool
    uvs: np.ndarray | None
    weights: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Dressed:
    """A character, the bodies that the garment collides with, and the garment.

    Attributes:
        meters_per_unit: length of one of Blender's units [m].
        classes: of the garment's vertices, shape (V,), or None to have them found.
        plain: the garment's weights before it was rigged, over the character's joints, or None.
    """

    meters_per_unit: float
    joints: Joints
    bodies: tuple[Shape, ...]
    garment: Shape
    classes: np.ndarray | None
    plain: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Rig:
    """What `ssilk rig` made of a garment.

    Attributes:
        classes: shape (V,).
        names: of the proxies, length P.
        parents: joint index of each proxy's parent, shape (P,).
        binds: proxy to world at rest, rigid, shape (P, 4, 4).
        weights: over the character's joints and the proxies, shape (V, J + P).
        plain: weights over the character's joints alone, shape (V, J).
    """

    classes: np.ndarray
    names: tuple[str, ...]
    parents: np.ndarray
    binds: np.ndarray
    weights: np.ndarray
    plain: np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """What the character's joints do, frame by frame.

    Attributes:
        worlds: joint to world, rigid, shape (F, J, 4, 4).
        start: the first frame.
        fps: frames per second [1/s].
        meters_per_unit: length of one of Blender's units [m].
    """

    worlds: np.ndarray
    start: int
    fps: float
    meters_per_unit: float


@dataclass(frozen=True, eq=False)
class Shot:
    """What `ssilk bake` made of a garment over a motion, F frames of it; in the joint order of an armature.

    Attributes:
        start: the first frame.
        binds: joint to world at rest, rigid, shape (J, 4, 4).
        rotations: each proxy to its parent, unit quaternions (w, x, y, z), shape (F, P, 4).
        points: of the garment at rest, shape (V, 3).
        weights: over all joints, as trained, shape (V, J).
        shapes: names of the blendshapes, length K.
        offsets: of each blendshape, shape (K, V, 3).
        activations: weights of the blendshapes, shape (F, K).
        left_out: how many proxies of the armature it does not have; they stay at rest and move nothing.
    """

    start: int
    binds: np.ndarray
    rotations: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    shapes: tuple[str, ...]
    offsets: np.ndarray
    activations: np.ndarray
    left_out: int = 0


@dataclass(frozen=True, eq=False)
class Staged:
    """What a stage knows of a garment that Blender's importer leaves out.

    Attributes:
        name: of its prim.
        proxies: names of its proxies.
        plain: its weights before it was rigged, shape (V, len(plain_joints)), or None.
        plain_joints: names of the joints that these are over.
    """

    name: str
    proxies: tuple[str, ...]
    plain: np.ndarray | None
    plain_joints: tuple[str, ...]


def influences(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return joint indices and weights of each vertex, heaviest first, shape (V, I), of dense weights (V, J)."""
    width = max(int((weights > 0).sum(axis=1).max(initial=0)), 1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :width]
    kept = np.take_along_axis(weights, order, axis=1)
    return np.where(kept > 0, order, 0).astype(np.int32), kept.astype(np.float32)


def dense(indices: np.ndarray, weights: np.ndarray, joint_count: int) -> np.ndarray:
    """Return weights over all joints, shape (V, joint_count), of influences, shape (V, I) each."""
    matrix = np.zeros((len(indices), joint_count), dtype=np.float32)
    np.add.at(matrix, (np.arange(len(indices))[:, None], indices), weights)
    return matrix


def orthonormal(transforms: ArrayLike) -> np.ndarray:
    """Return nearly rigid transforms (..., 4, 4) with the rotations that are nearest to their axes."""
    rigid = np.array(transforms, dtype=np.float64)
    left, _, right = np.linalg.svd(rigid[..., :3, :3])
    rigid[..., :3, :3] = left @ right
    return rigid


def to_parents(worlds: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return joint to parent, world for roots, of joint to world, both shape (..., J, 4, 4)."""
    above = np.where((parents >= 0)[:, None, None], worlds[..., parents, :, :], np.eye(4))
    return np.linalg.inv(above) @ worlds
