# SPDX-License-Identifier: Apache-2.0
"""All energies of one garment, term by term; whoever needs a total adds up `TERMS`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import LOOSE, TIGHT, Floats, Ints, Mesh
from ...scene.fabrics import Fabric
from ...scene.mesh import topology
from ...scene.mesh.stitches import held_stitches
from ...scene.mesh.topology import SLIVER
from .. import kernels, loops
from ..collision import PosedBody, signed_distance, signed_distance_to_planes
from ..collision.sampled_cloth import SampledCloth
from ..kernels.corners import elastic_tables
from ..operators import difference_operator
from ..samples import ContactSamples, contact_samples
from .bending import bending_energy, dihedral_angles
from .collision import ContactLaw
from .factors import FabricFactors
from .stitching import Stitching
from .stretch import column_weights, deformation_gradient_operator, stiffened, stretch_density, stretched_areas

TERMS = ("stretch", "bending", "gravity", "inertia", "collision", "tether", "stitch")
"""The paper's terms, and tether and stitches, which its fabric does without.

Drag is part of training but not of totals, so that these compare with the paper's.
"""
STATIC_TERMS = tuple(term for term in TERMS if term != "inertia")
"""Those that a pose at rest has."""


class GarmentEnergy:
    """Energies of a garment mesh made of one fabric.

    Attributes:
        mass: lumped vertex masses [kg], shape (V,).
        cloth: the samples of the cloth, at which it meets the body.
        tethered: indices of the vertices that a tether holds, shape (T,).
        tether_stiffness: of each of these [N/m], shape (T,).
        stitching: what holds islands on one another, or None.
        area: of the triangles, as their stretch counts [m2], shape (F, 1).
        bending_stiffness: of the hinges [J], shape (H, 1).
        rest_angle: of these [rad], shape (H, 1).
        gradient_operator, hinge_operator: from positions to deformation gradients, and to the edges of hinges.
        tables: of the rest shape, for fused energies.

    Args:
        classes: of the vertices, shape (V,). Without them contact has its full stiffness and there are no tethers.
            Pinned vertices need no stitches.
    """

    def __init__(
        self,
        mesh: Mesh,
        fabric: Fabric,
        classes: Ints | None = None,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        device = torch.device(device)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        areas = stretched_areas(mesh)
        hinges = topology.hinges(mesh.faces) if fabric.bending else np.zeros((0, 4), dtype=np.int64)
        self.fabric = fabric
        self.area = tensor(areas)[:, None]
        vertex_areas = topology.vertex_areas(mesh.points, mesh.faces)
        self.mass = tensor(fabric.density * vertex_areas)
        held = fabric.tether > 0 and classes is not None
        tethered = np.flatnonzero(classes == TIGHT) if held else np.zeros(0, dtype=np.int64)
        self.tethered = torch.as_tensor(tethered, device=device)
        self.tether_stiffness = tensor(fabric.tether * vertex_areas[tethered])
        stitches = held_stitches(mesh, fabric, classes)
        springs = fabric.stitch * vertex_areas[stitches.vertices]
        self.stitching = Stitching(mesh, stitches, springs, device, dtype) if len(stitches) else None
        samples = contact_samples(mesh, fabric)
        self.law = ContactLaw.of(fabric)
        shares = _stiffness_shares(samples, fabric, self.law, classes)
        self.cloth = SampledCloth(samples, device, dtype, shares)
        self.gradient_operator = deformation_gradient_operator(mesh, device, dtype)
        heads = hinges[:, [1, 2, 3]].T.reshape(-1)
        self.hinge_operator = difference_operator(heads, np.tile(hinges[:, 0], 3), mesh.vertex_count, device, dtype)
        self.bending_stiffness = tensor(fabric.bending * _hinge_shapes(mesh, hinges))[:, None]
        rest = tensor(mesh.points)[:, :, None]
        self.rest_angle = (
            dihedral_angles(*self.hinge_operator(rest).chunk(3)) if len(hinges) else rest.new_zeros(0, 1)
        )
        numbers = torch.hstack([self.bending_stiffness, self.rest_angle])
        self.tables = elastic_tables(mesh.vertex_count, mesh.faces, column_weights(mesh), areas, hinges, numbers)

    def stretch(self, x: Tensor, moduli: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """Return the energy of the membrane, where asked with other moduli of its model in each frame, (N,) each."""
        return (self.area * stretch_density(self.gradient_operator(x), self.fabric, moduli)).sum(0)

    def bending(self, x: Tensor) -> Tensor:
        if len(self.rest_angle) == 0:
            return x.new_zeros(x.shape[-1])
        angle = dihedral_angles(*self.hinge_operator(x).chunk(3))
        return bending_energy(angle, self.rest_angle, self.bending_stiffness).sum(0)

    def gravity(self, x: Tensor, gravity: Tensor) -> Tensor:
        """Return -sum m g.x [J]; `gravity` is the acceleration [m/s2] of each frame, shape (3, N) or (3, 1)."""
        return -(self.mass @ (x * gravity).sum(1))

    def inertia(self, x: Tensor, predicted: Tensor, dt: float) -> Tensor:
        """Return sum m/(2 dt^2) |x - predicted|^2; predicted = 2 x_{t-1} - x_{t-2} has no gradient."""
        return self.mass @ ((x - predicted.detach()) ** 2).sum(1) / (2 * dt * dt)

    def drag(self, x: Tensor, advected: Tensor, dt: float) -> Tensor:
        """Return sum c a/(2 dt) |x - advected|^2, whose force is -c a v with v = (x - advected) / dt.

        `advected` (V, 3, N) are the last positions moved with the air; they have no gradient.
        """
        weight = self.fabric.drag / self.fabric.density * self.mass
        return weight @ ((x - advected.detach()) ** 2).sum(1) / (2 * dt)

    def tether(self, x: Tensor, skinned: Tensor) -> Tensor:
        """Return sum k/2 |x - skinned|^2 over the tethered vertices; `skinned` (T, 3, N) has no gradient."""
        return self.tether_stiffness @ ((x.index_select(0, self.tethered) - skinned.detach()) ** 2).sum(1) / 2

    def stitch(self, x: Tensor) -> Tensor:
        return self.stitching.energy(x) if self.stitching else x.new_zeros(x.shape[-1])

    def collision(self, x: Tensor, body: PosedBody) -> Tensor:
        return self.collision_at(signed_distance(self.cloth.positions(x), body))

    def collision_at(self, distance: Tensor) -> Tensor:
        """Return the energy of contact at given signed distances of the samples (S, N)."""
        return (self.cloth.area * self.law.energy(distance)).sum(0)

    def elastic(self, x: Tensor, factors: FabricFactors | None = None) -> tuple[Tensor, Tensor]:
        """Return stretch and bending; this and the next two methods are fused where a device can.

        Args:
            factors: of the fabric in each frame; its own by default.
        """
        moduli = factors.moduli(self.fabric) if factors else None
        if kernels.supports(x):
            from ..kernels.elastic import elastic_kernel

            stretch, bending = elastic_kernel(x, self.tables, self.fabric, moduli)
        elif loops.supports(x):
            from ..loops.elastic import elastic_loop

            stretch, bending = elastic_loop(x, self.tables, self.fabric, moduli)
        else:
            stretch, bending = self.stretch(x, moduli), self.bending(x)
        return stretch, bending * factors.bending if factors else bending

    def gravity_and_collision(
        self,
        x: Tensor,
        root: Tensor,
        gravity: Tensor,
        sampled: Tensor,
        normal: Tensor,
        offset: Tensor,
        factors: FabricFactors | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return gravity, with heights relative to `root` (3, N), and the collision with one plane for each sample.

        Args:
            sampled: positions of the samples (S, 3, N), with the gradient of x.
            normal, offset: unit normals (S, 3, N) and offsets (S, N) of the planes; they have no gradient.
            factors: as in `elastic`; contact does not depend on them.
        """
        if factors:
            gravity = gravity * factors.density
        normal, offset, root = normal.detach(), offset.detach(), root.detach()
        law = self.law.stiffness, self.law.start, self.law.ramp
        if kernels.supports(x):
            from ..kernels.pointwise import contact_kernel, gravity_kernel

            falling = gravity_kernel(x, self.mass, root, gravity)
            return falling, contact_kernel(sampled, self.cloth.area, (normal, offset), *law)
        falling = self.gravity(x - root, gravity)
        if loops.supports(x):
            from ..loops.pointwise import contact_loop

            return falling, contact_loop(sampled, self.cloth.area, (normal, offset), *law)
        return falling, self.collision_at(signed_distance_to_planes(sampled, normal, offset))

    def inertia_and_drag(
        self,
        x: Tensor,
        last: Tensor,
        before: Tensor,
        shift: Tensor,
        dt: float,
        factors: FabricFactors | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return inertia and drag of the first M frames of x (V, 3, N); only x has a gradient.

        Args:
            last, before: positions one and two frames ago (V, 3, M).
            shift: displacement of the air, which moves with the character's root, since the last frame (3, M).
            factors: of the fabric in these M frames; its own by default.
        """
        inertia, drag = self._inertia_and_drag(x, last, before, shift, dt)
        return (inertia * factors.density, drag * factors.drag) if factors else (inertia, drag)

    def _inertia_and_drag(
        self, x: Tensor, last: Tensor, before: Tensor, shift: Tensor, dt: float
    ) -> tuple[Tensor, Tensor]:
        weights = 1 / (dt * dt), self.fabric.drag / self.fabric.density / dt
        if kernels.supports(x):
            from ..kernels.pointwise import inertia_and_drag_kernel

            return inertia_and_drag_kernel(x, self.mass, last, before, shift, *weights)
        if loops.supports(x):
            from ..loops.pointwise import inertia_and_drag_loop

            return inertia_and_drag_loop(x, self.mass, last, before, shift, *weights)
        moving = x[..., : last.shape[-1]]
        return self.inertia(moving, 2 * last - before, dt), self.drag(moving, last + shift, dt)


def _stiffness_shares(
    samples: ContactSamples, fabric: Fabric, law: ContactLaw, classes: Ints | None
) -> Floats | None:
    """Return each sample's share of the law's stiffness, shape (S,); None for one everywhere."""
    if classes is None or fabric.contact_model == "vertex" or not law.stiffness:
        return None
    return np.where(samples.classes(classes) == LOOSE, fabric.loose_contact, fabric.contact) / law.stiffness


def _hinge_shapes(mesh: Mesh, hinges: Ints) -> Floats:
    """Return l^2 / (8 (A_1 + A_2)) of each hinge at rest, from the length of its edge and the adjacent areas, (H,).

    It is multiplied by the stiffness of its two triangles, of which each has the mean of its corners.

    The derivative of the angle grows with the inverse of a face's height. Heights below edge / `SLIVER` count as
    that, and such hinges are softened, so that no sliver is stiffer than the thinnest regular triangle.
    """
    x0, x1, left, right = (mesh.points[hinges[:, i]] for i in range(4))
    squared = np.sum((x1 - x0) ** 2, axis=1)
    doubled = [np.linalg.norm(np.cross(x1 - x0, tip - x0), axis=1) for tip in (left, right)]
    slim = np.minimum(1.0, SLIVER * np.minimum(*doubled) / np.maximum(squared, np.finfo(float).tiny))
    shapes = slim**2 * squared / (4 * sum(np.maximum(each, squared / SLIVER) for each in doubled))
    return stiffened(shapes, mesh, hinges[:, [0, 1, 2, 0, 1, 3]])
