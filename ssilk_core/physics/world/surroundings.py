# SPDX-License-Identifier: Apache-2.0
"""The meshes, the gravity and the air of shots, placed around the characters of N frames.

Cloth meets each mesh on its own, and the energies add up: where a floor meets a wall, the distance to both together
would have a crease. Distances are searched for on a processor, in float64, whatever the device of the cloth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, ShotWorld
from .air import MovingAir
from .colliders import ColliderPoser, PosedCollider, voting_rows


@dataclass(frozen=True, eq=False)
class Touched:
    """P samples of the cloth that are near what surrounds the character, in N frames, ascending.

    Attributes:
        row, frame: of each, shape (P,).
        normal: away from what it meets, unit vectors, shape (3, P).
        distance: [m], shape (P,).
        corners: of the nearest point, vertices of all colliders of the shot, shape (3, P); weights: likewise.
    """

    row: Tensor
    frame: Tensor
    normal: Tensor
    distance: Tensor
    corners: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class PosedWorld:
    """What surrounds the characters of N frames, relative to their roots.

    Attributes:
        colliders: of each frame.
        gravity: [m/s2], shape (3, N).
        air: of each frame, or None for air that moves with the root.
        seconds: since the first frame of each motion, length N.
        roots: positions of the characters' roots in the world [m], shape (N, 3).
    """

    colliders: tuple[tuple[PosedCollider, ...], ...]
    gravity: Tensor
    air: tuple[MovingAir | None, ...]
    seconds: tuple[float, ...]
    roots: Floats

    def select(self, frames: Tensor) -> PosedWorld:
        """Return that of the frames with indices (M,)."""
        chosen = frames.tolist()
        colliders = tuple(self.colliders[index] for index in chosen)
        air, seconds = tuple(self.air[index] for index in chosen), tuple(self.seconds[index] for index in chosen)
        return PosedWorld(colliders, self.gravity[:, frames], air, seconds, self.roots[chosen])

    @classmethod
    def concatenated(cls, parts: Sequence[PosedWorld]) -> PosedWorld:
        """Return that of the frames of several, one after the other."""
        colliders, air, seconds = (
            tuple(value for part in parts for value in getattr(part, name))
            for name in ("colliders", "air", "seconds")
        )
        gravity = torch.cat([part.gravity for part in parts], dim=-1)
        return cls(colliders, gravity, air, seconds, np.concatenate([part.roots for part in parts]))

    @property
    def has_colliders(self) -> bool:
        return any(self.colliders)

    def on_surfaces(self, corners: Tensor, weights: Tensor, frame: Tensor) -> Tensor:
        """Return points of colliders [m], shape (3, P), NaN where their collider is not there.

        Args:
            corners, weights, frame: of each, as `Touched` has them, shapes (3, P), (3, P) and (P,).
        """
        vertices, shares, frames = (each.cpu().numpy().T for each in (corners, weights.double(), frame))
        found = np.full(vertices.shape, np.nan)
        order = np.lexsort((vertices[:, 0], frames))  # those of a frame, and of a collider in it, are neighbours
        ends = np.searchsorted(frames[order], np.arange(len(self.colliders) + 1))
        for number in np.unique(frames):
            own = order[ends[number] : ends[number + 1]]
            for collider in self.colliders[number]:
                edges = np.searchsorted(vertices[own, 0], [collider.first, collider.first + collider.count])
                rows = own[slice(*edges)]
                found[rows] = collider.on_surface(vertices[rows] - collider.first, shares[rows])
        return torch.as_tensor(found.T.copy(), dtype=weights.dtype, device=weights.device)

    def touched(self, samples: Tensor, within: float) -> Touched:
        """Return which samples (S, 3, N) are nearer to a collider than `within` [m], or inside one."""
        queries = samples.detach().double().cpu().numpy()
        rows, frames, distances, normals, corners, weights = ([] for _ in range(6))
        for frame, own in enumerate(self.colliders):
            for collider in own:
                row, found = collider.near(np.ascontiguousarray(queries[:, :, frame]), within)
                rows.append(row)
                frames.append(np.full(len(row), frame))
                distances.append(found.distance)
                normals.append(found.normal)
                corners.append(found.corners + collider.first)
                weights.append(found.weights)

        def joined(parts: Sequence[np.ndarray], empty: np.ndarray) -> np.ndarray:
            return np.concatenate(parts) if parts else empty

        def real(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values.T.copy(), dtype=samples.dtype, device=samples.device)

        def whole(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values.T.copy(), dtype=torch.long, device=samples.device)

        none, vectors = np.zeros(0), np.zeros((0, 3))
        return Touched(
            whole(joined(rows, none)),
            whole(joined(frames, none)),
            real(joined(normals, vectors)),
            real(joined(distances, none)),
            whole(joined(corners, vectors)),
            real(joined(weights, vectors)),
        )


class Surroundings:
    """The worlds of shots, each prepared once.

    Args:
        gravity: where a world says none [m/s2], shape (3,).
    """

    def __init__(self, worlds: Sequence[ShotWorld | None], gravity: Floats) -> None:
        self._worlds = [world or ShotWorld(1.0) for world in worlds]
        self._gravity = gravity
        self._air = [MovingAir(world.air, world.fps) if world.air else None for world in self._worlds]
        self._colliders = ColliderPoser()

    def around(self, places: Sequence[tuple[int, float]], root: Tensor, carried: Tensor) -> PosedWorld:
        """Return what surrounds N characters.

        Args:
            places: shot and seconds since its first frame, of each.
            root: their roots in the world [m], shape (3, N).
            carried: the garment as the body carries it, relative to the roots, shape (V, 3, N).
        """
        roots = root.double().cpu().numpy().T
        voters = voting_rows(len(carried))
        points = carried[torch.as_tensor(voters, device=carried.device)].double().cpu().numpy()
        gravity = np.zeros((len(places), 3))
        colliders = []
        for frame, (shot, seconds) in enumerate(places):
            world = self._worlds[shot]
            at = self._gravity if world.gravity is None else world.between(world.gravity, seconds)
            gravity[frame] = at
            colliders.append(self._colliders.at(world, seconds, roots[frame], points[..., frame]))
        down = torch.as_tensor(gravity.T.copy(), dtype=carried.dtype, device=carried.device)
        air = tuple(self._air[shot] for shot, _ in places)
        return PosedWorld(tuple(colliders), down, air, tuple(seconds for _, seconds in places), roots)
