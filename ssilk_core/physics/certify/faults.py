# SPDX-License-Identifier: Apache-2.0
"""What is wrong in one frame of a garment: triangles that intersect others, and covered skin that shows.

Others are its own, and those of garments beneath it, which stay where they are. Its own triangles have the first
numbers, and its own vertices too.

Skin is looked at where its share is measured (`skin.covered_skin`), and at four times as many points between, along
smooth normals. Points inside another part of the body are not seen, whatever lies over them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ...scene.assets import Floats, Ints, Scene
from ...scene.mesh import topology
from ..collision.winding_number import ENCLOSED, winding_number
from ..intersections.cloth import ClothIntersections
from ..intersections.pairs import intersections_between
from ..skin.blocked_rays import NO_TRIANGLE, BlockedRays
from ..skin.covered_points import CoveredPoints, LastingRays
from ..skin.figures import COVER_REACH, SHOW_DEPTH

DENSE = 30_001  # points between those at which skin is measured, 7 mm apart on a person
PAIRS_AT_ONCE = 1 << 20  # of a point and a triangle of the body
LIFTED = 5e-4  # [m] above a point at which it is asked whether other parts of the body enclose it


@dataclass(frozen=True, eq=False)
class SkinPoints:
    """M points of the skin with the cloth that lies next to them along their normals.

    Attributes:
        index: among all points that are looked at, shape (M,).
        face: triangle of the cloth (M,); weights: barycentric coordinates on it (M, 3).
        normal: of the skin (M, 3).
        height: of the cloth above the point [m], negative beneath it, shape (M,).
    """

    index: Ints
    face: Ints
    weights: Floats
    normal: Floats
    height: Floats

    def __len__(self) -> int:
        return len(self.index)

    def chosen(self, kept: Ints | np.ndarray) -> SkinPoints:
        """Return some of the points."""
        return SkinPoints(*(getattr(self, name)[kept] for name in ("index", "face", "weights", "normal", "height")))


@dataclass(frozen=True, eq=False)
class FrameFaults:
    """What is wrong in a frame: pairs of triangles that intersect (P, 2), and skin that shows.

    The first triangle of a pair is the garment's.
    """

    pairs: Ints
    skin: SkinPoints

    @property
    def count(self) -> int:
        """Number of pairs and points together; 0 where the frame is free."""
        return len(self.pairs) + len(self.skin)


class FaultFinder:
    """Finds what is wrong in frames of one garment on one character.

    Args:
        scene: with the character's body, if it has one.
        beneath: triangles (G, 3) of the garments beneath it, which have W vertices together.

    Attributes:
        cloth: which triangles intersect.
        faces: of the garment (F, 3); `every` has those beneath as well, whose vertices come after its own.
        joints: of each point of the skin that is looked at, the joint with the largest weight, shape (S,).
    """

    def __init__(self, scene: Scene, beneath: Ints | None = None) -> None:
        self.cloth, self.faces = ClothIntersections.of(scene), scene.garment.mesh.faces
        self.beneath = np.zeros((0, 3), dtype=np.int64) if beneath is None else beneath
        self.every = np.concatenate([self.faces, self.beneath + scene.garment.mesh.vertex_count])
        self._sets: list[tuple[CoveredPoints, bool]] = []
        self.joints = np.zeros(0, dtype=np.int64)
        if not scene.character.bodies:
            return
        merged, mesh = scene.character.merged_body(), scene.garment.mesh
        self._body = merged.mesh
        cpu = torch.device("cpu")
        found = [(CoveredPoints(merged.mesh, mesh, device=cpu), False)]
        found.append((CoveredPoints(merged.mesh, mesh, count=DENSE, seed=None, smooth=True, device=cpu), True))
        self._sets = [each for each in found if len(each[0])]
        heaviest = merged.skin.dense(len(scene.character.skeleton.joint_names)).argmax(axis=1)
        if self._sets:
            self.joints = np.concatenate([
                heaviest[merged.mesh.faces[points.faces, points.weights.argmax(axis=1)]] for points, _ in self._sets
            ])  # fmt: skip
            self._rays = LastingRays(mesh, len(self.joints))
            self._search = BlockedRays(mesh.points, mesh.faces)
            self._last = np.full(len(self.joints), NO_TRIANGLE)

    def place(self, body: Floats | None, beneath: Floats | None = None) -> FrameSurroundings | None:
        """Return the points of the skin on a posed body (B, 3) [m]; None where none is covered and nothing beneath.

        Args:
            beneath: positions of the garments beneath (W, 3) [m].
        """
        if body is None or not self._sets:
            none = np.zeros((0, 3))
            return (
                None if beneath is None else FrameSurroundings(none, none, none, np.zeros(0, dtype=np.int8), beneath)
            )
        smooth_normals = topology.vertex_normals(body, self._body.faces)
        starts, normals = [], []
        for points, smooth in self._sets:
            corners, share = self._body.faces[points.faces], points.weights[..., None]
            at = body[corners]
            starts.append((at * share).sum(axis=1))
            flat = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
            normal = (smooth_normals[corners] * share).sum(axis=1) if smooth else flat
            normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12))
        unknown = np.full(len(self.joints), -1, dtype=np.int8)
        return FrameSurroundings(body, np.concatenate(starts), np.concatenate(normals), unknown, beneath)

    def find(self, points: Floats, skin: FrameSurroundings | None) -> FrameFaults:
        """Return what is wrong with the cloth at these positions [m], shape (V, 3)."""
        pairs = self.cloth.pairs(points)
        if skin is not None and skin.beneath is not None:
            crossing = intersections_between(points, self.faces, skin.beneath, self.beneath)
            pairs = np.concatenate([pairs, crossing + [0, len(self.faces)]])
        return FrameFaults(pairs, self.showing(points, skin))

    def showing(self, points: Floats, skin: FrameSurroundings | None) -> SkinPoints:
        """Return the points of the skin that show, with the cloth beneath them."""
        if skin is None or not len(skin.starts):
            return _no_points()
        origin = skin.starts.mean(axis=0)
        x, starts = (np.ascontiguousarray(each, dtype=np.float32) for each in (points - origin, skin.starts - origin))
        covered, near = self._rays.look(x, starts, skin.normals.astype(np.float32))
        shows = np.flatnonzero(near & ~covered)
        shows = shows[~self._enclosed(skin, shows)]
        return self._beside(points, skin, shows, -SHOW_DEPTH, 0.0)

    def resting(self, points: Floats, skin: FrameSurroundings, chosen: Ints, above: float) -> SkinPoints:
        """Return the points, of those with indices (M,), whose outermost cloth lies less than `above` them [m].

        Beneath the skin it is looked for as deep as it is seen.
        """
        found = self._beside(points, skin, chosen, -SHOW_DEPTH, above)
        low, high = (np.full(len(found), reach, np.float32) for reach in (above, COVER_REACH))
        unknown = np.full(len(found), NO_TRIANGLE)
        x, starts, directions = self._asked(points, skin, found.index)
        over, _ = self._search.find(x, starts, directions, low, high, unknown)
        return found.chosen(over == NO_TRIANGLE)

    def _beside(self, points: Floats, skin: FrameSurroundings, chosen: Ints, low: float, high: float) -> SkinPoints:
        """Return the points, of those with indices (M,), with any cloth between two heights over them [m]."""
        least, most = (np.full(len(chosen), reach, np.float32) for reach in (low, high))
        x, starts, directions = self._asked(points, skin, chosen)
        face, height = self._search.find(x, starts, directions, least, most, self._last[chosen])
        self._last[chosen] = face
        kept = face != NO_TRIANGLE
        index, face, height = chosen[kept], face[kept], height[kept].astype(np.float64)
        normal = skin.normals[index]
        weights = barycentric(skin.starts[index] + height[:, None] * normal, points[self.faces[face]])
        return SkinPoints(index, face, weights, normal, height)

    @staticmethod
    def _asked(points: Floats, skin: FrameSurroundings, chosen: Ints) -> tuple[Floats, Floats, Floats]:
        """Return vertices, and starts and directions of rays, around an origin that float32 is exact near."""
        origin = skin.starts.mean(axis=0)
        x, starts = ((each - origin).astype(np.float32) for each in (points, skin.starts[chosen]))
        return np.ascontiguousarray(x), starts, skin.normals[chosen].astype(np.float32)

    def _enclosed(self, skin: FrameSurroundings, chosen: Ints) -> np.ndarray:
        """Tell which points lie inside a part of the body, bool (M,); it is looked for once in each pose."""
        asked = chosen[skin.enclosed[chosen] < 0]
        starts = skin.starts[asked] + LIFTED * skin.normals[asked]
        corners = torch.from_numpy(np.ascontiguousarray(skin.body[self._body.faces]))
        for some in np.array_split(np.arange(len(asked)), 1 + len(asked) * len(corners) // PAIRS_AT_ONCE):
            away = corners[None] - torch.from_numpy(starts[some])[:, None, None]
            skin.enclosed[asked[some]] = (winding_number(away) > ENCLOSED).numpy()
        return skin.enclosed[chosen] > 0


@dataclass(frozen=True, eq=False)
class FrameSurroundings:
    """What is around a garment in a frame: points of the skin (S, 3) [m] with unit normals (S, 3), on a posed body
    (B, 3) [m], and the garments beneath.

    Attributes:
        enclosed: which points lie inside another part of the body, 1 or 0, and -1 where nobody has asked yet, (S,).
        beneath: positions of the garments beneath (W, 3) [m]; None without any.
    """

    body: Floats
    starts: Floats
    normals: Floats
    enclosed: Ints
    beneath: Floats | None = None

    def joined(self, points: Floats) -> Floats:
        """Return positions of the garment (V, 3) and of those beneath, (V + W, 3) [m]."""
        return points if self.beneath is None else np.concatenate([points, self.beneath])


def _no_points() -> SkinPoints:
    none = np.zeros(0, dtype=np.int64)
    return SkinPoints(none, none, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def barycentric(places: Floats, corners: Floats) -> Floats:
    """Return the barycentric coordinates (M, 3) of places (M, 3) on triangles (M, 3, 3)."""
    first, second, away = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], places - corners[:, 0]
    normal = np.cross(first, second)
    square = (normal * normal).sum(axis=1).clip(np.finfo(float).tiny)
    u = (np.cross(away, second) * normal).sum(axis=1) / square
    v = (np.cross(first, away) * normal).sum(axis=1) / square
    return np.stack([1 - u - v, u, v], axis=1).clip(0, 1)
