# SPDX-License-Identifier: Apache-2.0
"""The incremental potential of several garments that are worn together: their own ones, and contact between them.

All vertices are one system, those of the first garment first, so that contact pushes both sides with equal forces.
Each garment keeps its fabric, its stitches and its contact with the body. Garments meet as the cloth of one meets
itself (`self_contact`): with their thickness, on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...scene.assets import Floats, Scene
from ...scene.fabrics import Fabric
from ..collision import PosedBody, SmoothedDistance
from ..collision.limb_axes import outfit_axes
from ..collision.pierced import PiercedOutfit
from ..collision.sampled_cloth import SampledCloth
from ..samples import ContactSamples
from ..self_contact import ClothNeighbours, SelfContact, TouchingCloth
from ..world.surroundings import PosedWorld
from .blocks import BlockMatrix, BlockPattern
from .friction import Friction
from .incremental_potential import IncrementalPotential, StepInputs


@dataclass(frozen=True, eq=False)
class WornGarment:
    """A garment of an outfit.

    Attributes:
        scene: it on the character that all wear.
        start: where it starts in the bind pose [m], shape (V, 3), where that is not at its points, as after it was
            settled off what it is worn over; its rest shape stays that of its points.
    """

    scene: Scene
    fabric: Fabric
    start: Floats | None = None

    @property
    def offsets(self) -> Floats:
        """How far it starts from its points [m], shape (V, 3)."""
        points = self.scene.garment.mesh.points
        return np.zeros_like(points) if self.start is None else self.start - points


def need_one_character(garments: Sequence[WornGarment]) -> None:
    """Raise `SsilkError` unless garments are worn by one character."""
    first = garments[0].scene.character
    for each in garments[1:]:
        own = each.scene.character
        if own is not first and own.skeleton.joint_names != first.skeleton.joint_names:
            found, allowed = f"worn by {own.path}", f"garments of an outfit are worn by one character, {first.path}"
            fail(each.scene.garment.mesh.path, found, allowed, "name garments of one stage")


class OutfitPotential(IncrementalPotential):
    """The incremental potential of an outfit; positions are (V, 3, N).

    Attributes:
        parts: the potentials of its garments.
        limbs: axes that loose cloth of some garment must not cross; None where there are none.
        offsets: how far vertices start from their points in the bind pose [m], shape (V, 3, 1).
        cloth: the samples of all garments, those of the first garment first.

    Args:
        own: whether each garment also touches itself.
    """

    in_graphs = False  # its garments are evaluated one after the other

    def __init__(
        self, garments: Sequence[WornGarment], *, own: bool, device: torch.device, dtype: torch.dtype
    ) -> None:
        need_one_character(garments)
        self.limbs, clear = outfit_axes([each.scene for each in garments])
        self.parts = [
            IncrementalPotential(
                each.scene, each.fabric, device=device, dtype=dtype, limbs=limbs if self.limbs else None
            )
            for each, limbs in zip(garments, clear)
        ]
        self._rows = _slices([len(part.mass) for part in self.parts])
        self._sample_rows = _slices([len(part.cloth.area) for part in self.parts])
        self.dtype, self.size = dtype, max(part.size for part in self.parts)
        self.mass = torch.cat([part.mass for part in self.parts])
        self.free = torch.cat([part.free + rows.start for part, rows in self._each()])
        offsets = np.concatenate([each.offsets for each in garments])
        self.offsets = torch.as_tensor(offsets, dtype=dtype, device=device)[..., None]
        self._friction = torch.cat([torch.full_like(part.mass[:, 0], part.fabric.friction) for part in self.parts])
        self.cloth = SampledCloth(_joined([part.cloth.samples for part in self.parts]), device, dtype)
        worn = TouchingCloth.joined(
            [TouchingCloth.of(each.scene, each.fabric, each.start, beside_others=True) for each in garments]
        )
        self._self_contact = partial(SelfContact, worn, device, dtype, own)

    def _each(self) -> list[tuple[IncrementalPotential, slice]]:
        return list(zip(self.parts, self._rows))

    def _split(
        self, inputs: StepInputs, body_distance: SmoothedDistance | None = None
    ) -> Iterator[tuple[IncrementalPotential, slice, StepInputs, SmoothedDistance | None]]:
        """Yield each garment's potential with its rows, and its part of inputs and distances."""
        for number, ((part, rows), samples) in enumerate(zip(self._each(), self._sample_rows)):
            predicted, advected, skinned = (
                v if v is None else v[rows] for v in (inputs.predicted, inputs.advected, inputs.skinned)
            )
            gravity, pierced = inputs.gravity, inputs.pierced
            own = replace(
                inputs,
                gravity=gravity[rows.start] if gravity.dim() == 3 else gravity,
                predicted=predicted,
                advected=advected,
                skinned=skinned,
                neighbours=None,
                contacts=None,
                friction=None,
                pierced=pierced.parts[number] if isinstance(pierced, PiercedOutfit) else None,
            )
            distance = body_distance and SmoothedDistance(*(values[samples] for values in body_distance.tensors()))
            yield part, rows, own, distance

    @property
    def garments(self) -> list[tuple[slice, Fabric]]:
        """The rows of each garment among the vertices, with its fabric."""
        return [(rows, part.fabric) for part, rows in self._each()]

    @cached_property
    def _pattern(self) -> BlockPattern:
        """The pattern of the whole Hessian, whose blocks are those of the garments (`_together`)."""
        pairs = [
            part.free.cpu().numpy()[np.stack(np.divmod(part.block_pattern.keys, part.block_pattern.count), axis=1)]
            + rows.start
            for part, rows in self._each()
        ]
        free = self.free.cpu().numpy()
        return BlockPattern(np.concatenate(pairs), free, len(self.mass), self.free.device)

    @property
    def block_pattern(self) -> BlockPattern:
        """The sparsity pattern of its Hessian without contacts."""
        return self._pattern

    def pierced(self, x: Tensor, body: PosedBody) -> PiercedOutfit | None:
        """Return where limbs pierce each garment at x; None where none ever can."""
        found = []
        for part, rows in self._each():
            one = part.pierced(x[rows], body)
            assert not isinstance(one, PiercedOutfit)
            found.append(one)
        return PiercedOutfit(tuple(found)) if any(one is not None for one in found) else None

    def body_distance(self, x: Tensor, inputs: StepInputs, allowance: float = math.inf) -> SmoothedDistance | None:
        """Return the distances of the samples of x to the body, as that of one garment does."""
        return _joined_distances(
            [part.body_distance(x[rows], own, allowance) for part, rows, own, _ in self._split(inputs)]
        )

    def body_distance_nearby(
        self, x: Tensor, inputs: StepInputs, known: SmoothedDistance | None, at: Tensor
    ) -> SmoothedDistance | None:
        """Return distances where those at other positions are known, as that of one garment does."""
        return _joined_distances(
            [
                part.body_distance_nearby(x[rows], own, part_known, at[rows])
                for part, rows, own, part_known in self._split(inputs, known)
            ]
        )

    def friction(
        self,
        x: Tensor,
        body: PosedBody,
        neighbours: ClothNeighbours | None,
        dt: float,
        world: PosedWorld | None = None,
    ) -> Friction | None:
        """Return the friction in the step of dt [s] after positions x, as that of one garment does."""
        found = [
            replace(rubbing, vertices=rubbing.vertices + rows.start)
            for part, rows in self._each()
            if (rubbing := part.friction(x[rows], body, None, dt, world)) is not None
        ]
        if not found:
            return None
        if neighbours is not None:
            contacts = self.self_contact.contacts(x, neighbours)
            found.append(Friction.of_contacts(contacts, x, self._friction, dt))
        return Friction.joined(*found)

    def best_start(self, starts: Sequence[Tensor], inputs: StepInputs) -> Tensor:
        """Return for each frame, and each garment by itself, the start (V, 3, N) with the least energy."""
        return torch.cat(
            [part.best_start([x[rows] for x in starts], own) for part, rows, own, _ in self._split(inputs)]
        )

    def inside(self, x: Tensor, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the share of vertices inside the part of the body that they can touch, shape (N,)."""
        if body_distance is None:
            return x.new_zeros(x.shape[-1])
        distance = body_distance.distance(self.cloth.positions(x))
        rows = [distance[samples][: len(part.mass)] for part, samples in zip(self.parts, self._sample_rows)]
        return (torch.cat(rows) < 0).to(x.dtype).mean(0)

    def energy(self, x: Tensor, inputs: StepInputs, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the energy [J] of each frame, shape (N,), at the distances `body_distance` of x."""
        every = self._split(inputs, body_distance)
        total = torch.stack([part.energy(x[rows], own, distance) for part, rows, own, distance in every]).sum(0)
        for met in inputs.touching:
            total = total + met.energy(x)
        return total

    def collision(self, x: Tensor, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the collision energy of each sample [J], shape (S, N)."""
        if body_distance is None:
            return x.new_zeros(len(self.cloth.area), x.shape[-1])
        return self.collision_at(body_distance.distance(self.cloth.positions(x)))

    def collision_at(self, distance: Tensor) -> Tensor:
        """Return the collision energy of samples at given distances [J], shape (S, N)."""
        return torch.cat([part.collision_at(distance[rows]) for part, rows in zip(self.parts, self._sample_rows)])

    def gradient(self, x: Tensor, inputs: StepInputs, body_distance: SmoothedDistance | None) -> Tensor:
        """Return the gradient [N] at all vertices, shape (V, 3, N)."""
        every = self._split(inputs, body_distance)
        total = torch.cat([part.gradient(x[rows], own, distance) for part, rows, own, distance in every])
        for met in inputs.touching:
            total += met.gradient(x)
        return total

    def hessian(
        self,
        x: Tensor,
        inputs: StepInputs,
        body_distance: SmoothedDistance | None,
        fixed: Tensor | None = None,
        exact_hessian: Tensor | None = None,
    ) -> BlockMatrix:
        """Return the Hessian over the free vertices, as that of one garment does."""
        found = [
            part.hessian(x[rows], own, distance, None if fixed is None else fixed[rows], exact_hessian)
            for part, rows, own, distance in self._split(inputs, body_distance)
        ]
        diagonal = [each.blocks[: each.pattern.count] for each in found]
        above = [each.blocks[each.pattern.count :] for each in found]
        return BlockMatrix(self._pattern, torch.cat([*diagonal, *above]), self.touching_stiffness(x, inputs))

    def residual(self, gradient: Tensor) -> Tensor:
        """Return the largest RMS acceleration of a garment that a gradient (V, 3, N) leaves, in units of g: (N,)."""
        moving = [part.residual(gradient[rows]) for part, rows in self._each() if len(part.free)]
        return torch.stack([gradient.new_zeros(gradient.shape[-1]), *moving]).amax(0)


def _slices(counts: Sequence[int]) -> list[slice]:
    """Return the rows of each of several parts that follow each other."""
    ends = np.cumsum([0, *counts]).tolist()
    return [slice(first, last) for first, last in pairwise(ends)]


def _joined(parts: Sequence[ContactSamples]) -> ContactSamples:
    """Return the samples of several garments, each with its vertices first, on vertices that follow each other."""
    rows = _slices([part.vertex_count for part in parts])
    return ContactSamples(
        rows[-1].stop,
        np.concatenate([part.corners + own.start for part, own in zip(parts, rows)]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.area for part in parts]),
    )


def _joined_distances(parts: Sequence[SmoothedDistance | None]) -> SmoothedDistance | None:
    """Return the distances of the samples of several garments; None without a body."""
    own = [part.tensors() for part in parts if part is not None]
    return SmoothedDistance(*(torch.cat(values) for values in zip(*own, strict=True))) if own else None
