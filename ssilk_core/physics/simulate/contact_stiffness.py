# SPDX-License-Identifier: Apache-2.0
"""The stiffness of cloth against cloth, and of friction, as a sparse matrix G'G; its pattern varies with steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..operators import csr
from ..self_contact.contacts import Slopes


@dataclass(frozen=True, eq=False)
class ContactStiffness:
    """Stiffness over U free vertices in N frames, float32; vectors are (U, 3, N).

    Attributes:
        rows: G, the slopes, CSR (R, 3 U N).
        columns: its transpose, CSR.
        diagonal: blocks on the diagonal, shape (U, 3, 3, N).
    """

    rows: Tensor
    columns: Tensor
    diagonal: Tensor

    @classmethod
    def of(cls, found: Slopes, frames: int, place: Tensor, count: int) -> ContactStiffness:
        """Return that of slopes in a number of frames.

        Args:
            place: of each vertex among the free ones, -1 for others, shape (V,).
            count: number U of free vertices.
        """
        device = place.device
        slopes = found.values.float().permute(2, 0, 1)  # (R, 4, 3)
        own = place[found.vertices.T]
        kept = own >= 0
        row = kept.nonzero()[:, 0]
        vertex, frame, values = own[kept], found.frame[row], slopes[kept]
        block = values.new_zeros(count, frames, 3, 3)
        block.index_put_((vertex, frame), values[:, :, None] * values[:, None], accumulate=True)
        axis = torch.arange(3, device=device)
        column = ((3 * vertex[:, None] + axis) * frames + frame[:, None]).flatten()
        lines, size = row.repeat_interleave(3), 3 * count * frames
        order = column.argsort(stable=True)
        flat = values.flatten()
        return cls(
            csr(lines, column, flat, (len(slopes), size)),
            csr(column[order], lines[order], flat[order], (size, len(slopes))),
            block.permute(0, 2, 3, 1).contiguous(),
        )

    def add_product(self, vectors: Tensor, to: Tensor) -> None:
        """Add the product with vectors to others, both contiguous."""
        to.view(-1).add_(self.columns @ (self.rows @ vectors.reshape(-1)))
