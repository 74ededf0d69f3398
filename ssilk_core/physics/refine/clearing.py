# SPDX-License-Identifier: Apache-2.0
"""Lift refined cloth off the skin that still shows.

Contact pushes each sample of the cloth out of the part of the body that it can touch. Skin shows all the same where
the body comes through between samples, where tight cloth lies in a part that is not beneath it at rest, and where few
iterations were made. So covered points of the skin (`skin.covered_points`) ask. Where the outermost cloth along
the normal n lies beneath such a point p, the cloth moves by the u with

    min u' H u / 2   subject to   n . sum_k w_k (x_k + u_k) = n . p + HEIGHT,

the smallest step in the metric of the Hessian H of the incremental potential, so that stiff ways of moving are
avoided. The w are the barycentric coordinates at which the cloth meets the line through p along n. Stiff springs
stand in for the constraints. Pinned cloth does not move, and skin inside another part of the body asks for nothing:
it is not seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Scene
from ..collision import PosedBody
from ..collision.winding_number import ENCLOSED, winding_number
from ..simulate.incremental_potential import IncrementalPotential, StepInputs
from ..simulate.newton import State
from ..skin.covered_points import CoveredPoints

POINTS = 30_001  # on the body, 7 mm apart on a person; others than those at which skin that shows is measured
ROUNDS = 12  # at most; each finds anew where skin shows
HEIGHT = 3e-3  # [m] above the points, since skin between them is not asked and springs stop a little short
STIFFER = 9.0  # springs of each point, relative to the Hessian at the cloth; with more points they can be softer
DEEPEST = 0.02  # [m] beneath the skin; deeper cloth could only be lifted as a spike
SHALLOWEST = 0.002  # [m]; a frame that does not gain lifts cloth half as deep, but not from less than this
LEAST_GAIN = 0.1  # of the points that ask, by which fewer must show; with less, a frame goes on for nothing
FARTHEST = 0.03  # [m] that a vertex moves in all rounds
REDUCTION, CG_ITERATIONS = 1e-4, 300  # of the residual by each linear solve, and its longest
MOST_FREE = 0.5  # share of the cloth's weights at free corners from which on it is lifted
CORNERS = list(combinations_with_replacement(range(3), 2))  # pairs of them in a triangle
PAIRS_AT_ONCE = 1 << 20  # of a point and a triangle
ROWS = ("frame", "face", "weights", "normal", "gap")  # what `Lifts` has of each point


@dataclass(frozen=True, eq=False)
class Lifts:
    """Where M points of the skin ask cloth to rise, in any of N frames.

    Attributes:
        frame, face: frame and triangle of each, both (M,).
        weights: barycentric coordinates on the triangle (M, 3); normal: of the skin (M, 3).
        gap: how far to rise along the normal [m], shape (M,).
        shown: points that show in each frame, asking or not, shape (N,).
    """

    frame: Tensor
    face: Tensor
    weights: Tensor
    normal: Tensor
    gap: Tensor
    shown: Tensor

    @property
    def asking(self) -> Tensor:
        """Number of points that ask in each frame (N,)."""
        return torch.bincount(self.frame, minlength=len(self.shown))

    @property
    def deepest(self) -> Tensor:
        """How deep the cloth lies that is asked to rise, at most, in each frame [m]; zero for none (N,)."""
        depths = self.gap.new_zeros(len(self.shown))
        return depths.scatter_reduce(0, self.frame, self.gap - HEIGHT, "amax")

    def within(self, depth: Tensor) -> Lifts:
        """Return what is asked of cloth up to the depths (N,) beneath the skin in each frame [m]."""
        return self._chosen(self.gap - HEIGHT <= depth[self.frame])

    def select(self, frames: Tensor) -> Lifts:
        """Return what is asked in the frames with indices (K,), in ascending order."""
        place = torch.full_like(self.shown, -1)
        place[frames] = torch.arange(len(frames), device=frames.device)
        lifts = self._chosen(place[self.frame] >= 0)
        return replace(lifts, frame=place[lifts.frame], shown=self.shown[frames])

    def where(self, stay: Tensor, other: Lifts) -> Lifts:
        """Return what is asked in the frames that stay (N,), and what others ask in all other frames."""
        own, new = self._chosen(stay[self.frame]), other._chosen(~stay[other.frame])
        rows = {name: torch.cat([getattr(own, name), getattr(new, name)]) for name in ROWS}
        return replace(self, shown=self.shown.where(stay, other.shown), **rows)

    def _chosen(self, kept: Tensor) -> Lifts:
        return replace(self, **{name: getattr(self, name)[kept] for name in ROWS})


class SkinClearing:
    """Lifts one garment off the skin.

    Args:
        potential: whose Hessian says which way of moving costs least.
    """

    def __init__(self, scene: Scene, potential: IncrementalPotential) -> None:
        device, mesh, body = potential.free.device, scene.garment.mesh, scene.character.merged_body().mesh
        self.potential = potential
        self.points = CoveredPoints(body, mesh, count=POINTS, seed=None, smooth=True, device=device)
        self.faces, self.body_faces = (torch.as_tensor(np.array(each.faces), device=device) for each in (mesh, body))
        self.vertices = torch.as_tensor(self.points.vertices, device=device)
        pattern = potential.block_pattern
        slots = np.stack([pattern.slots(mesh.faces[:, side]) for side in CORNERS], axis=1)
        self.slots = torch.as_tensor(slots, device=device)  # of the blocks of each triangle, -1 where one is pinned
        self.places = torch.as_tensor(pattern.place[mesh.faces], device=device)

    @torch.no_grad()
    def lift(self, x: Tensor, inputs: StepInputs, most: Tensor) -> Tensor:
        """Return positions (V, 3, N) at which less skin shows; frames that cannot gain stay as they are.

        Args:
            most: energy that no frame may exceed [J], shape (N,).
        """
        if inputs.body is None or not len(self.points):
            return x
        found, before = x, self._lifts(x, inputs.body)
        (left,) = before.asking.nonzero(as_tuple=True)
        if not len(left):
            return x
        before, inputs, most = before.select(left), inputs.select(left), most[left]
        state, depth = State.at(self.potential, x[..., left], inputs), before.deepest
        asked = before.within(depth)
        for _ in range(ROUNDS):
            assert inputs.body
            moved = state.x + self._step(state, inputs, asked) - x[..., left]
            moved = moved * (FARTHEST / moved.norm(dim=1, keepdim=True).clamp_min(FARTHEST))
            trial = State.at(self.potential, x[..., left] + moved, inputs)
            after = self._lifts(trial.x, inputs.body)
            better = (before.shown - after.shown >= LEAST_GAIN * asked.asking) & (trial.energy <= most)
            (gained,) = better.nonzero(as_tuple=True)
            found = found.index_copy(-1, left[gained], trial.x[..., gained])
            state, before = state.replace_frames(gained, trial.select(gained)), before.where(~better, after)
            depth = depth.where(better, depth / 2).minimum(before.deepest)
            asked = before.within(depth)
            (kept,) = ((asked.asking > 0) & (better | (depth >= SHALLOWEST))).nonzero(as_tuple=True)
            if not len(kept):
                break
            left, inputs, most, depth = left[kept], inputs.select(kept), most[kept], depth[kept]
            state, before, asked = state.select(kept), before.select(kept), asked.select(kept)
        return found

    def _lifts(self, x: Tensor, body: PosedBody) -> Lifts:
        """Find where cloth lies beneath covered skin."""
        single = x.float()
        points, normals = self.points.place(body.points[self.vertices], body.normals[self.vertices])
        distance, face = self.points.outermost(single, points, normals)
        point, frame = ((distance > -torch.inf) & (distance < 0)).nonzero().unbind(1)
        start, normal = points[point, :, frame], normals[point, :, frame]
        distance, face = distance[point, frame], face[point, frame]
        seen = ~self._enclosed(start + HEIGHT / 2 * normal, frame, body)
        frame, face, start, normal, distance = (each[seen] for each in (frame, face, start, normal, distance))
        corners = single.permute(2, 0, 1)[frame[:, None], self.faces[face]]
        weights = _barycentric(start + distance[:, None] * normal, corners)
        movable = (weights * (self.places[face] >= 0)).sum(1) > MOST_FREE
        asked = movable & (distance >= -DEEPEST)
        shown = torch.bincount(frame, minlength=x.shape[-1])
        return Lifts(frame[asked], face[asked], weights[asked], normal[asked], HEIGHT - distance[asked], shown)

    def _enclosed(self, points: Tensor, frame: Tensor, body: PosedBody) -> Tensor:
        """Tell which points (M, 3) lie inside a part of the body, in the frames (M,)."""
        inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        whole, at_once = body.points.permute(2, 0, 1), max(1, PAIRS_AT_ONCE // len(self.body_faces))
        for some in torch.arange(len(points), device=points.device).split(at_once):
            corners = whole[frame[some]][:, self.body_faces] - points[some, None, None]
            inside[some] = winding_number(corners) > ENCLOSED
        return inside

    def _step(self, state: State, inputs: StepInputs, lifts: Lifts) -> Tensor:
        """Return the displacement (V, 3, N) that lifts the cloth of a state."""
        potential, x = self.potential, state.x
        matrix = potential.hessian(x, inputs, state.body_distance)
        places, frames = self.places[lifts.face], lifts.frame[:, None]
        diagonal = matrix.blocks[: len(potential.free)].diagonal(dim1=1, dim2=2).mean(-1)  # (U, N)
        stiffness = STIFFER * diagonal[places.clamp_min(0), frames].where(places >= 0, 0).amax(1)
        springs = stiffness[:, None, None] * lifts.normal[:, :, None] * lifts.normal[:, None]
        blocks = matrix.blocks.permute(0, 3, 1, 2)
        for side, (i, j) in enumerate(CORNERS):
            slot = self.slots[lifts.face, side]
            free = slot >= 0
            share = (lifts.weights[:, i] * lifts.weights[:, j])[free, None, None]
            _add(blocks, slot[free], lifts.frame[free], share * springs[free])
        pull = (stiffness * lifts.gap)[:, None, None] * lifts.weights[:, :, None] * lifts.normal[:, None]
        right, free = matrix.blocks.new_zeros(len(potential.free), x.shape[-1], 3), places >= 0
        _add(right, places[free], frames.expand_as(places)[free], pull[free])
        right = right.transpose(1, 2).contiguous()
        z, _ = matrix.solve(right, REDUCTION, CG_ITERATIONS)
        step = torch.zeros_like(x)
        step[potential.free] = z.to(x.dtype)
        return step


def _add(target: Tensor, rows: Tensor, frames: Tensor, values: Tensor) -> None:
    """Add values (M, ...) to rows and frames (M,) of a tensor, those of the same place always in the same order."""
    summed = torch.sparse_coo_tensor(torch.stack([rows, frames]), values, target.shape, check_invariants=False)
    summed = summed.coalesce()
    target[tuple(summed.indices())] += summed.values()


def _barycentric(points: Tensor, triangles: Tensor) -> Tensor:
    """Return barycentric coordinates (M, 3) of points (M, 3) in triangles (M, corners, 3)."""
    first, second = (triangles[:, corner] - triangles[:, 0] for corner in (1, 2))
    away, normal = points - triangles[:, 0], torch.linalg.cross(first, second)
    square = (normal * normal).sum(1).clamp_min(torch.finfo(points.dtype).tiny)
    u = (torch.linalg.cross(away, second) * normal).sum(1) / square
    v = (torch.linalg.cross(first, away) * normal).sum(1) / square
    return torch.stack([1 - u - v, u, v], dim=1).clamp(0, 1)
