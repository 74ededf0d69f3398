# SPDX-License-Identifier: Apache-2.0
"""The incremental potential on few elements of a garment, for states with far fewer degrees of freedom than it has.

With weights w of chosen faces f and hinges h, and vertices v that each stand for those around them,

    E(x) ~ sum_f w_f stretch_f(x) + sum_h w_h bending_h(x) + sum_v (gravity, inertia, drag, tether, contact)_v(x)

A chosen vertex has the mass, the tether and the contact area of all that it stands for. Who chooses the vertices
knows the states (`network.latent_solver.elements`); all faces and hinges between them count.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints, Mesh, Scene, SkinWeights
from ...scene.mesh import topology
from ...scene.mesh.stitches import held_stitches
from ..collision import Contacts
from ..collision.sampled_cloth import SampledCloth
from ..energy.stitching import Stitching
from ..samples import vertex_samples
from .hessian import Hessian
from .hinges import Hinges
from .incremental_potential import IncrementalPotential
from .membrane import Membrane

MAX_STITCHES = 64
IN_PART = 3  # pairs of faces of a part of the garment, at least
NO_ELEMENTS: Ints = np.zeros(0, dtype=np.int64)
OWNED_AT_ONCE = 4096  # vertices whose distances to all chosen ones are in memory


@dataclass(frozen=True, eq=False)
class Cubature:
    """What of a garment's elements an energy is summed over.

    Attributes:
        vertices: that are needed, in ascending order, shape (V',).
        owners: which of these stands for each vertex of the garment, shape (V,).
        faces, hinges: indices of those that count, of the mesh and of `topology.hinges`, shapes (F',) and (H',).
        face_weights, hinge_weights: positive, of the same shapes.
        stitches: indices of those that count, shape (S',).
    """

    vertices: Ints
    owners: Ints
    faces: Ints
    face_weights: Floats
    hinges: Ints
    hinge_weights: Floats
    stitches: Ints

    def place(self, count: int) -> Ints:
        """Return the index of each of a garment's vertices among those needed, -1 for others, shape (V,)."""
        place = np.full(count, -1)
        place[self.vertices] = np.arange(len(self.vertices))
        return place


def spread_evenly(count: int, most: int) -> Ints:
    """Return at most `most` of the indices 0 to count - 1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def spread_pairs(scene: Scene, count: int) -> Ints:
    """Return the vertices of about `count` pairs of adjacent faces, far from each other at rest.

    Each class of vertices has some in each part that hangs together, such as a strip of a fringe: `IN_PART` pairs,
    fewer where there are many parts. A part without enough of them would move as it likes.
    """
    mesh, groups = scene.garment.mesh, _groups(scene)
    pairs = topology.hinges(mesh.faces)
    corners = np.concatenate([pairs, np.column_stack([mesh.faces, mesh.faces[:, :1]])])  # a face may have no other
    return np.unique(corners[_spread(mesh.points[corners].mean(axis=1), groups[corners[:, 0]], count)])


def cubature_between(scene: Scene, whole: IncrementalPotential, vertices: Ints) -> Cubature:
    """Return the cubature of all faces and hinges between some vertices, each with the weights of those around it.

    Args:
        whole: the potential of the scene's garment.
        vertices: some of each part, as `spread_pairs` has them; those of a few stitches are added.
    """
    mesh, stitches = scene.garment.mesh, NO_ELEMENTS
    if whole.stitching:
        stitches = spread_evenly(len(whole.stitching), MAX_STITCHES)
        vertices = np.append(vertices, whole.stitching.corners[stitches])
    vertices = np.unique(vertices)
    faces = _between(scene, mesh.faces, whole.membrane.area, vertices)
    hinges: tuple[Ints, Floats] = NO_ELEMENTS, np.zeros(0)
    if whole.hinges:
        hinges = _between(scene, whole.hinges.corners, whole.hinges.stiffness, vertices)
    groups = _groups(scene)
    owners = _owners(mesh.points, groups, mesh.points[vertices], groups[vertices])
    return Cubature(vertices, owners, *faces, *hinges, stitches)


def _groups(scene: Scene) -> Ints:
    """Return a number of what each vertex hangs together with in its own class, such as its strip, shape (V,)."""
    mesh, classes = scene.garment.mesh, scene.classes
    edges = topology.edges(mesh.faces)
    return topology.components(edges[classes[edges[:, 0]] == classes[edges[:, 1]]], mesh.vertex_count)


def _spread(points: Floats, groups: Ints, count: int) -> Ints:
    """Return about `count` indices of points (E, 3), far from each other, some of each group (E,)."""
    chosen: list[int] = []
    numbers = np.unique(groups)
    least = max(1, min(IN_PART, 2 * count // len(numbers)))
    for number in numbers:
        own = np.flatnonzero(groups == number)
        part, apart = [own[0]], np.full(len(own), np.inf)
        while len(part) < min(len(own), max(least, round(count * len(own) / len(points)))):
            apart = np.minimum(apart, ((points[own] - points[part[-1]]) ** 2).sum(axis=1))
            part.append(own[apart.argmax()])
        chosen.extend(part)
    return np.array(chosen)


def _between(scene: Scene, corners: Ints, stiffness: Tensor, vertices: Ints) -> tuple[Ints, Floats]:
    """Return which elements (E, C) lie between vertices, and weights that keep the sum of their stiffness (E, 1)."""
    chosen = np.flatnonzero(np.isin(corners, vertices).all(axis=1))
    if not len(chosen):
        return chosen, np.zeros(0)
    middles, groups = scene.garment.mesh.points[corners].mean(axis=1), _groups(scene)[corners[:, 0]]
    owners, own = _owners(middles, groups, middles[chosen], groups[chosen]), stiffness[:, 0].double().cpu().numpy()
    weights = np.bincount(owners, own, len(chosen)) / np.maximum(own[chosen], np.finfo(float).tiny)
    kept = (own[chosen] > 0) & (weights > 0)
    return chosen[kept], weights[kept]


def _owners(points: Floats, groups: Ints, chosen: Floats, chosen_groups: Ints) -> Ints:
    """Return the nearest of the chosen points to each point (E, 3), of its own group where one is, shape (E,)."""
    owners = np.zeros(len(points), dtype=np.int64)
    for number in np.unique(groups):
        own, among = np.flatnonzero(groups == number), np.flatnonzero(chosen_groups == number)
        among = among if len(among) else np.arange(len(chosen))
        candidates = torch.as_tensor(chosen[among])
        for part in np.array_split(own, -(-len(own) // OWNED_AT_ONCE)):
            owners[part] = among[torch.cdist(torch.as_tensor(points[part]), candidates).argmin(1).numpy()]
    return owners


def sampled_potential(whole: IncrementalPotential, scene: Scene, cubature: Cubature) -> IncrementalPotential:
    """Return the potential of a scene's garment on the elements of a cubature; positions are (V', 3, N)."""
    mesh, device, dtype = scene.garment.rest_mesh, whole.mass.device, whole.dtype
    vertices, place = cubature.vertices, cubature.place(mesh.vertex_count)
    free = np.isin(np.arange(mesh.vertex_count), whole.free.cpu().numpy())
    owners = torch.as_tensor(cubature.owners, device=device)

    def lumped(values: Tensor) -> Tensor:
        """Return the sums (V', 1) of a quantity of the free vertices (V, 1)."""
        kept = values * torch.as_tensor(free, device=device)[:, None]
        return values.new_zeros(len(vertices), 1).index_add(0, owners, kept)

    def part(corners: Ints) -> Mesh:
        stiffness = None if mesh.stiffness is None else mesh.stiffness[vertices]
        return Mesh(mesh.path, mesh.points[vertices], place[corners], stiffness=stiffness)

    found = copy.copy(whole)
    found.mass, found.tether = lumped(whole.mass), lumped(whole.tether)
    faces = part(mesh.faces[cubature.faces])
    membrane = Membrane(faces, whole.fabric, device, dtype)
    membrane.area *= torch.as_tensor(cubature.face_weights, device=device).to(dtype)[:, None]
    hinges = None
    if whole.hinges:
        rows = torch.as_tensor(cubature.hinges, device=device)
        weights = torch.as_tensor(cubature.hinge_weights, device=device).to(dtype)[:, None]
        bending = whole.hinges.stiffness[rows] * weights, whole.hinges.rest[rows]
        hinges = Hinges(place[whole.hinges.corners[cubature.hinges]], *bending, len(vertices))
    if whole.stitching:
        kept = held_stitches(mesh, whole.fabric, scene.classes).select(cubature.stitches)
        kept = replace(kept, vertices=place[kept.vertices], corners=place[kept.corners])
        stiffness = whole.stitching.stiffness[:, 0].cpu().numpy()[cubature.stitches]
        stiffness = stiffness * len(whole.stitching) / len(kept)
        found.stitching = Stitching(faces, kept, stiffness, device, dtype)
    area = lumped(whole.cloth.to_vertices(whole.cloth.area[..., None])[..., 0])[:, 0].double().cpu().numpy()
    samples = replace(vertex_samples(len(vertices)), area=area)
    found.cloth = SampledCloth(samples, device, dtype)
    found.contacts = Contacts(_coarse(scene, cubature), samples, pinned=False, device=device)
    found.use(Hessian(membrane, hinges, samples, np.flatnonzero(free[vertices]), found.stitching))
    return found


def _coarse(scene: Scene, cubature: Cubature) -> Scene:
    """Return a scene whose garment has the cubature's vertices, and a triangle where three of them meet."""
    vertices, garment, rig, mesh = cubature.vertices, scene.garment, scene.rig, scene.garment.mesh

    def part(skin: SkinWeights) -> SkinWeights:
        return SkinWeights(skin.path, skin.indices[vertices], skin.weights[vertices])

    owned = cubature.owners[mesh.faces]
    met = owned[(owned != np.roll(owned, 1, axis=1)).all(axis=1)]
    first = np.unique(np.sort(met, axis=1), axis=0, return_index=True)[1]
    coarse = Mesh(mesh.path, mesh.points[vertices], met[np.sort(first)])
    dressed = replace(
        garment,
        mesh=coarse,
        skin=part(scene.lbs_skin),
        classes=scene.classes[vertices],
        pins=None,
        levels=None,
        sewn=None,  # contacts, which alone look at it, are about where it lies
    )
    return Scene(scene.character, dressed, replace(rig, skin=part(rig.skin)))
