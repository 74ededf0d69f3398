# SPDX-License-Identifier: Apache-2.0
"""Settle a garment out of the body at the bind pose, with the least change of its shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints, Mesh
from ..mesh.topology import edges, vertex_mask, vertex_normals
from .mesh import SAME_PLACE, distinct_faces
from .shape_energy import ShapeEnergy
from .sides import Facing, OuterSurface, SurfaceSide, find_facing

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Mask = NDArray[np.bool_]
GAP = 4e-3  # [m] that settled cloth keeps from the body; contact with the default fabric begins there
DEEPEST = 0.06  # [m] from which a garment is not fitted to this body at all
SLACK = 1e-4  # [m] that cloth is settled beyond the gap, for what the penalty and the last step leave
SAMPLE_SPACING = 0.01  # [m] between samples inside triangles, at most while `MAX_ORDER` allows
MAX_ORDER = 6  # parts into which samples divide an edge, at most
SLOPE = 10.0  # cloth takes part as far from a sample as this many times the way that the sample moves ...
LEAST_REACH = 0.04  # [m] ... and this much
PENALTY = 2e3  # stiffness of contact, relative to that of an edge
ITERATIONS = 40
SETTLED_STEP = 5e-5  # [m] movement in an iteration from which on the garment rests
CALM = 15  # iterations after which steps are damped more and more, so that cloth in a crease comes to rest
LAYER_DISTANCE = 0.012  # [m] within which layers are tied
LEAST_FRICTION = 1e-3  # of contacts, relative to the penalty
DAMPING = 0.2  # growth of the damping in each further iteration, relative to the stiffness of an edge
ACTIVE_SETS = 4  # changes of the active set in an iteration, at most
TURNED = 0.9  # cosine between planes below which the earlier is kept as well
CREASE, CREASE_WIDTH = 2e-4, 0.02  # [m] depth and width of a crease between two planes
LONGEST_PUSH = 4e-3  # [m] in an iteration
COVER = 0.02  # [m] within which cloth is held off a vertex of the body


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
    """

    offsets: Floats
    before: PartInside
    after: PartInside

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


@dataclass(frozen=True, eq=False)
class ClothSamples:
    """Points on triangles of cloth: vertices first, then points on edges and inside triangles.

    Attributes:
        corners: vertices of the triangle, shape (S, 3).
        weights: barycentric coordinates, shape (S, 3).
    """

    corners: Ints
    weights: Floats

    def of(self, rows: Floats) -> Floats:
        """Interpolate values at the vertices (V, N), shape (S, N)."""
        return np.einsum("sk,skc->sc", self.weights, rows[self.corners])

    def __getitem__(self, chosen: Ints | Mask) -> ClothSamples:
        return ClothSamples(self.corners[chosen], self.weights[chosen])

    def __add__(self, other: ClothSamples) -> ClothSamples:
        return ClothSamples(
            *(np.concatenate(rows) for rows in zip((self.corners, self.weights), (other.corners, other.weights)))
        )


def sample_cloth(points: Floats, faces: Ints) -> ClothSamples:
    """Return samples of all vertices of faces, and on a grid in each triangle, `SAMPLE_SPACING` apart."""
    used = np.unique(faces)
    corners, weights = [np.repeat(used[:, None], 3, axis=1)], [np.tile([1.0, 0, 0], (len(used), 1))]
    sides = points[faces] - points[np.roll(faces, 1, axis=1)]
    longest = np.linalg.norm(sides, axis=2).max(axis=1, initial=0.0)
    order = np.clip(np.ceil(longest / SAMPLE_SPACING), 2, MAX_ORDER).astype(int)
    for size in np.unique(order):
        inner = _grid(int(size))
        chosen = faces[order == size]
        corners.append(np.repeat(chosen, len(inner), axis=0))
        weights.append(np.tile(inner, (len(chosen), 1)))
    return _distinct(ClothSamples(np.concatenate(corners), np.concatenate(weights)))


def settle(mesh: Mesh, body: Mesh, gap: float = GAP) -> Settled:
    """Settle a garment out of a body.

    Every vertex, point inside a triangle, and vertex of the body beneath cloth comes to lie at least `gap` apart [m].
    The change of shape (`ShapeEnergy`) is the least that this allows. Coincident vertices move together. Cloth far
    from any that must move stays exactly as it is. So does all of it where it lies deeper than `DEEPEST`.
    """
    return _Cloth(mesh, body).settled(gap)


class _Cloth:
    """The garment with coincident vertices joined, and the body's surface."""

    def __init__(self, mesh: Mesh, body: Mesh) -> None:
        _, first, joined = np.unique(
            np.round(mesh.points / SAME_PLACE), axis=0, return_index=True, return_inverse=True
        )
        self.joined = joined.reshape(-1)
        self.points = mesh.points[first]
        self.faces = distinct_faces(self.joined[mesh.faces])
        self.surface = OuterSurface(body)
        self.samples = sample_cloth(self.points, self.faces)
        start = self.surface.nearest(self.samples.of(self.points))
        self.distance, self.inside = start.distance, start.inside

    def settled(self, gap: float) -> Settled:
        before, points = self._part_inside(self.inside, self.distance), self.points
        if before.depth > DEEPEST or not (self.distance < gap).any():
            return Settled(np.zeros((len(self.joined), 3)), before, before)
        points = _Solve(self, gap).run()
        side = self.surface.nearest(self.samples.of(points))
        return Settled((points - self.points)[self.joined], before, self._part_inside(side.inside, side.distance))

    def _part_inside(self, inside: Mask, distance: Floats) -> PartInside:
        samples, among = self.samples.corners, self.samples.weights > 0
        alone = inside & (among.sum(axis=1) == 1)
        vertices = vertex_mask(samples[alone, 0], len(self.points))
        between = inside & ~(vertices[samples] & among).any(axis=1)
        vertices[samples[between][among[between]]] = True
        depth = float(max(0.0, -distance[inside].min(initial=0.0)))
        return PartInside(np.flatnonzero(vertices[self.joined]), depth)


class _Solve:
    """Newton's method on the shape energy and the penalty of contact, with the body's surface linearised anew."""

    def __init__(self, cloth: _Cloth, gap: float) -> None:
        self.cloth, self.gap = cloth, gap
        self.facing = find_facing(cloth.points, cloth.faces, cloth.surface)
        short = self._first_violations()
        self.free = _reached(cloth.points, cloth.faces, cloth.samples, np.where(short < gap, gap - short, 0.0))
        touched = self.free[cloth.samples.corners].any(axis=1)
        self.samples = cloth.samples[touched]
        directions = self.samples.of(self.facing.directions)
        self.directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        among = self.facing.doubtful[self.samples.corners] & (self.samples.weights > 0)
        self.doubtful = among.any(axis=1) | cloth.inside[touched]
        self.crossed = (self.facing.crossed[self.samples.corners] & (self.samples.weights > 0)).any(axis=1)
        self.energy = ShapeEnergy(cloth.points, cloth.faces, _layer_ties(cloth, self.facing, self.free))

    def _first_violations(self) -> Floats:
        samples, facing = self.cloth.samples, self.facing
        among = samples.weights > 0
        return self.cloth.surface.belonging(
            samples.of(self.cloth.points), _unit(samples.of(facing.directions)),
            (facing.doubtful[samples.corners] & among).any(axis=1) | self.cloth.inside,
            (facing.crossed[samples.corners] & among).any(axis=1),
        ).distance  # fmt: skip

    def run(self) -> Floats:
        points, planes = self.cloth.points.copy(), _Planes(len(self.samples.corners))
        for iteration in range(ITERATIONS):
            places = self.samples.of(points)
            due = planes.due(places, 2 * self.gap)
            planes.update(due, places[due], self.cloth.surface.belonging(
                places[due], self.directions[due], self.doubtful[due], self.crossed[due]
            ))  # fmt: skip
            index, normals, offsets = planes.held(2 * self.gap)
            covering, above, beneath = self._beneath(points)
            contacts = self.samples[index] + covering, np.r_[normals, above], np.r_[offsets, beneath]
            friction = max(LEAST_FRICTION, 0.1 * 0.5**iteration)
            new = self._step(points, *contacts, friction=friction, damping=max(0.0, DAMPING * (iteration - CALM)))
            step, points = np.abs(new - points).max(initial=0.0), new
            if step < SETTLED_STEP:
                break
        return points

    def _step(
        self, points: Floats, samples: ClothSamples, normals: Floats, offsets: Floats, friction: float, damping: float
    ) -> Floats:
        """Return the minimum of the energy for fixed rotations and planes, by a few changes of the active set."""
        import scipy.sparse as sparse
        from scipy.sparse.linalg import splu

        free, held = np.flatnonzero(self.free), ~self.free
        place = np.full(len(points), -1)
        place[free] = np.arange(len(free))
        matrix = self.energy.matrix[free]
        load = (self.energy.load(points)[free] - matrix[:, held] @ points[held]) + damping * points[free]
        inner = matrix[:, free] + damping * sparse.identity(len(free))
        weights, along, fixed = _contact_matrices(samples, normals, points, place, len(free))
        now = np.einsum("sc,sc->s", normals, samples.of(points))
        # Deep cloth comes out little by little, so that the rotations and the planes follow.
        target = np.minimum(offsets + self.gap + SLACK, now + LONGEST_PUSH)
        active = now < target
        solution = points[free]
        for _ in range(ACTIVE_SETS):
            slid, pushed = weights[active], along[active]
            # Friction keeps contacts at their places, so that planes that contradict each other throw nothing far.
            sliding = PENALTY * friction * (slid.T @ slid)
            system = sparse.kron(inner + sliding, sparse.identity(3)) + PENALTY * (pushed.T @ pushed)
            right = (load + sliding @ points[free]).reshape(-1) + PENALTY * (pushed.T @ (target - fixed)[active])
            right += PENALTY * friction * (pushed.T @ (target - now)[active])
            factor = splu(
                system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
            solution = factor.solve(right)
            before, active = active, along @ solution + fixed < target
            if np.array_equal(before, active):
                break
        new = points.copy()
        new[free] = solution.reshape(-1, 3)
        return new

    def _beneath(self, points: Floats) -> tuple[ClothSamples, Floats, Floats]:
        """Return points of the cloth that cover vertices of the body, with the planes through those, (S, 3), (S,)."""
        import igl

        faces = self.cloth.faces[self.free[self.cloth.faces].any(axis=1)]
        body = self.cloth.surface.mesh
        squared, face, found = igl.point_mesh_squared_distance(
            body.points, np.ascontiguousarray(points), np.ascontiguousarray(faces)
        )
        normals = vertex_normals(body.points, body.faces)
        corners = faces[face]
        facing = self.facing.directions[corners].mean(axis=1)
        along = np.einsum("sc,sc->s", found - body.points, normals)
        aside = np.sqrt(np.maximum(squared - along**2, 0.0))
        covered = (squared < COVER**2) & (along < self.gap + SLACK) & (aside < 0.25 * self.gap)
        covered &= (np.einsum("sc,sc->s", facing, normals) > 0.5) & normals.any(axis=1)
        chosen = np.flatnonzero(covered)
        triangles = [np.ascontiguousarray(points[corners[chosen, k]]) for k in range(3)]
        if not len(chosen):
            return ClothSamples(np.zeros((0, 3), int), np.zeros((0, 3))), np.zeros((0, 3)), np.zeros(0)
        weights = np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(found[chosen]), *triangles))
        sound = np.isfinite(weights).all(axis=1)
        chosen, weights = chosen[sound], weights[sound]
        offsets = np.einsum("sc,sc->s", normals[chosen], body.points[chosen])
        return ClothSamples(corners[chosen], weights), normals[chosen], offsets


def _distinct(samples: ClothSamples) -> ClothSamples:
    """Return each sample once: those on an edge belong to both of its triangles. Vertices stay first."""
    used = samples.weights > 0
    corners = np.where(used, samples.corners, -1)
    order = np.argsort(corners, axis=1, kind="stable")
    keys = np.c_[np.take_along_axis(corners, order, 1), np.take_along_axis(samples.weights, order, 1).round(6)]
    return samples[np.sort(np.unique(keys, axis=0, return_index=True)[1])]


def _contact_matrices(
    samples: ClothSamples, normals: Floats, points: Floats, place: Ints, count: int
) -> tuple[csr_matrix, csr_matrix, Floats]:
    """Return the matrices of samples (S, V) and of normals . samples (S, 3 V), and the part of the held vertices."""
    import scipy.sparse as sparse

    local = place[samples.corners]
    loose, each = local >= 0, np.broadcast_to(np.arange(len(local))[:, None], local.shape)
    size = len(local), count
    weights = sparse.csr_matrix((samples.weights[loose], (each[loose], local[loose])), shape=size)
    values = samples.weights[:, :, None] * normals[:, None, :]
    columns = 3 * local[:, :, None] + np.arange(3)
    rows = np.broadcast_to(each[:, :, None], values.shape)
    along = sparse.csr_matrix(
        (values[loose].reshape(-1), (rows[loose].reshape(-1), columns[loose].reshape(-1))), shape=(size[0], 3 * count)
    )
    fixed = np.where(loose[:, :, None], 0.0, values * points[samples.corners]).sum(axis=(1, 2))
    return weights, along, fixed


class _Planes:
    """The plane that holds each sample off the body, and an earlier one in whose crease with it the sample lies."""

    def __init__(self, count: int) -> None:
        self.distance, self.places = np.full(count, -np.inf), np.zeros((count, 3))
        self.normals, self.points = np.zeros((2, count, 3)), np.zeros((2, count, 3))

    def due(self, places: Floats, distance: float) -> Mask:
        """Return the samples that may have come within a distance of the body [m] since they were last queried."""
        return self.distance - np.linalg.norm(places - self.places, axis=1) < distance

    def update(self, due: Mask, places: Floats, side: SurfaceSide) -> None:
        turned = np.einsum("sc,sc->s", self.normals[0, due], side.normals) < TURNED
        rows = np.flatnonzero(due)
        self.normals[1, rows[turned]], self.points[1, rows[turned]] = (
            self.normals[0, rows[turned]], self.points[0, rows[turned]],
        )  # fmt: skip
        self.distance[rows], self.places[rows] = side.distance, places
        self.normals[0, rows], self.points[0, rows] = side.normals, side.points

    def held(self, distance: float) -> tuple[Ints, Floats, Floats]:
        """Return the samples within a distance [m], with normals (S, 3) and offsets (S,) of their planes."""
        near = np.flatnonzero(self.distance < distance)
        between = self.points[1, near] - self.points[0, near]
        # Of two planes at a crease, each holds the other's point in front of it; at a ridge, it does not.
        crease = (np.einsum("sc,sc->s", between, self.normals[0, near]) > CREASE) & (
            np.einsum("sc,sc->s", between, self.normals[1, near]) < -CREASE
        )
        crease &= self.normals[1, near].any(axis=1) & (np.linalg.norm(between, axis=1) < CREASE_WIDTH)
        index = np.r_[near, near[crease]]
        normals = np.r_[self.normals[0, near], self.normals[1, near[crease]]]
        points = np.r_[self.points[0, near], self.points[1, near[crease]]]
        return index, normals, np.einsum("sc,sc->s", normals, points)


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
    alike = np.einsum("tc,tc->t", facing.directions[pairs[:, 0]], facing.directions[pairs[:, 1]]) > 0.5
    return pairs[apart & alike]


def _grid(order: int) -> Floats:
    """Return barycentric coordinates of a grid on a triangle without its corners, shape (S, 3)."""
    rows = [(i, j, order - i - j) for i in range(order + 1) for j in range(order + 1 - i)]
    return np.array([row for row in rows if max(row) < order]) / order


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
