# SPDX-License-Identifier: Apache-2.0
"""The smoothed distance to a body's surface; reference: `collision.smoothed_distance`.

Each query goes through groups of triangles, then through those of groups within reach, and keeps the ones that it
finds until all are known. Numbers are float64, whatever the precision of positions.
"""

from __future__ import annotations

from math import exp, log, sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

GROUP = 16  # consecutive triangles with one bounding sphere
ROUNDING = 1 + 1e-6  # by which spheres are larger than what they hold
LEAST_RATIO = 0.69  # of two distances, whose power is below the resolution of float64
TINY = 1e-300


def smoothed_distance_loop(
    x: Tensor,
    search_radius: Tensor,
    points: Tensor,
    normals: Tensor,
    faces: Tensor,
    candidates: Tensor | None,
    bounds: tuple[NDArray, NDArray],
    *,
    reach: float,
    max_distance: float,
    deep_cosine: float,
    surface_epsilon: float,
    exponent: float,
    search_margin: float,
    edge_epsilon: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return which queries have a triangle within reach (V, N), gradients (V, 3, N), offsets (V, N) and curvatures
    (V, 3, 3, N), as `collision.smoothed_distance.smoothed_distance` does.

    Arguments are those of that function, and limits as for `kernels.smoothed_distance.smoothed_distance_kernel`.

    Args:
        bounds: of the body, as `sphere_bounds` returns them.
    """
    rows, _, frames = x.shape
    found, normal, offset = (
        torch.zeros(rows, frames, dtype=torch.bool),
        torch.zeros_like(x),
        x.new_zeros(rows, frames),
    )
    curvature = x.new_zeros(rows, 3, 3, frames, dtype=torch.float32)
    listed = faces.new_zeros(0, 0) if candidates is None else candidates
    body = array(points), array(faces), array(normals)
    given = array(x), array(search_radius), *body, array(listed), *bounds
    limits = reach, max_distance, deep_cosine, surface_epsilon, exponent, 1 + search_margin, edge_epsilon
    out = found.numpy(), normal.numpy(), offset.numpy(), curvature.numpy()
    run_parts(_search, rows, *given, candidates is not None, *limits, *out)
    return found, normal, offset, curvature


def sphere_bounds(points: Tensor, faces: Tensor) -> tuple[NDArray, NDArray]:
    """Return centres and radii of spheres around triangles (N, F, 4) and around groups of them (N, G, 4).

    Args:
        points: of a body (B, 3, N); faces: (F, 3).
    """
    spheres = np.empty((points.shape[2], len(faces), 4))
    groups = np.empty((points.shape[2], -(-len(faces) // GROUP), 4))
    run_parts(_bound, points.shape[2], array(points), array(faces), spheres, groups)
    return spheres, groups


@compiled
def _bound(points, faces, spheres, groups, start, stop):
    """Write centres and radii of spheres around triangles (N, F, 4) and around groups of them (N, G, 4)."""
    for frame in range(start, stop):
        for face in range(len(faces)):
            i, j, k = faces[face]
            radius = 0.0
            for axis in range(3):
                total = np.float64(points[i, axis, frame]) + points[j, axis, frame] + points[k, axis, frame]
                spheres[frame, face, axis] = total / 3
            for corner in range(3):
                square = 0.0
                for axis in range(3):
                    square += (points[faces[face, corner], axis, frame] - spheres[frame, face, axis]) ** 2
                radius = max(radius, square)
            spheres[frame, face, 3] = sqrt(radius)
        for group in range(groups.shape[1]):
            first, last = group * GROUP, min(group * GROUP + GROUP, len(faces))
            own = groups[frame, group]
            own[:] = 0
            for face in range(first, last):
                for axis in range(3):
                    own[axis] += spheres[frame, face, axis] / (last - first)
            for face in range(first, last):
                square = 0.0
                for axis in range(3):
                    square += (spheres[frame, face, axis] - own[axis]) ** 2
                own[3] = max(own[3], sqrt(square) + spheres[frame, face, 3])


@compiled
def _meets(sphere, x, y, z, reach):
    dx, dy, dz, apart = x - sphere[0], y - sphere[1], z - sphere[2], (sphere[3] + reach) * ROUNDING
    return dx * dx + dy * dy + dz * dz <= apart * apart


@compiled
def _share(part, whole):
    return min(max(part / max(whole, TINY), 0.0), 1.0)


@compiled
def _closest(points, faces, face, frame, x, y, z, own):
    """Write the direction away from a triangle, barycentric coordinates s and t, and the distance into `own` (6,)."""
    i, j, k = faces[face]
    ax, ay, az = points[i, 0, frame], points[i, 1, frame], points[i, 2, frame]
    ux, uy, uz = (
        np.float64(points[j, 0, frame]) - ax,
        np.float64(points[j, 1, frame]) - ay,
        np.float64(points[j, 2, frame]) - az,
    )
    wx, wy, wz = (
        np.float64(points[k, 0, frame]) - ax,
        np.float64(points[k, 1, frame]) - ay,
        np.float64(points[k, 2, frame]) - az,
    )
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
    a, b, c = ux * ux + uy * uy + uz * uz, ux * wx + uy * wy + uz * wz, wx * wx + wy * wy + wz * wz
    determinant = max(a * c - b * b, TINY)
    s, t = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
    if not (s >= 0 and t >= 0 and s + t <= 1):
        s, t = 0.0, 0.0
    best = min(s * (s * a - 2 * d1) + t * (t * c - 2 * d2) + 2 * s * t * b, 0.0)
    alone = _share(d1, a)
    value = alone * (alone * a - 2 * d1)
    if value < best:
        s, t, best = alone, 0.0, value
    alone = _share(d2, c)
    value = alone * (alone * c - 2 * d2)
    if value < best:
        s, t, best = 0.0, alone, value
    alone = _share(d2 - d1 - b + a, a - 2 * b + c)
    value = a - 2 * d1 + alone * (alone * (a - 2 * b + c) - 2 * (d2 - d1 - b + a))
    if value < best:
        s, t = 1 - alone, alone
    px, py, pz = px - s * ux - t * wx, py - s * uy - t * wy, pz - s * uz - t * wz
    r = max(sqrt(px * px + py * py + pz * pz), TINY)
    own[0], own[1], own[2], own[3], own[4], own[5] = px / r, py / r, pz / r, s, t, r


@compiled
def _search(x, search_radius, points, faces, normals, listed, spheres, groups, uses_list, reach, max_distance,
            deep_cosine, surface_epsilon, exponent, search_margin, edge_epsilon, found, normal, offset, curvature,
            start, stop):  # fmt: skip
    known, near = np.empty((len(faces), 6)), np.empty(len(faces), np.int64)
    mean, gradient, square, unit = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    edge, position = np.empty(3), np.empty(3)
    weights, corners = np.empty(3), np.empty(3, np.int64)
    for row in range(start, stop):
        for frame in range(x.shape[2]):
            if not search_radius[row, frame] >= 0:
                continue
            searched = search_radius[row, frame] * search_margin
            for axis in range(3):
                position[axis] = x[row, axis, frame]
            px, py, pz = position
            count, best = 0, 0
            if uses_list:
                for place in range(listed.shape[1]):
                    face = listed[row, place]
                    if face >= 0 and _meets(spheres[frame, face], px, py, pz, searched):
                        near[count] = face
                        count += 1
            else:
                for group in range(groups.shape[1]):
                    if _meets(groups[frame, group], px, py, pz, searched):
                        for face in range(group * GROUP, min(group * GROUP + GROUP, len(faces))):
                            if _meets(spheres[frame, face], px, py, pz, searched):
                                near[count] = face
                                count += 1
            for place in range(count):
                _closest(points, faces, near[place], frame, px, py, pz, known[place])
                if known[place, 5] < known[best, 5]:
                    best = place
            if count == 0 or not (known[best, 5] < reach and known[best, 5] <= searched):
                continue
            nearest = known[best, 5]
            total = 0.0
            mean[:], gradient[:], square[:] = 0, 0, 0
            for place in range(count):
                ratio = nearest / known[place, 5]
                if ratio < LEAST_RATIO:
                    continue
                weight = exp(exponent * log(ratio))
                total += weight
                for axis in range(3):
                    mean[axis] += weight * known[place, axis]
                    gradient[axis] += weight / known[place, 5] * known[place, axis]
                    for other in range(3):
                        square[axis, other] += weight * known[place, axis] * known[place, other]
            distance = nearest * exp(-log(total) / exponent)

            s, t = known[best, 3], known[best, 4]
            weights[0], weights[1], weights[2] = 1 - s - t, s, t
            corners[:] = faces[near[best]]
            length, height, empty = 0.0, 0.0, 0
            for axis in range(3):
                unit[axis] = 0.0
                for corner in range(3):
                    unit[axis] += weights[corner] * normals[corners[corner], axis, frame]
                length += unit[axis] * unit[axis]
            length = max(sqrt(length), 1e-8)
            for axis in range(3):
                unit[axis] /= length
                height += nearest * known[best, axis] * unit[axis]
            inside = height < -deep_cosine * nearest * min(nearest / max_distance, 1.0)
            touches = nearest <= surface_epsilon
            sign = -1.0 if inside else 1.0
            distance = sign * (nearest if touches else distance)

            edge[:] = 0
            for corner in range(3):
                if weights[corner] <= edge_epsilon:
                    empty += 1
            if empty == 1:  # the edge opposite of the corner that is out of reach
                length = 0.0
                for corner in range(3):
                    if weights[corner] <= edge_epsilon:
                        for axis in range(3):
                            one, other = corners[(corner + 1) % 3], corners[(corner + 2) % 3]
                            edge[axis] = np.float64(points[one, axis, frame]) - points[other, axis, frame]
                            length += edge[axis] * edge[axis]
                edge /= max(sqrt(length), TINY)
            product = 0.0
            for axis in range(3):
                slope = unit[axis] if touches else sign * gradient[axis] * (distance * sign / total)
                normal[row, axis, frame] = slope
                product += slope * position[axis]
                for other in range(3):
                    bent = 0.0
                    if not touches and inside and empty > 0:
                        bent = -known[best, axis] * known[best, other] - edge[axis] * edge[other]
                        bent = (bent + (1.0 if axis == other else 0.0)) / nearest
                    elif not touches and not inside:
                        bent = square[axis, other] / total - mean[axis] * mean[other] / (total * total)
                        bent *= (exponent + 1) / distance
                    curvature[row, axis, other, frame] = bent
            found[row, frame] = True
            offset[row, frame] = product - distance
