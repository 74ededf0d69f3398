# SPDX-License-Identifier: Apache-2.0
"""The decoder over the free vertices alone, with its Jacobian dx/dz; weights and shapes are prepared once.

With the rest position r_v(a) = r_v + B_v a of a vertex, M_p of the joints and W of the skinning,

    x_v = sum_p W_vp M_p [r_v; 1],    dx_v = sum_p W_vp dM_p [r_v; 1] + (sum_p W_vp R_p) B_v da

R_p is the linear part of M_p. The activations a and the transforms in M follow from the output network (`slopes`).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ...physics import loops
from ...physics.skinning import blend_matrices, transform_points
from ..model.decoder import limited, rotation_from_six_d
from ..model.network import GarmentModel
from .slopes import ProxyChain, limited_slopes, mlp_slopes, rotation_slopes


@dataclass(frozen=True, eq=False)
class DecodedPoints:
    """Free vertices of N frames [m], shape (U, 3, N), and their Jacobian by the m latents [m], (N, 3 U, m)."""

    x: Tensor
    jacobian: Tensor


class FreeDecoder(nn.Module):
    """Decodes latents to some vertices.

    Args:
        model: whose decoder is meant; it may be trained further without effect here.
        vertices: that are decoded, none of them pinned, shape (U,).
        dtype: of everything.
    """

    weights: Tensor
    rest: Tensor
    shapes: Tensor
    readout: Tensor
    pivots: Tensor
    identity: Tensor
    scale: Tensor

    @torch.no_grad()
    def __init__(self, model: GarmentModel, vertices: Tensor, dtype: torch.dtype) -> None:
        super().__init__()
        decoder, device = copy.deepcopy(model.decoder).to(vertices.device, dtype), vertices.device
        joints = model.scene.character.skeleton.joint_count
        self.activation_count, self.proxy_outputs = decoder.activation_count, decoder.proxy_outputs
        self.bounded, self.tanh = decoder.bounded, decoder.tanh
        self.proxy_count, self.reach, self.is_reduced = decoder.proxy_count, decoder.reach, decoder.is_reduced
        self.output = copy.deepcopy(model.output).requires_grad_(False)
        self.chain = ProxyChain(decoder.parent_indices, joints, device)
        rest = decoder.rest.index_add(0, decoder.free, decoder.offset) if self.is_reduced else decoder.rest
        place = torch.full((len(rest),), -1, device=decoder.free.device)
        place[decoder.free] = torch.arange(len(decoder.free), device=place.device)
        constants = {
            "weights": decoder.rest.new_zeros(len(vertices), joints + self.proxy_count).index_copy(
                1, decoder.used, decoder.skin_weights()[vertices]
            ),
            "rest": rest[vertices],
            "shapes": decoder.shapes[place[vertices]],
            "readout": decoder.readout,
            "pivots": decoder.pivots,
            "identity": decoder.identity,
            "scale": decoder.scale,
        }
        for name, value in constants.items():
            self.register_buffer(name, value.detach().clone(), persistent=False)
        self.joints = joints
        self.to(device=device, dtype=dtype)

    @torch.no_grad()
    def positions(self, z: Tensor, character: Tensor) -> Tensor:
        """Return positions [m], shape (U, 3, N).

        Args:
            z: latents, shape (N, m).
            character: skinning matrices of the character's joints, shape (J, 3, 4, N).
        """
        return self.placed(self.output(z), character)

    @torch.no_grad()
    def placed(self, output: Tensor, character: Tensor) -> Tensor:
        """Return positions [m], shape (U, 3, N), of outputs (N, outputs); `character` as for `positions`."""
        activation = self.bounded(output[:, : self.activation_count].T)
        values = self._values(output.T[self.activation_count :])
        if loops.supports(values) and values.numel():
            matrices, _ = self._proxies_by_loop(
                values, values.new_empty(len(output), values[..., 0].numel(), 0), character
            )
        else:
            moved = limited(values[:, 6:], self.reach) if self.proxy_outputs > 6 else torch.zeros_like(values[:, :3])
            matrices = self.chain.matrices(self._about_pivots(rotation_from_six_d(values[:, :6]), moved), character)
        return transform_points(blend_matrices(self.weights, matrices), self._at_rest(self._read(activation)))

    @torch.no_grad()
    def linearise(self, z: Tensor, character: Tensor) -> DecodedPoints:
        """Return positions and their Jacobian; arguments as for `positions`."""
        output, slopes = mlp_slopes(self.output, z)
        count = self.activation_count
        activation = self.bounded(output[:, :count].T)
        slope = 1 - activation.T**2 if self.tanh else (output[:, :count] == activation.T).to(output.dtype)
        d_activation = slope[:, :, None] * slopes[:, :count]
        values, rest = self._values(output.T[count:]), self._at_rest(self._read(activation))
        if loops.supports(values) and values.numel():
            matrices, d_matrices = self._proxies_by_loop(values, slopes[:, count:], character)
        else:
            matrices, d_matrices = self._proxies(values, slopes[:, count:], character)
        affine, jacobian = blend_matrices(self.weights, matrices), self._by_proxies(rest, d_matrices)
        if len(self.shapes) and self.shapes.shape[-1]:
            turned_shapes = torch.einsum("uabn,ubk->nuak", affine[:, :, :3], self.shapes).flatten(1, 2)
            jacobian = jacobian.baddbmm_(turned_shapes, self._read(d_activation, dim=1))
        return DecodedPoints(transform_points(affine, rest), jacobian)

    def _proxies_by_loop(self, values: Tensor, slopes: Tensor, character: Tensor) -> tuple[Tensor, Tensor]:
        """Return the result of `_proxies`."""
        from ...physics.loops.proxy_slopes import proxy_slopes_loop

        return proxy_slopes_loop(
            values, slopes, self.scale[:, 0], self.pivots, self.chain.parents, character, self.reach
        )

    def _proxies(self, values: Tensor, slopes: Tensor, character: Tensor) -> tuple[Tensor, Tensor]:
        """Return skinning matrices of all joints (J + P, 3, 4, N), and slopes of the proxies' (N, P, 4, 3, m).

        Args:
            values: of the proxies (P, C, N); slopes: of the network's outputs for them (N, C P, m).
        """
        frames, latents = len(slopes), slopes.shape[2]
        d_values = slopes.reshape(frames, self.proxy_count, self.proxy_outputs, latents).permute(1, 2, 0, 3)
        d_values = self.scale[..., None] * d_values
        turned, d_turned = rotation_slopes(values[:, :6], d_values[:, :6])
        moved, d_moved = torch.zeros_like(values[:, :3]), torch.zeros_like(d_values[:, :3])
        if self.proxy_outputs > 6:
            moved, d_moved = limited_slopes(values[:, 6:], d_values[:, 6:], self.reach)
        own, d_own = self._about_pivots(turned, moved), self._about_pivots_slopes(d_turned, d_moved)
        matrices = self.chain.matrices(own, character)
        return matrices, self.chain.slopes(own, d_own, matrices).permute(3, 0, 2, 1, 4)

    def _values(self, delta: Tensor) -> Tensor:
        """Return what `decoder.transform_of` takes (P, C, N) from the network's outputs for proxies (C P, N)."""
        return self.identity + self.scale * delta.reshape(self.proxy_count, self.proxy_outputs, delta.shape[1])

    def _read(self, activation: Tensor, dim: int = 0) -> Tensor:
        """Return weights of the blendshapes from activations along a dimension."""
        if not self.is_reduced:
            return activation
        return torch.tensordot(self.readout, activation, dims=([1], [dim])).movedim(0, dim)

    def _at_rest(self, activation: Tensor) -> Tensor:
        """Return the rest positions with blendshapes, shape (U, 3, N)."""
        offsets = self.shapes.flatten(0, 1) @ activation
        return self.rest[:, :, None] + offsets.reshape(len(self.rest), 3, activation.shape[1])

    def _about_pivots(self, turned: Tensor, moved: Tensor) -> Tensor:
        """Return T_p = [R, p - R p + t], shape (P, 3, 4, N)."""
        offset = self.pivots[:, :, None] - torch.einsum("pabn,pb->pan", turned, self.pivots) + moved
        return torch.cat([turned, offset[:, :, None]], dim=2)

    def _about_pivots_slopes(self, d_turned: Tensor, d_moved: Tensor) -> Tensor:
        """Return the slopes of T_p, shape (P, 3, 4, N, m)."""
        offset = d_moved - torch.einsum("pabnm,pb->panm", d_turned, self.pivots)
        return torch.cat([d_turned, offset[:, :, None]], dim=2)

    def _by_proxies(self, rest: Tensor, d_matrices: Tensor) -> Tensor:
        """Return the part of the Jacobian by the slopes of the proxies' matrices (N, P, 4, 3, m), (N, 3 U, m)."""
        frames, latents = len(d_matrices), d_matrices.shape[4]
        points = torch.cat([rest, torch.ones_like(rest[:, :1])], dim=1).permute(2, 0, 1)  # (N, U, 4)
        weighted = (self.weights[:, self.joints :, None] * points[:, :, None]).flatten(2)  # (N, U, 4 P)
        slopes = d_matrices.reshape(frames, 4 * self.proxy_count, 3 * latents)
        return (weighted @ slopes).reshape(frames, 3 * len(rest), latents)
