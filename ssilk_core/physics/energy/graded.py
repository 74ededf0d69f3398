# SPDX-License-Identifier: Apache-2.0
"""The rest shape of a garment's energies, moved in place: a garment that is graded to bodies, while it learns.

A `GarmentEnergy` is made of the rest shape in numpy, once. Here its numbers are made again on its device, for other
rest points of the same topology, and copied into the tensors that it has: a captured CUDA graph reads these where
they were, and nothing waits for the device. They are what a new `GarmentEnergy` has, with two exceptions. Samples
stay at the places in their triangles that they have on the first body, and stitches between the vertices that they
join there.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh import topology
from ...scene.mesh.topology import SLIVER
from ..operators import Entries, csr
from .bending import dihedral_angles
from .garment import GarmentEnergy
from .stretch import gradient_places, stiffened

TINY = 1e-60  # [m2], under which nothing is divided by an area or a squared length


class GradedRest:
    """Gives an energy the rest shape of a garment on any body of a family, in place.

    Args:
        energy: of `mesh`, which nothing else may use that needs the first body.
        mesh: at rest on the first body.
        moves: how far a unit along each direction of the family moves the vertices [m], shape (K, V, 3).
    """

    def __init__(self, energy: GarmentEnergy, mesh: Mesh, moves: Floats) -> None:
        self.energy, device = energy, energy.mass.device

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(np.array(values), device=device)

        self.points, self.moves = tensor(mesh.points), tensor(moves)
        self.faces = tensor(mesh.faces)
        hinges = topology.hinges(mesh.faces) if energy.fabric.bending else np.zeros((0, 4), dtype=np.int64)
        self.hinges = tensor(hinges)
        self.stiffness = tensor(stiffened(np.ones(len(mesh.faces)), mesh, mesh.faces))
        self.hinge_stiffness = tensor(stiffened(np.ones(len(hinges)), mesh, hinges[:, [0, 1, 2, 0, 1, 3]]))
        self.vertex_areas = self._sums(np.repeat(np.arange(len(mesh.faces)), 3), mesh.faces.reshape(-1), 1 / 3)
        self.samples = self._sample_areas(energy.cloth.stiffness)
        self.entries = Entries(*gradient_places(mesh), device)

    @torch.no_grad()
    def wear(self, place: Tensor) -> None:
        """Take the rest shape on the body at coordinates (K,)."""
        self.take(self.points + torch.tensordot(place.double(), self.moves, 1))

    @torch.no_grad()
    def take(self, points: Tensor) -> None:
        """Take the rest shape with points (V, 3) [m], in double precision."""
        energy, fabric = self.energy, self.energy.fabric
        a, b, c = points[self.faces].unbind(1)
        normal = torch.linalg.cross(b - a, c - a, dim=1)
        face_areas = normal.norm(dim=1) / 2
        vertex_areas = (self.vertex_areas @ face_areas[:, None])[:, 0]
        weights, areas = _column_weights(a, b, c, normal), self._stretched_areas(a, b, c, face_areas)
        energy.area.copy_(areas[:, None])
        energy.mass.copy_(fabric.density * vertex_areas)
        energy.tether_stiffness.copy_(fabric.tether * vertex_areas[energy.tethered])
        self.entries.fill(energy.gradient_operator, weights.permute(2, 0, 1).reshape(-1))
        if self.samples is not None:
            energy.cloth.area.copy_(self.samples @ face_areas[:, None])
        if len(self.hinges):
            energy.bending_stiffness.copy_((fabric.bending * self._hinge_shapes(points))[:, None])
            rest = points.to(energy.rest_angle.dtype)[:, :, None]
            energy.rest_angle.copy_(dihedral_angles(*energy.hinge_operator(rest).chunk(3)))
        energy.tables.take(weights, areas, torch.hstack([energy.bending_stiffness, energy.rest_angle]))
        if energy.stitching:
            energy.stitching.take(points, fabric.stitch * vertex_areas)

    def _sums(self, faces: Ints, rows: Ints, shares: Floats | float, count: int | None = None) -> Tensor:
        """Return the matrix that sums shares of areas of faces (E,) into rows (E,), in double precision."""
        order = np.argsort(rows, kind="stable")
        shares = np.broadcast_to(np.asarray(shares, dtype=np.float64), rows.shape)
        found = (torch.as_tensor(np.ascontiguousarray(each[order])) for each in (rows, faces, shares))
        size = (len(self.points) if count is None else count, len(self.faces))
        row, column, share = (each.to(self.points.device) for each in found)
        return csr(row, column, share, size)

    def _sample_areas(self, stiffness: Floats | None) -> Tensor | None:
        """Return the matrix from areas of faces to those of samples; None where these count vertices."""
        samples = self.energy.cloth.samples
        if samples.faces is None:
            return None
        faces, inner = self.faces.cpu().numpy(), samples.faces
        divided = np.bincount(inner, minlength=len(faces))  # samples of each triangle, n^2
        corner = 1 / (1 + 3 * divided)
        rows = np.concatenate([faces.reshape(-1), samples.vertex_count + np.arange(len(inner))])
        of = np.concatenate([np.repeat(np.arange(len(faces)), 3), inner])
        shares = np.concatenate([np.repeat(corner / 3, 3), ((1 - corner) / divided)[inner]])
        if stiffness is not None:
            shares = shares * stiffness[rows]
        return self._sums(of, rows, shares, len(samples.area))

    def _stretched_areas(self, a: Tensor, b: Tensor, c: Tensor, areas: Tensor) -> Tensor:
        """Return what `stretch.stretched_areas` does."""
        longest = torch.stack([((one - other) ** 2).sum(1) for one, other in ((a, c), (b, a), (c, b))]).amax(0)
        slim = (SLIVER * 2 * areas / longest.clamp_min(TINY)).clamp_max(1)
        return areas * slim**3 * self.stiffness

    def _hinge_shapes(self, points: Tensor) -> Tensor:
        """Return what `garment._hinge_shapes` does."""
        x0, x1, left, right = points[self.hinges].unbind(1)
        edge = x1 - x0
        squared = (edge * edge).sum(1)
        doubled = [torch.linalg.cross(edge, tip - x0, dim=1).norm(dim=1) for tip in (left, right)]
        slim = (SLIVER * torch.minimum(*doubled) / squared.clamp_min(TINY)).clamp_max(1)
        below = sum(torch.maximum(each, squared / SLIVER) for each in doubled)
        return slim**2 * squared / (4 * below) * self.hinge_stiffness


def _column_weights(a: Tensor, b: Tensor, c: Tensor, normal: Tensor) -> Tensor:
    """Return what `stretch.column_weights` does, (F, 3, 2)."""
    first, second = b - a, c - a
    normal = normal / normal.norm(dim=1, keepdim=True).clamp_min(sqrt(TINY))
    axes = torch.eye(3, dtype=normal.dtype, device=normal.device)
    along = torch.where(normal[:, 1:2].abs() < 0.99, axes[1], axes[0])
    u = torch.linalg.cross(along, normal, dim=1)
    u = u / u.norm(dim=1, keepdim=True)
    v = torch.linalg.cross(normal, u, dim=1)
    (p, q), (r, s) = (((first * axis).sum(1), (second * axis).sum(1)) for axis in (u, v))
    inverse = torch.stack([s, -q, -r, p], dim=1).reshape(-1, 2, 2) / (p * s - q * r)[:, None, None]
    return torch.cat([-inverse.sum(1, keepdim=True), inverse], dim=1)
