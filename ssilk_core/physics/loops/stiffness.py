# SPDX-License-Identifier: Apache-2.0
"""Hessian blocks of faces, hinges, samples and single vertices; reference: `simulate.hessian.Hessian`.

A loop owns some frames, and adds up all elements of a frame in order, in float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.fabrics import Fabric
from .compiling import compiled
from .running import array, run_parts

TINY = 1e-18  # as in `simulate.hinges`
MIN_SQUARED_LENGTH = 1e-12  # as in `simulate.membrane`


@dataclass(frozen=True, eq=False)
class StiffnessTables:
    """Elements, and where their blocks are stored: -1 for those that are not.

    Attributes:
        faces: vertices in ascending order (F, 3); face_slots: of their pairs 00, 01, 02, 11, 12, 22, shape (F, 6).
        face_numbers: weights of the corners in both columns of F, then the area, shape (F, 7).
        hinges: vertices (H, 4); order: their places in ascending order (H, 4); hinge_slots: of pairs in that order
            00, 01, 02, 03, 11, ..., 33, shape (H, 10); roots: sqrt(2 k) [J^1/2], shape (H,).
        sample_slots: of the corners' pairs, as of faces (S, 6); sample_weights: products of their weights (S, 6).
    """

    faces: NDArray
    face_slots: NDArray
    face_numbers: NDArray
    hinges: NDArray
    order: NDArray
    hinge_slots: NDArray
    roots: NDArray
    sample_slots: NDArray
    sample_weights: NDArray


def stiffness_loop(
    x: Tensor,
    tables: StiffnessTables,
    fabric: Fabric,
    stored: int,
    weight: Tensor,
    contact: Tensor | None,
    exact_hessian: Tensor | None,
) -> Tensor:
    """Return the blocks (stored, 3, 3, N) at positions x (V, 3, N); other arguments are those of `Hessian`."""
    frames, blocks = x.shape[2], x.new_empty(stored, 3, 3, x.shape[2])
    given = x.new_zeros(0, 3, 3, frames) if contact is None else contact.float()
    exact = torch.zeros(frames, dtype=torch.bool) if exact_hessian is None else exact_hessian
    woven = fabric.stretch_model != "stvk"
    moduli = (fabric.stretch, fabric.shear) if woven else (fabric.lame_mu, fabric.lame_lambda)
    elements = (tables.faces, tables.face_slots, tables.face_numbers, tables.hinges, tables.order,
                tables.hinge_slots, tables.roots, tables.sample_slots, tables.sample_weights)  # fmt: skip
    numbers = array(x), *elements, *map(float, moduli), woven, array(weight.expand(-1, frames))
    run_parts(_stiffness, frames, *numbers, array(given), array(exact), blocks.numpy())
    return blocks


@compiled
def _stiffness(x, faces, face_slots, face_numbers, hinges, order, hinge_slots, roots, sample_slots, sample_weights,
               first, second, woven, weight, contact, exact, blocks, start, stop):  # fmt: skip
    total = np.empty((len(blocks), 9))
    for n in range(start, stop):
        total[:] = 0
        for v in range(len(weight)):
            total[v, 0] = total[v, 4] = total[v, 8] = weight[v, n]
        _add_faces(x, faces, face_slots, face_numbers, first, second, woven, exact[n], n, total)
        _add_hinges(x, hinges, order, hinge_slots, roots, n, total)
        for sample in range(len(contact)):
            for pair in range(6):
                slot, share = sample_slots[sample, pair], sample_weights[sample, pair]
                if slot >= 0 and share != 0:
                    for a in range(3):
                        for b in range(3):
                            total[slot, 3 * a + b] += share * contact[sample, a, b, n]
        for slot in range(len(blocks)):
            for a in range(3):
                for b in range(3):
                    blocks[slot, a, b, n] = total[slot, 3 * a + b]


@compiled
def _stresses(uu, uv, vv, first, second, woven):
    """Entries of the second Piola-Kirchhoff stress, and a, b, c, d of the material part (`simulate.membrane`)."""
    if woven:
        length_u, length_v = sqrt(max(uu, MIN_SQUARED_LENGTH)), sqrt(max(vv, MIN_SQUARED_LENGTH))
        s_uu, s_vv = 2 * first * (1 - 1 / length_u), 2 * first * (1 - 1 / length_v)
        a, c = 2 * first / (length_u * length_u * length_u), 2 * first / (length_v * length_v * length_v)
        return s_uu, 2 * second * uv, s_vv, a, 2 * second, c, 0.0
    trace, along = 0.5 * second * (uu + vv - 2), 2 * first + second
    return first * (uu - 1) + trace, first * uv, first * (vv - 1) + trace, along, first, along, second


@compiled
def _add_faces(x, faces, slots, numbers, first, second, woven, exact, n, total):
    u, v = np.empty(3), np.empty(3)
    for face in range(len(faces)):
        i, j, k = faces[face]
        uj, uk, vj, vk = numbers[face, 1], numbers[face, 2], numbers[face, 4], numbers[face, 5]
        uu, uv, vv = 0.0, 0.0, 0.0
        for axis in range(3):
            base = np.float64(x[i, axis, n])
            p, q = x[j, axis, n] - base, x[k, axis, n] - base
            u[axis], v[axis] = uj * p + uk * q, vj * p + vk * q
            uu, uv, vv = uu + u[axis] * u[axis], uv + u[axis] * v[axis], vv + v[axis] * v[axis]
        s_uu, s_uv, s_vv, a, b, c, d = _stresses(uu, uv, vv, first, second, woven)
        if not exact:  # the nearest positive semi-definite one, with eigenvalues mean +- r clamped at zero
            mean, half = 0.5 * (s_uu + s_vv), 0.5 * (s_uu - s_vv)
            r = sqrt(half * half + s_uv * s_uv)
            low, high = max(mean - r, 0.0), max(mean + r, 0.0)
            mean, slope = 0.5 * (high + low), 0.5 * (high - low) / max(r, 1e-300)
            s_uu, s_uv, s_vv = mean + slope * half, slope * s_uv, mean - slope * half
        area, pair = numbers[face, 6], 0
        for one in range(3):
            for other in range(one, 3):
                slot = slots[face, pair]
                pair += 1
                if slot < 0:
                    continue
                ui, vi = area * numbers[face, one], area * numbers[face, 3 + one]
                uo, vo = numbers[face, other], numbers[face, 3 + other]
                p, q, r, s = ui * uo, ui * vo, vi * uo, vi * vo
                same = p * s_uu + (q + r) * s_uv + s * s_vv
                by_uu, by_vv = p * a + s * b, p * b + s * c
                by_uv, by_vu = q * d + r * b, q * b + r * d
                for row in range(3):
                    for column in range(3):
                        total[slot, 3 * row + column] += (
                            by_uu * u[row] * u[column]
                            + by_vv * v[row] * v[column]
                            + by_uv * u[row] * v[column]
                            + by_vu * v[row] * u[column]
                        )
                    total[slot, 4 * row] += same


@compiled
def _add_hinges(x, hinges, order, slots, roots, n, total):
    slopes = np.empty((4, 3))
    e, f, g, m, k = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for hinge in range(len(hinges)):
        o, i, j, h = hinges[hinge]
        for axis in range(3):
            base = np.float64(x[o, axis, n])
            e[axis], f[axis], g[axis] = x[i, axis, n] - base, x[j, axis, n] - base, x[h, axis, n] - base
        m[0], m[1], m[2] = e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]
        k[0], k[1], k[2] = g[1] * e[2] - g[2] * e[1], g[2] * e[0] - g[0] * e[2], g[0] * e[1] - g[1] * e[0]
        square = max(e[0] * e[0] + e[1] * e[1] + e[2] * e[2], TINY)
        left, right = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], k[0] * k[0] + k[1] * k[1] + k[2] * k[2]
        least = max(1e-6 * square * square, TINY)
        if left * right < least * least:  # a hinge with a degenerate face has no gradient
            continue
        length = roots[hinge] * sqrt(square)
        foot_left = (e[0] * f[0] + e[1] * f[1] + e[2] * f[2]) / square
        foot_right = (e[0] * g[0] + e[1] * g[1] + e[2] * g[2]) / square
        for axis in range(3):
            tip_left, tip_right = -length * m[axis] / left, -length * k[axis] / right
            end = -(foot_left * tip_left + foot_right * tip_right)
            slopes[0, axis], slopes[1, axis] = -(end + tip_left + tip_right), end
            slopes[2, axis], slopes[3, axis] = tip_left, tip_right
        pair = 0
        for one in range(4):
            for other in range(one, 4):
                slot = slots[hinge, pair]
                pair += 1
                if slot >= 0:
                    p, q = slopes[order[hinge, one]], slopes[order[hinge, other]]
                    for row in range(3):
                        for column in range(3):
                            total[slot, 3 * row + column] += p[row] * q[column]
