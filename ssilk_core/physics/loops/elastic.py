# SPDX-License-Identifier: Apache-2.0
"""Stretch and bending energies; reference: `GarmentEnergy.stretch` and `.bending`.

A loop owns a block of frames and adds up all triangles and hinges in order. With a gradient it adds up both
energies' gradients in the same pass, for the backward pass to weight. Each element is copied to a small array first,
where vectors of frames overlap with no others, so that the compiler can take all frames at once.
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
from .compiling import compiled
from .running import array, blocks_of, run_parts

LANES = 8  # frames that a loop processes at once, in one vector register

PART = 64  # elements that are added up before their sum is, so that rounding errors stay small
HALF_PI, PI, TWO_PI = np.float32(np.pi / 2), np.float32(np.pi), np.float32(2 * np.pi)


def elastic_loop(
    x: Tensor, tables: ElasticTables, fabric: Fabric, moduli: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Return stretch and bending [J] of positions x (V, 3, N), both (N,).

    Args:
        moduli: of the stretch model in each frame (N,), without gradients; the fabric's own by default.
    """
    return _Elastic.apply(x, tables, fabric, moduli)


def elastic_gradient_loop(x: Tensor, tables: ElasticTables, fabric: Fabric) -> Tensor:
    """Return the gradient of the sum of both [N], shape (V, 3, N)."""
    stretch, bending = _run(x, tables, fabric, True)[1]
    return stretch + bending


def _run(
    x: Tensor, tables: ElasticTables, fabric: Fabric, wanted: bool, moduli: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Return both energies (2, N) and, where wanted, their gradients (2, V, 3, N)."""
    frames = x.shape[2]
    energy = torch.empty(2, frames)
    # The gradients of both energies; one vertex stands for all where they are not asked for.
    slopes = torch.empty(2, len(x) if wanted else 1, 3, frames)
    woven = fabric.stretch_model != "stvk"
    own = (fabric.stretch, fabric.shear) if woven else (fabric.lame_mu, fabric.lame_lambda)
    rest = (tables.faces, tables.face_numbers, tables.hinges, tables.hinge_numbers)
    numbers = map(array, moduli) if moduli else (np.full(frames, modulus, np.float32) for modulus in own)
    out = energy.numpy(), slopes.numpy()
    run_parts(_elastic, blocks_of(frames, LANES), array(x), *map(array, rest), *numbers, woven, wanted, *out)
    return energy, slopes


class _Elastic(Function):
    @staticmethod
    def forward(ctx, x, tables, fabric, moduli):
        energy, slopes = _run(x, tables, fabric, ctx.needs_input_grad[0], moduli)
        ctx.save_for_backward(slopes)
        return energy[0], energy[1]

    @staticmethod
    @once_differentiable
    def backward(ctx, to_stretch, to_bending):
        ((stretch, bending),) = ctx.saved_tensors
        return (stretch * to_stretch).addcmul_(bending, to_bending), None, None, None


@compiled
def _elastic(
    x, faces, face_numbers, hinges, hinge_numbers, first, second, woven, wanted, energy, slopes, start, stop
):  # fmt: skip
    vertices, _, frames = x.shape
    held = vertices if wanted else 0
    here, slope = np.empty((vertices, 3 * LANES), np.float32), np.empty((held, 3 * LANES), np.float32)
    one, other = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for block in range(start, stop):
        first_frame = block * LANES
        count = min(LANES, frames - first_frame)
        for v in range(vertices):
            for axis in range(3):
                for n in range(LANES):
                    here[v, axis * LANES + n] = x[v, axis, first_frame + min(n, count - 1)]
        for n in range(LANES):
            one[n], other[n] = first[first_frame + min(n, count - 1)], second[first_frame + min(n, count - 1)]
        slope[:] = 0
        _stretch(here, faces, face_numbers, one, other, woven, slope, energy[0, first_frame:], count)
        _copied(slope, slopes[0], first_frame, count)
        slope[:] = 0
        _bending(here, hinges, hinge_numbers, slope, energy[1, first_frame:], count)
        _copied(slope, slopes[1], first_frame, count)


@compiled
def _copied(slope, out, first, count):
    for v in range(len(slope)):
        for axis in range(3):
            for n in range(count):
                out[v, axis, first + n] = slope[v, axis * LANES + n]


@compiled
def _gathered(here, rows, work):
    """Copy the positions of an element's vertices to the first rows of `work`, of LANES frames each."""
    for corner in range(len(rows)):
        point = here[rows[corner]]
        for n in range(3 * LANES):
            work[corner * 3 * LANES + n] = point[n]


@compiled
def _scattered(work, at, rows, slope):
    """Add the gradient of an element, in the rows of `work` from `at` on, to those of its vertices."""
    for corner in range(len(rows)):
        mine = slope[rows[corner]]
        for n in range(3 * LANES):
            mine[n] += work[at * LANES + corner * 3 * LANES + n]


@compiled
def _stretch(here, faces, numbers, first, second, woven, slope, energy, count):
    work, total, part = np.zeros(19 * LANES, np.float32), np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    for face in range(len(faces)):
        rows = faces[face, :3]
        _gathered(here, rows, work)
        if woven:
            _woven(work, numbers[face], first, second)
        else:
            _stvk(work, numbers[face], first, second)
        for n in range(LANES):
            part[n] += work[18 * LANES + n]
        if len(slope):
            _scattered(work, 9, rows, slope)
        if face % PART == PART - 1 or face == len(faces) - 1:
            total += part
            part[:] = 0
    energy[:count] = total[:count]


@compiled
def _columns(work, n, numbers):
    """Both columns of the deformation gradient of a triangle in `work`."""
    a, b, c = n, 3 * LANES + n, 6 * LANES + n
    px, py, pz = work[b] - work[a], work[b + LANES] - work[a + LANES], work[b + 2 * LANES] - work[a + 2 * LANES]
    qx, qy, qz = work[c] - work[a], work[c + LANES] - work[a + LANES], work[c + 2 * LANES] - work[a + 2 * LANES]
    bu, bv, cu, cv = numbers[0], numbers[1], numbers[2], numbers[3]
    ux, uy, uz = bu * px + cu * qx, bu * py + cu * qy, bu * pz + cu * qz
    return ux, uy, uz, bv * px + cv * qx, bv * py + cv * qy, bv * pz + cv * qz


@compiled
def _write(work, n, numbers, ux, uy, uz, vx, vy, vz, p, q, r, density):
    """Write the energy and its gradient from the derivatives p u + q v and q u + r v of its density."""
    bu, bv, cu, cv, area = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    p, q, r = area * p, area * q, area * r
    sx, sy, sz = p * ux + q * vx, p * uy + q * vy, p * uz + q * vz
    tx, ty, tz = q * ux + r * vx, q * uy + r * vy, q * uz + r * vz
    bx, by, bz = bu * sx + bv * tx, bu * sy + bv * ty, bu * sz + bv * tz
    cx, cy, cz = cu * sx + cv * tx, cu * sy + cv * ty, cu * sz + cv * tz
    a, b, c = 9 * LANES + n, 12 * LANES + n, 15 * LANES + n
    work[a], work[a + LANES], work[a + 2 * LANES] = -bx - cx, -by - cy, -bz - cz
    work[b], work[b + LANES], work[b + 2 * LANES] = bx, by, bz
    work[c], work[c + LANES], work[c + 2 * LANES] = cx, cy, cz
    work[18 * LANES + n] = area * density


@compiled
def _stvk(work, numbers, first, second):
    one, half, two = np.float32(1), np.float32(0.5), np.float32(2)
    for n in range(LANES):
        mu, lame_lambda = first[n], second[n]
        ux, uy, uz, vx, vy, vz = _columns(work, n, numbers)
        g_uu, g_vv = half * (ux * ux + uy * uy + uz * uz - one), half * (vx * vx + vy * vy + vz * vz - one)
        g_uv = half * (ux * vx + uy * vy + uz * vz)
        trace = g_uu + g_vv
        density = mu * (g_uu * g_uu + g_vv * g_vv + two * g_uv * g_uv) + half * lame_lambda * trace * trace
        pressure = lame_lambda * trace
        p, q, r = two * mu * g_uu + pressure, two * mu * g_uv, two * mu * g_vv + pressure
        _write(work, n, numbers, ux, uy, uz, vx, vy, vz, p, q, r, density)


@compiled
def _woven(work, numbers, first, second):
    zero, one, two, least = np.float32(0), np.float32(1), np.float32(2), np.float32(1e-12)
    for n in range(LANES):
        stretch, shear = first[n], second[n]
        ux, uy, uz, vx, vy, vz = _columns(work, n, numbers)
        uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
        long_u, long_v = sqrt(max(uu, least)), sqrt(max(vv, least))
        over_u, over_v = long_u - one, long_v - one
        density = stretch * (over_u * over_u + over_v * over_v) + shear * uv * uv
        p, r = two * stretch * over_u / long_u, two * stretch * over_v / long_v
        p, r = zero if uu < least else p, zero if vv < least else r
        _write(work, n, numbers, ux, uy, uz, vx, vy, vz, p, two * shear * uv, r, density)


@compiled
def _bending(here, hinges, numbers, slope, energy, count):
    work, total, part = np.zeros(25 * LANES, np.float32), np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    for hinge in range(len(hinges)):
        _gathered(here, hinges[hinge], work)
        _hinge(work, numbers[hinge, 0], numbers[hinge, 1])
        for n in range(LANES):
            part[n] += work[24 * LANES + n]
        if len(slope):
            _scattered(work, 12, hinges[hinge], slope)
        if hinge % PART == PART - 1 or hinge == len(hinges) - 1:
            total += part
            part[:] = 0
    energy[:count] = total[:count]


@compiled
def _angle(y, x):
    """Angle of (x, y) != 0 to float32 rounding, without a branch."""
    zero = np.float32(0)
    low, high = min(abs(x), abs(y)), max(abs(x), abs(y))
    steep = low > np.float32(0.41421357) * high  # above pi/8: rotated by pi/4
    t = (low - high if steep else low) / (low + high if steep else high)
    s = t * t
    # Minimax fit of (atan(t)/t - 1)/t^2; the relative error of the angle is 2e-8.
    fit = ((np.float32(0.08060307) * s - np.float32(0.13879849)) * s + np.float32(0.19977926)) * s
    angle = (np.float32(0.78539816) if steep else zero) + (t + t * s * (fit - np.float32(0.33332956)))
    angle = HALF_PI - angle if abs(y) > abs(x) else angle
    angle = PI - angle if x < zero else angle
    return -angle if y < zero else angle


@compiled
def _hinge(work, stiffness, rest):
    """Write the energy of a hinge and its gradient.

    The angle has the gradients -|e| n / |n|^2 at both tips; the vertices of the edge share what balances these.
    """
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    for n in range(LANES):
        e, f, g = 3 * LANES + n, 6 * LANES + n, 9 * LANES + n
        ox, oy, oz = work[n], work[LANES + n], work[2 * LANES + n]
        ex, ey, ez = work[e] - ox, work[e + LANES] - oy, work[e + 2 * LANES] - oz
        lx, ly, lz = work[f] - ox, work[f + LANES] - oy, work[f + 2 * LANES] - oz
        rx, ry, rz = work[g] - ox, work[g + LANES] - oy, work[g + 2 * LANES] - oz
        mx, my, mz = ey * lz - ez * ly, ez * lx - ex * lz, ex * ly - ey * lx
        kx, ky, kz = ry * ez - rz * ey, rz * ex - rx * ez, rx * ey - ry * ex
        square = ex * ex + ey * ey + ez * ez
        length = sqrt(max(square, np.float32(1e-18)))
        sine = -(kx * lx + ky * ly + kz * lz) * length
        cosine = mx * kx + my * ky + mz * kz
        # As in the reference, a degenerate hinge counts as flat and has no gradient.
        collapsed = abs(sine) + abs(cosine) < max(np.float32(1e-6) * square * square, np.float32(1e-18))
        change = _angle(zero if collapsed else sine, one if collapsed else cosine) - rest
        change -= (TWO_PI if change > PI else zero) - (TWO_PI if change < -PI else zero)
        pull = zero if collapsed else -two * stiffness * change * length
        at_l = pull / max(mx * mx + my * my + mz * mz, np.float32(1e-36))
        at_r = pull / max(kx * kx + ky * ky + kz * kz, np.float32(1e-36))
        over = one / max(square, np.float32(1e-18))
        by_l, by_r = (ex * lx + ey * ly + ez * lz) * over, (ex * rx + ey * ry + ez * rz) * over
        mx, my, mz, kx, ky, kz = at_l * mx, at_l * my, at_l * mz, at_r * kx, at_r * ky, at_r * kz
        qx, qy, qz = by_l * mx + by_r * kx, by_l * my + by_r * ky, by_l * mz + by_r * kz
        a, b, c, d = 12 * LANES + n, 15 * LANES + n, 18 * LANES + n, 21 * LANES + n
        work[a], work[a + LANES], work[a + 2 * LANES] = qx - mx - kx, qy - my - ky, qz - mz - kz
        work[b], work[b + LANES], work[b + 2 * LANES] = -qx, -qy, -qz
        work[c], work[c + LANES], work[c + 2 * LANES] = mx, my, mz
        work[d], work[d + LANES], work[d + 2 * LANES] = kx, ky, kz
        work[24 * LANES + n] = stiffness * change * change
