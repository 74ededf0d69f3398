# SPDX-License-Identifier: Apache-2.0
"""By how much rigid things that ride on a garment enter its cloth: they stay as they are, and cloth bends.

Vertices of a rider and the middles of its faces are looked at, in each frame. What lies beneath the cloth at rest,
such as a pin, counts as far as it goes deeper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...physics.world.surface import CollisionSurface
from ...scene.assets import Floats, Ints, Mesh
from ...scene.riders import Rider

LEAST = 1e-3  # [m] that is told: less is hidden by the thickness of cloth
AROUND = 0.05  # [m] beyond a rider, up to which cloth is looked at


@dataclass(frozen=True, kw_only=True)
class EnteredCloth:
    """A rider that enters its cloth.

    Attributes:
        rider: its name.
        depth: of the surface of it that is deepest in the cloth, in the worst frame [m].
        clip, frame: the worst frame, of several equal ones the first, as `ShownSkin` tells it.
    """

    rider: str
    depth: float
    clip: str
    frame: float

    def summary(self, clock: str = "frame") -> dict[str, str]:
        """Return figures for people; `clock` is what `frame` counts."""
        when = f"{self.clip} at {clock} {self.frame:g}"
        return {f"{self.rider} enters the cloth by": f"{1000 * self.depth:.1f} mm, {when}"}

    def to_metadata(self) -> dict[str, object]:
        """Return figures of four digits, as a shot stores them by the rider's name."""
        return {"depth": float(f"{self.depth:.4g}"), "frame": self.frame}


class EnteredCounter:
    """Measures the rigid ones of some riders frame by frame.

    Args:
        riders: with all that are soft, in the order of their meshes in the shot. What named vertices carry far from
            it enters no cloth.
        cloth: the garment at rest.
    """

    def __init__(self, riders: Sequence[Rider], cloth: Mesh) -> None:
        self._rigid: list[tuple[str, slice, _Patch]] = []
        self._worst: dict[str, tuple[float, float]] = {}
        first = 0
        for rider in riders:
            meshes = slice(first, first + len(rider.meshes))
            first = meshes.stop
            if rider.attachment and len(faces := _faces_around(rider, cloth)):
                self._rigid.append((rider.name, meshes, _Patch(rider, cloth, faces)))

    def add(self, garment: Floats, riders: Sequence[Floats], frame: float) -> None:
        """Measure in a frame.

        Args:
            garment: its points [m], shape (V, 3).
            riders: points of each mesh that rides on it [m], shape (M, 3).
            frame: as it is told.
        """
        for name, meshes, patch in self._rigid:
            depth = patch.depth(garment, riders[meshes])
            if depth > self._worst.get(name, (0.0, frame))[0]:
                self._worst[name] = depth, frame

    def figures(self, clip: str) -> tuple[EnteredCloth, ...]:
        """Return those that enter the cloth by more than `LEAST` in the frames of a clip."""
        return tuple(
            EnteredCloth(rider=name, depth=depth, clip=clip, frame=frame)
            for name, (depth, frame) in self._worst.items()
            if depth > LEAST
        )


def _faces_around(rider: Rider, cloth: Mesh) -> Ints:
    """Return the faces of the cloth around a rider (T, 3); none where what carries it is far from it."""
    points = np.concatenate([mesh.points for mesh in rider.meshes])
    centre = points.mean(axis=0)
    reach = np.linalg.norm(points - centre, axis=1).max() + AROUND
    corners = cloth.points[cloth.faces]
    middle = corners.mean(axis=1)
    size = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    return cloth.faces[np.linalg.norm(middle - centre, axis=1) < reach + size]


class _Patch:
    """The cloth around a rider, with the side on which the rider lies as its outside.

    Args:
        around: faces of the cloth (T, 3), one at least.
    """

    def __init__(self, rider: Rider, cloth: Mesh, around: Ints) -> None:
        self._faces = [mesh.faces for mesh in rider.meshes]
        samples = self._samples([mesh.points for mesh in rider.meshes])
        self._rows, faces = np.unique(around, return_inverse=True)
        self._surface = CollisionSurface(cloth.path, cloth.points[self._rows], faces.reshape(-1, 3))
        at_rest = self._surface.at(cloth.points[self._rows])
        self._sides = at_rest.outside(samples)
        self._below = -at_rest.distance(samples, self._sides).distance.clip(max=0)

    def depth(self, garment: Floats, riders: Sequence[Floats]) -> float:
        """Return how much deeper than at rest the rider is in the cloth [m]; 0 where no point of it is."""
        found = self._surface.at(garment[self._rows]).distance(self._samples(riders), self._sides)
        return float((-found.distance - self._below).max(initial=0.0))

    def _samples(self, meshes: Sequence[Floats]) -> Floats:
        parts = ((points, points[faces].mean(axis=1)) for points, faces in zip(meshes, self._faces))
        return np.concatenate([each for part in parts for each in part])
