# SPDX-License-Identifier: Apache-2.0
"""The Hessian of a garment's energy as 3 x 3 blocks, summed from faces, hinges, stitches and single vertices."""

from __future__ import annotations

from functools import cached_property
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import PINNED, Ints, Scene
from ...scene.mesh import topology
from .. import loops
from ..energy import GarmentEnergy
from ..energy.stitching import Stitching
from ..operators import SparseOperator
from ..samples import ContactSamples
from .blocks import BlockMatrix, BlockPattern
from .hinges import Hinges
from .membrane import Membrane, outer
from .stitches import stitch_slopes

if TYPE_CHECKING:
    from ..loops.stiffness import StiffnessTables

FIXED_STIFFNESS_FACTOR = 1e6
NO_CORNERS = np.zeros((0, 4), dtype=np.int64)
SIDES = list(combinations_with_replacement(range(4), 2))  # pairs of an element's four vertices


class Hessian:
    """Assembles the Hessian over the vertices `free` (U,), in float32; positions are (V, 3, N).

    Attributes:
        membrane, hinges: what bears stretch and bending; no hinges where nothing resists bending.

    Args:
        samples: of contact, each within a face.
        stitching: what holds islands on one another, or None.
    """

    def __init__(
        self,
        membrane: Membrane,
        hinges: Hinges | None,
        samples: ContactSamples,
        free: Ints,
        stitching: Stitching | None = None,
    ) -> None:
        device = membrane.area.device
        self.membrane, self.hinges, self.stitching, self.free_count = membrane, hinges, stitching, len(free)
        self.free, self.samples = torch.as_tensor(free, device=device), samples
        faces, corners = membrane.corners, hinges.corners if hinges else NO_CORNERS
        near = np.concatenate([faces[:, pair] for pair in combinations_with_replacement(range(3), 2)])
        stitched = stitching.corners if stitching else NO_CORNERS
        pairs = np.concatenate([near, _pairs(corners), _pairs(stitched)])
        self.pattern = BlockPattern(pairs, free, samples.vertex_count, device)
        self.sum_faces = self._face_sum(near, membrane.weights.cpu().numpy())
        self.sum_samples = self._sample_sum(samples)
        if hinges:
            self.left, self.right, self.sum_hinges = self._pair_sum(corners)
        if stitching:
            self.held, self.holding, self.sum_stitches = self._pair_sum(stitched)

    @classmethod
    def of(cls, scene: Scene, energy: GarmentEnergy) -> Hessian:
        """Return that of a scene's garment, over the vertices that are not pinned and have mass."""
        mesh, device = scene.garment.rest_mesh, energy.mass.device
        corners = topology.hinges(mesh.faces) if energy.fabric.bending else NO_CORNERS
        membrane = Membrane(mesh, energy.fabric, device, energy.mass.dtype)
        bending = energy.bending_stiffness, energy.rest_angle
        hinges = Hinges(corners, *bending, mesh.vertex_count) if len(corners) else None
        free = np.flatnonzero((scene.classes != PINNED) & (topology.vertex_areas(mesh.points, mesh.faces) > 0))
        return cls(membrane, hinges, energy.cloth.samples, free, energy.stitching)

    def _face_sum(self, near: Ints, weights: np.ndarray) -> SparseOperator:
        """Return the operator from `Membrane.stiffness` to blocks: w_ik w_jl times the block k, l for pairs i, j."""
        count = weights.shape[1]
        slots, rows, sources, products = self.pattern.slots(near), [], [], []
        for number, (i, j) in enumerate(combinations_with_replacement(range(3), 2)):
            for first, second in np.ndindex(2, 2):
                rows.append(slots[number * count : (number + 1) * count])
                sources.append((2 * first + second) * count + np.arange(count))
                products.append(weights[first, :, i] * weights[second, :, j])
        parts = [np.concatenate(part) for part in (rows, sources, products)]
        return self.pattern.summation(parts[0], parts[1], parts[2], 4 * count)

    def _pair_sum(self, corners: Ints) -> tuple[Tensor, Tensor, SparseOperator]:
        """Return which slopes are multiplied for each pair of elements' vertices, and the operator to blocks.

        Slopes of elements with the vertices `corners` (E, 4) have 4 E rows, those of the first vertices first.
        """
        rows = np.argsort(corners, axis=1, kind="stable") * len(corners) + np.arange(len(corners))[:, None]
        left, right = (
            torch.as_tensor(np.concatenate([rows[:, side[end]] for side in SIDES]), device=self.pattern.device)
            for end in range(2)
        )
        pairs = _pairs(corners)
        each = np.arange(len(pairs))
        return left, right, self.pattern.summation(self.pattern.slots(pairs), each, np.ones(len(pairs)), len(pairs))

    def _sample_sum(self, samples: ContactSamples) -> SparseOperator:
        """Return the operator from a block of each sample (S) to blocks: w_i w_j of it for the corners i, j."""
        slots, sources, products = [], [], []
        for i, j in combinations_with_replacement(range(3), 2):
            product = samples.weights[:, i] * samples.weights[:, j]
            used = np.flatnonzero(product)
            slots.append(self.pattern.slots(samples.corners[used][:, [i, j]]))
            sources.append(used)
            products.append(product[used])
        parts = [np.concatenate(part) for part in (slots, sources, products)]
        return self.pattern.summation(parts[0], parts[1], parts[2], len(samples.area))

    def __call__(
        self,
        x: Tensor,
        weight: Tensor,
        contact: Tensor | None,
        fixed: Tensor | None = None,
        exact_hessian: Tensor | None = None,
    ) -> BlockMatrix:
        """Return the Hessian at x.

        Args:
            weight: isotropic stiffness of each free vertex [N/m], shape (U, 1), or of each in each frame, (U, N).
            contact: block of each sample, shape (S, 3, 3, N), or None.
            fixed: free vertices that are stiffened so that a solution hardly moves them, shape (U, N), or None.
            exact_hessian: see `Membrane.stiffness`.
        """
        blocks = self._unstitched(x, weight, contact, exact_hessian)
        if self.stitching:
            slopes = stitch_slopes(self.stitching, x)
            product = slopes[self.held][:, :, :, None] * slopes[self.holding][:, :, None]
            blocks += self.sum_stitches(product.sum(1))
        if fixed is not None:
            diagonal = blocks[: self.free_count]
            stiff = (
                FIXED_STIFFNESS_FACTOR
                * diagonal.square().sum((1, 2)).sqrt()[:, None, None]
                * torch.eye(3, device=x.device)[..., None]
            )
            diagonal.copy_(torch.where(fixed[:, None, None], stiff, diagonal))
        return BlockMatrix(self.pattern, blocks)

    def _unstitched(self, x: Tensor, weight: Tensor, contact: Tensor | None, exact_hessian: Tensor | None) -> Tensor:
        """Return the blocks (stored, 3, 3, N) without those of stitches."""
        if loops.supports(x):
            from ..loops.stiffness import stiffness_loop

            stored, fabric = self.pattern.block_count, self.membrane.fabric
            return stiffness_loop(x, self._tables, fabric, stored, weight, contact, exact_hessian)
        blocks = self.sum_faces(self.membrane.stiffness(x, exact_hessian))
        if self.hinges:
            slopes = self.hinges.slopes(x)
            blocks += self.sum_hinges(outer(slopes[self.left], slopes[self.right]))
        if contact is not None:
            blocks += self.sum_samples(contact.float().flatten(1, 2)).view_as(blocks)
        blocks[: self.free_count] += weight[:, None, None] * torch.eye(3, device=x.device)[:, :, None]
        return blocks

    @cached_property
    def _tables(self) -> StiffnessTables:
        from ..loops.stiffness import StiffnessTables

        membrane, hinges, samples = self.membrane, self.hinges, self.samples
        near = list(combinations_with_replacement(range(3), 2))
        corners: Ints = hinges.corners if hinges else NO_CORNERS
        roots = (2 * hinges.stiffness[:, 0]).sqrt().double().numpy() if hinges else np.zeros(0)

        def slots(elements: Ints, sides: list[tuple[int, int]]) -> Ints:
            return np.stack([self.pattern.slots(elements[:, side]) for side in sides], axis=1)

        weights = membrane.weights.double().numpy().transpose(1, 0, 2).reshape(-1, 6)
        return StiffnessTables(
            membrane.corners,
            slots(membrane.corners, near),
            np.column_stack([weights, membrane.area.double().numpy()]),
            corners,
            np.argsort(corners, axis=1, kind="stable"),
            slots(np.sort(corners, axis=1), SIDES),
            roots,
            slots(samples.corners, near),
            np.stack([samples.weights[:, i] * samples.weights[:, j] for i, j in near], axis=1),
        )


def _pairs(corners: Ints) -> Ints:
    """Return the pairs of vertices of elements (E, 4), lower index first, shape (10 E, 2)."""
    ordered = np.sort(corners, axis=1)
    return np.concatenate([ordered[:, side] for side in SIDES])
