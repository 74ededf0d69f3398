# SPDX-License-Identifier: Apache-2.0
"""The incremental potential that a frame minimises: the training energy, with its gradient and Hessian.

Implicit Euler with time step dt is the minimum of

    stretch + bending + gravity + collision + tether + stitches
    + m/(2 dt^2) |x - (2 x' - x'')|^2 + drag a/(2 dt) |x - advected|^2

(`energy.GarmentEnergy`), and what friction takes (`friction`); a quasi-static state has none of the last two terms,
and no friction. The distance to the body is that to the whole surface that a vertex can touch. In training tight
cloth has only the triangles around the nearest vertex. It is smoothed on its creases (`collision.smoothed_distance`),
so that the gradient vanishes at minima there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.assets import Ints, Scene
from ...scene.fabrics import Fabric
from .. import loops
from ..captured import Captured, replays
from ..collision import Contacts, PosedBody, SmoothedDistance
from ..collision.inner_cloth import PosedBeneath
from ..collision.pierced import PiercedCloth, PiercedOutfit
from ..constants import GRAVITY
from ..energy import GarmentEnergy
from ..framed import Framed
from ..kernels.corners import ElasticTables, elastic_tables
from ..self_contact import ClothContacts, ClothNeighbours, SelfContact, TouchingCloth
from ..self_contact.contacts import Slopes
from ..world.surroundings import PosedWorld
from .blocks import BlockMatrix, BlockPattern
from .captured_potential import CapturedPotential
from .contact_stiffness import ContactStiffness
from .friction import CREEP, Friction, corners_of
from .hessian import NO_CORNERS, Hessian
from .membrane import outer
from .stitches import stitch_gradient

ROUNDS, ARRIVED = 24, 1e-3  # in which a garment goes towards a target, and how near it comes there [m]
HELD = 1e3  # weight of a vertex that is not free, in the rigid motion that a garment begins with


@dataclass(frozen=True, eq=False)
class StepInputs(Framed):
    """Inputs of the energy of N frames, besides the positions.

    Attributes:
        body: in the coordinates of the positions, float32.
        gravity: acceleration [m/s2], shape (3, N), or of each vertex, (V, 3, N), where wind pushes an outfit's
            garments differently.
        predicted: 2 x' - x'' [m], shape (V, 3, N), or None for a quasi-static state.
        advected: x' moved with the air [m], shape (V, 3, N), or None likewise.
        dt: time step [s], or that of each frame, shape (N,). For a quasi-static state it only damps the solver's
            steps.
        skinned: the garment under linear blend skinning [m], where tethers hold it, shape (V, 3, N); None without.
        neighbours: which cloth may touch which, or None where cloth may pass through cloth.
        contacts: of cloth with cloth, about the positions that a step starts from; None where no step began.
        friction: of what pressed in the step before; None without.
        pierced: the cloth that limbs are through, wherever it goes; None where that is found at each position.
        world: what cloth meets besides the body; None without.
        beneath: the garments beneath, for a potential that meets them (`over_cloth`); None without.
    """

    body: PosedBody | None
    gravity: Tensor
    predicted: Tensor | None = None
    advected: Tensor | None = None
    dt: float | Tensor = 0.1
    skinned: Tensor | None = None
    neighbours: ClothNeighbours | None = None
    contacts: ClothContacts | None = None
    friction: Friction | None = None
    pierced: PiercedCloth | PiercedOutfit | None = None
    world: PosedWorld | None = None
    beneath: PosedBeneath | None = None

    @property
    def touching(self) -> list[ClothContacts | Friction]:
        """What is among a number of places that changes from step to step: cloth on cloth, and what rubs."""
        return [part for part in (self.contacts, self.friction) if part is not None]

    @property
    def alone(self) -> StepInputs:
        """What is left without these."""
        return replace(self, neighbours=None, contacts=None, friction=None)

    @property
    def is_plain(self) -> bool:
        """Whether the rest is tensors of fixed sizes: one garment meets its body alone."""
        return self.world is None and self.beneath is None and not isinstance(self.pierced, PiercedOutfit)


class IncrementalPotential:
    """The incremental potential of one garment; positions are (V, 3, N).

    Attributes:
        free: indices of the free vertices: not pinned, with mass, shape (U,).
        size: diagonal of the garment's bounding box at rest [m].
        cloth: the samples at which it meets things, those that meet the body and the world first.
        sample_count: of these.
        in_graphs: whether a GPU may keep graphs of it, which hold memory as long as it lives.

    Args:
        dtype: of positions, energies and gradients; Hessians are float32.
        limbs: which of the limbs that are posed must not cross the garment, bool (L,); all by default.
    """

    in_graphs = True

    def __init__(
        self,
        scene: Scene,
        fabric: Fabric,
        *,
        device: torch.device,
        dtype: torch.dtype = torch.float64,
        limbs: NDArray[np.bool_] | None = None,
    ) -> None:
        mesh = scene.garment.mesh
        energy = GarmentEnergy(scene.garment.rest_mesh, fabric, scene.classes, device=device, dtype=dtype)
        self.fabric, self.dtype = fabric, dtype
        self.mass: Tensor = energy.mass[:, None]
        self.tether = torch.zeros_like(self.mass)
        self.tether[energy.tethered, 0] = energy.tether_stiffness
        self.size = mesh.diagonal
        self.cloth, self.law, self.stitching = energy.cloth, energy.law, energy.stitching
        self.sample_count = len(self.cloth.area)
        self.contacts = Contacts(scene, self.cloth.samples, limbs=limbs, device=device)
        self._self_contact = partial(SelfContact, TouchingCloth.of(scene, fabric), device, dtype)
        self.use(Hessian.of(scene, energy))

    def use(self, hessian: Hessian) -> None:
        """Take the elastic elements and the free vertices of a Hessian."""
        self._hessian = hessian
        self.membrane, self.hinges, self.free = hessian.membrane, hessian.hinges, hessian.free
        for name in ("_elastic_tables", "_place", "captured"):
            self.__dict__.pop(name, None)

    @property
    def garments(self) -> list[tuple[slice, Fabric]]:
        """The rows of each garment among the vertices, with its fabric: of one, all."""
        return [(slice(None), self.fabric)]

    @cached_property
    def self_contact(self) -> SelfContact:
        """What knows where the garment touches itself; nothing is spent on it where nobody asks."""
        return self._self_contact()

    def replays(self, x: Tensor, inputs: StepInputs) -> bool:
        """Return whether `captured` serves positions x (V, 3, N), for all of the inputs but those that touch."""
        return self.in_graphs and inputs.is_plain and replays(x)

    @cached_property
    def captured(self) -> CapturedPotential:
        """What a GPU computes of it at once, for inputs alone (`StepInputs.alone`)."""

        def state(x: Tensor, inputs: StepInputs) -> list[Tensor]:
            distance = self.body_distance(x, inputs)
            return [self.energy(x, inputs, distance), *(distance.tensors() if distance else [])]

        def gradient(x: Tensor, inputs: StepInputs, distance: SmoothedDistance | None) -> list[Tensor]:
            return [self.gradient(x, inputs, distance)]

        def hessian(x: Tensor, inputs: StepInputs, touching: Tensor | None, *others: Any) -> list[Tensor]:
            matrix = self.hessian(x, inputs, *others)
            return [matrix.blocks, matrix.inverse_diagonal(touching)]

        return CapturedPotential(Captured(state), Captured(gradient), Captured(hessian))

    @property
    def block_pattern(self) -> BlockPattern:
        """The sparsity pattern of its Hessian."""
        return self._hessian.pattern

    def pierced(self, x: Tensor, body: PosedBody) -> PiercedCloth | PiercedOutfit | None:
        """Return where limbs pierce the cloth at x; None where none ever can."""
        return self.contacts.pierced(self.cloth.positions(x), body)

    def body_distance(self, x: Tensor, inputs: StepInputs, allowance: float = math.inf) -> SmoothedDistance | None:
        """Return the distances of the samples of x to the body, to second order.

        Args:
            allowance: what cloth may come nearer [m] while the distances are used; with less they cost less.
        """
        if inputs.body is None:
            return None
        assert not isinstance(inputs.pierced, PiercedOutfit)
        within = self.law.start + allowance
        return self.contacts.smoothed(self._own_samples(x), inputs.body, within, inputs.pierced)

    def body_distance_nearby(
        self, x: Tensor, inputs: StepInputs, known: SmoothedDistance | None, at: Tensor
    ) -> SmoothedDistance | None:
        """Return distances that give the energy and its derivatives at x as `body_distance` does, where those at
        other positions `at` (V, 3, N) are known: on a processor in less time, the nearer the two are."""
        if inputs.body is None or known is None or inputs.pierced is not None:
            return self.body_distance(x, inputs)
        samples, within = self._own_samples, self.law.start
        return self.contacts.smoothed_nearby(samples(x), inputs.body, known, samples(at), within)

    def with_contacts(self, x: Tensor, inputs: StepInputs, moved: bool = False) -> StepInputs:
        """Return inputs with the contacts of cloth with cloth at x, where cloth may not pass through cloth.

        Args:
            moved: the garment has moved to x, which is not only tried.
        """
        if inputs.neighbours is None:
            return inputs
        if moved:
            neighbours, contacts = self.self_contact.moved(x, inputs.neighbours)
        else:
            neighbours = self.self_contact.around(x, inputs.neighbours)
            contacts = self.self_contact.contacts(x, neighbours)
        return replace(inputs, neighbours=neighbours, contacts=contacts)

    def approach(
        self, x: Tensor, target: Tensor, inputs: StepInputs, known: ClothNeighbours | None
    ) -> tuple[Tensor, StepInputs]:
        """Return how far the garment comes from x towards a target, both (V, 3, N), without passing through itself.

        It first moves as a rigid body with what is pinned, which brings no cloth nearer to other cloth.

        Args:
            known: which cloth may touch which at x, on older sides than those at x; None where there are none.

        Returns:
            The positions, and the inputs with what may touch there.
        """
        x = moved_rigidly(x, target, torch.full_like(self.mass, HELD).index_fill_(0, self.free, 1.0))
        inputs = replace(inputs, neighbours=self.self_contact.neighbours(x, x, known))
        inputs = self.with_contacts(x, inputs, moved=True)
        arrived = torch.zeros(x.shape[-1], dtype=torch.bool, device=x.device)
        for _ in range(ROUNDS):
            assert inputs.neighbours is not None
            neighbours, step, met = self.self_contact.ahead(target - x, inputs.neighbours)
            inputs, step = replace(inputs, neighbours=neighbours), met.without_passing(x, step)
            arrived = arrived | (step.norm(dim=1).amax(0) < ARRIVED)
            if bool(arrived.all()):
                break
            x = torch.where(arrived, x, x + step)
            inputs = self.with_contacts(x, inputs, moved=True)
        return x, inputs

    def friction(
        self,
        x: Tensor,
        body: PosedBody,
        neighbours: ClothNeighbours | None,
        dt: float,
        world: PosedWorld | None = None,
    ) -> Friction | None:
        """Return the friction in the step of dt [s] after positions x on a body, and on the colliders of a world;
        None for cloth without friction."""
        mu = self.fabric.friction
        if not mu:
            return None
        samples = self._own_samples(x)
        found = self.contacts.smoothed(samples, body)
        distance = found.distance(samples)
        force = self.cloth.area[: self.sample_count] * self.law.pressure(distance)
        reach = torch.where(force > 0, 2 * distance.abs() + self.law.start, -1.0).float()
        row, frame, corners, weights = self.contacts.touched(samples.float(), reach, body)
        normal = torch.nn.functional.normalize(found.normal[row, :, frame].T, dim=0)
        weights = weights.to(x.dtype)
        on_body = (weights[:, None] * body.points[corners, :, frame].movedim(-1, 1)).sum(0)
        rubbing = Friction(
            x.shape[-1],
            CREEP * dt,
            frame,
            *corners_of(self.cloth, row, x),
            corners,
            weights,
            normal,
            mu * force[row, frame],
            samples[row, :, frame].T - on_body,
        )
        parts = [rubbing]
        if world is not None and world.has_colliders:
            parts.append(Friction.on_world(self.cloth, self.law, samples, x, world, len(body.points), mu, dt))
        if neighbours is not None:
            parts.append(Friction.of_contacts(self.self_contact.contacts(x, neighbours), x, mu, dt))
        return Friction.joined(*parts)

    def best_start(self, starts: Sequence[Tensor], inputs: StepInputs) -> Tensor:
        """Return for each frame the start (V, 3, N) with the least energy."""
        energies = [self.energy(x, inputs, self.body_distance(x, inputs)) for x in starts]
        chosen = torch.stack(energies).nan_to_num(nan=torch.inf).argmin(0)
        best = starts[0]
        for number, start in enumerate(starts[1:], start=1):
            best = torch.where(chosen == number, start, best)
        return best

    def inside(self, x: Tensor, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the share of vertices inside the part of the body that they can touch, shape (N,)."""
        if body_distance is None:
            return x.new_zeros(x.shape[-1])
        return (body_distance.distance(self.cloth.positions(x))[: len(x)] < 0).to(x.dtype).mean(0)

    def energy(self, x: Tensor, inputs: StepInputs, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the energy [J] of each frame, shape (N,), at the distances `body_distance` of x."""
        total = self._elastic_energy(x)
        if self.stitching:
            total = total + self.stitching.energy(x)
        for part in inputs.touching:
            total = total + part.energy(x)
        if inputs.world is not None:
            total = total + self._world_energy(x, inputs.world)
        if self._by_loop(x, inputs) and not x.requires_grad:
            return total + self._points(x, inputs, body_distance, False)[0]
        total = total - (self.mass * (x * inputs.gravity).sum(1)).sum(0)
        for weight, target in self._anchors(inputs):
            total = total + (0.5 * weight * ((x - target) ** 2).sum(1)).sum(0)
        return total + self.collision(x, body_distance).sum(0)

    @staticmethod
    def _by_loop(x: Tensor, inputs: StepInputs) -> bool:
        return loops.supports(x) and not isinstance(inputs.dt, Tensor)

    def _points(
        self, x: Tensor, inputs: StepInputs, body_distance: SmoothedDistance | None, wanted: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `loops.points.points_loop` does for gravity, anchors and contact with the body."""
        from ..loops.points import points_loop

        given = x, self.mass, inputs.gravity, self._anchors(inputs), self.cloth.positions(x)
        planes = (body_distance.normal, body_distance.offset) if body_distance else None
        law = self.law.stiffness, self.law.start, self.law.ramp
        return points_loop(*given, planes, self.cloth.area, law, wanted)

    def collision(self, x: Tensor, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the collision energy of each sample [J], shape (S, N)."""
        if body_distance is None:
            return torch.zeros_like(x[:, 0])
        return self.collision_at(body_distance.distance(self.cloth.positions(x)))

    def collision_at(self, distance: Tensor) -> Tensor:
        """Return the collision energy of samples at given distances [J], shape (S, N)."""
        return self.cloth.area * self.law.energy(distance)

    def gradient(self, x: Tensor, inputs: StepInputs, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the gradient [N] at all vertices, shape (V, 3, N)."""
        total = self._elastic_gradient(x)
        if self.stitching:
            total += stitch_gradient(self.stitching, x)
        for part in inputs.touching:
            total += part.gradient(x)
        if inputs.world is not None:
            total += self._world_gradient(x, inputs.world)
        if self._by_loop(x, inputs):
            _, slopes, pushes = self._points(x, inputs, body_distance, True)
            total += slopes
            return total + self.cloth.to_vertices(pushes) if body_distance else total
        total -= self.mass[:, None] * inputs.gravity
        for weight, target in self._anchors(inputs):
            total += weight[:, None] * (x - target)
        if body_distance:
            total -= self.cloth.to_vertices(self._push(x, body_distance)[:, None] * body_distance.normal)
        return total

    def hessian(
        self,
        x: Tensor,
        inputs: StepInputs,
        body_distance: SmoothedDistance | None,
        fixed: Tensor | None = None,
        exact_hessian: Tensor | None = None,
    ) -> BlockMatrix:
        """Return the Hessian over the free vertices, in float32, with each part projected to be semi-definite.

        Args:
            fixed: vertices that must not move, shape (V, N); none by default.
            exact_hessian: frames that use the membrane's exact Hessian, which compression may make indefinite, shape
                (N,); none by default.
        """
        still = [] if inputs.predicted is not None else [(self.mass / inputs.dt**2, None)]
        weight = sum((weight for weight, _ in [*self._anchors(inputs), *still]), torch.zeros_like(self.mass))
        contact = None
        if body_distance:
            distance, normal = body_distance.distance(self.cloth.positions(x)), body_distance.normal
            push, stiffness = (
                self.cloth.area * part for part in (self.law.pressure(distance), self.law.curvature(distance))
            )
            contact = stiffness[:, None, None] * outer(normal, normal) + push[:, None, None] * body_distance.curvature
        if inputs.world is not None:
            contact = self._with_world(contact, x, inputs.world)
        fixed = None if fixed is None else fixed[self.free]
        found = self._hessian(x, weight[self.free].float(), contact, fixed, exact_hessian)
        return replace(found, contacts=self.touching_stiffness(x, inputs))

    def _world_energy(self, x: Tensor, world: PosedWorld) -> Tensor:
        """Return the energy of contact with what surrounds the character [J], shape (N,)."""
        near = world.touched(self._own_samples(x), self.law.start)
        each = self.cloth.area[near.row, 0] * self.law.energy(near.distance)
        return x.new_zeros(x.shape[-1]).index_put_((near.frame,), each, accumulate=True)

    def _world_gradient(self, x: Tensor, world: PosedWorld) -> Tensor:
        """Return its gradient [N], shape (V, 3, N)."""
        samples = self.cloth.positions(x)
        near = world.touched(samples[: self.sample_count], self.law.start)
        push = -self.cloth.area[near.row, 0] * self.law.pressure(near.distance) * near.normal
        pushes = samples.new_zeros(len(samples), x.shape[-1], 3)
        pushes.index_put_((near.row, near.frame), push.T, accumulate=True)
        return self.cloth.to_vertices(pushes.transpose(1, 2).contiguous())

    def _with_world(self, contact: Tensor | None, x: Tensor, world: PosedWorld) -> Tensor:
        """Return blocks of contact (S, 3, 3, N) with those of what surrounds the character.

        How its normal turns is left out: outside of edges and corners that would make a block indefinite.
        """
        samples = self.cloth.positions(x)
        near = world.touched(samples[: self.sample_count], self.law.start)
        stiffness = self.cloth.area[near.row, 0] * self.law.curvature(near.distance)
        blocks = samples.new_zeros(len(samples), x.shape[-1], 3, 3)
        each = (stiffness * near.normal[:, None] * near.normal).permute(2, 0, 1)
        blocks = blocks.index_put_((near.row, near.frame), each, accumulate=True).permute(0, 2, 3, 1)
        return blocks if contact is None else contact + blocks

    def _own_samples(self, x: Tensor) -> Tensor:
        """Return the samples that meet body and world, at positions (V, 3, N), shape (S, 3, N)."""
        return self.cloth.positions(x)[: self.sample_count]

    def touching_stiffness(self, x: Tensor, inputs: StepInputs) -> ContactStiffness | None:
        """Return the Hessian of what touches, or None where nothing could."""
        if not inputs.touching:
            return None
        parts = [part.slopes(x) for part in inputs.touching]
        slopes = parts[0] if len(parts) == 1 else Slopes.joined(*parts)
        return ContactStiffness.of(slopes, x.shape[-1], self._place, len(self.free))

    @cached_property
    def _place(self) -> Tensor:
        """The place of each vertex among the free ones, -1 for others, shape (V,)."""
        place = torch.full((len(self.mass),), -1, device=self.free.device)
        place[self.free] = torch.arange(len(self.free), device=self.free.device)
        return place

    def residual(self, gradient: Tensor) -> Tensor:
        """Return the RMS acceleration, over the free mass, that a gradient (V, 3, N) leaves, in units of g: (N,)."""
        force, mass = gradient[self.free], self.mass[self.free]
        return ((force * force).sum(1) / mass).sum(0).div(mass.sum()).sqrt() / GRAVITY

    def _elastic_energy(self, x: Tensor) -> Tensor:
        """Return stretch and bending [J], shape (N,)."""
        if loops.supports(x):
            from ..loops.elastic import elastic_loop

            stretch, bending = elastic_loop(x, self._elastic_tables, self.fabric)
            return stretch + bending
        stretch = self.membrane.energy(x)
        return stretch + self.hinges.energy(x) if self.hinges else stretch

    def _elastic_gradient(self, x: Tensor) -> Tensor:
        """Return the gradient of stretch and bending [N], shape (V, 3, N)."""
        if loops.supports(x):
            from ..loops.elastic import elastic_gradient_loop

            return elastic_gradient_loop(x, self._elastic_tables, self.fabric)
        total = self.membrane.gradient(x)
        return total + self.hinges.gradient(x) if self.hinges else total

    @cached_property
    def _elastic_tables(self) -> ElasticTables:
        membrane, hinges = self.membrane, self.hinges
        corners: Ints = hinges.corners if hinges else NO_CORNERS
        numbers = torch.cat([hinges.stiffness, hinges.rest], dim=1) if hinges else self.mass.new_zeros(0, 2)
        weights, areas = membrane.weights.permute(1, 2, 0).numpy(), membrane.area[:, 0].numpy()
        return elastic_tables(len(self.mass), membrane.corners, weights, areas, corners, numbers)

    def _anchors(self, inputs: StepInputs) -> list[tuple[Tensor, Tensor]]:
        """Return stiffness [N/m] and target (V, 3, N) of the tether, inertia and drag, where present.

        Stiffness is (V, 1), or (V, N) where frames have time steps of their own.
        """
        found = []
        if inputs.skinned is not None and self.fabric.tether:
            found.append((self.tether, inputs.skinned))
        if inputs.predicted is not None:
            found.append((self.mass / inputs.dt**2, inputs.predicted))
        if inputs.advected is not None and self.fabric.drag:
            found.append((self.fabric.drag / self.fabric.density * self.mass / inputs.dt, inputs.advected))
        return found

    def _push(self, x: Tensor, body_distance: SmoothedDistance) -> Tensor:
        """Return the force along the gradient of the distance on each sample [N], shape (S, N)."""
        return self.cloth.area * self.law.pressure(body_distance.distance(self.cloth.positions(x)))


def moved_rigidly(x: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return positions x (V, 3, N), moved as a rigid body in each frame so that they are nearest to a target.

    The least sum of squares, each with its weight (V, 1), has the rotation of Kabsch (Acta Cryst. A32, 1976).
    """
    share = (weight / weight.sum())[:, None]
    own, goal = ((share * points).sum(0) for points in (x, target))
    spread = torch.einsum("vin,vjn->nij", share * (target - goal), x - own)
    left, _, right = torch.linalg.svd(spread)
    mirrored = torch.linalg.det(left @ right) < 0
    left[:, :, 2] = torch.where(mirrored[:, None], -left[:, :, 2], left[:, :, 2])
    return torch.einsum("nij,vjn->vin", left @ right, x - own) + goal
