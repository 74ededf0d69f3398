# SPDX-License-Identifier: Apache-2.0
"""Where segments cross triangles; reference: `collision.ray_casting.RayCaster.crossings`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

# A crossing lies outside of its triangle by at most this many times the tolerance and the rounding error, relative to
# the triangle's size; segments whose boxes do not reach so far are not looked at.
WIDENED, ROUNDING = 4.0, 1e-9


def crossings_loop(
    starts: Tensor, ends: Tensor, x: Tensor, faces: Tensor, edge_tolerance: float
) -> tuple[Tensor, Tensor]:
    """Return how many triangles each segment crosses, and which is the last along it, zero without a crossing.

    Args:
        starts, ends: of the segments (P, 3, N); x: vertices (V, 3, N); faces: triangles (F, 3).
        edge_tolerance: by how much a barycentric coordinate may be negative.

    Returns:
        Counts and indices, int64, both (P, N).
    """
    segments, _, frames = starts.shape
    counts, last = torch.zeros(2, segments, frames, dtype=torch.int64).unbind()
    given = array(starts.double()), array(ends.double()), array(x), array(faces)
    run_parts(_crossings, segments, *given, edge_tolerance, counts.numpy(), last.numpy())
    return counts, last


@compiled
def _crossings(starts, ends, x, faces, edge_tolerance, counts, last, start, stop):
    low, high = np.empty((len(faces), 3)), np.empty((len(faces), 3))  # boxes of triangles, somewhat widened
    for n in range(starts.shape[2]):
        for f in range(len(faces)):
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            widest = 0.0
            for axis in range(3):
                a, b, c = np.float64(x[i, axis, n]), np.float64(x[j, axis, n]), np.float64(x[k, axis, n])
                low[f, axis], high[f, axis] = min(a, b, c), max(a, b, c)
                widest = max(widest, high[f, axis] - low[f, axis])
            for axis in range(3):
                low[f, axis] -= WIDENED * (edge_tolerance + ROUNDING) * widest
                high[f, axis] += WIDENED * (edge_tolerance + ROUNDING) * widest
        for p in range(start, stop):
            ox, oy, oz = starts[p, 0, n], starts[p, 1, n], starts[p, 2, n]
            dx, dy, dz = ends[p, 0, n] - ox, ends[p, 1, n] - oy, ends[p, 2, n] - oz
            left, right = min(ox, ox + dx), max(ox, ox + dx)
            below, above = min(oy, oy + dy), max(oy, oy + dy)
            back, front = min(oz, oz + dz), max(oz, oz + dz)
            farthest = -1.0
            for f in range(len(faces)):
                if low[f, 0] > right or high[f, 0] < left or low[f, 1] > above or high[f, 1] < below:
                    continue
                if low[f, 2] > front or high[f, 2] < back:
                    continue
                i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
                sx, sy, sz = ox - x[i, 0, n], oy - x[i, 1, n], oz - x[i, 2, n]
                ux, uy, uz = sx + x[j, 0, n] - ox, sy + x[j, 1, n] - oy, sz + x[j, 2, n] - oz
                wx, wy, wz = sx + x[k, 0, n] - ox, sy + x[k, 1, n] - oy, sz + x[k, 2, n] - oz
                ax, ay, az = dy * wz - dz * wy, dz * wx - dx * wz, dx * wy - dy * wx
                tx, ty, tz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
                determinant = ux * ax + uy * ay + uz * az
                u, v = sx * ax + sy * ay + sz * az, dx * tx + dy * ty + dz * tz
                share = wx * tx + wy * ty + wz * tz
                if determinant < 0:
                    determinant, u, v, share = -determinant, -u, -v, -share
                slack = edge_tolerance * determinant
                inside = u >= -slack and v >= -slack and u + v <= determinant + slack
                if inside and determinant > 0 and 0 <= share <= determinant:  # not where parallel
                    counts[p, n] += 1
                    if share / determinant > farthest:
                        farthest = share / determinant
                        last[p, n] = f
