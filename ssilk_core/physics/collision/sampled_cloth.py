# SPDX-License-Identifier: Apache-2.0
"""Positions of a garment's samples in PyTorch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats
from .. import kernels
from ..operators import SparseOperator
from ..samples import ContactSamples


class SampledCloth:
    """Positions of a garment's samples from those of its vertices, with a deterministic gradient.

    Attributes:
        samples: as they were given.
        area: of each sample, times the share of the full stiffness of contact that it has, shape (S, 1).
        stiffness: that share, shape (S,); None for one everywhere.
    """

    def __init__(
        self, samples: ContactSamples, device: torch.device, dtype: torch.dtype, stiffness: Floats | None = None
    ) -> None:
        count = len(samples.area)
        self.samples, self.stiffness = samples, stiffness
        area = samples.area if stiffness is None else samples.area * stiffness
        self.area = torch.as_tensor(area, dtype=dtype, device=device)[:, None]
        rows = np.repeat(np.arange(count), 3)
        used = samples.weights.reshape(-1) > 0
        entries = rows[used], samples.corners.reshape(-1)[used], samples.weights.reshape(-1)[used]
        self._rows = SparseOperator(*entries, (count, samples.vertex_count), device, dtype)
        self._only_vertices = count == samples.vertex_count

    def positions(self, x: Tensor) -> Tensor:
        """Return the samples (S, 3, N) of vertices x (V, 3, N); the first V of them are x."""
        if self._only_vertices:
            return x
        if not kernels.supports(x):
            return self._rows(x)
        from ..kernels.rows import rows_kernel

        return rows_kernel(x, self._rows.matrix, self._rows.transposed)

    def to_vertices(self, values: Tensor) -> Tensor:
        """Return sums (V, 3, N) of values at the samples (S, 3, N), each distributed to its corners by weight."""
        return values if self._only_vertices else self._rows.adjoint(values)
