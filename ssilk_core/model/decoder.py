# SPDX-License-Identifier: Apache-2.0
"""From blendshape weights and proxy rotations to vertices, differentiably (paper, Sections 3.3 and 3.4).

Layouts keep frames last: transforms (joints, 3, 4, N), positions (V, 3, N). Linear blend skinning is then one
dense matrix product over joints, and every element-wise step runs over contiguous memory.

A skinning matrix S_j takes the bind pose to the posed world. A proxy turns about its own bind position p inside
its parent's frame, so S_p = S_parent [R', p - R' p], with R' the network's rotation in the axes of the bind pose.
The local rotation that a file stores is P^T R' B, with B and P the bind rotations of the proxy and its parent.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ..assets import PINNED, Scene


def rotation_from_six_d(values: Tensor) -> Tensor:
    """Orthonormalise 6D rotations by Gram-Schmidt [ZBL*19]; (..., 6, N) to matrices (..., 3, 3, N)."""
    a, b = values[..., :3, :], values[..., 3:, :]
    x = a / a.norm(dim=-2, keepdim=True).clamp_min(1e-8)
    b = b - (x * b).sum(-2, keepdim=True) * x
    y = b / b.norm(dim=-2, keepdim=True).clamp_min(1e-8)
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-2)], dim=-2)


def compose(left: Tensor, right: Tensor) -> Tensor:
    """Multiply affine transforms (..., 3, 4, N), left after right."""
    linear, moved = left[..., :3, :], left[..., 3:, :]
    product = torch.einsum("...abn,...bcn->...acn", linear, right)
    return torch.cat([product[..., :3, :], product[..., 3:, :] + moved], dim=-2)


def blended(weights: Tensor, matrices: Tensor) -> Tensor:
    """Blend skinning matrices (J, 3, 4, N) by dense weights (V, J) to one for each vertex, (V, 3, 4, N)."""
    return (weights @ matrices.flatten(1)).reshape(-1, *matrices.shape[1:])


def transformed(affine: Tensor, points: Tensor) -> Tensor:
    """Apply an affine transform (V, 3, 4, N) to each point (V, 3, N or 1); returns (V, 3, N)."""
    return (affine[:, :, :3] * points[:, None]).sum(2) + affine[:, :, 3]


class Decoder(nn.Module):
    """Blendshapes, proxy kinematics and skinning with trainable B, W^g and W^p (Eqs. 5, 7 and 8).

    Args:
        scene: garment, rig and character.
        shapes: blendshapes K.
        generator: source of the initial blendshapes.
    """

    rest: Tensor
    pivots: Tensor
    free: Tensor
    used: Tensor
    columns: Tensor
    support: Tensor
    logits: Tensor
    order: Tensor
    identity: Tensor

    def __init__(self, scene: Scene, shapes: int, generator: torch.Generator) -> None:
        super().__init__()
        rig = scene.rig
        self.proxy_count, self.shape_count = rig.proxy_count, shapes
        free = np.flatnonzero(scene.classes != PINNED)
        # Joints that no vertex uses are left out of the product.
        used = np.unique(rig.skin.indices[rig.skin.weights > 0])
        support = rig.skin.weights > 0
        self._constant("rest", scene.garment.mesh.points)
        self._constant("pivots", rig.bind_transforms[:, :3, 3])
        self._constant("free", free)
        self._constant("used", used)
        self._constant("columns", np.searchsorted(used, rig.skin.indices).clip(max=len(used) - 1))
        self._constant("support", support)
        self._constant("logits", np.log(np.where(support, rig.skin.weights, 1.0)))
        self._constant("identity", np.array([1.0, 0, 0, 0, 1, 0]))
        self._constant_levels(scene)
        self.skin_offset = nn.Parameter(torch.zeros(len(free), support.shape[1]))
        self.shapes = nn.Parameter(1e-3 * torch.randn(len(free), 3, shapes, generator=generator))

    def _constant(self, name: str, values: np.ndarray) -> None:
        """Register a constant that is rebuilt from the scene, hence not saved; floats become float32."""
        tensor = torch.as_tensor(np.array(values))
        tensor = tensor.float() if tensor.is_floating_point() else tensor
        self.register_buffer(name, tensor.long() if tensor.dtype == torch.int32 else tensor, persistent=False)

    def _constant_levels(self, scene: Scene) -> None:
        """Group proxies by depth; positions run over character joints, then proxies level by level."""
        joints, parents = scene.character.skeleton.joint_count, scene.rig.parents
        depth = np.zeros(len(parents), dtype=int)
        for proxy, parent in enumerate(parents):
            depth[proxy] = depth[parent - joints] + 1 if parent >= joints else 0
        by_level = np.argsort(depth, kind="stable")
        position = np.arange(joints + len(parents))
        position[joints + by_level] = joints + np.arange(len(parents))
        self.level_count = int(depth.max(initial=-1)) + 1
        for level in range(self.level_count):
            members = np.flatnonzero(depth == level)
            self._constant(f"level_{level}", members)
            self._constant(f"above_{level}", position[parents[members]])
        self._constant("order", position)

    @property
    def output_count(self) -> int:
        """Numbers the network must give for each frame: K blendshape activations and 6 P for the proxies."""
        return self.shape_count + 6 * self.proxy_count

    def activations(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Split network output (N, K + 6 P) into activations (K, N) in [-1, 1] and rotations (P, 3, 3, N)."""
        a = torch.tanh(output[:, : self.shape_count].T)
        delta = output[:, self.shape_count :].T.reshape(self.proxy_count, 6, len(output))
        return a, rotation_from_six_d(self.identity[:, None] + delta)

    def skin_weights(self) -> Tensor:
        """Return dense weights (V, used joints): a softmax over each vertex's support, pinned rows frozen."""
        logits = self.logits.index_add(0, self.free, self.skin_offset)
        weights = torch.softmax(logits.masked_fill(~self.support, -torch.inf), dim=1)
        dense = weights.new_zeros(len(weights), len(self.used))
        return dense.scatter_add(1, self.columns, weights.masked_fill(~self.support, 0.0))

    def proxy_matrices(self, rotations: Tensor, character: Tensor) -> Tensor:
        """Forward kinematics: skinning matrices of all joints, (J + P, 3, 4, N).

        Args:
            rotations: proxy rotations R' in bind-pose axes, (P, 3, 3, N).
            character: skinning matrices of the character's joints, (J, 3, 4, N).
        """
        offset = self.pivots[:, :, None] - torch.einsum("pabn,pb->pan", rotations, self.pivots)
        own = torch.cat([rotations, offset[:, :, None]], dim=2)
        matrices: Tensor = character
        for level in range(self.level_count):
            members, above = getattr(self, f"level_{level}"), getattr(self, f"above_{level}")
            matrices = torch.cat([matrices, compose(matrices[above], own[members])])
        return matrices[self.order]

    def forward(self, activation: Tensor, rotations: Tensor, character: Tensor) -> Tensor:
        """Return vertices (V, 3, N) [m] from activations (K, N), rotations (P, 3, 3, N), character (J, 3, 4, N)."""
        matrices = self.proxy_matrices(rotations, character) if self.proxy_count else character
        canonical = self.rest[:, :, None]
        if self.shape_count:
            offsets = (self.shapes.flatten(0, 1) @ activation).reshape(len(self.free), 3, activation.shape[1])
            canonical = canonical.expand(-1, -1, offsets.shape[-1]).index_add(0, self.free, offsets)
        return transformed(blended(self.skin_weights(), matrices[self.used]), canonical)
