# SPDX-License-Identifier: Apache-2.0
"""Settle a garment out of the body at the bind pose, with the least change of its shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.topology import SAME_PLACE, components, edges, vertex_mask
from .cloth_samples import ClothSamples, sample_cloth
from .contact_planes import ContactPlanes, HeldSamples, covering_planes
from .inner_surface import LayeredSurface
from .mesh import distinct_faces
from .shape_energy import ShapeEnergy
from .sides import ClothObstacle, Facing, OuterSurface, find_facing

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Mask = NDArray[np.bool_]
GAP = 4e-3  # [m] that settled cloth keeps from the body
DEEPEST = 0.04  # [m] from which a garment is not fitted to this body at all
# [m] that cloth moves at most. What is in the middle of a limb, at most `DEEPEST` deep, is as far from its own side
# even if it has passed through all of the limb. Cloth that is led farther goes around a limb that pierces it.
FARTHEST = 2 * DEEPEST + GAP
TOLERANCE = 4e-4  # [m] that a sample may lie nearer than it should; cloth is settled so much beyond the gap
SLOPE = 10.0  # cloth takes part as far from a sample as this many times the way that the sample moves ...
LEAST_REACH = 0.04  # [m] ... and this much
PENALTY = 2e3  # stiffness of contact, relative to that of an edge
ITERATIONS = 30
RESTING = 2e-4  # [m] movement of 99 % of the vertices in an iteration from which on the garment rests
CALM = 6  # iterations after which steps are damped more and more, so that cloth in a crease comes to rest
LAYER_DISTANCE = 0.012  # [m] within which layers are tied
ACROSS = 0.7  # cosine between cloth's normal and the way to another layer, at least
LEAST_FRICTION = 2e-3  # of contacts, relative to the penalty
DAMPING = 0.4  # growth of the damping in each further iteration, relative to the stiffness of an edge
TOUCHING = 1e-4  # [m] from its plane up to which a sample is taken to touch it at first
ACTIVE_SETS = 4  # changes of the active set in an iteration, at most
LONGEST_PUSH = 4e-3  # [m] in an iteration
LONGEST_STEP = 0.01  # [m] movement in an iteration from which on the next ones are damped more


@dataclass(frozen=True, eq=False)
class PartInside:
    """The part of a garment that lies in the body.

    Attributes:
        vertices: those inside, and the corners of triangles that are inside although their corners are not, (N,).
        depth: depth of the deepest sample, a vertex or a point inside a triangle [m]; 0 if none is inside.
    """

    vertices: Ints
    depth: float


@dataclass(frozen=True, eq=False)
class Settled:
    """A garment settled out of the body.

    Attributes:
        offsets: how far the vertices move [m], shape (V, 3); exactly zero for those that stay.
        before, after: what lies in the body.
        failed: whether no shape was found that is less deep in the body, so that the garment stays as it is.
        layered: whether there were garments beneath, besides the body.
        pierced: vertices where a limb goes through the cloth, which stay as they are, shape (N,).
    """

    offsets: Floats
    before: PartInside
    after: PartInside
    failed: bool = False
    layered: bool = False
    pierced: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def left(self) -> bool:
        """Whether something stays inside the body."""
        return len(self.after.vertices) > 0

    @property
    def moved(self) -> int:
        """The number of vertices that move."""
        return int(self.offsets.any(axis=1).sum())

    @property
    def mean(self) -> float:
        """The mean displacement of those that move [m]."""
        return float(np.linalg.norm(self.offsets, axis=1).sum() / max(1, self.moved))

    @property
    def largest(self) -> float:
        """The largest displacement [m]."""
        return float(np.linalg.norm(self.offsets, axis=1).max(initial=0.0))


def settle(mesh: Mesh, body: Mesh, gap: float = GAP, *, inner: Sequence[Mesh] = ()) -> Settled:
    """Settle a garment out of a body, and off garments that it is worn over.

    Every vertex, point inside a triangle, and vertex of the body beneath cloth comes to lie at least `gap` apart [m],
    as far as `ITERATIONS` allow; `Settled.after` tells what is left. The change of shape (`ShapeEnergy`) is the least
    that this allows. Coincident vertices move together. Cloth far from any that must move stays exactly as it is. So
    does all of it where nothing is inside, where it lies deeper than `DEEPEST`, or where it would come to lie deeper
    than before (`Settled.failed`). A piece in the body that could only come out by moving cloth farther than
    `FARTHEST` stays, too (`Settled.pierced`): there a limb goes through the cloth.

    Args:
        inner: the garments beneath in the bind pose, which stay. What lies beneath one counts as inside.
    """
    return replace(_Cloth(mesh, body, inner).settled(gap), layered=bool(inner))


def part_inside(mesh: Mesh, body: Mesh, *, inner: Sequence[Mesh] = ()) -> PartInside:
    """Return the part of a garment that lies in a body or beneath inner garments, which `settle` would take out."""
    return _Cloth(mesh, body, inner).inside_now()


class _Cloth:
    """The garment with coincident vertices joined, and the surface of what is beneath."""

    def __init__(self, mesh: Mesh, body: Mesh, inner: Sequence[Mesh] = ()) -> None:
        _, first, joined = np.unique(
            np.round(mesh.points / SAME_PLACE), axis=0, return_index=True, return_inverse=True
        )
        self.joined = joined.reshape(-1)
        self.points = mesh.points[first]
        self.faces = distinct_faces(self.joined[mesh.faces])
        self.surface: ClothObstacle = LayeredSurface(body, inner) if inner else OuterSurface(body)
        self.samples = sample_cloth(self.points, self.faces)

    def inside_now(self) -> PartInside:
        """Return the part that lies in the body where the garment is."""
        return self._part_inside(self.samples, self.points)

    def settled(self, gap: float) -> Settled:
        before, still = self.inside_now(), np.zeros((len(self.joined), 3))
        if before.depth > DEEPEST or not len(before.vertices):
            return Settled(still, before, before)
        points, held = self._rest(gap)
        pierced = before.vertices[held[self.joined[before.vertices]]]
        if not np.isfinite(points).all():
            return Settled(still, before, before, failed=True)
        after = self._part_inside(sample_cloth(points, self.faces), points)  # stretched triangles need more samples
        if after.depth > before.depth:
            return Settled(still, before, before, failed=True)
        return Settled((points - self.points)[self.joined], before, after, pierced=pierced)

    def _rest(self, gap: float) -> tuple[Floats, Mask]:
        """Return where the vertices come to rest [m], shape (V, 3), and those of pierced pieces, which stay, (V,)."""
        inside = self.surface.nearest(self.samples.of(self.points)).inside
        held = np.zeros(len(self.points), dtype=bool)
        while True:
            points = _Solve(self, gap, held).run()
            far = np.linalg.norm(points - self.points, axis=1) > FARTHEST
            if not far.any():
                return points, held
            held = held | self._pieces(inside, far)

    def _pieces(self, inside: Mask, far: Mask) -> Mask:
        """Return the vertices of the pieces of cloth in the body that touch those `far`, and these themselves, (V,).

        Args:
            inside: samples in the body, shape (S,).
            far: vertices, shape (V,).
        """
        among = self.samples.weights > 0
        within = far | vertex_mask(self.samples.corners[inside][among[inside]], len(self.points))
        pairs = edges(self.faces)
        piece = components(pairs[within[pairs].all(axis=1)], len(self.points))
        return within & np.isin(piece, piece[far])

    def _part_inside(self, samples: ClothSamples, points: Floats) -> PartInside:
        side = self.surface.nearest(samples.of(points))
        among = samples.weights > 0
        alone = side.inside & (among.sum(axis=1) == 1)
        vertices = vertex_mask(samples.corners[alone, 0], len(points))
        between = side.inside & ~(vertices[samples.corners] & among).any(axis=1)
        vertices[samples.corners[between][among[between]]] = True
        return PartInside(np.flatnonzero(vertices[self.joined]), float(max(0.0, -side.distance.min(initial=0.0))))


class _Solve:
    """Newton's method on the shape energy and the penalty of contact, with the body's surface linearised anew."""

    def __init__(self, cloth: _Cloth, gap: float, held: Mask) -> None:
        """Prepare to solve; `held` are vertices (V,) that stay, and that nothing holds off the body."""
        self.cloth, self.gap = cloth, gap
        self.facing = find_facing(cloth.points, cloth.faces, cloth.surface)
        self.planes = ContactPlanes(cloth.surface, cloth.samples, self.facing, cloth.points)
        kept_off = ~(held[cloth.samples.corners] & (cloth.samples.weights > 0)).any(axis=1)
        push = np.where(kept_off, np.maximum(gap - self.planes.distance, 0.0), 0.0)
        self.free = _reached(cloth.points, cloth.faces, cloth.samples, push) & ~held
        self.taking_part = self.free[cloth.samples.corners].any(axis=1) & kept_off
        self.faces = cloth.faces[self.free[cloth.faces].any(axis=1) & ~held[cloth.faces].any(axis=1)]
        self.energy = ShapeEnergy(cloth.points, cloth.faces, _layer_ties(cloth, self.facing, self.free))

    def run(self) -> Floats:
        """Return where the vertices come to rest [m], shape (V, 3), or where one first is farther than `FARTHEST`.

        They are not finite if the equations have no solution.
        """
        points, step, brake = self.cloth.points, np.inf, 0.0
        if not self.free.any():
            return points
        for iteration in range(ITERATIONS):
            contacts = self._contacts(points)
            if step < RESTING and contacts.heights(points).min(initial=np.inf) > self.gap - TOLERANCE:
                break
            friction, damping = max(LEAST_FRICTION, 0.1 * 0.5**iteration), max(brake, DAMPING * (iteration - CALM))
            new = self._step(points, contacts, friction, damping)
            if not np.isfinite(new).all():
                return new
            moved, points = np.linalg.norm(new - points, axis=1)[self.free], new
            if (np.linalg.norm(points - self.cloth.points, axis=1) > FARTHEST).any():
                break  # its piece of cloth will be held
            brake = max(DAMPING, 4 * brake) if moved.max() > LONGEST_STEP else brake / 2
            step = np.quantile(moved, 0.99)
        return points

    def _contacts(self, points: Floats) -> HeldSamples:
        near = 2 * self.gap
        self.planes.update(points, near)
        covering = covering_planes(self.cloth.surface, points, self.faces, self.facing, near)
        return self.planes.near(self.taking_part, near) + covering

    def _step(self, points: Floats, contacts: HeldSamples, friction: float, damping: float) -> Floats:
        """Return the minimum of the energy for fixed rotations and planes, by changes of the active set."""
        import scipy.sparse as sparse
        from scipy.sparse.linalg import splu

        free, held = np.flatnonzero(self.free), ~self.free
        place = np.full(len(points), -1)
        place[free] = np.arange(len(free))
        matrix = self.energy.matrix[free]
        load = (self.energy.load(points)[free] - matrix[:, held] @ points[held]) + damping * points[free]
        inner = matrix[:, free] + damping * sparse.identity(len(free))
        weights, along, held_part = _contact_matrices(contacts, points, place, len(free))
        now = contacts.heights(points)
        # Deep cloth comes out little by little, so that the rotations and the planes follow.
        target = np.minimum(self.gap + TOLERANCE, now + LONGEST_PUSH)
        active = now < target + TOUCHING  # what hardly left a plane will mostly be pressed onto it again
        solution = points[free]
        for _ in range(ACTIVE_SETS):
            slid, pushed = weights[active], along[active]
            # Friction keeps contacts at their places, so that planes that contradict each other throw nothing far.
            sliding = PENALTY * friction * (slid.T @ slid)
            system = sparse.kron(inner + sliding, sparse.identity(3)) + PENALTY * (pushed.T @ pushed)
            right = (load + sliding @ points[free]).reshape(-1) + PENALTY * (pushed.T @ (target - held_part)[active])
            right += PENALTY * friction * (pushed.T @ (target - now)[active])
            try:
                factor = splu(
                    system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
            except RuntimeError as error:
                if "singular" not in str(error):
                    raise
                return np.full_like(points, np.nan)  # as where a solution overflows: the garment stays as it is
            solution = factor.solve(right)
            before, active = active, along @ solution + held_part < target
            if np.array_equal(before, active):
                break
        new = points.copy()
        new[free] = solution.reshape(-1, 3)
        return new


def _contact_matrices(
    contacts: HeldSamples, points: Floats, place: Ints, count: int
) -> tuple[csr_matrix, csr_matrix, Floats]:
    """Return the matrices of samples (S, V) and of heights (S, 3 V), and the heights without the free vertices."""
    import scipy.sparse as sparse

    samples = contacts.samples
    local = place[samples.corners]
    loose, each = local >= 0, np.broadcast_to(np.arange(len(local))[:, None], local.shape)
    size = len(local), count
    weights = sparse.csr_matrix((samples.weights[loose], (each[loose], local[loose])), shape=size)
    values = samples.weights[:, :, None] * contacts.normals[:, None, :]
    columns = 3 * local[:, :, None] + np.arange(3)
    rows = np.broadcast_to(each[:, :, None], values.shape)
    along = sparse.csr_matrix(
        (values[loose].reshape(-1), (rows[loose].reshape(-1), columns[loose].reshape(-1))), shape=(size[0], 3 * count)
    )
    fixed = np.where(loose[:, :, None], 0.0, values * points[samples.corners]).sum(axis=(1, 2))
    return weights, along, fixed - contacts.offsets


def _reached(points: Floats, faces: Ints, samples: ClothSamples, push: Floats) -> Mask:
    """Return the vertices that take part: those near enough, along the cloth, to samples that move by `push` [m]."""
    import scipy.sparse as sparse
    from scipy.sparse.csgraph import dijkstra

    count, pairs = len(points), edges(faces)
    most = np.zeros(count)
    pushed = push > 0
    used = samples.weights[pushed] > 0
    np.maximum.at(most, samples.corners[pushed][used], np.repeat(push[pushed], used.sum(axis=1)))
    sources = np.flatnonzero(most)
    reach = SLOPE * most[sources] + LEAST_REACH
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # One more node leads to all sources, the later the shorter their reach.
    rows = np.r_[pairs[:, 0], pairs[:, 1], np.full(len(sources), count)]
    columns, starts = np.r_[pairs[:, 1], pairs[:, 0], sources], reach.max(initial=0.0) - reach + 1e-9
    graph = sparse.csr_matrix((np.r_[lengths, lengths, starts] + 1e-9, (rows, columns)), shape=(count + 1, count + 1))
    return np.asarray(dijkstra(graph, indices=count)[:count] <= reach.max(initial=0.0))


def _layer_ties(cloth: _Cloth, facing: Facing, free: Mask) -> Ints:
    """Return pairs of vertices of two layers over the same part of the body, shape (T, 2)."""
    import scipy.sparse as sparse
    from scipy.spatial import cKDTree

    near = np.flatnonzero(free)
    pairs = cKDTree(cloth.points[near]).query_pairs(LAYER_DISTANCE, output_type="ndarray")
    if not len(pairs):
        return np.zeros((0, 2), dtype=np.int64)
    count, edge = len(cloth.points), edges(cloth.faces)
    links = sparse.csr_matrix((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), shape=(count, count))
    links = links + links.T + sparse.identity(count)
    around = links @ links @ links
    pairs = np.sort(near[pairs], axis=1)
    apart = np.asarray(around[pairs[:, 0], pairs[:, 1]]).reshape(-1) == 0
    directions, between = facing.directions[pairs], cloth.points[pairs[:, 0]] - cloth.points[pairs[:, 1]]
    alike = np.einsum("tc,tc->t", directions[:, 0], directions[:, 1]) > 0.5
    # What lies beside a vertex is of its own layer, if that is fine.
    height = np.abs(np.einsum("tc,tc->t", between, directions[:, 0]))
    across = height > ACROSS * np.linalg.norm(between, axis=1)
    return pairs[apart & alike & across]
