# SPDX-License-Identifier: Apache-2.0
"""Obstacles around the characters of a training run: floors and walls, boxes, capsules and balls.

Each is a box with rounded edges: a capsule has one long half extent, a ball none, and a floor or a wall is a box so
large that it has one face. Their distances have closed forms, of which those outside are exact:

    q = |R^T (x - c)| - h,    d = |max(q, 0)| + min(max(q), 0) - r

Bodies do not pass through floors and chairs, so that an obstacle is where the body does not come in the frames that
it is drawn for. Where it would, one beside the garment is moved away, and then r shrinks until it does not, below
zero at need. The same is done in each window that continues another: an obstacle that stands in the way draws back.
Some obstacles are kept off the garment, too, as it would rest: what is near is not always touched.

A window of a family of bodies continues on another body than that before. Its floor is then as far from the new body
as it was from the old one, as if that had been in the same frames; what stands in the new one's way draws back.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..network.feedback import spread_rows
from ..network.model.descriptors import proximity_features, proximity_length
from ..network.model.feedback import BodyFrames
from ..network.model.network import GarmentModel
from ..network.proximity import proximity_reach
from ..physics import kernels
from ..physics.collision import signed_distance_to_planes
from ..physics.skinning import Skinning
from ..scene.assets import SkinWeights
from ..scene.family import BodyFamily
from .family_bank import FamilyBank
from .motion_bank import MotionBank

BODY_POINTS = 256  # spread over the body, by which it is kept out of obstacles
SKIN = 0.005  # [m] between these and an obstacle that touches the body
FLOORS, BOTH = 0.4, 0.25  # shares of poses with obstacles that have a floor or wall alone, and one beside something
TOUCHED = 0.6  # share of floors that the body touches
LEVEL = 0.6  # share of floors that are level; others are tilted, or walls
LYING = 0.6  # share of bodies that are turned over that lie on a level floor, beside all others
TURNED = 0.7  # cosine between gravity and straight down, below which a body is turned over
FURTHEST = 0.4  # of the reach, up to which others are away from the body
UNTOUCHED = 0.4  # share of obstacles beside the garment that do not touch it; they are away as far as floors are
LARGE = 50.0  # [m] half extents of a floor
ABSENT = -2 * LARGE  # [m] radius of what is not there
SMALLEST, LARGEST = 0.03, 0.5  # [m] half extents of boxes
THINNEST, THICKEST = 0.02, 0.25  # [m] radii of capsules and balls
OVERLAP, GAP = 0.2, 0.2  # [m] that what is drawn beside the garment reaches into it, and stays away from it
TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Obstacles:
    """K rounded boxes in each of N frames.

    Attributes:
        turn: axes of the boxes as columns, shape (K, N, 3, 3).
        centre, half: [m], shape (K, N, 3).
        radius: [m], shape (K, N).
    """

    turn: Tensor
    centre: Tensor
    half: Tensor
    radius: Tensor

    def repeated(self, count: int) -> Obstacles:
        """Return those of N frames again and again."""
        return Obstacles(*(each.repeat(1, count, *[1] * (each.ndim - 2)) for each in self.parts))

    def joined(self, other: Obstacles) -> Obstacles:
        """Return the frames of both."""
        return Obstacles(*(torch.cat(both, dim=1) for both in zip(self.parts, other.parts)))

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.turn, self.centre, self.half, self.radius

    def without_empty(self) -> Obstacles:
        """Return them with those away of which nothing is left."""
        empty = self.radius <= -self.half.amin(dim=2)
        radius = torch.where(empty, torch.full_like(self.radius, ABSENT), self.radius)
        return Obstacles(self.turn, self.centre, self.half, radius)

    def distance(self, points: Tensor, box: int) -> Tensor:
        """Return the distances of points (M, 3, N) to one box of each frame [m], shape (M, N)."""
        outside = self._local(points, box).abs() - self.half[box].T
        return self._signed(self._length(outside), outside.amax(dim=1), box)

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances of points (M, 3, N) to the nearest box [m], (M, N), and directions away, (M, 3, N)."""
        if kernels.supports(points):
            from ..physics.kernels.boxes import nearest_box_kernel

            return nearest_box_kernel(points, self.parts)
        found = [self._away(points, box) for box in range(len(self.radius))]
        distance, away = found[0]
        for other, direction in found[1:]:
            nearer = other < distance
            distance, away = torch.where(nearer, other, distance), torch.where(nearer[:, None], direction, away)
        return distance, away

    def clearance(self, points: Tensor) -> Tensor:
        """Return the least distance of points (M, 3, N) to each box [m], shape (K, N)."""
        if kernels.supports(points):
            from ..physics.kernels.boxes import box_clearance_kernel

            return box_clearance_kernel(points, self.parts)
        return torch.stack([self.distance(points, box).amin(dim=0) for box in range(len(self.radius))])

    def nearer_planes(
        self, points: Tensor, normal: Tensor, offset: Tensor, clearance: float
    ) -> tuple[Tensor, Tensor]:
        """Return planes of points (M, 3, N), moved outwards: those given, or of the nearest box where it is nearer.

        Args:
            normal: (M, 3, N), and offset: (M, N) [m]; they may be changed.
            clearance: by which planes are moved [m].
        """
        if kernels.supports(points):
            from ..physics.kernels.boxes import nearer_planes_kernel

            normal, offset = normal.contiguous(), offset.contiguous()
            nearer_planes_kernel(points, self.parts, normal, offset, clearance)
            return normal, offset
        distance, away = self.nearest(points)
        nearer = distance < signed_distance_to_planes(points, normal, offset)
        offset = torch.where(nearer, (away * points).sum(1) - distance, offset)
        return torch.where(nearer[:, None], away, normal), offset + clearance

    def _local(self, points: Tensor, box: int) -> Tensor:
        return torch.einsum("nba,mbn->man", self.turn[box], points - self.centre[box].T)

    @staticmethod
    def _length(outside: Tensor) -> Tensor:
        return torch.linalg.vector_norm(outside.clamp_min(0), dim=1)

    def _signed(self, length: Tensor, deepest: Tensor, box: int) -> Tensor:
        return length + deepest.clamp(max=0) - self.radius[box]

    def _away(self, points: Tensor, box: int) -> tuple[Tensor, Tensor]:
        local = self._local(points, box)
        outside = local.abs() - self.half[box].T
        length, deepest = self._length(outside), outside.amax(dim=1)
        # Inside, the nearest face is that which is least deep.
        face = (outside == deepest[:, None]).to(local.dtype)
        own = torch.where((length > TINY)[:, None], outside.clamp_min(0), face)
        own = torch.copysign(nn.functional.normalize(own, dim=1, eps=TINY), local)
        away = torch.einsum("nab,mbn->man", self.turn[box], own)
        return self._signed(length, deepest, box), away


@dataclass(frozen=True, eq=False)
class Near:
    """The nearest obstacle to each of M points in N frames.

    Attributes:
        points: where the cloth would rest without obstacles [m], shape (M, 3, N).
        distance: from them [m], shape (M, N); away: directions away from obstacles, shape (M, 3, N).
    """

    points: Tensor
    distance: Tensor
    away: Tensor

    def planes(self, count: int) -> Tensor:
        """Return the planes (count, 4, N) at the first points, as `network.model.feedback.BodyFrames` has them."""
        away = self.away[:count]
        height = (away * self.points[:count]).sum(1) - self.distance[:count]
        return torch.cat([away, height[:, None]], dim=1)

    def stopping(self, body: BodyFrames, count: int, length: int) -> BodyFrames:
        """Return a body in windows of `length` frames, with the planes at the first points."""
        planes = self.planes(count)
        return BodyFrames(body.matrices, body.bend, planes.unflatten(-1, (length, -1)).movedim(-2, 0))


class ObstacleDrawer:
    """Draws obstacles around the characters of a bank, and tells what the network sees of them.

    Args:
        model: of the garment, as it is trained.
        hub: the place of the skeleton's hub among the joints of the descriptors.
        share: of windows and poses that have any.
        family: bodies that steps are done on; the scene's alone by default.
    """

    def __init__(
        self,
        model: GarmentModel,
        bank: MotionBank,
        hub: int,
        share: float,
        generator: torch.Generator,
        family: BodyFamily | None = None,
    ) -> None:
        body = model.scene.character.merged_body()
        self.model, self.bank, self.hub, self.share, self.generator = model, bank, hub, share, generator
        self.reach = proximity_reach(model.scene)
        rows = spread_rows(body.mesh.points, BODY_POINTS)
        skin = SkinWeights(body.skin.path, body.skin.indices[rows], body.skin.weights[rows])
        self._skin = Skinning(skin).to(bank.static.device)
        self._body = torch.tensor(body.mesh.points[rows], dtype=torch.float32, device=bank.static.device)
        self._base, self._moves = self._body.clone(), None
        if family:
            assert isinstance(bank, FamilyBank)
            self._moves = torch.tensor(family.point_moves[:, rows], dtype=torch.float32, device=self._body.device)

    def wear(self, place: Tensor) -> None:
        """Keep obstacles out of the body of a family at coordinates (K,), in place."""
        if self._moves is not None:
            self._body.copy_(self._base + torch.tensordot(place, self._moves, 1))

    @property
    def worn(self) -> Tensor | None:
        """Coordinates (K,) of the body that steps are done on; None for one body alone."""
        return self.bank.place if isinstance(self.bank, FamilyBank) else None

    def near(self, obstacles: Obstacles, frames: Tensor, gravity: Tensor, fabric: Tensor | None = None) -> Near:
        """Return how near obstacles are in frames (N,) to the points that see them.

        Args:
            gravity: and wind [g], shape (N, 3).
            fabric: features of it (N, 5); the model's own by default.
        """
        points = self._resting(frames, gravity, fabric)
        return Near(points, *obstacles.nearest(points))

    def seen(self, near: Near, frames: Tensor) -> Tensor:
        """Return features of proximity (N, 3 M) of what is near in frames (N,), as `network.proximity` has them."""
        vectors = near.away * proximity_length(near.distance / self.reach)[:, None]
        return proximity_features(vectors.permute(2, 0, 1), self.bank.down[frames, self.hub])

    def draw(self, frames: Tensor, gravity: Tensor) -> Obstacles:
        """Draw a floor or wall and another obstacle, or none, for N frames or windows.

        Args:
            frames: those in which the body stays outside, shape (T, N); obstacles are placed about the middle one.
            gravity: its directions (N, 3).
        """
        count, middle = frames.shape[1], frames[len(frames) // 2]
        chance = self._uniform(5, count)
        lies = (-gravity[:, 1] < TURNED) & (chance[4] < LYING)
        floor = lies | (chance[0] < self.share) & (chance[1] < FLOORS + BOTH)
        other = (chance[0] < self.share) & (chance[1] > FLOORS)
        points = self._resting(middle, gravity)
        # A floor is at the body or further away, and others where they were put unless the body or cloth is there.
        gap, beside = self._uniform(2, count) ** 2 * FURTHEST * self.reach
        gap = torch.where(lies | (chance[2] < TOUCHED), torch.zeros_like(gap), gap)
        beside = torch.where(chance[3] < UNTOUCHED, beside, torch.full_like(beside, -LARGE))

        def in_the_way(box: Obstacles) -> Tensor:
            cloth = beside - box.clearance(points)[0]
            return torch.maximum(-self._clearance(box, frames)[0], cloth).clamp_min(0)

        level, (box, way) = self._floors(points, gravity, lies), self._others(points)
        box = Obstacles(box.turn, box.centre + in_the_way(box)[:, None] * way, box.half, box.radius)
        radius = torch.cat([
            level.radius + self._clearance(level, frames) - gap,
            box.radius - in_the_way(box),
        ])  # fmt: skip
        radius = torch.where(torch.stack([floor, other]), radius, torch.full_like(radius, ABSENT))
        turn, centre, half = (torch.cat(both) for both in zip(level.parts[:3], box.parts[:3]))
        return Obstacles(turn, centre, half, radius).without_empty()

    def drawn_back(self, obstacles: Obstacles, frames: Tensor) -> Obstacles:
        """Return obstacles that the body stays outside of in frames (T, N), too."""
        inside = (-self._clearance(obstacles, frames)).clamp_min(0)
        drawn = Obstacles(obstacles.turn, obstacles.centre, obstacles.half, obstacles.radius - inside)
        return drawn.without_empty()

    def brought(self, obstacles: Obstacles, frames: Tensor, before: Tensor) -> Obstacles:
        """Return obstacles around a body at coordinates `before` (K,) as they are around that which is worn now.

        Floors and walls, which come first, stay as far from it in frames (T, N); it stays outside of all.
        """
        assert isinstance(self.bank, FamilyBank)
        now, place = self._clearance(obstacles, frames), self.bank.place.clone()
        self._put_on(before)
        then = self._clearance(obstacles, frames)
        self._put_on(place)
        nearer = torch.cat([(now - then)[:1], torch.zeros_like(now[1:])])
        brought = Obstacles(obstacles.turn, obstacles.centre, obstacles.half, obstacles.radius + nearer)
        return self.drawn_back(brought, frames)

    def _put_on(self, place: Tensor) -> None:
        assert isinstance(self.bank, FamilyBank)
        self.bank.wear(place)
        self.wear(place)

    def _resting(self, frames: Tensor, gravity: Tensor, fabric: Tensor | None = None) -> Tensor:
        """Return the points that see obstacles (M, 3, N), where they would rest without in frames (N,)."""
        static = self.bank.static_descriptor(frames, gravity)
        static = static if fabric is None else torch.cat([fabric, static], dim=1)
        return self.model.resting(static, self.bank.character(frames))

    def _clearance(self, obstacles: Obstacles, frames: Tensor) -> Tensor:
        """Return how far the body is outside of each obstacle in its frames (T, N), at least, [m], shape (K, N)."""
        with torch.no_grad():
            points = self._skin(self._body, None, self._skin.weights, self.bank.character(frames.flatten()))
        least = obstacles.repeated(len(frames)).clearance(points)
        return least.unflatten(1, frames.shape).amin(dim=1) - SKIN

    def _floors(self, points: Tensor, gravity: Tensor, level: Tensor) -> Obstacles:
        """Return floors and walls that pass through the middle of the garment; level ones where `level` (N,) says."""
        count, device = len(gravity), points.device
        tilt = 0.2 * self._normal(count, 3)
        anywhere, chance = self._normal(count, 3), self._uniform(2, count, 1)
        up = nn.functional.normalize(-gravity, dim=1)
        flat = level[:, None] | (chance[0] < LEVEL)
        up = torch.where(flat, up, torch.where(chance[1] < 0.5, up + tilt, anywhere))
        turn = _frames_along(nn.functional.normalize(up, dim=1), self._normal(count, 3))
        centre = points.mean(dim=0).T - LARGE * turn[..., 0]
        half, radius = torch.full((count, 3), LARGE, device=device), torch.zeros(count, device=device)
        return Obstacles(turn[None], centre[None], half[None], radius[None])

    def _others(self, points: Tensor) -> tuple[Obstacles, Tensor]:
        """Return boxes, capsules and balls beside points (M, 3, N) of the garment, and directions away (N, 3)."""
        count = points.shape[2]
        draw, chance = self._uniform(4, count), self._uniform(2, count, 1)
        turn = _frames_along(nn.functional.normalize(self._normal(count, 3), dim=1), self._normal(count, 3))
        sizes = SMALLEST * (LARGEST / SMALLEST) ** self._uniform(count, 3)
        long = torch.cat([sizes[:, :1], torch.zeros_like(sizes[:, 1:])], dim=1)
        half = torch.where(chance[0] < 0.5, sizes, torch.where(chance[1] < 0.5, long, torch.zeros_like(sizes)))
        round_ = THINNEST * (THICKEST / THINNEST) ** draw[0]
        radius = torch.where(chance[0, :, 0] < 0.5, torch.full_like(round_, SKIN), round_)
        pick = (draw[1] * len(points)).long().clamp_max(len(points) - 1)
        beside = points.permute(2, 0, 1)[torch.arange(count, device=pick.device), pick]
        way = nn.functional.normalize(self._normal(count, 3), dim=1)
        extent = ((turn.mT @ way[..., None])[..., 0].abs() * half).sum(dim=1) + radius
        away = extent + draw[2] * (OVERLAP + GAP) - OVERLAP
        return Obstacles(turn[None], (beside + away[:, None] * way)[None], half[None], radius[None]), way

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self.bank.static.device)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, device=self.bank.static.device)


def _frames_along(first: Tensor, other: Tensor) -> Tensor:
    """Return rotations (N, 3, 3) whose first column is `first` (N, 3), and whose second is towards `other`."""
    second = nn.functional.normalize(other - (other * first).sum(1, keepdim=True) * first, dim=1)
    return torch.stack([first, second, torch.linalg.cross(first, second, dim=1)], dim=2)
