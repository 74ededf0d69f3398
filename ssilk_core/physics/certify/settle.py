# SPDX-License-Identifier: Apache-2.0
"""Bring freed cloth as near to where it was wanted as contact lets it, without passing through itself.

From a free start, Newton's method minimises the cost of the distance from the target (`metric`), the barrier of
incremental potential contact [Li et al. 2020] between the garment's triangles, and springs under cloth that lies on
skin and would uncover it. No step is longer than what continuous tests allow, so what is free stays free. Barrier,
candidates and tests are ipctk's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh import topology
from .faults import FaultFinder, FrameSurroundings, SkinPoints
from .metric import DisplacementMetric

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

# Stiffness of the barrier in the metric's units: soft while cloth comes near, stiff so that it keeps its thickness.
BARRIERS = (1e6, 3e7, 1e9)
THICKNESS = 4e-4  # [m] from which on the barrier pushes
MARGIN = 0.02  # [m] around the vertices that move, within which the rest of the garment is met
STEPS = 12  # with each barrier, at most
ENOUGH = 2e-5  # [m] of a step, after which none follows
SHORTEST = 1e-3  # of a step in the search along it
SPRING = 20.0  # under cloth on skin, relative to the metric's diagonal
RESTING = 1e-3  # [m] above skin, below which cloth is held up by springs
LOWEST = 5e-4  # [m] above skin, where they end


class Settler:
    """Settles frames of one garment.

    Args:
        mesh: of the garment in the bind pose.
        metric: the cost of displacements.
    """

    def __init__(self, mesh: Mesh, finder: FaultFinder, metric: DisplacementMetric) -> None:
        self.mesh, self.finder, self.metric = mesh, finder, metric
        self._edges = topology.edges(mesh.faces)
        first, second = np.divmod(finder.cloth.allowed, max(len(mesh.faces), 1))
        pairs = [(one, other) for a, b in zip(mesh.faces[first], mesh.faces[second]) for one in a for other in b]
        self._apart = {(int(one), int(other)): False for one, other in pairs}
        self._apart |= {(other, one): False for one, other in self._apart}

    def settle(
        self,
        start: Floats,
        target: Floats,
        moves: np.ndarray,
        skin: FrameSurroundings | None,
        thickness: float = THICKNESS,
    ) -> Floats:
        """Return free positions (V, 3) [m] near a target.

        Args:
            start: free positions, those of the target where nothing moves.
            moves: which vertices may move, bool (V,).
            thickness: from which on the barrier pushes [m].
        """
        rows = np.flatnonzero(moves)
        if not len(rows):
            return start
        potential = _Potential(self, start, target, rows, thickness, skin)
        x, whole = start[rows], np.array(start)
        for stiffness in BARRIERS:
            potential.stiffen(stiffness)
            for _ in range(STEPS):
                whole[rows] = x
                held = self._held(whole, moves, skin)
                step = self._step(potential, x, _Supports.of(held, self.mesh.faces, moves, self.metric))
                if step is None:
                    break
                x = x + step
                if np.linalg.norm(step, axis=1).max() < ENOUGH:
                    break
        found = np.array(target)
        found[rows] = x
        return found

    def _step(self, potential: _Potential, x: Floats, supports: _Supports | None) -> Floats | None:
        """Return a step (R, 3) that lowers the energy; None where only a tiny one does."""
        energy, gradient, hessian = potential.at(x, supports)
        step = _solve(hessian, -gradient).reshape(-1, 3)
        share, slope = potential.free_share(x, step), float(gradient @ step.reshape(-1))
        while share > SHORTEST and potential.energy(x + share * step, supports) > energy + 1e-4 * share * slope:
            share /= 2
        return share * step if share > SHORTEST else None

    def _held(self, points: Floats, moves: np.ndarray, skin: FrameSurroundings | None) -> SkinPoints | None:
        """Return the points of the skin that moving cloth lies on."""
        if skin is None or not len(skin.starts):
            return None
        lows, highs = points[moves].min(axis=0) - RESTING, points[moves].max(axis=0) + RESTING
        near = np.flatnonzero(((skin.starts >= lows) & (skin.starts <= highs)).all(axis=1))
        if not len(near):
            return None
        found = self.finder.resting(points, skin, near, RESTING)
        return found.chosen(moves[self.mesh.faces[found.face]].any(axis=1))


class _Supports:
    """Springs that hold cloth up over M points of the skin, on which it lies with barycentric weights (M, 3)."""

    def __init__(self, rows: csc_matrix, heights: Floats, stiffness: Floats) -> None:
        self.rows, self.heights, self.stiffness = rows, heights, stiffness

    @classmethod
    def of(
        cls,
        held: SkinPoints | None,
        faces: Ints,
        moves: np.ndarray,
        metric: DisplacementMetric,
    ) -> _Supports | None:
        """Return springs under what is held; heights are those that fixed vertices and the skin leave."""
        import scipy.sparse as sparse

        if held is None or not len(held):
            return None
        place = np.where(moves, np.cumsum(moves) - 1, -1)
        corner = faces[held.face]
        at = place[corner]
        values = held.weights[:, :, None] * held.normal[:, None]
        row = np.broadcast_to(np.arange(len(held))[:, None, None], values.shape)
        column = 3 * at[:, :, None] + np.arange(3)
        free = np.broadcast_to((at >= 0)[:, :, None], values.shape)
        shape = (len(held), 3 * int(moves.sum()))
        rows = sparse.coo_matrix((values[free], (row[free], column[free])), shape=shape).tocsc()
        stiffness = SPRING * metric.matrix.diagonal()[corner].mean(axis=1)
        return cls(rows, held.height, stiffness)


class _Potential:
    """What a settled frame minimises over some of its vertices (R, 3)."""

    def __init__(
        self,
        owner: Settler,
        start: Floats,
        target: Floats,
        rows: Ints,
        thickness: float,
        skin: FrameSurroundings | None,
    ) -> None:
        import ipctk
        import scipy.sparse as sparse

        own, every = len(start), owner.finder.every
        self.thickness, self.target, self.origin = thickness, target[rows], start[rows]
        self.cost = sparse.kron(owner.metric.matrix[rows][:, rows], sparse.identity(3)).tocsc()
        moving = np.stack([start[rows], target[rows]])
        low, high = moving.min(axis=(0, 1)) - MARGIN, moving.max(axis=(0, 1)) + MARGIN
        whole = start if skin is None else skin.joined(start)
        if len(whole) == own:
            every = owner.mesh.faces
        corners = whole[every]
        kept = ((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)
        vertices = np.unique(every[kept])
        place = np.full(len(whole), -1)
        place[vertices] = np.arange(len(vertices))
        faces = place[every[kept]]
        rest = np.concatenate([owner.mesh.points, whole[own:]])  # what does not move rests where it is
        self.mesh = ipctk.CollisionMesh(
            np.asfortranarray(rest[vertices]),
            np.asfortranarray(topology.edges(faces).astype(np.int32)),
            np.asfortranarray(faces.astype(np.int32)),
        )
        apart = {
            (int(place[one]), int(place[other])): False
            for one, other in owner._apart
            if place[one] >= 0 and place[other] >= 0
        }
        filters = [ipctk.make_sparse_filter(apart, True)] if apart else []
        if (moving_ones := int((vertices < own).sum())) < len(vertices):
            filters.append(ipctk.make_static_obstacle_filter(moving_ones))
        if filters:
            self.mesh.can_collide = filters[0] if len(filters) == 1 else filters[0] & filters[1]
        self.places = place[rows]
        self.whole = np.asfortranarray(whole[vertices])
        self.stiffen(BARRIERS[0])
        degrees = np.arange(3 * len(vertices)).reshape(-1, 3)[self.places].reshape(-1)
        self.degrees = degrees

    def stiffen(self, stiffness: float) -> None:
        """Take a barrier of this stiffness."""
        import ipctk

        self.barrier = ipctk.BarrierPotential(self.thickness, stiffness)

    def _placed(self, x: Floats) -> Floats:
        placed = self.whole.copy(order="F")
        placed[self.places] = x
        return placed

    def _collisions(self, placed: Floats) -> Any:
        import ipctk

        found = ipctk.NormalCollisions()
        found.build(self.mesh, placed, self.thickness)
        return found

    def energy(self, x: Floats, supports: _Supports | None) -> float:
        """Return the energy at positions (R, 3)."""
        placed, away = self._placed(x), (x - self.target).reshape(-1)
        found = 0.5 * float(away @ (self.cost @ away)) + self.barrier(self._collisions(placed), self.mesh, placed)
        if supports:
            short = self._short(x, supports)
            found += 0.5 * float(supports.stiffness @ short**2)
        return float(found)

    def at(self, x: Floats, supports: _Supports | None) -> tuple[float, Floats, csc_matrix]:
        """Return energy, gradient (3 R,) and Hessian (3 R, 3 R) at positions; supports are those found there."""
        import ipctk
        import scipy.sparse as sparse

        self.origin = x
        placed, away = self._placed(x), (x - self.target).reshape(-1)
        collisions = self._collisions(placed)
        gradient = self.cost @ away + self.barrier.gradient(collisions, self.mesh, placed)[self.degrees]
        bent = self.barrier.hessian(collisions, self.mesh, placed, ipctk.PSDProjectionMethod.CLAMP)
        hessian = self.cost + sparse.csc_matrix(bent)[self.degrees][:, self.degrees]
        energy = 0.5 * float(away @ (self.cost @ away)) + float(self.barrier(collisions, self.mesh, placed))
        if supports:
            short = self._short(x, supports)
            pull = supports.stiffness * short
            energy += 0.5 * float(pull @ short)
            gradient = gradient - supports.rows.T @ pull
            active = sparse.diags(supports.stiffness * (short > 0))
            hessian = hessian + supports.rows.T @ active @ supports.rows
        return energy, gradient, hessian.tocsc()

    def _short(self, x: Floats, supports: _Supports) -> Floats:
        """Return how far cloth lies beneath the height at which it is held up [m], shape (M,)."""
        height = supports.heights + supports.rows @ (x - self.origin).reshape(-1)
        return np.maximum(LOWEST - height, 0)

    def free_share(self, x: Floats, step: Floats) -> float:
        """Return the share of a step (R, 3) that cloth can go without meeting cloth, at most 1."""
        import ipctk

        start, end = self._placed(x), self._placed(x + step)
        # The default test subdivides intervals, and sheets that move in parallel keep it for minutes.
        test = ipctk.AdditiveCCD()
        return float(ipctk.compute_collision_free_stepsize(self.mesh, start, end, narrow_phase_ccd=test))


def _solve(matrix: csc_matrix, right: Floats) -> Floats:
    from scipy.sparse.linalg import splu

    return np.asarray(splu(matrix).solve(right), dtype=np.float64)
