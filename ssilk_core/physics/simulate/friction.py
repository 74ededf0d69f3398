# SPDX-License-Identifier: Apache-2.0
"""Coulomb friction of cloth on the body, on colliders and on cloth, as a potential of the slip in one step.

What pressed at the end of the last step rubs in this one: its forces and directions stay as they were then. So the
friction of a step is a convex potential, as in IPC (Li et al. 2020, Section 5). With the coefficient mu, a force p,
and a slip of the length y, its derivative by y rises smoothly from zero to mu p at y = `CREEP` dt, and stays there:
cloth that sticks creeps, at most so fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..collision.sampled_cloth import SampledCloth
from ..energy.collision import ContactLaw
from ..framed import consecutive
from ..self_contact import ClothContacts
from ..self_contact.contacts import Slopes, at_vertices
from ..self_contact.neighbours import places_among
from ..world.surroundings import PosedWorld

CREEP = 2e-3  # [m/s]
TINY = 1e-12  # [m]


@dataclass(frozen=True, eq=False)
class Friction:
    """What rubs in N frames, in P places.

    Attributes:
        frames: number N.
        creep: slip from which on friction is full [m].
        frame: of each place, shape (P,).
        vertices: of the cloth, shape (4, P).
        coefficients: of these in a position c . x, or in the difference of two, shape (4, P).
        corners: vertices of the body, and after these of all colliders of the shot, shape (3, P).
        weights: of these, likewise; zero where cloth rubs on cloth, shape (3, P).
        direction: across which it slips, unit vectors, shape (3, P).
        limit: mu p [N], shape (P,).
        held: c . x - w . b at the end of the last step [m], for vertices b of what cloth rubs on; then, for a step,
            c . x where nothing would slip, shape (3, P).
    """

    frames: int
    creep: float
    frame: Tensor
    vertices: Tensor
    coefficients: Tensor
    corners: Tensor
    weights: Tensor
    direction: Tensor
    limit: Tensor
    held: Tensor

    @classmethod
    def joined(cls, *parts: Friction) -> Friction:
        """Return all together, of the same frames."""
        rows = [torch.cat(each, dim=-1) for each in zip(*(part._rows() for part in parts), strict=True)]
        return cls(parts[0].frames, parts[0].creep, *rows)

    @classmethod
    def of_contacts(cls, contacts: ClothContacts, x: Tensor, mu: float | Tensor, dt: float) -> Friction:
        """Return that of contacts of cloth with cloth at positions x (V, 3, N).

        Args:
            mu: the coefficient, or that of the cloth at each vertex (V,): two kinds of cloth rub with their mean.
        """
        own = contacts.pressing(x)
        if isinstance(mu, Tensor):
            mu = 0.5 * (mu[own.vertices[0]] + mu[own.vertices[-1]])
        none = torch.zeros(3, len(own.frame), dtype=torch.long, device=x.device)
        held = _combined(own.coefficients, x, own.vertices, own.frame)
        rows = own.vertices, own.coefficients, none, none.to(x.dtype), own.direction, mu * own.pressure(x), held
        return cls(own.frames, CREEP * dt, own.frame, *rows)

    @classmethod
    def on_world(
        cls,
        cloth: SampledCloth,
        law: ContactLaw,
        samples: Tensor,
        x: Tensor,
        world: PosedWorld,
        body: int,
        mu: float,
        dt: float,
    ) -> Friction:
        """Return that of cloth at positions x (V, 3, N) on colliders, beside a body of so many vertices.

        Args:
            samples: positions of those that meet colliders, the first of the cloth's, shape (S, 3, N).
        """
        near = world.touched(samples, law.start)
        row, frame = near.row, near.frame
        held = samples[row, :, frame].T - world.on_surfaces(near.corners, near.weights, frame)
        limit = mu * cloth.area[row, 0] * law.pressure(near.distance)
        met = near.corners + body, near.weights
        return cls(x.shape[-1], CREEP * dt, frame, *corners_of(cloth, row, x), *met, near.normal, limit, held)

    @classmethod
    def concatenated(cls, parts: Sequence[Friction]) -> Friction:
        """Return that of the frames of several, one after the other."""
        places = consecutive([part.frames for part in parts], parts[0].frame.device)
        moved = [replace(part, frame=place[part.frame]) for part, place in zip(parts, places)]
        return replace(cls.joined(*moved), frames=sum(map(len, places)))

    def after(self, body: Tensor, world: PosedWorld | None = None) -> Friction:
        """Return that of a step in which the body has moved to points (B, 3, N), and colliders as `world` has them.

        A collider that is gone rubs no more.
        """
        on_world = self.corners[0] >= len(body)
        if not bool(on_world.any()):
            return replace(self, held=self.held + _combined(self.weights, body, self.corners, self.frame))
        moved = _combined(self.weights, body, self.corners.where(~on_world, 0), self.frame)
        if world is None:
            moved[:, on_world] = torch.nan
        else:
            own = (self.corners - len(body))[:, on_world], self.weights[:, on_world], self.frame[on_world]
            moved[:, on_world] = world.on_surfaces(*own)
        there = ~moved.isnan().any(0)
        return replace(self, held=self.held + moved.where(there, 0), limit=self.limit.where(there, 0))

    def select(self, frames: Tensor) -> Friction:
        """Return that of the frames with indices (M,), in ascending order."""
        place = places_among(self.frame, frames, self.frames)
        kept = place >= 0
        _, *rest = (part[..., kept] for part in self._rows())
        return Friction(len(frames), self.creep, place[kept], *rest)

    def energy(self, x: Tensor) -> Tensor:
        """Return the potential of each frame [J], shape (N,), at positions x (V, 3, N); zero where nothing slips."""
        slip = self._slip(x).norm(dim=0)
        part = slip.clamp_max(self.creep) / self.creep
        potential = self.limit * self.creep * (part**2 - part**3 / 3) + self.limit * (slip - self.creep).clamp_min(0)
        return potential.new_zeros(self.frames).index_put_((self.frame,), potential, accumulate=True)

    def gradient(self, x: Tensor) -> Tensor:
        """Return its gradient [N], shape (V, 3, N)."""
        slip = self._slip(x)
        force = self._along(slip.norm(dim=0)) * slip
        return at_vertices(self.coefficients[:, None] * force, self.vertices, self.frame, x)

    def slopes(self, x: Tensor) -> Slopes:
        """Return what its Hessian at x is made of: along the slip, and across it."""
        slip = self._slip(x)
        length = slip.norm(dim=0)
        other = torch.eye(3, dtype=x.dtype, device=x.device)[self.direction.abs().argmin(0)].T
        any_way = torch.nn.functional.normalize(torch.linalg.cross(self.direction, other, dim=0), dim=0)
        along = torch.where(length > TINY, slip / length.clamp_min(TINY), any_way)
        across = torch.linalg.cross(self.direction, along, dim=0)
        stiffness = 2 / self.creep * (1 - length / self.creep).clamp_min(0) * self.limit
        parts = [
            (root.sqrt() * self.coefficients)[:, None] * axis
            for root, axis in ((stiffness, along), (self._along(length), across))
        ]
        return Slopes(self.frame.repeat(2), self.vertices.repeat(1, 2), torch.cat(parts, dim=-1))

    def _slip(self, x: Tensor) -> Tensor:
        """Return by what cloth slips [m], shape (3, P)."""
        moved = _combined(self.coefficients, x, self.vertices, self.frame) - self.held
        return moved - (self.direction * moved).sum(0) * self.direction

    def _along(self, length: Tensor) -> Tensor:
        """Return the force of friction over the length of the slip [N/m], shape (P,)."""
        part = length / self.creep
        return self.limit / self.creep * torch.where(part < 1, 2 - part, 1 / part.clamp_min(1))

    def _rows(self) -> tuple[Tensor, ...]:
        return (
            self.frame,
            self.vertices,
            self.coefficients,
            self.corners,
            self.weights,
            self.direction,
            self.limit,
            self.held,
        )


def corners_of(cloth: SampledCloth, row: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vertices of samples (P,) at positions x, with their coefficients, of four of which one has none."""
    vertices = torch.as_tensor(cloth.samples.corners, device=x.device)[row].T
    coefficients = torch.as_tensor(cloth.samples.weights, dtype=x.dtype, device=x.device)[row].T
    return torch.cat([vertices, vertices[:1]]), torch.cat([coefficients, torch.zeros_like(coefficients[:1])])


def _combined(coefficients: Tensor, points: Tensor, index: Tensor, frame: Tensor) -> Tensor:
    """Return sums (3, P) of points (V, 3, N), each of the index (C, P) in its frame (P,)."""
    return (coefficients[:, None] * points[index, :, frame].movedim(-1, 1).to(coefficients.dtype)).sum(0)
