# SPDX-License-Identifier: Apache-2.0
"""Measure the costs and errors of variants of a model."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..assets import Motion
from ..checkpoint import ModelFile, network
from ..cost import POINT_BYTES, ShotBytes, Time, memory, model_bytes, operations, play_time
from ..evaluation.methods import EvaluationScene, Method, TakeSet
from ..evaluation.record import recorded
from ..evaluation.tally import Tally
from ..kinematics import resample
from ..reduction import ModelSize, Reducer
from ..rollout import decode, garment_poses
from ..runtime import Player
from .point import SECONDS, TradePoint
from .shot_method import ShotMethod
from .variants import Variant

HALF_PRECISIONS = ("float16", "bfloat16")  # two bytes on disk for each parameter


Weigh = Callable[[ModelFile, float], ShotBytes]
"""Returns the size of a model's shots at a frame rate."""


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

    def point(self, variant: Variant) -> TradePoint:
        """Measure one variant."""
        cut = self._cut(variant.size)
        player = Player(variant.in_precision(cut))
        method = ShotMethod(variant.name, player, self.dressed, self.take_set, fps=variant.fps, refine=variant.refine)
        tally, timed = self._tally(method, self.whole), self._time(variant, method)
        shot = self._shot(variant, cut)
        total = float(tally.totals().mean())
        return TradePoint(
            model=self.name,
            swept=variant.swept,
            variant=variant.name,
            **vars(variant.size),
            precision=variant.precision,
            fps=variant.fps,
            refine=variant.refine,
            milliseconds=timed.median,
            high=timed.high,
            torch=None if variant.refine else self._torch(variant.size),
            operations=sum(operations(cut).values()),
            memory=memory(player),
            model_bytes=_bytes(cut, variant.precision),
            shot_bytes=shot.of(round(SECONDS * variant.fps)),
            total=total,
            excess=total - float(self.base),
            collisions=tally.mean("collisions"),
            shown_skin=tally.shown_skin(self.dressed.covered),
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

    def _time(self, variant: Variant, method: ShotMethod) -> Time:
        if variant.refine:
            return Time.of(method.milliseconds)
        return play_time(method.player, resample(self.motion, variant.fps))

    def _torch_time(self, size: ModelSize) -> float:
        """Return the time of a frame in PyTorch [ms], measured in the second of two passes over a clip."""
        model = network(self._cut(size)).to(self.dressed.device)
        for _ in range(2):
            begun = time.perf_counter()
            for pose in garment_poses(model, self.motion, self.motion.fps):
                decode(model, self.motion, pose)
        return 1000 * (time.perf_counter() - begun) / self.motion.frame_count

    def _shot(self, variant: Variant, cut: ModelFile) -> ShotBytes:
        shot = self.weigh(cut, variant.fps)
        if not variant.refine:
            return shot
        return replace(shot, frame=shot.frame + POINT_BYTES * self.dressed.scene.garment.mesh.vertex_count)


def _bytes(file: ModelFile, precision: str) -> int:
    """Return the size of a model's file in this precision [bytes]."""
    if precision in HALF_PRECISIONS:
        parameters = {name: value.astype(np.float16) for name, value in file.parameters.items()}
        file = replace(file, parameters=parameters)
    return model_bytes(file, pack=precision == "int16")
