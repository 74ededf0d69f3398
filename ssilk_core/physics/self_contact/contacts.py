# SPDX-License-Identifier: Apache-2.0
"""Contacts of cloth with cloth, linear in the positions: gap = n . sum c_i x_i over the four vertices of each.

Nearest points, directions n and sides are those of one state. Gradient and Hessian there are those of the energy in
which they turn, but for the Hessian's part that turning makes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .. import kernels
from ..energy.collision import ContactLaw
from ..framed import consecutive
from .neighbours import places_among

CLOSING = 0.8  # of a gap, by which it may close in one step
SLACK = 0.2  # of what pairs of one garment begin to touch later than others: they lie near at rest, as along seams
SLOWED = 40  # rounds in which single vertices are slowed, since each changes how others close
UNSLOWED = 0.99  # the share above which a vertex counts as not slowed: 0.8 + 0.01 of a gap is still a gap
TINY = 1e-12  # [m]


def at_vertices(parts: Tensor, vertices: Tensor, frame: Tensor, x: Tensor) -> Tensor:
    """Return the sums of parts (4, 3, P), of the vertices (4, P) in frames (P,), in the shape (V, 3, N) of x."""
    found = x.new_zeros(len(x), x.shape[-1], 3)
    at = vertices, frame.expand_as(vertices)
    return found.index_put_(at, parts.movedim(1, -1), accumulate=True).movedim(-1, 1).contiguous()


@dataclass(frozen=True, eq=False)
class Slopes:
    """Rows whose squares add up to a Hessian: the sum over R rows of each row with itself.

    Attributes:
        frame: of each, shape (R,).
        vertices: shape (4, R).
        values: the row's part at each vertex [(N/m)^1/2], shape (4, 3, R).
    """

    frame: Tensor
    vertices: Tensor
    values: Tensor

    @classmethod
    def joined(cls, *parts: Slopes) -> Slopes:
        """Return all together."""
        names = "frame", "vertices", "values"
        return cls(*(torch.cat([getattr(part, name) for part in parts], dim=-1) for name in names))


@dataclass(frozen=True, eq=False)
class ClothContacts:
    """Contacts of P pairs in N frames.

    Attributes:
        law: how pressure depends on the gap, which is measured from each pair's own start.
        frames: number N.
        frame: of each contact, shape (P,).
        vertices: shape (4, P).
        coefficients: c_i, shape (4, P).
        second: whether each vertex belongs to the second of the two, shape (4, P).
        direction: n, from the second to the first, unit vectors, shape (3, P).
        start: gap at which contact begins [m], shape (P,).
        area: on which pressure acts [m2], shape (P,).
        slack: by which a pair may come nearer in a step, however near it is [m], shape (P,).
    """

    law: ContactLaw
    frames: int
    frame: Tensor
    vertices: Tensor
    coefficients: Tensor
    second: Tensor
    direction: Tensor
    start: Tensor
    area: Tensor
    slack: Tensor

    def along(self, x: Tensor) -> Tensor:
        """Return vectors (V, 3, N) along each direction, shape (4, P)."""
        if kernels.available(x.device):
            from ..kernels.cloth_contacts import along_kernel

            return along_kernel(x, self.vertices, self.frame, self.direction)
        return (self.direction * x[self.vertices, :, self.frame].movedim(-1, 1)).sum(1)

    def gap(self, x: Tensor) -> Tensor:
        """Return the gaps [m] at positions (V, 3, N), shape (P,); negative where cloth has passed through."""
        return (self.coefficients * self.along(x)).sum(0)

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy of each frame [J], shape (N,)."""
        energy = self._by_kernel(x, "energy")
        if energy is None:
            energy = self.area * self.law.energy(self._relative(x))
        return energy.new_zeros(self.frames).index_put_((self.frame,), energy, accumulate=True)

    def gradient(self, x: Tensor) -> Tensor:
        """Return the gradient [N], shape (V, 3, N)."""
        force = self._by_kernel(x, "force")
        if force is None:
            force = (-self.pressure(x) * self.coefficients)[:, None] * self.direction
        return at_vertices(force, self.vertices, self.frame, x)

    def stiffness(self, x: Tensor) -> Tensor:
        """Return the second derivative of each contact's energy by its gap [N/m], shape (P,)."""
        return self.area * self.law.curvature(self._relative(x))

    def pressure(self, x: Tensor) -> Tensor:
        """Return the force of each contact [N], shape (P,)."""
        return self.area * self.law.pressure(self._relative(x))

    def slopes(self, x: Tensor) -> Slopes:
        """Return what the Hessian at x is made of."""
        values = self._by_kernel(x, "slopes")
        if values is None:
            values = (self.stiffness(x).sqrt() * self.coefficients)[:, None] * self.direction
        return Slopes(self.frame, self.vertices, values)

    def _by_kernel(self, x: Tensor, what: str) -> Tensor | None:
        """Return what `pressed_kernel` does, where kernels run."""
        if not kernels.available(x.device):
            return None
        from ..kernels.cloth_contacts import pressed_kernel

        rows = self.vertices, self.frame, self.coefficients, self.direction, self.start, self.area
        return pressed_kernel(x, self.law, *rows, what)

    def allowed(self, x: Tensor, step: Tensor, yielding: float = 0.0) -> Tensor:
        """Return by which share of a step (V, 3, N) each vertex may move, shape (V, N).

        With the least of all shares of a frame, a plane across n goes on to separate each pair: the two come nearer
        to each other by at most `CLOSING` of their gap. Those that are hardly apart may do so by
        `yielding` [m].
        """
        if kernels.available(x.device):
            from ..kernels.cloth_contacts import allowed_kernel

            rows = self.vertices, self.frame, self.coefficients, self.second, self.direction, self.slack
            return allowed_kernel(x, step, *rows, CLOSING, yielding)
        along = self.along(step)
        first = along.masked_fill(self.second, torch.inf).amin(0)
        closing = along.masked_fill(~self.second, -torch.inf).amax(0) - first
        share = (self._most(x, yielding).clamp_min(TINY) / closing.clamp_min(TINY)).clamp_max(1).expand(4, -1)
        found = torch.ones_like(step[:, 0]).flatten()
        at = self.vertices * self.frames + self.frame
        return found.scatter_reduce_(0, at.flatten(), share.flatten(), "amin").view_as(step[:, 0])

    def without_passing(self, x: Tensor, step: Tensor, yielding: float = 0.0) -> Tensor:
        """Return a step (V, 3, N) from x in which no cloth passes through cloth: some vertices are slowed.

        Args:
            yielding: as in `allowed`.
        """
        done = torch.zeros(self.frames, dtype=torch.bool, device=x.device)
        near = self._meeting(x, step, yielding)
        for _ in range(SLOWED):
            share = near.allowed(x, step, yielding)
            step = torch.where(done, step, share[:, None] * step)
            done = done | (share > UNSLOWED).all(0)
            if bool(done.all()):
                return step
        return torch.where(done, step, near.allowed(x, step, yielding).amin(0) * step)

    def _meeting(self, x: Tensor, step: Tensor, yielding: float) -> ClothContacts:
        """Return those that may slow a step, or one in which some vertices are slower; no other changes `allowed`.

        Where kernels run all are returned, since that takes less time.
        """
        if kernels.available(x.device):
            return self
        along = self.along(step)
        first = along.masked_fill(self.second, 0.0).clamp_max(0).amin(0)
        closing = along.masked_fill(~self.second, 0.0).clamp_min(0).amax(0) - first
        return self._kept(closing > self._most(x, yielding), self.frame, self.frames)

    def _most(self, x: Tensor, yielding: float) -> Tensor:
        """Return by how much each pair may come nearer in a step [m], shape (P,)."""
        return torch.maximum(CLOSING * self.gap(x), self.slack.clamp_min(yielding))

    def select(self, frames: Tensor) -> ClothContacts:
        """Return the contacts in the frames with indices (M,), in ascending order."""
        if len(frames) == self.frames:
            return self
        new = places_among(self.frame, frames, self.frames)
        return self._kept(new >= 0, new, len(frames))

    @classmethod
    def concatenated(cls, parts: Sequence[ClothContacts]) -> ClothContacts:
        """Return the contacts in the frames of several, one after the other."""
        places = consecutive([part.frames for part in parts], parts[0].frame.device)
        rows = "vertices", "coefficients", "second", "direction", "start", "area", "slack"
        frame = torch.cat([place[part.frame] for part, place in zip(parts, places)])
        own = (torch.cat([getattr(part, name) for part in parts], dim=-1) for name in rows)
        return cls(parts[0].law, sum(part.frames for part in parts), frame, *own)

    def pressing(self, x: Tensor) -> ClothContacts:
        """Return those that have an energy."""
        return self._kept(self.gap(x) < self.start, self.frame, self.frames)

    def _kept(self, kept: Tensor, frame: Tensor, frames: int) -> ClothContacts:
        own = self.vertices, self.coefficients, self.second, self.direction, self.start, self.area, self.slack
        return ClothContacts(self.law, frames, *(part[..., kept] for part in (frame, *own)))

    def _relative(self, x: Tensor) -> Tensor:
        """Return the gaps as the law counts them."""
        return self.gap(x) + (self.law.start - self.start)
