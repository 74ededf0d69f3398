# SPDX-License-Identifier: Apache-2.0
"""The stiffness of cloth against cloth, and of friction, as a sparse matrix G'G; its pattern varies with steps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .. import kernels
from ..operators import csr
from ..self_contact.contacts import Slopes

if TYPE_CHECKING:
    from ..kernels.slopes import SlopeTable


@dataclass(frozen=True, eq=False)
class ContactStiffness:
    """Stiffness over U free vertices in N frames, float32; vectors are (U, 3, N).

    Attributes:
        vertices: of each of R slopes, among the free ones; -1 for others, shape (4, R).
        frame: of each, shape (R,).
        values: rows of G, at these vertices [(N/m)^1/2], shape (4, 3, R).
        count, frames: numbers U and N.
    """

    vertices: Tensor
    frame: Tensor
    values: Tensor
    count: int
    frames: int

    @classmethod
    def of(cls, found: Slopes, frames: int, place: Tensor, count: int) -> ContactStiffness:
        """Return that of slopes in a number of frames.

        Args:
            place: of each vertex among the free ones, -1 for others, shape (V,).
            count: number U of free vertices.
        """
        return cls(place[found.vertices], found.frame, found.values.float(), count, frames)

    @cached_property
    def table(self) -> SlopeTable:
        """The slopes, for kernels."""
        from ..kernels.slopes import SlopeTable

        return SlopeTable.of(self.vertices, self.frame, self.values, self.count, self.frames)

    @cached_property
    def diagonal(self) -> Tensor:
        """Blocks on the diagonal, shape (U, 3, 3, N)."""
        if kernels.available(self.frame.device):
            return self.table.diagonal()
        vertex, frame, values = self._entries[1:]
        block = values.new_zeros(self.count, self.frames, 3, 3)
        block.index_put_((vertex, frame), values[:, :, None] * values[:, None], accumulate=True)
        return block.permute(0, 2, 3, 1).contiguous()

    @cached_property
    def matrices(self) -> tuple[Tensor, Tensor]:
        """G, CSR (R, 3 U N), and its transpose."""
        row, vertex, frame, values = self._entries
        axis = torch.arange(3, device=row.device)
        column = ((3 * vertex[:, None] + axis) * self.frames + frame[:, None]).flatten()
        lines, size = row.repeat_interleave(3), (len(self.frame), 3 * self.count * self.frames)
        order, flat = column.argsort(stable=True), values.flatten()
        return csr(lines, column, flat, size), csr(column[order], lines[order], flat[order], size[::-1])

    @cached_property
    def _entries(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Row, vertex and frame of each vertex of a slope that is free, shape (E,), and its values, shape (E, 3)."""
        vertices = self.vertices.T
        kept = vertices >= 0
        row = kept.nonzero()[:, 0]
        return row, vertices[kept], self.frame[row], self.values.permute(2, 0, 1)[kept]

    def add_product(self, vectors: Tensor, to: Tensor) -> None:
        """Add the product with vectors to others, both contiguous."""
        rows, columns = self.matrices
        to.view(-1).add_(columns @ (rows @ vectors.reshape(-1)))
