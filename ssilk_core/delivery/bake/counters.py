# SPDX-License-Identifier: Apache-2.0
"""What is counted in posed frames: covered skin that shows, cloth through cloth, in colliders, and around riders.

Each counter is given all frames of a shot, in their order. Skin, colliders and riders are counted in every frame, and
triangles that intersect others in every `EVERY`-th from the first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ...physics.intersections.figures import EVERY, SelfIntersections
from ...physics.skin.figures import ShownSkin
from ...physics.world.colliders import voting_points
from ...physics.world.sunk import SunkCloth, SunkCounter
from ...scene.assets import Floats, Motion, Scene, ShotWorld
from ...scene.kinematics import body_at_rest, centred_matrices, skin_points
from ...scene.riders import Rider
from .entered import EnteredCloth, EnteredCounter
from .posed import PosedFrames

if TYPE_CHECKING:
    import torch

    from ...physics.intersections.cloth import ClothIntersections, IntersectionCounts
    from ...physics.skin.covered_skin import CoveredSkin, ShownCounts


class FrameCounter(Protocol):
    """Counts something in each frame of a shot."""

    def add(self, frames: PosedFrames) -> None:
        """Count in frames that follow those before."""


class SkinCounter:
    """Counts the points of covered skin that show.

    Bodies are where the frames have them; otherwise the motion poses them.

    Args:
        motion: of the character, at the shot's samples.
    """

    def __init__(self, skin: CoveredSkin, scene: Scene, motion: Motion) -> None:
        self._skin, self._scene, self._motion = skin, scene, motion
        self._counts: list[ShownCounts] = []

    def add(self, frames: PosedFrames) -> None:
        """Count in frames that follow those before."""
        import torch

        from ...physics.skin.covered_skin import ShownCounts

        skin, character = self._skin, self._scene.character
        device, bodies = skin.points.device, frames.bodies
        part = self._motion.picked(frames.samples)
        matrices, origin = centred_matrices(part, character.skeleton)

        def tensor(points: Sequence[Floats]) -> torch.Tensor:
            return torch.as_tensor(np.stack(points, axis=-1), dtype=torch.float32, device=device)

        if bodies is None and part.shapes:
            body_skin = character.merged_body().skin
            bodies = list(skin_points(body_at_rest(character, part), body_skin, matrices) + origin)
        body = None if bodies is None else tensor([points[skin.points.vertices] - origin for points in bodies])
        cloth = tensor([points - origin for points in frames.garment])
        states = skin.states(cloth, tensor(list(matrices[:, :, :3])), body)
        self._counts.append(ShownCounts.of(states, list(frames.times)))

    def figures(self, name: str) -> ShownSkin | None:
        """Return what was counted in the frames of a motion of this name; None where there were none."""
        return self._skin.figures([(name, each) for each in self._counts])


class IntersectionCounter:
    """Counts the triangles of a garment that intersect others of it; needs libigl."""

    def __init__(self, scene: Scene) -> None:
        self._cloth = _cloth(scene)
        self._counts: list[IntersectionCounts] = []

    def add(self, frames: PosedFrames) -> None:
        """Count in frames that follow those before."""
        # As many frames come at once that each of these parts begins with one that is counted.
        self._counts.append(self._cloth.counts(frames.garment[::EVERY], frames.times[::EVERY]))

    def figures(self, name: str) -> SelfIntersections:
        """Return what was counted in the frames of a motion of this name."""
        return self._cloth.figures([(name, each) for each in self._counts])


class ColliderCounter:
    """Counts the vertices of a garment inside the colliders around it; needs libigl.

    Args:
        world: the colliders.
        seconds: the time of each of the shot's samples in it [s].
        motion: of the character, at the shot's samples.
    """

    def __init__(self, world: ShotWorld, seconds: Callable[[int], float], scene: Scene, motion: Motion) -> None:
        self._counter, self._seconds = SunkCounter(world), seconds
        self._scene, self._motion = scene, motion
        self._counted = False

    def add(self, frames: PosedFrames) -> None:
        """Count in frames that follow those before."""
        voters = voting_points(self._motion.picked(frames.samples), self._scene)
        for points, votes, sample, time in zip(frames.garment, voters, frames.samples.tolist(), frames.times):
            self._counter.add(points, votes, self._seconds(sample), time)
            self._counted = True

    def figures(self, name: str) -> SunkCloth | None:
        """Return what was counted in the frames of a motion of this name; None where there were none."""
        return self._counter.figures(name) if self._counted else None


class RiderCounter:
    """Measures by how much riders enter the cloth that they ride on; needs libigl."""

    def __init__(self, riders: Sequence[Rider], scene: Scene) -> None:
        self._counter = EnteredCounter(riders, scene.garment.mesh)

    def add(self, frames: PosedFrames) -> None:
        """Measure in frames that follow those before."""
        for garment, riders, time in zip(frames.garment, frames.riders, frames.times):
            self._counter.add(garment, riders, time)

    def figures(self, name: str) -> tuple[EnteredCloth, ...]:
        """Return the riders that enter the cloth in the frames of a motion of this name."""
        return self._counter.figures(name)


@lru_cache(maxsize=1)
def covered_skin(scene: Scene, device: torch.device) -> CoveredSkin | None:
    """Return the skin that a garment covers; None where it covers nothing."""
    from ...physics.skin.covered_skin import CoveredSkin

    found = CoveredSkin(scene, device=device)
    return found if len(found) else None


@lru_cache(maxsize=1)
def _cloth(scene: Scene) -> ClothIntersections:
    from ...physics.intersections.cloth import ClothIntersections

    return ClothIntersections.of(scene)
