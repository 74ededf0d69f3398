# SPDX-License-Identifier: Apache-2.0
"""A body to cut garments on, and surfaces that are laid round it: grids of points, shape (rows, columns, 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene.assets import Character, Floats, Ints

# Where joints stand in a standing adult, as (left, up) fractions of the height: used when a rig names them otherwise.
PROPORTIONS = {
    "Hips": (0.0, 0.535),
    "Spine": (0.0, 0.665),
    "Neck": (0.0, 0.85),
    "Head": (0.0, 0.91),
    "LeftArm": (0.1, 0.79),
    "LeftUpLeg": (0.063, 0.53),
    "LeftLeg": (0.083, 0.29),
    "LeftFoot": (0.109, 0.043),
}


@dataclass(frozen=True, eq=False)
class BodyFit:
    """A body in its bind pose to cut garments on: points [m] (V, 3), faces (F, 3), joint positions by plain name."""

    points: Floats
    faces: Ints
    joints: dict[str, Floats]

    def joint(self, name: str) -> Floats:
        """Return a joint's position [m], or where a body of this height usually has it."""
        if name in self.joints:
            return self.joints[name]
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        side, up = np.array(PROPORTIONS[name]) * (high[1] - low[1])
        return np.array([(low[0] + high[0]) / 2 + side, low[1] + up, float(np.median(self.points[:, 2]))])

    @property
    def size(self) -> float:
        """How broad the shoulders are, against the adult of 1.62 m that the cuts were drawn for."""
        return float(self.joint("LeftArm")[0]) / 0.162

    def nearest(self, points: Floats) -> tuple[Floats, Floats]:
        """Return signed distances [m], shape (N,), and directions of their growth, shape (N, 3)."""
        import igl

        distance, _, closest, _ = igl.signed_distance(
            np.ascontiguousarray(points),
            self.points,
            self.faces,
            sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
        )
        away = (points - closest) * np.where(distance < 0, -1.0, 1.0)[:, None]
        return distance, away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)


def fit(character: Character) -> BodyFit:
    """Return the merged body of a character with its joint positions at the bind pose."""
    body, skeleton = character.merged_body(), character.skeleton
    names = [name.rsplit("/", 1)[-1].rsplit(":", 1)[-1] for name in skeleton.joint_names]
    joints = dict(zip(names, skeleton.bind_transforms[:, :3, 3]))
    return BodyFit(np.asarray(body.mesh.points), np.asarray(body.mesh.faces), joints)


def keep_off(fit: BodyFit, points: Floats, clearance: float) -> Floats:
    """Return points (N, 3) moved out to `clearance` [m] from the body where they are closer or inside."""
    distance, away = fit.nearest(points)
    return points + np.maximum(clearance - distance, 0.0)[:, None] * away


def relax(
    fit: BodyFit, grid: Floats, clearance: float, *, cling: Floats, rounds: int, closed: bool = False
) -> Floats:
    """Smooth a grid of points, shape (rows, columns, 3), while it stays off the body.

    `cling` in [0, 1], shape (rows, 1), is how much each row is drawn to lie at `clearance` [m] from the body. The
    first and the last row slide only along themselves, and so do the side columns unless the rows are `closed`.
    """
    if closed:
        grid = grid[:, :-1]
    for _ in range(rounds):
        tall = np.concatenate([2 * grid[:1] - grid[1:2], grid, 2 * grid[-1:] - grid[-2:-1]])
        left = tall[:, -1:] if closed else 2 * tall[:, :1] - tall[:, 1:2]
        right = tall[:, :1] if closed else 2 * tall[:, -1:] - tall[:, -2:-1]
        wide = np.concatenate([left, tall, right], axis=1)
        grid = grid + 0.5 * ((wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / 4 - grid)
        distance, away = fit.nearest(grid.reshape(-1, 3))
        gap = (clearance - distance).reshape(grid.shape[:2])
        grid = grid + (np.where(gap > 0, 1.0, cling) * gap)[..., None] * away.reshape(grid.shape)
    return np.concatenate([grid, grid[:, :1]], axis=1) if closed else grid


def through(keys: Floats, count: int) -> tuple[Floats, Floats]:
    """Return a smooth grid of `count` rows through key lines (K, C, 3), and each row's depth from the top [m]."""
    from scipy.interpolate import PchipInterpolator

    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(keys, axis=0), axis=-1).mean(axis=1))])
    depth = np.linspace(0, at[-1], count)
    return PchipInterpolator(at, keys)(depth), depth


def outline(fit: BodyFit, height: float, clearance: float, *, half_width: float, count: int = 97) -> Floats:
    """Return a closed convex line round the body at a height [m], from the back by its left side, shape (count, 3).

    Only what lies within `half_width` [m] of the middle is seen, so that hanging arms are left out.
    """
    near = np.abs(fit.points[:, 1] - height) < 0.035
    flat = fit.points[near & (np.abs(fit.points[:, 0]) < half_width)][:, [0, 2]]
    centre = (flat.min(axis=0) + flat.max(axis=0)) / 2
    angle = np.linspace(0, 2 * np.pi, count)
    ray = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    support = ((flat - centre) @ ray.T).max(axis=0) + clearance
    facing = ray @ ray.T
    radius = np.where(facing > 0.05, support[:, None] / np.maximum(facing, 0.05), np.inf).min(axis=0)
    line = centre + radius[:, None] * ray
    return np.stack([line[:, 0], np.full(count, height), line[:, 1]], axis=1)
