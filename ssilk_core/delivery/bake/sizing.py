# SPDX-License-Identifier: Apache-2.0
"""How much of a garment is baked: a level of quality, a budget, or what the target takes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import fail
from ...events import Reporter
from ...network.checkpoint import ModelFile
from ...quality.cost import ShotBytes
from ...quality.levels import quality_named, size_at, spend
from ...quality.reduction import Reducer
from ...scene.assets import Deformer, GarmentPose, Motion
from ..targets import GLB
from .direction import held_proxies
from .glb import write_glb_shot
from .load import load_garment, load_rollout, with_model
from .request import BakeRequest
from .rollout import BakeRollout

if TYPE_CHECKING:
    from ssilk_usd.units import StageUnits

    from ...scene.decomposition import Decomposition

STATED = 2560  # bytes of what a shot says of its origin, its skin and its cloth, which an excerpt does not hold
STATED_OF_COLLIDERS = 512  # likewise, where there are any
EXCERPT = 64  # frames that are written to estimate the bytes of a whole shot


def load_sized(
    request: BakeRequest,
    *,
    quality: str | None,
    budget: str | None,
    suffix: str,
    include_body: bool,
    report: Reporter,
) -> BakeRollout:
    """Load a rollout with as much of its garment, and as many frames, as a level, a budget and the target allow.

    What is kept is fitted to the shot's own motion.

    Args:
        suffix, include_body: of the file that a budget in bytes is for.

    Raises:
        SsilkError: an unknown level, a budget that nothing fits, or either for linear blend skinning or points.
    """
    request = _at_quality(request, quality, budget)
    garment = load_garment(request)
    rollout = garment.over(request.motion, range=request.range, handles=request.handles)
    most = request.receiver.influences or rollout.influences
    if not (quality or budget or rollout.influences > most):
        return rollout
    if quality and request.fps is None:
        request = replace(request, fps=quality_named(quality).rate(rollout.source.fps))
    reducer = Reducer(garment.file, [rollout.source], held=_held(rollout))
    size = reducer.allowed(size_at(quality, reducer.whole))
    size = replace(size, influences=min(size.influences, most))
    if budget:
        at_fps = load_rollout(replace(request, latent_iterations=0))  # solved states take as many bytes
        stated = STATED + (STATED_OF_COLLIDERS if at_fps.around.colliders else 0)

        def size_bytes(file: ModelFile) -> float:
            found = shot_bytes(with_model(at_fps, file), suffix, include_body=include_body)
            return found.of(at_fps.motion.frame_count) + stated

        size = spend(budget, reducer, size, rollout.source, size_bytes, report).size
    return load_rollout(replace(request, keep=None if size == reducer.whole else size))


def _at_quality(request: BakeRequest, quality: str | None, budget: str | None) -> BakeRequest:
    """Return a request refined as its level says, where it does not say so itself; check that they go together."""
    if request.lbs and (quality or budget):
        fail(
            "--lbs",
            "linear blend skinning has no level of quality",
            "--quality and --budget are about the network",
            "leave one of them out",
        )
    if quality:
        level = quality_named(quality)
        request = replace(
            request,
            refine=request.refine or level.refine,
            feedback=request.feedback or level.feedback,
            latent_iterations=request.latent_iterations or level.latent_iterations,
        )
    if budget and request.refine:
        fail(
            "--budget",
            "a budget for refined frames",
            "they are stored as points, or as blendshapes of the shot's own, whatever is kept of the model",
            "leave one of them out",
        )
    return request


def _held(rollout: BakeRollout) -> set[str]:
    """Return the proxies that hold parts of a garment, which stay."""
    if rollout.direction is None or rollout.model is None:
        return set()
    return held_proxies(rollout.direction.said, rollout.deformer, rollout.model.scene.rig.joint_names)


def shot_bytes(rollout: BakeRollout, suffix: str, *, include_body: bool) -> ShotBytes:
    """Estimate the bytes of a shot from two excerpts, one of more frames than the other."""
    excerpt = _Excerpt(
        rollout.deformer, rollout.motion, rollout.units, rollout.request.samples_per_frame, suffix, include_body
    )
    return excerpt.extrapolated(rollout.network_poses)


def stored_bytes(rollout: BakeRollout, motion: Motion, shot: Decomposition) -> ShotBytes:
    """Estimate the bytes of a .usdc shot of other poses and blendshapes, in a rollout's units, without the body."""
    return _Excerpt(shot.deformer, motion, rollout.units, 1, ".usdc", False).extrapolated(lambda: iter(shot.poses))


@dataclass(frozen=True, eq=False)
class _Excerpt:
    """The first frames of a shot, as they are written."""

    deformer: Deformer
    motion: Motion
    units: StageUnits
    samples_per_frame: int
    suffix: str
    include_body: bool

    def extrapolated(self, poses: Callable[[], Iterator[GarmentPose]]) -> ShotBytes:
        """Return the size of the whole."""
        many = min(EXCERPT * self.samples_per_frame, self.motion.frame_count)
        few = max(many // 4, 1)
        first, second = (self._bytes(_first(poses(), count), count) for count in (few, many))
        frame = (second - first) / max(many - few, 1)
        return ShotBytes(second - frame * many, frame)

    def _bytes(self, poses: Iterator[GarmentPose], frames: int) -> int:
        from ssilk_usd.shots.shot import write_shot

        motion = self.motion.clip(0, frames)
        common: dict[str, Any] = {"samples_per_frame": self.samples_per_frame, "include_body": self.include_body}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"shot{self.suffix if self.suffix in ('.usda', GLB) else '.usdc'}"
            if self.suffix == GLB:
                write_glb_shot(path, self.deformer, motion, poses, start=0.0, **common)
            else:
                write_shot(path, self.deformer, motion, poses, units=self.units, **common)
            return path.stat().st_size


def _first(poses: Iterator[GarmentPose], frames: int) -> Iterator[GarmentPose]:
    """Yield the first frames of consecutive poses."""
    for pose in poses:
        count = min(pose.frame_count, frames - pose.start)
        yield pose.part(slice(count))
        if pose.start + count == frames:
            return
