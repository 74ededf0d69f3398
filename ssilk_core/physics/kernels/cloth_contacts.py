# SPDX-License-Identifier: Apache-2.0
"""Contacts of cloth with cloth, found among known pairs, and what they do; references: `self_contact`.

A program owns a block of pairs, each in a frame of its own. Pairs that touch are marked, counted, and written in
their order: results are deterministic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl
from torch import Tensor

from .separations import BLOCK, VARYING, apart, at_vertex, four_vertices
from .vectors import dot

if TYPE_CHECKING:
    from ..energy.collision import ContactLaw

TINY = tl.constexpr(1e-24)
LEAST = tl.constexpr(1e-12)  # [m]
PRESSED = "energy", "force", "slopes"


@dataclass(frozen=True, eq=False)
class PairTable:
    """Pairs of one kind that are known, as `PairKind` and `KnownPairs` hold them."""

    first: Tensor
    second: Tensor
    first_start: Tensor
    second_start: Tensor
    first_area: Tensor
    second_area: Tensor
    first_stiffness: Tensor | None
    second_stiffness: Tensor | None
    frame: Tensor
    one: Tensor
    other: Tensor
    distance: Tensor
    side: Tensor


def contacts_kernel(
    parts: Sequence[PairTable],
    x: Tensor,
    last: Tensor | None,
    rest: Tensor,
    moved: Tensor,
    near: float,
    *,
    start: float,
    closer: float,
    slack: float,
    garment: Tensor | None,
    settled: bool = False,
    step: Tensor | None = None,
    closing: float = 0.0,
) -> tuple[list[Tensor], list[Tensor]]:
    """Return the sides of all pairs of each part, and the rows of `ClothContacts` of those that touch.

    Args:
        parts: of faces, and of edges.
        x, last, rest: positions now, at which pairs without a side have theirs, if given, and in the bind pose.
        moved: how far each vertex has moved since pairs were found, shape (V, N).
        near: pairs nearer than this are close [m], and with a `step` those that come nearer in it by more than
            `closing` of their distance. Without a step, contacts are those that press.
        start, closer, slack: see `SelfContact.law`, and `CLOSER` and `SLACK` there.
        garment: of each vertex, or None: pairs of two have no slack.
        settled: whether only those keep a side that are on the wrong one, and no deeper than `start`.
    """
    x, rest, moved = x.contiguous(), rest.contiguous(), moved.contiguous()
    before, steps = (x if each is None else each.contiguous() for each in (last, step))
    counts = [len(part.frame) for part in parts]
    marks = torch.zeros(sum(counts) + 1, dtype=torch.int32, device=x.device)
    sides = [torch.zeros_like(part.side) for part in parts]
    frames, flags = x.shape[-1], (last is not None, settled, step is not None)
    first, blocks = 1, [(triton.cdiv(count, BLOCK),) for count in counts]  # the first mark is none
    for part, side, count, grid in zip(parts, sides, counts, blocks):
        if count:
            _mark[grid](
                x, before, rest, moved, steps, part.first, part.second, part.frame, part.one, part.other,
                part.distance, part.side, part.first_start, part.second_start, marks, side, near, start, closer,
                closing, first, count, frames, *flags, part.first.shape[1] == 1, BLOCK, num_warps=4,
            )  # fmt: skip
        first += count
    places = marks.cumsum(0, dtype=torch.int32)
    found = int(places[-1])
    numbers, whole = x.new_empty(10, found), torch.empty(5, found, dtype=torch.long, device=x.device)
    second = torch.empty(4, found, dtype=torch.bool, device=x.device)
    first = 1
    for part, side, count, grid in zip(parts, sides, counts, blocks):
        if count and found:
            stiffness = part.first_stiffness, part.second_stiffness
            given = [part.first_start if each is None else each for each in stiffness]
            _write[grid](
                x, rest, part.first, part.second, part.frame, part.one, part.other, side, marks, places,
                part.first_start, part.second_start, part.first_area, part.second_area, *given,
                part.one if garment is None else garment, numbers, whole, second, start, closer, slack, first, count,
                found, frames, stiffness[0] is not None, garment is not None, part.first.shape[1] == 1, BLOCK,
                num_warps=4,
            )  # fmt: skip
        first += count
    return sides, [whole[0], whole[1:], numbers[:4], second, numbers[4:7], *numbers[7:]]


def along_kernel(vectors: Tensor, vertices: Tensor, frame: Tensor, direction: Tensor) -> Tensor:
    """Return what `ClothContacts.along` does."""
    vectors, count = vectors.contiguous(), len(frame)
    found = vectors.new_empty(4, count)
    if count:
        _along[(triton.cdiv(count, BLOCK),)](vectors, vertices, frame, direction.contiguous(), found, count,
                                             vectors.shape[-1], BLOCK, num_warps=4)  # fmt: skip
    return found


def allowed_kernel(
    x: Tensor,
    step: Tensor,
    vertices: Tensor,
    frame: Tensor,
    coefficients: Tensor,
    second: Tensor,
    direction: Tensor,
    slack: Tensor,
    closing: float,
    yielding: float,
) -> Tensor:
    """Return what `ClothContacts.allowed` does."""
    x, step, count = x.contiguous(), step.contiguous(), len(frame)
    found = torch.ones_like(step[:, 0])
    if count:
        rows = (each.contiguous() for each in (vertices, frame, coefficients, second, direction, slack))
        _allowed[(triton.cdiv(count, BLOCK),)](x, step, *rows, found, closing, yielding, count, x.shape[-1], BLOCK,
                                               num_warps=4)  # fmt: skip
    return found


def pressed_kernel(
    x: Tensor,
    law: ContactLaw,
    vertices: Tensor,
    frame: Tensor,
    coefficients: Tensor,
    direction: Tensor,
    start: Tensor,
    area: Tensor,
    what: str,
) -> Tensor:
    """Return of each contact its energy (P,), its forces on its vertices (4, 3, P), or its slopes, likewise.

    Args:
        what: one of `PRESSED`.
    """
    x, count = x.contiguous(), len(frame)
    found = x.new_empty(count) if what == "energy" else x.new_empty(4, 3, count)
    if count:
        rows = (each.contiguous() for each in (vertices, frame, coefficients, direction, start, area))
        numbers = law.stiffness, max(law.ramp, TINY.value), law.ramp
        _pressed[(triton.cdiv(count, BLOCK),)](x, *rows, found, *numbers, count, x.shape[-1], PRESSED.index(what),
                                               BLOCK, num_warps=4)  # fmt: skip
    return found


@triton.jit
def _sided(side, distance, height, faced):
    """The gap on a side, and the sign of the normal there."""
    sign = tl.where(side == 0, tl.where(height < 0, -1.0, 1.0), side)
    return tl.where(faced, sign * height, distance), sign


@triton.jit
def _height(ax, ay, az, nx, ny, nz):
    return dot(ax, ay, az, nx, ny, nz) / tl.maximum(tl.sqrt(dot(nx, ny, nz, nx, ny, nz)), TINY)


@triton.jit
def _begun(rest, i, j, k, o, first_start, second_start, p, q, mask, closer, faces: tl.constexpr):
    """The gap at which contact of pairs begins."""
    rx, ry, rz, _1, _2, _3, _4, _5, _6, _7, _8, _9, _0 = apart(rest + p * 0, 1, i, j, k, o, faces)
    most = 0.5 * (tl.load(first_start + p, mask=mask, other=0.0) + tl.load(second_start + q, mask=mask, other=0.0))
    return tl.minimum(closer * tl.sqrt(dot(rx, ry, rz, rx, ry, rz)), most)


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _mark(
    x, last, rest, moved, step, first, second, frame, one, other, known, side, first_start, second_start, marks,
    sides, near, deepest, closer, closing, offset, count, frames,
    from_last: tl.constexpr, settled: tl.constexpr, steps: tl.constexpr, faces: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = n < count
    f = tl.load(frame + n, mask=inside, other=0)
    p, q, i, j, k, o = four_vertices(first, second, one, other, n, inside, faces)
    mi, mj = tl.load(moved + i * frames + f), tl.load(moved + j * frames + f)
    mk, mo = tl.load(moved + k * frames + f), tl.load(moved + o * frames + f)
    nearer = mi + tl.maximum(mj, tl.maximum(mk, mo)) if faces else tl.maximum(mi, mj) + tl.maximum(mk, mo)
    may = inside & (tl.load(known + n, mask=inside, other=float("inf")) - nearer < near)
    if tl.max(may.to(tl.int32), axis=0) > 0:
        rx, ry, rz, ax, ay, az, nx, ny, nz, _1, _2, _3, faced = apart(x + f, frames, i, j, k, o, faces)
        square = dot(rx, ry, rz, rx, ry, rz)
        distance, height = tl.sqrt(square), _height(ax, ay, az, nx, ny, nz)
        close = distance < near
        own = tl.load(side + n, mask=inside, other=0.0)
        if from_last:
            _x, _y, _z, ax, ay, az, nx, ny, nz, _1, _2, _3, once = apart(last + f, frames, i, j, k, o, faces)
            before = _height(ax, ay, az, nx, ny, nz)
            sign = tl.where(before > 0, 1.0, tl.where(before < 0, -1.0, 0.0))
            own = tl.where((own == 0) & once, sign, own)
        if settled:
            wrong = faced & (own * height < 0) & (own * height >= -deepest)
            own = tl.where(wrong, own, 0.0)
        if steps:
            ai, aj = _at_along(step + f, frames, i, rx, ry, rz), _at_along(step + f, frames, j, rx, ry, rz)
            ak, ao = _at_along(step + f, frames, k, rx, ry, rz), _at_along(step + f, frames, o, rx, ry, rz)
            lowest = ai if faces else tl.minimum(ai, aj)
            highest = tl.maximum(aj, tl.maximum(ak, ao)) if faces else tl.maximum(ak, ao)
            close = close | (tl.maximum(highest, 0.0) - tl.minimum(lowest, 0.0) > closing * square)
            kept = may & close
        else:
            gap, sign = _sided(own, distance, height, faced)
            begun = _begun(rest, i, j, k, o, first_start, second_start, p, q, inside, closer, faces)
            kept = may & close & (gap < begun)
        tl.store(marks + offset + n, kept.to(tl.int32), mask=inside)
        tl.store(sides + n, tl.where(may & close, own, 0.0), mask=inside)


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _write(
    x, rest, first, second, frame, one, other, sides, marks, places, first_start, second_start, first_area,
    second_area, first_stiffness, second_stiffness, garment, numbers, whole, seconds, start, closer, slack, offset,
    count, found, frames, stiff: tl.constexpr, several: tl.constexpr, faces: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    kept = (n < count) & (tl.load(marks + offset + n, mask=n < count, other=0) > 0)
    if tl.max(kept.to(tl.int32), axis=0) > 0:
        f = tl.load(frame + n, mask=kept, other=0)
        p, q, i, j, k, o = four_vertices(first, second, one, other, n, kept, faces)
        rx, ry, rz, ax, ay, az, nx, ny, nz, c1, c2, c3, faced = apart(x + f, frames, i, j, k, o, faces)
        distance, across = tl.sqrt(dot(rx, ry, rz, rx, ry, rz)), tl.sqrt(dot(nx, ny, nz, nx, ny, nz))
        away, across = tl.maximum(distance, TINY), tl.maximum(across, TINY)
        side = tl.load(sides + n, mask=kept, other=0.0)
        _gapped, sign = _sided(side, distance, _height(ax, ay, az, nx, ny, nz), faced)
        begun = _begun(rest, i, j, k, o, first_start, second_start, p, q, kept, closer, faces)
        area = tl.minimum(
            tl.load(first_area + p, mask=kept, other=0.0), tl.load(second_area + q, mask=kept, other=0.0)
        )
        if stiff:
            both = tl.load(first_stiffness + p, mask=kept, other=0.0) + tl.load(
                second_stiffness + q, mask=kept, other=0.0
            )
            area *= 0.5 * both
        least = slack * (start - begun)
        if several:
            least = tl.where(tl.load(garment + i) == tl.load(garment + o), least, 0.0)
        at = tl.load(places + offset + n - 1, mask=kept, other=0).to(tl.int64)
        tl.store(whole + at, f, mask=kept)
        row = whole + found + at
        tl.store(row, i, mask=kept)
        tl.store(row + found, j, mask=kept)
        tl.store(row + 2 * found, k, mask=kept)
        tl.store(row + 3 * found, o, mask=kept)
        row = numbers + at
        tl.store(row, -c1 - c2 - c3, mask=kept)
        tl.store(row + found, c1, mask=kept)
        tl.store(row + 2 * found, c2, mask=kept)
        tl.store(row + 3 * found, c3, mask=kept)
        tl.store(row + 4 * found, tl.where(faced, sign * (nx / across), rx / away), mask=kept)
        tl.store(row + 5 * found, tl.where(faced, sign * (ny / across), ry / away), mask=kept)
        tl.store(row + 6 * found, tl.where(faced, sign * (nz / across), rz / away), mask=kept)
        tl.store(row + 7 * found, begun, mask=kept)
        tl.store(row + 8 * found, area, mask=kept)
        tl.store(row + 9 * found, least, mask=kept)
        row = seconds + at
        tl.store(row, n < 0, mask=kept)
        tl.store(row + found, (n >= 0) if faces else (n < 0), mask=kept)
        tl.store(row + 2 * found, n >= 0, mask=kept)
        tl.store(row + 3 * found, n >= 0, mask=kept)


@triton.jit
def _at_along(vectors, frames, v, nx, ny, nz):
    sx, sy, sz = at_vertex(vectors, frames, v)
    return dot(nx, ny, nz, sx, sy, sz)


@triton.jit
def _four_along(vectors, frames, vertices, direction, n, inside, count):
    """The vertices of contacts, and vectors there along their directions."""
    nx = tl.load(direction + n, mask=inside, other=0.0)
    ny = tl.load(direction + count + n, mask=inside, other=0.0)
    nz = tl.load(direction + 2 * count + n, mask=inside, other=0.0)
    i, j = tl.load(vertices + n, mask=inside, other=0), tl.load(vertices + count + n, mask=inside, other=0)
    k = tl.load(vertices + 2 * count + n, mask=inside, other=0)
    o = tl.load(vertices + 3 * count + n, mask=inside, other=0)
    ai, aj = _at_along(vectors, frames, i, nx, ny, nz), _at_along(vectors, frames, j, nx, ny, nz)
    ak, ao = _at_along(vectors, frames, k, nx, ny, nz), _at_along(vectors, frames, o, nx, ny, nz)
    return i, j, k, o, ai, aj, ak, ao, nx, ny, nz


@triton.jit
def _gap(coefficients, n, inside, count, ai, aj, ak, ao):
    ci, cj = (
        tl.load(coefficients + n, mask=inside, other=0.0),
        tl.load(coefficients + count + n, mask=inside, other=0.0),
    )
    ck = tl.load(coefficients + 2 * count + n, mask=inside, other=0.0)
    co = tl.load(coefficients + 3 * count + n, mask=inside, other=0.0)
    return ci * ai + cj * aj + ck * ak + co * ao, ci, cj, ck, co


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _along(vectors, vertices, frame, direction, found, count, frames, block: tl.constexpr):
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = n < count
    f = tl.load(frame + n, mask=inside, other=0)
    _i, _j, _k, _o, ai, aj, ak, ao, _x, _y, _z = _four_along(
        vectors + f, frames, vertices, direction, n, inside, count
    )
    tl.store(found + n, ai, mask=inside)
    tl.store(found + count + n, aj, mask=inside)
    tl.store(found + 2 * count + n, ak, mask=inside)
    tl.store(found + 3 * count + n, ao, mask=inside)


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _allowed(
    x, step, vertices, frame, coefficients, second, direction, slack, found, closing, yielding, count, frames,
    block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = n < count
    f = tl.load(frame + n, mask=inside, other=0)
    i, j, k, o, ai, aj, ak, ao, _x, _y, _z = _four_along(step + f, frames, vertices, direction, n, inside, count)
    far = float("inf")
    si = tl.load(second + n, mask=inside, other=0) != 0
    sj = tl.load(second + count + n, mask=inside, other=0) != 0
    sk = tl.load(second + 2 * count + n, mask=inside, other=0) != 0
    so = tl.load(second + 3 * count + n, mask=inside, other=0) != 0
    lowest = tl.minimum(
        tl.minimum(tl.where(si, far, ai), tl.where(sj, far, aj)),
        tl.minimum(tl.where(sk, far, ak), tl.where(so, far, ao)),
    )
    highest = tl.maximum(
        tl.maximum(tl.where(si, ai, -far), tl.where(sj, aj, -far)),
        tl.maximum(tl.where(sk, ak, -far), tl.where(so, ao, -far)),
    )
    _i, _j, _k, _o, ai, aj, ak, ao, _x, _y, _z = _four_along(x + f, frames, vertices, direction, n, inside, count)
    gap, _1, _2, _3, _4 = _gap(coefficients, n, inside, count, ai, aj, ak, ao)
    most = tl.maximum(closing * gap, tl.maximum(tl.load(slack + n, mask=inside, other=0.0), yielding))
    share = tl.maximum(most, LEAST) / tl.maximum(highest - lowest, LEAST)
    less = inside & (share < 1)
    tl.atomic_min(found + i * frames + f, share, mask=less)
    tl.atomic_min(found + j * frames + f, share, mask=less)
    tl.atomic_min(found + k * frames + f, share, mask=less)
    tl.atomic_min(found + o * frames + f, share, mask=less)


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _pressed(
    x, vertices, frame, coefficients, direction, begun, area, found, stiffness, slope, ramp, count, frames,
    what: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = n < count
    f = tl.load(frame + n, mask=inside, other=0)
    _i, _j, _k, _o, ai, aj, ak, ao, nx, ny, nz = _four_along(x + f, frames, vertices, direction, n, inside, count)
    gap, ci, cj, ck, co = _gap(coefficients, n, inside, count, ai, aj, ak, ao)
    depth = tl.maximum(tl.load(begun + n, mask=inside, other=0.0) - gap, 0.0)
    scale = stiffness * tl.load(area + n, mask=inside, other=0.0)
    soft, touches = depth < ramp, depth > 0
    if what == 0:
        deep = tl.where(touches, 0.5 * depth * (depth - ramp) + ramp * ramp / 6, 0.0)
        tl.store(found + n, scale * tl.where(soft, depth * depth * depth / (6 * slope), deep), mask=inside)
    else:
        if what == 1:
            deep = tl.where(touches, depth - 0.5 * ramp, 0.0)
            value = -scale * tl.where(soft, depth * depth / (2 * slope), deep)
        else:
            value = tl.sqrt(scale * tl.where(soft, depth / slope, tl.where(touches, 1.0, 0.0)))
        for c in tl.static_range(4):
            own = value * (ci if c == 0 else (cj if c == 1 else (ck if c == 2 else co)))
            row = found + 3 * c * count + n
            tl.store(row, own * nx, mask=inside)
            tl.store(row + count, own * ny, mask=inside)
            tl.store(row + 2 * count, own * nz, mask=inside)
