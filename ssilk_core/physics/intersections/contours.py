# SPDX-License-Identifier: Apache-2.0
"""Contours along which a garment intersects itself, as an energy that draws cloth out of cloth.

Two triangles that intersect have a segment in common, and these segments are the contours. Where a vertex has come
through other cloth is not seen there, but the contour is, and cloth that leaves the other by the shortest way
shortens it. With a line tension [N] its length is a potential (Volino and Magnenat-Thalmann, "Resolving Surface
Collisions through Intersection Contour Minimization", 2006).

A segment ends where an edge of one triangle crosses the other. Such an end r slides along its edge e as the plane of
the face, with normal n, moves: a force g on it is g - (g.e / n.e) n on the edge, and the opposite of the last part on
the face. Where the edge is almost in that plane, this has no bound, so |n.e| counts as `STEEPEST` |n||e| at least.

Pairs do not count where `intersections.cloth` allows them, where they have a common vertex, and where all corners are
pinned or tight: these follow skin, which leaves no room where it folds.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ...scene.assets import LOOSE, Ints
from ...scene.mesh.topology import merged_places
from .. import kernels
from .cloth import ClothIntersections
from .figures import EVERY

STEEPEST = 0.2  # sine of the angle between an edge and a face, from which on the end of a contour slides freely


class IntersectionContours:
    """The contours of a garment; positions are (V, 3, N).

    Args:
        cloth: the garment, and what may intersect.
        classes: of its vertices, shape (V,).
        tension: of the contours [N].
    """

    def __init__(self, cloth: ClothIntersections, classes: Ints, tension: float, device: torch.device) -> None:
        mesh = cloth.mesh
        self.cloth, self.tension = cloth, tension
        # Near triangles are neighbours in the order of a curve that fills space.
        order = _spatial_order(mesh.points[mesh.faces].mean(axis=1))
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        first, second = np.divmod(cloth.allowed, len(order))
        renamed = np.sort(place[np.column_stack([first, second])], axis=1)
        allowed = np.unique(renamed[:, 0] * len(order) + renamed[:, 1])
        faces = mesh.faces[order]

        def tensor(values: np.ndarray, kind: torch.dtype = torch.int32) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(values), dtype=kind, device=device)

        self._faces, self._places = tensor(faces), tensor(merged_places(mesh.points)[faces])
        self._moves = tensor((classes[faces] == LOOSE).any(axis=1))
        self._allowed = tensor(allowed if len(allowed) else np.array([-1]), torch.int64)
        self._place = place

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy of the contours [J], shape (N,), whose mean is that of one frame in `EVERY`.

        Only these frames are searched. They stand for the others, which have zero.
        """
        searched, found = x[..., ::EVERY].contiguous(), x.new_zeros(x.shape[-1])
        found[::EVERY] = x.shape[-1] / searched.shape[-1] * self.tension * self.lengths(searched)
        return found

    def lengths(self, x: Tensor) -> Tensor:
        """Return the length of the contours in each frame [m], shape (N,), with a gradient."""
        if kernels.supports(x):
            return _Lengths.apply(x, self._faces, self._places, self._moves, self._allowed)
        frame, corners = self._found(x)
        found = x.new_zeros(x.shape[-1])
        if not len(frame):
            return found + 0 * x.sum()
        at = x[corners, :, frame[:, None, None]]  # (P, 2, 3, 3)
        return found.index_add(0, frame, segment_lengths(at[:, 0], at[:, 1]))

    def _found(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the frames (P,) and corners (P, 2, 3) of the pairs that count."""
        faces, moves, places = (values.cpu().numpy() for values in (self._faces, self._moves, self._places))
        frames, pairs = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)]
        for number, points in enumerate(x.detach().permute(2, 0, 1).double().cpu().numpy()):
            if np.isfinite(points).all():
                own = self._place[self.cloth.pairs(points)]
                apart = (places[own[:, 0], :, None] != places[own[:, 1], None]).all(axis=(1, 2))
                own = own[apart & moves[own].any(axis=1).astype(bool)]
                frames.append(np.full(len(own), number))
                pairs.append(own)
        joined = faces[np.concatenate(pairs)].astype(np.int64)
        return (torch.as_tensor(values, device=x.device) for values in (np.concatenate(frames), joined))  # type: ignore[return-value]


class _Lengths(Function):
    @staticmethod
    def forward(ctx, x, faces, places, moves, allowed):
        from ..kernels.contours import contours_kernel

        lengths, gradient = contours_kernel(x.detach(), faces, places, moves, allowed, STEEPEST)
        ctx.save_for_backward(gradient)
        return lengths

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return ctx.saved_tensors[0] * upstream, *[None] * 4


def segment_lengths(first: Tensor, second: Tensor, steepest: float = STEEPEST) -> Tensor:
    """Return the length of what pairs of triangles have in common [m], shape (P,); 0 unless it is a segment.

    Args:
        first, second: corners, shape (P, 3 corners, 3).
        steepest: as `STEEPEST`; 0 for the exact gradient.
    """
    ends, inside = [], []
    for edges, faces in ((first, second), (second, first)):
        for corner in range(3):
            end, hit = _crossing(edges[:, corner], edges[:, (corner + 1) % 3], faces, steepest)
            ends.append(end)
            inside.append(hit)
    points, hits = torch.stack(ends, dim=1), torch.stack(inside, dim=1)
    whole = hits.sum(1) == 2
    rows = torch.arange(len(first), device=first.device)
    one, other = hits.int().argmax(1), 5 - hits.flip(1).int().argmax(1)
    apart = points[rows, one] - points[rows, other]
    return torch.where(whole, (torch.where(whole[:, None], apart, 1.0)).norm(dim=1), 0.0)


def _crossing(start: Tensor, end: Tensor, face: Tensor, steepest: float) -> tuple[Tensor, Tensor]:
    """Return where edges meet the planes of faces (P, 3), and whether within both (P,)."""
    origin, p, q = face[:, 0], face[:, 1] - face[:, 0], face[:, 2] - face[:, 0]
    normal, edge = torch.linalg.cross(p, q), end - start
    height, after = ((start - origin) * normal).sum(1), ((end - origin) * normal).sum(1)
    through = (height > 0) != (after > 0)
    span = torch.where(through, height - after, 1.0)
    share = (height / span).detach()
    r = start - origin + share[:, None] * edge
    square = (normal * normal).sum(1).clamp_min(torch.finfo(r.dtype).tiny)
    u = ((torch.linalg.cross(r, q) * normal).sum(1) / square).detach()
    v = ((torch.linalg.cross(p, r) * normal).sum(1) / square).detach()
    inside = through & (u >= 0) & (v >= 0) & (u + v <= 1)
    # The end slides along the edge by as much as its material point leaves that of the face.
    least = steepest * (normal.norm(dim=1) * edge.norm(dim=1)).detach()
    slope = -span.detach()
    slope = torch.where(slope < 0, -1.0, 1.0) * slope.abs().maximum(least)
    leaves = ((r - u[:, None] * p - v[:, None] * q) * normal.detach()).sum(1)
    slid = (leaves - leaves.detach()) / torch.where(inside, slope, 1.0)
    return origin + r - slid[:, None] * edge.detach(), inside


def _spatial_order(points: np.ndarray) -> np.ndarray:
    """Return the order of points (P, 3) along a Z-order curve, shape (P,)."""
    low = points.min(axis=0)
    cells = ((points - low) / max(1e-12, float(np.ptp(points, axis=0).max())) * 1023).astype(np.int64)
    key = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")
