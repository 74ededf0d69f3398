# SPDX-License-Identifier: Apache-2.0
"""Differentiable decoder: from blendshape weights and proxy transforms to vertices (paper, Sections 3.3 and 3.4).

Layouts keep frames last: transforms (joints, 3, 4, N), positions (V, 3, N).

A skinning matrix S_j maps the bind pose to the posed world. A proxy rotates about its bind position p in its parent's
frame and moves by t: S_p = S_parent [R', p - R' p + t]. The network's transform [R', t] has the bind pose's axes; in
the paper t is zero. A file stores the local rotation P^T R' B and translation P^T (p + t - q): B and P are the bind
rotations of the proxy and its parent, q the parent's bind position.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ...physics import kernels, loops
from ...physics.skinning import Skinning
from ...scene.assets import PINNED, Scene
from ..parameters import IDENTITY, OUTPUT_SCALE
from ..settings import FREE_ACTIVATION, ModelConfig


def rotation_from_six_d(values: Tensor) -> Tensor:
    """Orthonormalise 6D rotations by Gram-Schmidt [ZBL*19]; (..., 6, N) to matrices (..., 3, 3, N)."""
    a, b = values[..., :3, :], values[..., 3:, :]
    x = a / a.norm(dim=-2, keepdim=True).clamp_min(1e-8)
    b = b - (x * b).sum(-2, keepdim=True) * x
    y = b / b.norm(dim=-2, keepdim=True).clamp_min(1e-8)
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-2)], dim=-2)


def transform_of(values: Tensor) -> Tensor:
    """Return transforms (P, 3, 4, N): of 6D rotations (P, 6, N), or of these and displacements (P, 9, N) [m]."""
    turned, moved = rotation_from_six_d(values[:, :6]), values[:, 6:]
    if not moved.shape[1]:
        moved = torch.zeros_like(values[:, :3])
    return torch.cat([turned, moved[:, :, None]], dim=2)


def limited(displacements: Tensor, reach: float) -> Tensor:
    """Return displacements (P, 3, N) no longer than `reach`, unchanged where they are not."""
    return displacements * (reach / displacements.norm(dim=1, keepdim=True).clamp_min(reach))


def compose(left: Tensor, right: Tensor) -> Tensor:
    """Multiply affine transforms (..., 3, 4, N): first `right`, then `left`."""
    linear, moved = left[..., :3, :], left[..., 3:, :]
    product = torch.einsum("...abn,...bcn->...acn", linear, right)
    return torch.cat([product[..., :3, :], product[..., 3:, :] + moved], dim=-2)


class Decoder(nn.Module):
    """Blendshapes, proxy kinematics and skinning with trainable B, W^g and W^p (Eqs. 5, 7 and 8).

    Args:
        scene: garment, rig and character.
        config: number of blendshapes K; whether proxies move; and the number of activations that the network
            outputs, where it is more than K. Fixed linear combinations of these, `readout` (K, activations), held
            within [-1, 1], then weight the blendshapes, relative to the mean displacement `offset` (V', 3) [m] of
            vertices that are not pinned.
        generator: source of the initial blendshapes.
    """

    rest: Tensor
    pivots: Tensor
    parents: Tensor
    free: Tensor
    logits: Tensor
    identity: Tensor
    scale: Tensor
    readout: Tensor
    offset: Tensor

    def __init__(self, scene: Scene, config: ModelConfig, generator: torch.Generator) -> None:
        super().__init__()
        rig, shapes = scene.rig, config.shapes
        self.proxy_count, self.shape_count, self.activation_count = rig.proxy_count, shapes, config.activation_count
        self.proxy_outputs, self.is_reduced, self.tanh = config.proxy_outputs, config.activations > 0, config.tanh
        self.reach = scene.garment.sewn_mesh.diagonal  # several times what trained models use
        self.parent_indices = tuple(rig.parents.tolist())  # as Python numbers, without a copy from the GPU
        self.skin = Skinning(rig.skin, range(scene.character.skeleton.joint_count, len(scene.joint_names)))
        free = np.flatnonzero(scene.classes != PINNED)
        self._constant("rest", scene.garment.mesh.points)
        self._constant("pivots", rig.bind_transforms[:, :3, 3])
        self._constant("parents", rig.parents)
        self._constant("free", free)
        # Minus infinity never changes: training adds no joints to a vertex.
        weights = rig.skin.weights
        self._constant("logits", np.log(weights, out=np.full_like(weights, -np.inf), where=weights > 0))
        self._constant("identity", IDENTITY[: self.proxy_outputs, None])
        self._constant("scale", OUTPUT_SCALE[: self.proxy_outputs, None])
        self.skin_offset = nn.Parameter(torch.zeros(len(free), weights.shape[1]))
        self.shapes = nn.Parameter(1e-3 * torch.randn(len(free), 3, shapes, generator=generator))
        self.register_buffer("readout", torch.eye(shapes, self.activation_count), persistent=self.is_reduced)
        self.register_buffer("offset", torch.zeros(len(free), 3), persistent=self.is_reduced)

    def _constant(self, name: str, values: np.ndarray) -> None:
        """Register a constant that is rebuilt from the scene and so not saved; floats become float32."""
        tensor = torch.as_tensor(np.array(values))
        self.register_buffer(name, tensor.float() if tensor.is_floating_point() else tensor, persistent=False)

    @property
    def used(self) -> Tensor:
        """Joints that move any vertex, the columns of `skin_weights`."""
        return self.skin.used

    @property
    def output_count(self) -> int:
        """Outputs of the network for each frame: blendshape activations, and C = 6 or 9 for each of P proxies."""
        return self.activation_count + self.proxy_outputs * self.proxy_count

    @property
    def has_constant(self) -> bool:
        """Whether a file needs one more shape with a constant weight."""
        return self.activation_count > 0

    def activations(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Split network output (N, K + C P) into activations (K, N) and transforms (P, 3, 4, N)."""
        activation, values = self.split(output)
        return activation, transform_of(values)

    def split(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Split network output (N, K + C P) into activations (K, N) and values of `transform_of` (P, C, N)."""
        delta = output[:, self.activation_count :].T.reshape(self.proxy_count, self.proxy_outputs, output.shape[0])
        activation = self.bounded(output[:, : self.activation_count].T)
        values = self.identity + self.scale * delta
        if values.shape[1] > 6:
            values = torch.cat([values[:, :6], limited(values[:, 6:], self.reach)], dim=1)
        return (self.readout @ activation).clamp(-1, 1) if self.is_reduced else activation, values

    def bounded(self, activation: Tensor) -> Tensor:
        """Return activations in [-1, 1], or without a tanh in a range that they do not leave."""
        return torch.tanh(activation) if self.tanh else activation.clamp(-FREE_ACTIVATION, FREE_ACTIVATION)

    def _influence_weights(self) -> Tensor:
        """Return weights (V, I): a softmax over each vertex's support, pinned rows frozen."""
        return torch.softmax(self.logits.index_add(0, self.free, self.skin_offset), dim=1)

    def skin_weights(self) -> Tensor:
        """Return the weights as a matrix (V, used joints)."""
        return self.skin.dense(self._influence_weights())

    def free_rest(self) -> Tensor:
        """Return the shape in the middle of the blendshapes' range, of vertices that are not pinned (V', 3) [m]."""
        rest = self.rest[self.free]
        return rest + self.offset if self.is_reduced else rest

    def proxy_matrices(self, transforms: Tensor, character: Tensor) -> Tensor:
        """Forward kinematics: skinning matrices of all joints, (J + P, 3, 4, N).

        Args:
            transforms: of the proxies, [R', t] in the axes of the bind pose, (P, 3, 4, N).
            character: skinning matrices of the character's joints, (J, 3, 4, N).
        """
        rotations, moved = transforms[:, :, :3], transforms[:, :, 3]
        offset = self.pivots[:, :, None] - torch.einsum("pabn,pb->pan", rotations, self.pivots) + moved
        own = torch.cat([rotations, offset[:, :, None]], dim=2)
        matrices = [*character]
        for parent, turn in zip(self.parent_indices, own):
            matrices.append(compose(matrices[parent], turn))
        return torch.stack(matrices)

    def matrices(self, values: Tensor, character: Tensor) -> Tensor:
        """Return skinning matrices of all joints (J + P, 3, 4, N) from the values (P, C, N) of `transform_of`."""
        if kernels.available(character.device):
            from ...physics.kernels.proxies import proxies_kernel

            return proxies_kernel(values, self.pivots, self.parents, character)
        if loops.supports(character):
            from ...physics.loops.proxies import proxies_loop

            return proxies_loop(values, self.pivots, self.parents, character)
        return self.proxy_matrices(transform_of(values), character)

    def _offsets(self, activation: Tensor) -> Tensor | None:
        """Return the displacements by blendshapes (V, 3, N), zero for pinned vertices."""
        if not self.shape_count:
            return None
        # Zero rows for pinned vertices cost less than scattering the others in every frame.
        shapes = self.shapes.new_zeros(len(self.rest), 3, self.shape_count).index_copy(0, self.free, self.shapes)
        return (shapes.flatten(0, 1) @ activation).reshape(len(self.rest), 3, activation.shape[1])

    def _skinned(self, activation: Tensor, matrices: Tensor) -> Tensor:
        rest = self.rest.index_add(0, self.free, self.offset) if self.is_reduced else self.rest
        return self.skin(rest, self._offsets(activation), self._influence_weights(), matrices)

    def vertices(self, output: Tensor, character: Tensor) -> Tensor:
        """Return vertices (V, 3, N) [m] from network output (N, K + C P) and character (J, 3, 4, N)."""
        activation, values = self.split(output)
        return self._skinned(activation, self.matrices(values, character))

    def forward(self, activation: Tensor, transforms: Tensor, character: Tensor) -> Tensor:
        """Return vertices (V, 3, N) [m] from activations (K, N), transforms (P, 3, 4, N), character (J, 3, 4, N)."""
        return self._skinned(activation, self.proxy_matrices(transforms, character))
