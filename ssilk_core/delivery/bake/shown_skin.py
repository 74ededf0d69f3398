# SPDX-License-Identifier: Apache-2.0
"""The covered skin that shows in a shot, counted while it is written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from ...devices import select_device
from ...physics.skin.figures import ShownSkin
from ...scene.assets import Floats, GarmentPose, Scene
from .rollout import BakeRollout

if TYPE_CHECKING:
    import torch

    from ...physics.skin.covered_skin import CoveredSkin, ShownCounts

SKIN_FRAMES = 48  # samples of a shot that are counted at most, spread evenly: a count takes as long as two frames


class ShownSkinMeter:
    """Counts the covered skin that shows in a rollout.

    Attributes:
        stated: the figures so far, as a shot stores them; empty where the garment covers nothing.
    """

    def __init__(self, rollout: BakeRollout) -> None:
        self.rollout = rollout
        self.stated: dict[str, object] = {}
        self._counts: list[ShownCounts] = []
        total = rollout.motion.frame_count
        count = min(total, SKIN_FRAMES)
        self._chosen = {(2 * number + 1) * total // (2 * count) for number in range(count)}

    def poses(self) -> Iterator[GarmentPose]:
        """Yield the poses that a shot stores, and count what shows in the vertices that it plays."""
        if self.rollout.refinement is not None and self.rollout.request.writes_points:
            self.add_points()
            yield from self.rollout.poses()
            return
        for pose in self.rollout.poses():
            for frame in self._among(range(pose.start, pose.start + pose.frame_count)):
                row = slice(frame - pose.start, frame - pose.start + 1)
                self._add(frame, self.rollout.decode(pose.part(row))[0])
            self._state()
            yield pose

    def add_points(self) -> None:
        """Count what shows in the refined points of a rollout."""
        assert self.rollout.refinement is not None
        points = self.rollout.refinement.points
        for frame in self._among(range(len(points))):
            self._add(frame, points[frame])
        self._state()

    def shown(self) -> ShownSkin | None:
        """Return the figures so far; None where the garment covers nothing."""
        name = Path(self.rollout.request.motion).stem
        return self._skin.figures([(name, part) for part in self._counts]) if self._skin and self._counts else None

    def _among(self, frames: range) -> Iterable[int]:
        return (frame for frame in frames if frame in self._chosen) if self._skin else ()

    def _state(self) -> None:
        found = self.shown()
        self.stated.update(found.to_metadata() if found else {})

    @cached_property
    def _skin(self) -> CoveredSkin | None:
        """The covered skin; None where there is none."""
        scene = self.rollout.deformer.scene
        found = _covered_skin(scene, select_device(self.rollout.request.device)) if scene.character.bodies else None
        return found if found is not None and len(found) else None

    def _add(self, sample: int, points: Floats) -> None:
        import torch

        from ...physics.skin.covered_skin import ShownCounts
        from ...scene.kinematics import centred_matrices

        assert self._skin is not None
        motion, device = self.rollout.motion, select_device(self.rollout.request.device)
        matrices, origin = centred_matrices(
            motion.clip(sample, sample + 1), self.rollout.deformer.scene.character.skeleton
        )
        character, x = (
            torch.as_tensor(values, dtype=torch.float32, device=device)[..., None]
            for values in (matrices[0, :, :3].copy(), points - origin)
        )
        time = self.rollout.start + sample / self.rollout.request.samples_per_frame
        self._counts.append(ShownCounts.of(self._skin.states(x, character), [time]))


@lru_cache(maxsize=1)
def _covered_skin(scene: Scene, device: torch.device) -> CoveredSkin:
    from ...physics.skin.covered_skin import CoveredSkin

    return CoveredSkin(scene, device=device)
