# SPDX-License-Identifier: Apache-2.0
"""The subject of a stress test: a trained garment on its character, a base motion, and the effort to spend."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from ...network.checkpoint import ModelFile, network
from ...network.model.network import GarmentModel
from ...scene.assets import Motion, Scene
from ...scene.fabrics import Fabric
from .drives import ProceduralMotion, loop_clip, sway


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Amount of work in each case.

    Attributes:
        seconds: duration of the motion in most cases [s].
        frames: share of the frames in the names of long cases that is computed.
        steps: optimiser steps of trial trainings.
        simulated: frames of trial simulations.
        vertices: largest number of vertices of a trial garment.
    """

    seconds: float = 20.0
    frames: float = 1.0
    steps: int = 60
    simulated: int = 10
    vertices: int = 200_000


FULL = Effort()
QUICK = Effort(seconds=3.0, frames=0.1, steps=12, simulated=3, vertices=20_000)


@dataclass(frozen=True, eq=False)
class StressSubject:
    """A model file, its scene with the character's bodies, and a clip (None for a procedural motion)."""

    file: ModelFile
    scene: Scene
    clip: Motion | None
    effort: Effort

    @property
    def fabric(self) -> Fabric:
        return self.file.fabric

    @property
    def fps(self) -> float:
        return self.file.config.fps

    @cached_property
    def base(self) -> ProceduralMotion:
        """The motion that the cases modify."""
        skeleton = self.scene.character.skeleton
        endless = loop_clip(self.clip, self.fps) if self.clip else sway(skeleton, self.fps)
        return endless.with_loops(self.effort.seconds)

    @cached_property
    def model(self) -> GarmentModel:
        return self.in_precision(torch.float32)

    def in_precision(self, dtype: torch.dtype) -> GarmentModel:
        """Return the network with all parameters and buffers in `dtype`."""
        return network(self.file, self.scene).to(dtype)
