# SPDX-License-Identifier: Apache-2.0
"""Values of the decoder's parts with their slopes: by how much each changes with each latent.

Slopes have the shape of the value and one more dimension at the end, m directions of change: those of the m latents.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..model.decoder import compose

NORM_EPSILON = 1e-8  # as in `decoder.rotation_from_six_d`


def mlp_slopes(network: nn.Sequential, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the outputs (N, C) of a perceptron of linear layers and SiLU at z (N, m), and their slopes (N, C, m).

    They are a product of the weights, with the slopes of SiLU between them:
        W_l diag(silu'(h_{l-1})) W_{l-1} ... W_1,    silu'(h) = s (1 + h (1 - s)),   s = 1 / (1 + e^-h)

    Raises:
        TypeError: the network has a layer of another kind.
    """
    value, slopes = z, None
    for layer in network:
        if isinstance(layer, nn.Linear):
            slopes = layer.weight.expand(len(z), -1, -1) if slopes is None else layer.weight @ slopes
        elif isinstance(layer, nn.SiLU) and slopes is not None:
            gate = torch.sigmoid(value)
            slopes = (gate * (1 + value * (1 - gate)))[:, :, None] * slopes
        else:
            raise TypeError(f"{type(layer).__name__} has no slopes here")
        value = layer(value)
    assert slopes is not None
    return value, slopes


def normalised(vectors: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit vectors u = v / |v| of v (P, 3, N), and their slopes (1 - u u') dv / |v|, (P, 3, N, m)."""
    length = vectors.norm(dim=1, keepdim=True).clamp_min(NORM_EPSILON)
    unit = vectors / length
    return unit, _across(unit, slopes) / length[..., None]


def _across(unit: Tensor, slopes: Tensor) -> Tensor:
    """Return what of slopes (P, 3, N, m) is across unit vectors (P, 3, N)."""
    return slopes - unit[..., None] * (unit[..., None] * slopes).sum(1, keepdim=True)


def rotation_slopes(values: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotations (P, 3, 3, N) of 6D values (P, 6, N) by Gram-Schmidt, and their slopes (P, 3, 3, N, m)."""
    (a, b), (da, db) = (part.split(3, dim=1) for part in (values, slopes))
    x, dx = normalised(a, da)
    along = (x * b).sum(1, keepdim=True)
    d_along = (dx * b[..., None] + x[..., None] * db).sum(1, keepdim=True)
    y, dy = normalised(b - along * x, db - d_along * x[..., None] - along[..., None] * dx)
    z = torch.linalg.cross(x, y, dim=1)
    left, right = torch.broadcast_tensors(dx, y[..., None])
    dz = torch.linalg.cross(left, right, dim=1)
    left, right = torch.broadcast_tensors(x[..., None], dy)
    dz = dz + torch.linalg.cross(left, right, dim=1)
    return torch.stack([x, y, z], dim=2), torch.stack([dx, dy, dz], dim=2)


def limited_slopes(moved: Tensor, slopes: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Return displacements t (P, 3, N) of at most `reach` [m], and their slopes (P, 3, N, m).

    Those of a displacement that is held back are across it: (1 - u u') dt reach / |t|.
    """
    length = moved.norm(dim=1, keepdim=True)
    factor = reach / length.clamp_min(reach)
    held = _across(moved / length.clamp_min(NORM_EPSILON), slopes) * factor[..., None]
    return moved * factor, torch.where((length > reach)[..., None], held, slopes)


class ProxyChain:
    """Forward kinematics of the proxies with slopes, those at the same depth at once.

    Args:
        parents: combined index of each proxy's parent: joints of the character first, then proxies.
        joints: number of the character's joints.
    """

    def __init__(self, parents: Sequence[int], joints: int, device: torch.device) -> None:
        self.joints, self.parents = joints, torch.as_tensor(parents, dtype=torch.long, device=device)
        depths: list[int] = []
        for parent in parents:  # a parent comes before its children
            depths.append(0 if parent < joints else depths[parent - joints] + 1)
        self.levels: list[tuple[Tensor, Tensor]] = []
        for level in range(max(depths, default=-1) + 1):
            rows = [proxy for proxy, depth in enumerate(depths) if depth == level]
            above = torch.as_tensor([parents[proxy] for proxy in rows], device=device)
            self.levels.append((torch.as_tensor(rows, device=device), above))

    def matrices(self, own: Tensor, character: Tensor) -> Tensor:
        """Return skinning matrices (J + P, 3, 4, N): M_p = M_parent T_p.

        Args:
            own: T_p of the proxies, about their pivots, shape (P, 3, 4, N).
            character: of the character's joints, shape (J, 3, 4, N).
        """
        found = torch.cat([character, torch.empty_like(own)])
        for rows, parents in self.levels:
            found[self.joints + rows] = compose(found[parents], own[rows])
        return found

    def slopes(self, own: Tensor, own_slopes: Tensor, matrices: Tensor) -> Tensor:
        """Return slopes (P, 3, 4, N, m) of the proxies' skinning matrices: dM_p = M_parent dT_p + dM_parent T_p.

        Args:
            own, own_slopes: T_p and its slopes, (P, 3, 4, N) and (P, 3, 4, N, m).
            matrices: of all joints, as `matrices` returns them.
        """
        found = torch.empty_like(own_slopes)
        for number, (rows, parents) in enumerate(self.levels):
            turned = torch.einsum("pabn,pbcnm->pacnm", matrices[parents][:, :, :3], own_slopes[rows])
            if number:  # parents at depth 0 are the character's joints, which no latent moves
                d_parent = found[parents - self.joints]
                turned += torch.einsum("pabnm,pbcn->pacnm", d_parent[:, :, :3], own[rows])
                turned[:, :, 3] += d_parent[:, :, 3]
            found[rows] = turned
        return found
