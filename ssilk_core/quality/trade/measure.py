# SPDX-License-Identifier: Apache-2.0
"""Measure the costs and errors of variants of a model."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ...network.checkpoint import ModelFile, network
from ...network.rollout import decode, garment_poses
from ...network.runtime import Player
from ...scene.assets import Motion
from ...scene.decomposition import Decomposition
from ...scene.kinematics import resample
from ..cost import (
    POINT_BYTES,
    ShotBytes,
    memory,
    model_bytes,
    operations,
    play_time,
    stored_memory,
    stored_operations,
    stored_time,
)
from ..evaluation.methods import EvaluationScene, Method, TakeSet
from ..evaluation.record import recorded
from ..evaluation.tally import Tally
from ..reduction import ModelSize, Reducer
from .point import SECONDS, TradePoint
from .shot_method import ShotMethod
from .variants import Variant

HALF_PRECISIONS = ("float16", "bfloat16")  # two bytes on disk for each parameter


Weigh = Callable[[ModelFile, float, "StoredTake | None"], ShotBytes]
"""Returns the size of a model's shots at a frame rate, or of a take that is stored otherwise."""


@dataclass(frozen=True, eq=False)
class StoredTake:
    """A take of a solver as a bake stores it: joints, and blendshapes of its own."""

    motion: Motion
    shot: Decomposition


class VariantMeter:
    """Measures variants of one model on takes.

    Args:
        name: name of the model.
        reducer: reduces the model.
        dressed, take_set: the scene and the takes for the measurements.
        weigh: returns the size of the model's shots.
    """

    def __init__(
        self,
        name: str,
        reducer: Reducer,
        dressed: EvaluationScene,
        take_set: TakeSet,
        weigh: Weigh,
    ) -> None:
        self.name, self.reducer, self.dressed, self.take_set, self.weigh = name, reducer, dressed, take_set, weigh
        self.whole = ShotMethod(name, reducer.player, dressed, take_set, fps=dressed.fps)
        self.base = self._tally(self.whole).totals().mean()
        self._cut = lru_cache(1)(lambda size: reducer.reduce(size).file)
        self._torch = lru_cache(1)(self._torch_time)

    @property
    def frames(self) -> int:
        """Number of frames that each variant is measured on."""
        return sum(take.frame_count for take in self.take_set.takes)

    def point(self, variant: Variant, advanced: Callable[[], object] = lambda: None) -> TradePoint:
        """Measure one variant; `advanced` is called after each frame of a solver."""
        cut = self._cut(variant.size)
        player = Player(variant.in_precision(cut))
        method = ShotMethod(
            variant.name,
            player,
            self.dressed,
            self.take_set,
            fps=variant.fps,
            refine=variant.refine,
            feedback=variant.feedback,
            latents=variant.latents,
            simulated=variant.simulated,
            advanced=advanced,
        )
        tally = self._tally(method, self.whole)
        total = float(tally.totals().mean())
        return TradePoint(
            garment=self.dressed.name,
            model=self.name,
            swept=variant.swept,
            variant=variant.name,
            **vars(variant.size),
            precision=variant.precision,
            fps=variant.fps,
            refine=variant.refine,
            solving=float(np.median(method.solving)) if variant.solved else None,
            torch=None if variant.solved else self._torch(variant.size),
            model_bytes=_bytes(cut, variant.precision),
            **vars(self._played(variant, method, cut)),
            total=total,
            excess=total - float(self.base),
            collisions=tally.mean("collisions"),
            shown_skin=tally.shown_skin(self.dressed.covered),
            intersections=tally.intersections(self.dressed.intersections),
            position=tally.root("position error"),
            velocity=tally.root("velocity error"),
        )

    @property
    def motion(self) -> Motion:
        """The motion for time measurements."""
        return self.take_set.takes[0].motion

    def _tally(self, method: Method, truth: Method | None = None) -> Tally:
        takes = range(len(self.take_set.takes))
        records = {take: recorded(self.dressed, self.take_set, method, take, truth) for take in takes}
        return Tally(records, {take: self.take_set.takes[take].clip for take in takes})

    def _played(self, variant: Variant, method: ShotMethod, cut: ModelFile) -> _Played:
        """Measure what playing and storing the shot of a variant costs.

        A shot of a solver has as many blendshapes as its first take needs.
        """
        frames = round(SECONDS * variant.fps)
        shot = method.shots.get(0)
        if shot is not None:
            timed = stored_time(shot.deformer, self.motion, shot.poses)
            used, size = stored_operations(shot.deformer), self.weigh(cut, variant.fps, StoredTake(self.motion, shot))
            return _Played(
                timed.median, timed.high, sum(used.values()), stored_memory(shot.deformer), size.of(frames)
            )
        timed, size = play_time(method.player, resample(self.motion, variant.fps)), self.weigh(cut, variant.fps, None)
        if variant.solved:  # points, beside joints of the body
            size = replace(size, frame=size.frame + POINT_BYTES * self.dressed.scene.garment.mesh.vertex_count)
        return _Played(
            timed.median, timed.high, sum(operations(cut).values()), memory(method.player), size.of(frames)
        )

    def _torch_time(self, size: ModelSize) -> float:
        """Return the time of a frame in PyTorch [ms], measured in the second of two passes over a clip."""
        model = network(self._cut(size)).to(self.dressed.device)
        for _ in range(2):
            begun = time.perf_counter()
            for pose in garment_poses(model, self.motion, self.motion.fps):
                decode(model, self.motion, pose)
        return 1000 * (time.perf_counter() - begun) / self.motion.frame_count


@dataclass(frozen=True)
class _Played:
    """Costs of a shot, as `TradePoint` has them."""

    milliseconds: float
    high: float
    operations: int
    memory: int
    shot_bytes: float


def _bytes(file: ModelFile, precision: str) -> int:
    """Return the size of a model's file in this precision [bytes]."""
    if precision in HALF_PRECISIONS:
        parameters = {name: value.astype(np.float16) for name, value in file.parameters.items()}
        file = replace(file, parameters=parameters)
    return model_bytes(file, pack=precision == "int16")
