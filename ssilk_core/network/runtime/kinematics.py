# SPDX-License-Identifier: Apache-2.0
"""Proxy transforms and skinning matrices of many frames at once, frames last, as `model.decoder` defines them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import ProxyRig

SHORTEST = np.float32(1e-8)  # what the length of an axis is taken for at least, as in `model.decoder`


def rotation_from_six_d(values: NDArray) -> NDArray:
    """Orthonormalise 6D rotations (P, 6, F) by Gram-Schmidt; returns (P, 3, 3, F) [ZBL*19]."""
    x = _unit(values[:, :3])
    b = values[:, 3:]
    y = _unit(b - (x * b).sum(1, keepdims=True) * x)
    z = x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - x[:, [2, 0, 1]] * y[:, [1, 2, 0]]
    return np.stack([x, y, z], axis=2)


def transform_of(values: NDArray) -> NDArray:
    """Return transforms (P, 3, 4, F) of 6D rotations (P, 6, F), or of these and displacements (P, 9, F) [m]."""
    moved = values[:, 6:] if values.shape[1] > 6 else np.zeros_like(values[:, :3])
    return np.concatenate([rotation_from_six_d(values[:, :6]), moved[:, :, None]], axis=2)


def limited(displacements: NDArray, reach: np.float32) -> NDArray:
    """Return displacements (P, 3, F) no longer than `reach`, as `model.decoder.limited`."""
    length = np.sqrt((displacements * displacements).sum(1, keepdims=True))
    return displacements * (reach / np.maximum(length, reach))


def _unit(vectors: NDArray) -> NDArray:
    length = np.sqrt((vectors * vectors).sum(1, keepdims=True))
    return vectors / np.maximum(length, SHORTEST)


class ProxyKinematics:
    """Forward kinematics of a rig's proxies, one level of the hierarchy after another.

    Args:
        rig: the proxies; joints: number of the character's joints.
    """

    def __init__(self, rig: ProxyRig, joints: int) -> None:
        self.joints, self.count = joints, rig.proxy_count
        self.pivots = rig.bind_transforms[:, :3, 3].astype(np.float32)
        depth = np.zeros(joints + self.count, dtype=int)
        for proxy, parent in enumerate(rig.parents):
            depth[joints + proxy] = depth[parent] + 1
        own = depth[joints:]
        self.generations = [
            (proxies, rig.parents[proxies])
            for proxies in (np.flatnonzero(own == level) for level in range(1, own.max(initial=0) + 1))
        ]

    def matrices(self, transforms: NDArray, character: NDArray) -> NDArray:
        """Return skinning matrices of all joints (J + P, 3, 4, F).

        Args:
            transforms: of the proxies, [R', t] in the axes of the bind pose (P, 3, 4, F).
            character: skinning matrices of the character's joints (J, 3, 4, F).
        """
        # Frames first, so that one product of many small matrices serves all joints of a generation.
        turns, displacements = np.split(transforms.transpose(3, 0, 1, 2), [3], axis=3)
        placed = self.pivots[:, :, None] - turns @ self.pivots[:, :, None] + displacements
        local = np.concatenate([turns, placed], axis=3)
        whole = np.empty((len(local), self.joints + self.count, 3, 4), dtype=np.float32)
        whole[:, : self.joints] = character.transpose(3, 0, 1, 2)
        for proxies, parents in self.generations:
            above = whole[:, parents]
            product = above[..., :3] @ local[:, proxies]
            product[..., 3] += above[..., 3]
            whole[:, self.joints + proxies] = product
        return whole.transpose(1, 2, 3, 0)
