# SPDX-License-Identifier: Apache-2.0
"""Stretch and bending energies; reference: `GarmentEnergy.stretch` and `.bending`.

A loop owns a block of frames and adds up all triangles and hinges in order. With a gradient it adds up both
energies' gradients in the same pass, for the backward pass to weight.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ...scene.fabrics import Fabric
from ..kernels.corners import ElasticTables
from .running import LANES, array, blocks_of, compiled, run_parts

HALF_PI, PI, TWO_PI = np.float32(np.pi / 2), np.float32(np.pi), np.float32(2 * np.pi)


def elastic_loop(x: Tensor, tables: ElasticTables, fabric: Fabric) -> tuple[Tensor, Tensor]:
    """Return stretch and bending [J] of positions x (V, 3, N), both (N,)."""
    return _Elastic.apply(x, tables, fabric)


class _Elastic(Function):
    @staticmethod
    def forward(ctx, x, tables, fabric):
        frames, wanted = x.shape[2], ctx.needs_input_grad[0]
        energy = torch.empty(2, frames)
        # The gradients of both energies; one vertex stands for all where they are not asked for.
        slopes = torch.empty(2, len(x) if wanted else 1, 3, frames)
        woven = fabric.stretch_model != "stvk"
        moduli = (fabric.stretch, fabric.shear) if woven else (fabric.lame_mu, fabric.lame_lambda)
        rest = (tables.faces, tables.face_numbers, tables.hinges, tables.hinge_numbers)
        numbers = (np.float32(modulus) for modulus in moduli)
        out = energy.numpy(), slopes.numpy()
        run_parts(_elastic, blocks_of(frames), array(x), *map(array, rest), *numbers, woven, wanted, *out)
        ctx.save_for_backward(slopes)
        return energy[0], energy[1]

    @staticmethod
    @once_differentiable
    def backward(ctx, to_stretch, to_bending):
        ((stretch, bending),) = ctx.saved_tensors
        return (stretch * to_stretch).addcmul_(bending, to_bending), None, None


@compiled
def _elastic(x, faces, face_numbers, hinges, hinge_numbers, first, second, woven, wanted, energy, slopes, start, stop):
    vertices, _, frames = x.shape
    held = vertices if wanted else 1
    here, stretch, bending = (
        np.empty((vertices, 3, LANES), np.float32),
        np.empty((held, 3, LANES), np.float32),
        np.empty((held, 3, LANES), np.float32),
    )
    for block in range(start, stop):
        first_frame = block * LANES
        count = min(LANES, frames - first_frame)
        for v in range(vertices):
            for axis in range(3):
                for n in range(LANES):
                    here[v, axis, n] = x[v, axis, first_frame + min(n, count - 1)]
        stretch[:], bending[:] = 0, 0
        _stretch(here, faces, face_numbers, first, second, woven, wanted, stretch, energy[0, first_frame:], count)
        _bending(here, hinges, hinge_numbers, wanted, bending, energy[1, first_frame:], count)
        for v in range(held):
            for axis in range(3):
                for n in range(count):
                    slopes[0, v, axis, first_frame + n] = stretch[v, axis, n]
                    slopes[1, v, axis, first_frame + n] = bending[v, axis, n]


@compiled
def _stretch(here, faces, numbers, first, second, woven, wanted, slope, energy, count):
    zero, one, half, two = np.float32(0), np.float32(1), np.float32(0.5), np.float32(2)
    total = np.zeros(LANES, np.float32)
    for face in range(len(faces)):
        a, b, c = here[faces[face, 0]], here[faces[face, 1]], here[faces[face, 2]]
        bu, bv, cu, cv = numbers[face, 0], numbers[face, 1], numbers[face, 2], numbers[face, 3]
        area = numbers[face, 4]
        if wanted:
            to_a, to_b, to_c = slope[faces[face, 0]], slope[faces[face, 1]], slope[faces[face, 2]]
        else:
            to_a, to_b, to_c = slope[0], slope[0], slope[0]
        for n in range(LANES):
            px, py, pz = b[0, n] - a[0, n], b[1, n] - a[1, n], b[2, n] - a[2, n]
            qx, qy, qz = c[0, n] - a[0, n], c[1, n] - a[1, n], c[2, n] - a[2, n]
            ux, uy, uz = bu * px + cu * qx, bu * py + cu * qy, bu * pz + cu * qz
            vx, vy, vz = bv * px + cv * qx, bv * py + cv * qy, bv * pz + cv * qz
            uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
            if woven:
                long_u, long_v = sqrt(max(uu, np.float32(1e-12))), sqrt(max(vv, np.float32(1e-12)))
                over_u, over_v = long_u - one, long_v - one
                density = first * (over_u * over_u + over_v * over_v) + second * uv * uv
                p = zero if uu < np.float32(1e-12) else two * first * over_u / long_u
                r = zero if vv < np.float32(1e-12) else two * first * over_v / long_v
                q = two * second * uv
            else:
                g_uu, g_uv, g_vv = half * (uu - one), half * uv, half * (vv - one)
                trace = g_uu + g_vv
                density = first * (g_uu * g_uu + g_vv * g_vv + two * g_uv * g_uv) + half * second * trace * trace
                pressure = second * trace
                p, q, r = two * first * g_uu + pressure, two * first * g_uv, two * first * g_vv + pressure
            total[n] += area * density
            if wanted:
                sx, sy, sz = area * (p * ux + q * vx), area * (p * uy + q * vy), area * (p * uz + q * vz)
                tx, ty, tz = area * (q * ux + r * vx), area * (q * uy + r * vy), area * (q * uz + r * vz)
                bx, by, bz = bu * sx + bv * tx, bu * sy + bv * ty, bu * sz + bv * tz
                cx, cy, cz = cu * sx + cv * tx, cu * sy + cv * ty, cu * sz + cv * tz
                to_b[0, n] += bx
                to_b[1, n] += by
                to_b[2, n] += bz
                to_c[0, n] += cx
                to_c[1, n] += cy
                to_c[2, n] += cz
                to_a[0, n] -= bx + cx
                to_a[1, n] -= by + cy
                to_a[2, n] -= bz + cz
    energy[:count] = total[:count]


@compiled
def _angle(y, x):
    """Angle of (x, y) != 0 to float32 rounding, without a branch."""
    low, high = min(abs(x), abs(y)), max(abs(x), abs(y))
    steep = low > np.float32(0.41421357) * high  # above pi/8: rotated by pi/4
    t = (low - high if steep else low) / (low + high if steep else high)
    s = t * t
    # Minimax fit of (atan(t)/t - 1)/t^2; the relative error of the angle is 2e-8.
    fit = ((np.float32(0.08060307) * s - np.float32(0.13879849)) * s + np.float32(0.19977926)) * s
    angle = (np.float32(0.78539816) if steep else np.float32(0)) + (t + t * s * (fit - np.float32(0.33332956)))
    angle = HALF_PI - angle if abs(y) > abs(x) else angle
    angle = PI - angle if x < np.float32(0) else angle
    return -angle if y < np.float32(0) else angle


@compiled
def _bending(here, hinges, numbers, wanted, slope, energy, count):
    """The hinge's angle has the gradients |e| n / |n|^2 at both tips; edge vertices share what balances these."""
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    total = np.zeros(LANES, np.float32)
    for hinge in range(len(hinges)):
        o, e = here[hinges[hinge, 0]], here[hinges[hinge, 1]]
        left, right = here[hinges[hinge, 2]], here[hinges[hinge, 3]]
        stiffness, rest = numbers[hinge, 0], numbers[hinge, 1]
        if wanted:
            to_o, to_e = slope[hinges[hinge, 0]], slope[hinges[hinge, 1]]
            to_l, to_r = slope[hinges[hinge, 2]], slope[hinges[hinge, 3]]
        else:
            to_o, to_e, to_l, to_r = slope[0], slope[0], slope[0], slope[0]
        for n in range(LANES):
            ox, oy, oz = o[0, n], o[1, n], o[2, n]
            ex, ey, ez = e[0, n] - ox, e[1, n] - oy, e[2, n] - oz
            lx, ly, lz = left[0, n] - ox, left[1, n] - oy, left[2, n] - oz
            rx, ry, rz = right[0, n] - ox, right[1, n] - oy, right[2, n] - oz
            mx, my, mz = ey * lz - ez * ly, ez * lx - ex * lz, ex * ly - ey * lx
            kx, ky, kz = ry * ez - rz * ey, rz * ex - rx * ez, rx * ey - ry * ex
            square = ex * ex + ey * ey + ez * ez
            length = sqrt(max(square, np.float32(1e-18)))
            sine = -(kx * lx + ky * ly + kz * lz) * length
            cosine = mx * kx + my * ky + mz * kz
            # As in the reference, a degenerate hinge counts as flat and has no gradient.
            collapsed = abs(sine) + abs(cosine) < max(np.float32(1e-6) * square * square, np.float32(1e-18))
            angle = _angle(zero if collapsed else sine, one if collapsed else cosine)
            change = angle - rest
            change -= (TWO_PI if change > PI else zero) - (TWO_PI if change < -PI else zero)
            total[n] += stiffness * change * change
            if wanted:
                pull = zero if collapsed else -two * stiffness * change
                at_l = pull * length / max(mx * mx + my * my + mz * mz, np.float32(1e-36))
                at_r = pull * length / max(kx * kx + ky * ky + kz * kz, np.float32(1e-36))
                over = one / max(square, np.float32(1e-18))
                by_l, by_r = (ex * lx + ey * ly + ez * lz) * over, (ex * rx + ey * ry + ez * rz) * over
                mx, my, mz, kx, ky, kz = at_l * mx, at_l * my, at_l * mz, at_r * kx, at_r * ky, at_r * kz
                to_l[0, n] += mx
                to_l[1, n] += my
                to_l[2, n] += mz
                to_r[0, n] += kx
                to_r[1, n] += ky
                to_r[2, n] += kz
                qx, qy, qz = by_l * mx + by_r * kx, by_l * my + by_r * ky, by_l * mz + by_r * kz
                to_e[0, n] -= qx
                to_e[1, n] -= qy
                to_e[2, n] -= qz
                to_o[0, n] -= mx + kx - qx
                to_o[1, n] -= my + ky - qy
                to_o[2, n] -= mz + kz - qz
    energy[:count] = total[:count]
