# SPDX-License-Identifier: Apache-2.0
"""Which vertices are near which faces, and which edges near which edges; reference: `PairKind.near`.

Each of what comes first in pairs looks through its part of a grid twice: pairs are counted, then written in order.
One compiled kernel does both, since another could round otherwise, and write another number than was counted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl
from torch import Tensor

from .separations import VARYING, apart
from .vectors import dot

if TYPE_CHECKING:
    from ..self_contact.neighbours import Grid

BLOCK = 32  # of what comes first in pairs


def near_kernel(
    x: Tensor,
    first: Tensor,
    second: Tensor,
    middles: tuple[Tensor, Tensor],
    reaches: tuple[Tensor, Tensor],
    grid: Grid,
    groups: tuple[Tensor, Tensor] | None,
    ascending: bool,
    reach: float,
) -> tuple[Tensor, ...]:
    """Return frame, first, second and distance of each pair, by frame; arguments are those of `loops.near_loop`."""
    count, frames = len(first), x.shape[-1]
    none = grid.order[:1]
    place = grid.order.argsort() if ascending else none
    given = (
        x.contiguous(), first, second, middles[0].contiguous(), middles[1].contiguous(), reaches[0].contiguous(),
        reaches[1].contiguous(), grid.order, grid.first.contiguous(), grid.last.contiguous(), place,
        *(groups or (none, none)),
    )  # fmt: skip
    sizes = reach, count, len(second), frames
    flags = groups is not None, ascending, first.shape[1] == 1
    ends = torch.zeros(frames * count + 1, dtype=torch.int64, device=x.device)
    blocks = (triton.cdiv(frames * count, BLOCK),)
    _near[blocks](*given, ends, ends, x, *sizes, 0, 0, *flags, BLOCK, num_warps=1)
    ends = ends.cumsum(0)
    found = int(ends[-1])
    pairs, distance = torch.empty(3, found, dtype=torch.int64, device=x.device), x.new_empty(found)
    if found:
        _near[blocks](*given, ends, pairs, distance, *sizes, found, 1, *flags, BLOCK, num_warps=1)
    return *pairs, distance


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _near(
    x, first, second, middle, other_middle, reaches, other_reaches, order, starts, ends, place, own, theirs, counts,
    pairs, distance, reach, count, others, frames, total, writes,
    grouped: tl.constexpr, ascending: tl.constexpr, faces: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    query = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = query < count * frames
    f, p = query // count, query % count
    at = middle + p * 3 * frames + f
    px = tl.load(at, mask=inside, other=0.0)
    py = tl.load(at + frames, mask=inside, other=0.0)
    pz = tl.load(at + 2 * frames, mask=inside, other=0.0)
    limit = tl.load(reaches + p, mask=inside, other=0.0)
    held = tl.load(counts + query, mask=inside & (writes != 0), other=0)
    for row in range(9):
        start = tl.load(starts + 9 * query + row, mask=inside, other=0)
        end = tl.load(ends + 9 * query + row, mask=inside, other=0)
        if ascending:
            start = tl.maximum(start, tl.load(place + query, mask=inside, other=0) + 1)
        for k in range(tl.max(tl.maximum(end - start, 0), axis=0)):
            here = start + k < end
            q = tl.load(order + start + k, mask=here, other=0) % others
            to = other_middle + q * 3 * frames + f
            dx = px - tl.load(to, mask=here, other=0.0)
            dy = py - tl.load(to + frames, mask=here, other=0.0)
            dz = pz - tl.load(to + 2 * frames, mask=here, other=0.0)
            most = limit + tl.load(other_reaches + q, mask=here, other=0.0)
            here = here & (dot(dx, dy, dz, dx, dy, dz) <= most * most)
            if grouped:
                here = here & (tl.load(own + p, mask=here, other=0) != tl.load(theirs + q, mask=here, other=0))
            if tl.max(here.to(tl.int32), axis=0) > 0:
                one, other = first + p * (1 if faces else 2), second + q * (3 if faces else 2)
                i = tl.load(one, mask=here, other=0)
                o = tl.load(other + (2 if faces else 1), mask=here, other=0)
                j = tl.load(other, mask=here, other=0) if faces else tl.load(one + 1, mask=here, other=0)
                m = tl.load(other + (1 if faces else 0), mask=here, other=0)
                shared = (i == m) | (i == o) | ((i == j) if faces else ((j == m) | (j == o)))
                r = apart(x + tl.where(here, f, 0), frames, i, j, m, o, faces)
                far = tl.sqrt(dot(r[0], r[1], r[2], r[0], r[1], r[2]))
                here = here & ~shared & (far < reach)
                if writes != 0:
                    turned = (q < p) if ascending else (q < 0)
                    tl.store(pairs + held, f, mask=here)
                    tl.store(pairs + total + held, tl.where(turned, q, p), mask=here)
                    tl.store(pairs + 2 * total + held, tl.where(turned, p, q), mask=here)
                    tl.store(distance + held, far, mask=here)
                held += here.to(tl.int64)
    tl.store(counts + 1 + query, held, mask=inside & (writes == 0))
