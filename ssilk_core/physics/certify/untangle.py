# SPDX-License-Identifier: Apache-2.0
"""Take cloth out of cloth and lift it off skin, from any start, in short steps.

Each step shortens the contours along which the garment intersects itself (`crossings`), and lifts it above the skin
that shows. Displacements spread as `metric` says, over the neighbourhood of what is wrong alone. Where contours do
not get shorter, pushes spread less: small folds need vertices that move against their neighbours. A contour
says which way out is short, not how far it is, so a step has the size of what moves most. A border that came through
other cloth all along has a contour that cannot shorten; it is freed from a neighbouring frame, if at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh import geodesic
from .crossings import contour_forces
from .faults import FaultFinder, FrameFaults, FrameSurroundings, SkinPoints
from .metric import DisplacementMetric, DisplacementSolver

LENGTHS = (0.03, 0.012, 0.004)  # [m] over which pushes spread; the next where a frame gets little better
REACH = 4.0  # lengths around what is wrong, within which vertices move
STEP = 8e-4  # [m] of the vertex that moves most
PATIENCE = 10  # steps, after which pushes spread less where faults are no fewer
FEWER = 0.75  # of the faults, for that
STEPS, FEW = 120, 8  # at most; and where cloth that is free is only lifted
FARTHEST = 0.04  # [m] from the start: what would go farther is not freed, since a spike would be seen more
HEIGHT = 1e-3  # [m] over points of the skin that showed
MOST = 200  # points of the skin that one step asks at, of each triangle the deepest
AGAIN = 1e-8  # of the largest response, so that points beside each other do not fight


@dataclass(frozen=True, eq=False)
class Untangled:
    """Positions of a frame (V, 3) [m], what is still wrong there, and which vertices may have moved, bool (V,)."""

    points: Floats
    faults: FrameFaults
    moved: np.ndarray

    @property
    def is_free(self) -> bool:
        return not self.faults.count


class Untangler:
    """Frees frames of one garment.

    Args:
        mesh: of the garment in the bind pose.
        finder: of what is wrong.
    """

    def __init__(self, mesh: Mesh, finder: FaultFinder) -> None:
        self.mesh, self.finder = mesh, finder
        self.metrics = [DisplacementMetric(mesh, length) for length in LENGTHS]

    def free(
        self, start: Floats, skin: FrameSurroundings | None, faults: FrameFaults | None = None, *, lifts: bool = False
    ) -> Untangled:
        """Return positions from a start (V, 3) [m] at which less is wrong, and nothing where that was found.

        Args:
            faults: what is wrong at the start, where that is known.
            lifts: only a little is left to lift, and few steps are made.
        """
        faults = faults or self.finder.find(start, skin)
        best = Untangled(start, faults, np.zeros(len(start), dtype=bool))
        points, level, waited, tried, goal = start, 0, 0, 0, FEWER * faults.count
        region, solver = np.zeros(len(start), dtype=bool), None
        while faults.count and tried < (FEW if lifts else STEPS):
            wanted = region | self._around(faults, LENGTHS[level] * REACH)
            if solver is None or (wanted & ~region).any():
                region, solver = wanted, self.metrics[level].within(np.flatnonzero(wanted))
            points = points + self._step(points, faults, region, solver, skin)
            if np.linalg.norm(points - start, axis=1).max() > FARTHEST:
                break
            faults = self.finder.find(points, skin)
            tried, waited = tried + 1, waited + 1
            if faults.count < best.faults.count:
                best = Untangled(points, faults, region.copy())
            if best.faults.count <= goal:
                waited, goal = 0, FEWER * best.faults.count
            elif waited >= PATIENCE:
                if level + 1 == len(LENGTHS):
                    break
                level, waited, goal = level + 1, 0, FEWER * best.faults.count
                points, faults, solver = best.points, best.faults, None
        return best

    def _around(self, faults: FrameFaults, reach: float) -> np.ndarray:
        """Return the vertices within reach of what is wrong, bool (V,)."""
        own = faults.pairs[faults.pairs < len(self.mesh.faces)]
        faces = np.concatenate([own, faults.skin.face]).astype(np.int64)
        vertices = np.unique(self.mesh.faces[faces])
        found = geodesic.within(self.mesh.points, self.mesh.faces, vertices, reach)
        return np.asarray(found)

    def _step(
        self,
        points: Floats,
        faults: FrameFaults,
        region: np.ndarray,
        solver: DisplacementSolver,
        skin: FrameSurroundings | None,
    ) -> Floats:
        """Return a displacement (V, 3) [m]; what lies beneath stays."""
        rows = np.flatnonzero(region)
        moved = np.zeros_like(points)
        whole = points if skin is None else skin.joined(points)
        forces = contour_forces(whole, self.finder.every, faults.pairs)[rows]
        if forces.any():
            found = solver.response(forces)
            largest = np.linalg.norm(found, axis=1).max()
            moved[rows] += STEP / largest * found
        if len(faults.skin):
            moved[rows] += lift(solver, faults.skin, self.mesh.faces, region, moved)
        return moved


def lift(solver: DisplacementSolver, skin: SkinPoints, faces: Ints, region: np.ndarray, moved: Floats) -> Floats:
    """Return the least displacement (R, 3) of the vertices of a region that lifts cloth off points of the skin.

    Args:
        moved: displacements (V, 3) that are made as well [m].
    """
    from scipy.optimize import nnls

    skin = _deepest(skin)
    place = np.cumsum(region) - 1
    count = int(region.sum())
    rows = np.zeros((len(skin), count, 3))
    for index, (face, weights, normal) in enumerate(zip(skin.face, skin.weights, skin.normal)):
        for vertex, weight in zip(faces[face], weights):
            if region[vertex]:
                rows[index, place[vertex]] += weight * normal
    gaps = HEIGHT - skin.height - np.einsum("mrc,rc->m", rows, moved[region])
    answers = solver.response(rows.transpose(1, 0, 2).reshape(count, -1)).reshape(count, len(skin), 3)
    compliance = np.einsum("mrc,rnc->mn", rows, answers)
    compliance += AGAIN * compliance.max() * np.eye(len(skin))
    lower = np.linalg.cholesky(compliance)
    pushes, _ = nnls(lower.T, np.linalg.solve(lower, gaps))
    return np.einsum("rnc,n->rc", answers, pushes)


def _deepest(skin: SkinPoints) -> SkinPoints:
    """Return of the points over each triangle the one with the deepest cloth, and of these the deepest `MOST`."""
    order = np.argsort(skin.height, kind="stable")
    first = order[np.sort(np.unique(skin.face[order], return_index=True)[1])]
    return skin.chosen(first[:MOST])
