# SPDX-License-Identifier: Apache-2.0
"""Stretch and bending energies; reference: `GarmentEnergy.stretch` and `.bending`.

Every program owns a block of frames. For values it sums over a few triangles or hinges and writes this partial sum;
for gradients it owns a vertex and gathers from the triangles around it. There are no atomics: results are
deterministic.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ...scene.fabrics import Fabric
from .corners import ElasticTables
from .vectors import cross, dot, load3, store3

FRAMES, WARPS = 128, 2  # frames and warps of one program
ELEMENTS = 8  # triangles or hinges that one program sums over


def elastic_kernel(
    x: Tensor, tables: ElasticTables, fabric: Fabric, moduli: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Return stretch and bending [J] of positions x (V, 3, N), both (N,).

    Args:
        moduli: of the stretch model in each frame (N,), without gradients; the fabric's own by default.
    """
    if moduli:
        moduli = tuple(each.detach().contiguous() for each in moduli)  # type: ignore[assignment]
    return _Elastic.apply(x.contiguous(), tables, fabric, moduli)


def _membrane(fabric: Fabric, moduli: tuple[Tensor, Tensor] | None) -> tuple[object, ...]:
    """Return both moduli of the stretch model [N/m], whether each frame has its own, and if it is Baraff-Witkin's."""
    if fabric.stretch_model == "stvk":
        return *(moduli or (fabric.lame_mu, fabric.lame_lambda)), moduli is not None, False
    return *(moduli or (fabric.stretch, fabric.shear)), moduli is not None, True


class _Elastic(Function):
    @staticmethod
    def forward(ctx, x, tables, fabric, moduli):
        frames, blocks = x.shape[-1], triton.cdiv(x.shape[-1], FRAMES)
        faces, hinges = len(tables.faces), len(tables.hinges)
        stretch = x.new_empty(triton.cdiv(faces, ELEMENTS), frames)
        bending = x.new_empty(triton.cdiv(hinges, ELEMENTS), frames)
        slope = x.new_empty(hinges, frames)
        _stretch[len(stretch), blocks](
            *(x, tables.faces, tables.face_numbers, stretch),
            *(*_membrane(fabric, moduli), faces, frames, ELEMENTS, FRAMES),
            num_warps=WARPS,
        )
        if hinges:
            _bending[len(bending), blocks](
                *(x, tables.hinges, tables.hinge_numbers, slope, bending),
                *(hinges, frames, ELEMENTS, FRAMES),
                num_warps=WARPS,
            )
        ctx.save_for_backward(x, slope)
        ctx.tables, ctx.membrane = tables, _membrane(fabric, moduli)
        return stretch.sum(0), bending.sum(0)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        (x, slope), tables = ctx.saved_tensors, ctx.tables
        vertices, _, frames = x.shape
        grad = x.new_empty(x.shape)
        _gradient[vertices, triton.cdiv(frames, FRAMES)](
            *(x, slope, tables.starts, tables.corners, tables.corner_numbers),
            *(values.contiguous() for values in upstream),
            *(grad, *ctx.membrane, len(slope) > 0, frames, FRAMES),
            num_warps=WARPS,
        )
        return grad, None, None, None


@triton.jit
def _point(x, index, frames, n, inside):
    """Load the position of the vertex whose index is stored at `index`."""
    return load3(x + tl.load(index).to(tl.int64) * 3 * frames, frames, n, inside)


@triton.jit
def _columns(px, py, pz, qx, qy, qz, number):
    """Both columns of the deformation gradient from the edges ab and ac of a corner, and its numbers."""
    bu, bv, cu, cv = tl.load(number), tl.load(number + 1), tl.load(number + 2), tl.load(number + 3)
    ux, uy, uz = bu * px + cu * qx, bu * py + cu * qy, bu * pz + cu * qz
    vx, vy, vz = bv * px + cv * qx, bv * py + cv * qy, bv * pz + cv * qz
    return ux, uy, uz, vx, vy, vz, bu + cu, bv + cv


@triton.jit
def _length(square):
    return tl.sqrt(tl.maximum(square, 1e-12))  # the floor is the reference implementation's


@triton.jit
def _modulus(values, n, inside, mixed: tl.constexpr):
    """A modulus of all frames, or where they are mixed, that of each."""
    if mixed:  # noqa: SIM108  # Triton compiles one branch of a statement alone
        modulus = tl.load(values + n, mask=inside, other=0.0)
    else:
        modulus = values
    return modulus


@triton.jit
def _density(uu, uv, vv, first, second, woven: tl.constexpr):
    """Energy per rest area from the products of the columns, with the moduli of `_membrane`."""
    if woven:
        over_u, over_v = _length(uu) - 1, _length(vv) - 1
        density = first * (over_u * over_u + over_v * over_v) + second * uv * uv
    else:
        g_uu, g_uv, g_vv = 0.5 * (uu - 1), 0.5 * uv, 0.5 * (vv - 1)
        trace = g_uu + g_vv
        density = first * (g_uu * g_uu + g_vv * g_vv + 2 * g_uv * g_uv) + 0.5 * second * trace * trace
    return density


@triton.jit
def _stress(uu, uv, vv, first, second, woven: tl.constexpr):
    """Derivative of the density in the columns u and v as p u + q v and q u + r v; returns p, q, r."""
    if woven:
        p = tl.where(uu < 1e-12, 0.0, 2 * first * (1 - 1 / _length(uu)))
        r = tl.where(vv < 1e-12, 0.0, 2 * first * (1 - 1 / _length(vv)))
        q = 2 * second * uv
    else:
        pressure = 0.5 * second * ((uu - 1) + (vv - 1))
        p, q, r = first * (uu - 1) + pressure, first * uv, first * (vv - 1) + pressure
    return p, q, r


@triton.jit
def _stretch(
    x,
    faces,
    numbers,
    shares,
    first,
    second,
    mixed: tl.constexpr,
    woven: tl.constexpr,
    count,
    frames,
    chunk: tl.constexpr,
    block: tl.constexpr,
):
    part = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    total = tl.zeros((block,), tl.float32)
    one, other = _modulus(first, n, inside, mixed), _modulus(second, n, inside, mixed)
    for face in range(part * chunk, tl.minimum((part + 1) * chunk, count)):
        index, number = faces + face * 6, numbers + face * 8
        ax, ay, az = _point(x, index, frames, n, inside)
        bx, by, bz = _point(x, index + 1, frames, n, inside)
        cx, cy, cz = _point(x, index + 2, frames, n, inside)
        ux, uy, uz, vx, vy, vz, _, _ = _columns(bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az, number)
        uu, uv, vv = dot(ux, uy, uz, ux, uy, uz), dot(ux, uy, uz, vx, vy, vz), dot(vx, vy, vz, vx, vy, vz)
        total += tl.load(number + 4) * _density(uu, uv, vv, one, other, woven)
    tl.store(shares + part * frames + n, total, mask=inside)


@triton.jit
def _atan2(y, x):
    """Angle of (x, y) != 0 to float32 rounding; Triton's interpreter lacks atan2."""
    low, high = tl.minimum(tl.abs(x), tl.abs(y)), tl.maximum(tl.abs(x), tl.abs(y))
    steep = low > 0.41421357 * high  # above pi/8: rotated by pi/4
    t = tl.where(steep, low - high, low) / tl.where(steep, low + high, high)
    s = t * t
    # Minimax fit of (atan(t)/t - 1)/t^2; the relative error of the angle is 2e-8.
    fit = ((0.08060307 * s - 0.13879849) * s + 0.19977926) * s - 0.33332956
    angle = tl.where(steep, 0.78539816, 0.0) + (t + t * s * fit)
    angle = tl.where(tl.abs(y) > tl.abs(x), 1.57079633 - angle, angle)
    angle = tl.where(x < 0, 3.14159265 - angle, angle)
    return tl.where(y < 0, -angle, angle)


@triton.jit
def _bending(x, hinges, numbers, slope, shares, count, frames, chunk: tl.constexpr, block: tl.constexpr):
    """Write the energy of a few hinges, and the derivative of each in its angle for `_gradient`."""
    part = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    total = tl.zeros((block,), tl.float32)
    for hinge in range(part * chunk, tl.minimum((part + 1) * chunk, count)):
        index = hinges + hinge * 4
        ox, oy, oz = _point(x, index, frames, n, inside)
        ex, ey, ez = _point(x, index + 1, frames, n, inside)
        lx, ly, lz = _point(x, index + 2, frames, n, inside)
        rx, ry, rz = _point(x, index + 3, frames, n, inside)
        ex, ey, ez = ex - ox, ey - oy, ez - oz
        lx, ly, lz = lx - ox, ly - oy, lz - oz
        mx, my, mz = cross(ex, ey, ez, lx, ly, lz)
        rx, ry, rz = cross(rx - ox, ry - oy, rz - oz, ex, ey, ez)
        square = dot(ex, ey, ez, ex, ey, ez)
        sine = -dot(rx, ry, rz, lx, ly, lz) * tl.sqrt(tl.maximum(square, 1e-18))
        cosine = dot(mx, my, mz, rx, ry, rz)
        # As in the reference implementation, a degenerate hinge counts as flat and has no gradient.
        collapsed = tl.abs(sine) + tl.abs(cosine) < tl.maximum(1e-6 * square * square, 1e-18)
        angle = tl.where(collapsed, 0.0, _atan2(sine, tl.where(collapsed, 1.0, cosine)))
        stiffness = tl.load(numbers + hinge * 2)
        change = angle - tl.load(numbers + hinge * 2 + 1)
        change -= tl.where(change > 3.14159265, 6.28318531, 0.0) - tl.where(change < -3.14159265, 6.28318531, 0.0)
        total += stiffness * change * change
        tl.store(slope + hinge * frames + n, tl.where(collapsed, 0.0, 2 * stiffness * change), mask=inside)
    tl.store(shares + part * frames + n, total, mask=inside)


@triton.jit
def _turn(slope, index, number, frames, n, inside):
    """Derivative of a hinge's energy with respect to its angle, with the sign stored at `number`."""
    row = slope + tl.load(index).to(tl.int64) * frames
    return tl.load(number) * tl.load(row + n, mask=inside, other=0.0)


@triton.jit
def _pull(px, py, pz, qx, qy, qz, ab, bc, ca):
    """Gradient at a of the three hinges of a triangle, whose energies have derivatives ab, bc and ca in their angles.

    The angle at bc has the gradient -|bc| n/|n|^2 at a, where n is the normal p x q. At an edge that ends in a, its
    share of the opposite tip's reaction follows from where the tip projects onto the edge.
    """
    nx, ny, nz = cross(px, py, pz, qx, qy, qz)
    dx, dy, dz = qx - px, qy - py, qz - pz
    at_ab = -ab * dot(dx, dy, dz, px, py, pz) * tl.rsqrt(tl.maximum(dot(px, py, pz, px, py, pz), 1e-18))
    at_ca = ca * dot(dx, dy, dz, qx, qy, qz) * tl.rsqrt(tl.maximum(dot(qx, qy, qz, qx, qy, qz), 1e-18))
    at_bc = -bc * tl.sqrt(dot(dx, dy, dz, dx, dy, dz))
    scale = (at_ab + at_bc + at_ca) / tl.maximum(dot(nx, ny, nz, nx, ny, nz), 1e-36)
    return scale * nx, scale * ny, scale * nz


@triton.jit
def _gradient(
    x,
    slope,
    starts,
    corners,
    numbers,
    to_stretch,
    to_bending,
    grad,
    first,
    second,
    mixed: tl.constexpr,
    woven: tl.constexpr,
    hinged: tl.constexpr,
    frames,
    block: tl.constexpr,
):
    v = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    ax, ay, az = load3(x + v * 3 * frames, frames, n, inside)
    sx, sy, sz = tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32)
    hx, hy, hz = sx, sy, sz
    one, other = _modulus(first, n, inside, mixed), _modulus(second, n, inside, mixed)
    for row in range(tl.load(starts + v).to(tl.int64), tl.load(starts + v + 1).to(tl.int64)):
        index, number = corners + row * 6, numbers + row * 8
        px, py, pz = _point(x, index + 1, frames, n, inside)
        qx, qy, qz = _point(x, index + 2, frames, n, inside)
        px, py, pz, qx, qy, qz = px - ax, py - ay, pz - az, qx - ax, qy - ay, qz - az
        ux, uy, uz, vx, vy, vz, by_u, by_v = _columns(px, py, pz, qx, qy, qz, number)
        uu, uv, vv = dot(ux, uy, uz, ux, uy, uz), dot(ux, uy, uz, vx, vy, vz), dot(vx, vy, vz, vx, vy, vz)
        p, q, r = _stress(uu, uv, vv, one, other, woven)
        area = tl.load(number + 4)
        along_u, along_v = area * (by_u * p + by_v * q), area * (by_u * q + by_v * r)
        sx -= along_u * ux + along_v * vx
        sy -= along_u * uy + along_v * vy
        sz -= along_u * uz + along_v * vz
        if hinged:
            ab = _turn(slope, index + 3, number + 5, frames, n, inside)
            bc = _turn(slope, index + 4, number + 6, frames, n, inside)
            ca = _turn(slope, index + 5, number + 7, frames, n, inside)
            gx, gy, gz = _pull(px, py, pz, qx, qy, qz, ab, bc, ca)
            hx, hy, hz = hx + gx, hy + gy, hz + gz
    stretch = tl.load(to_stretch + n, mask=inside, other=0.0)
    bending = tl.load(to_bending + n, mask=inside, other=0.0)
    gx, gy, gz = stretch * sx + bending * hx, stretch * sy + bending * hy, stretch * sz + bending * hz
    store3(grad + v * 3 * frames, frames, n, inside, gx, gy, gz)
