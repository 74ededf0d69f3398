# SPDX-License-Identifier: Apache-2.0
"""Evaluation method for garments as USD readers play their shots, at any frame rate, with or without refinement."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ...errors import SsilkError
from ...network.checkpoint import network
from ...network.latent_solver import LatentOptions, LatentRoller
from ...network.rollout import garment_poses
from ...network.runtime import Player
from ...network.runtime.character import character_matrices
from ...network.runtime.skinning import skin_garment
from ...network.sampling import sample_pose
from ...physics.refine import RefineOptions, Refiner
from ...physics.simulate import Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.history import StepHistory
from ...scene.assets import Floats, GarmentPose, Motion
from ...scene.decomposition import Decomposition, decompose
from ...scene.kinematics import deform, first_place, resample, sample_motion
from ..evaluation.methods import EvaluationScene, TakeSet

GIVEN = 2  # frames of the network that the simulator goes on from, as two steps back make a velocity
BLOCK_FRAMES = 64  # frames in each block of vertex computations


class ShotMethod:
    """A `Method` of the evaluation that plays a garment's shots of the takes as a USD reader does.

    Args:
        fps: frame rate of the shot [1/s]. Poses of garment and character are interpolated between frames, as in USD.
        refine: solver iterations per frame; 0 for no refinement. Frames of a solver are played as a bake stores them:
            as joints and blendshapes of the shot's own, or as points where these cannot reach them.
        feedback: as in `RefineOptions`.
        latents: how states are solved for in latents, in shots at the model's rate; None where the network takes the
            steps.
        simulated: let the simulator compute the frames; it goes on from the network's own first two.
        advanced: called after each frame of a solver.

    Attributes:
        solving: time of the solver for a frame but the first that it computes [ms], for each take that was computed.
        shots: takes of a solver as joints and blendshapes.
    """

    def __init__(
        self,
        name: str,
        player: Player,
        dressed: EvaluationScene,
        take_set: TakeSet,
        *,
        fps: float,
        refine: int = 0,
        feedback: bool = False,
        latents: LatentOptions | None = None,
        simulated: bool = False,
        advanced: Callable[[], object] = lambda: None,
    ) -> None:
        self.name, self.player, self.dressed, self.take_set, self.fps = name, player, dressed, take_set, fps
        self.refiner, self.simulator, self.advanced = None, dressed.simulator if simulated else None, advanced
        self.latents = latents
        if refine:
            options = RefineOptions(iterations=refine, feedback=feedback)
            self.refiner = Refiner(dressed.scene, dressed.fabric, options, fps=dressed.fps, device=dressed.device)
        self.solving: list[float] = []
        self.shots: dict[int, Decomposition] = {}
        self._points = lru_cache(1)(self._take)

    def vertices(self, take: int, frames: range) -> Tensor:
        """Return positions in consecutive frames of a take, relative to its first root position [m], (V, 3, N)."""
        points = self._points(take)[frames.start : frames.stop]
        return torch.as_tensor(points.transpose(1, 2, 0).copy(), dtype=torch.float32, device=self.dressed.device)

    def still(self, take: int, frames: range) -> None:
        """Return None, because only moving shots are compared."""

    def _take(self, take: int) -> Floats:
        """Return all frames of a take, shape (N, V, 3)."""
        motion = self.take_set.takes[take].motion
        points = self._in_latents(take, self.latents) if self.latents else self.unrefined(motion)
        if self.refiner:
            points = self._stored(take, self._solved(frame.points for frame in self.refiner.frames(motion, points)))
        elif self.simulator:
            rest = self._solved(self._carried_on(self.simulator, motion, points[:GIVEN]))
            points = self._stored(take, np.concatenate([points[:GIVEN], rest]))
        return points - first_place(motion, self.dressed.scene.character.skeleton)

    def _in_latents(self, take: int, options: LatentOptions) -> Floats:
        """Return all frames (N, V, 3) of a take whose states are solved for: joints and blendshapes as they are."""
        motion = self.take_set.takes[take].motion
        ends: list[float] = []

        def advanced() -> None:
            ends.append(time.perf_counter())
            self.advanced()

        file = self.player.file  # keeps the body near the garment, and that of the demo's models none
        scene = replace(file.scene, character=self.dressed.scene.character)
        model = network(file, scene).to(self.dressed.device)
        roller = LatentRoller(model, self.dressed.fabric, options, advanced=advanced)
        poses = tuple(garment_poses(model, motion, motion.fps, roller=roller))
        self.solving.append(1000 * (ends[-1] - ends[0]) / (len(ends) - 1))
        whole = self.player.deformer()
        self.shots[take] = Decomposition(whole, poses, rms=0.0, largest=0.0, own_shapes=0, local_shapes=0)
        return np.concatenate([deform(whole, motion, pose) for pose in poses])

    def _solved(self, frames: Iterator[Floats]) -> Floats:
        """Return frames (N, V, 3) that a solver computes as they are asked for; note the time of all but the first.

        With feedback the first is put to rest, which takes as long as many others.
        """
        points, ends = [], []
        for frame in frames:
            points.append(frame)
            ends.append(time.perf_counter())
            self.advanced()
        self.solving.append(1000 * (ends[-1] - ends[0]) / (len(points) - 1))
        return np.stack(points)

    def _carried_on(self, simulator: Simulator, motion: Motion, given: Floats) -> Iterator[Floats]:
        """Yield the simulator's vertices (V, 3) [m] in the frames after the first two, which are given (2, V, 3)."""
        states = torch.as_tensor(given, dtype=torch.float64, device=self.dressed.device)

        def poses_at(places: Sequence[tuple[int, int]]) -> PosedCharacters:
            return simulator.poser.poses_at([(motion, frame) for _, frame in places])

        last = poses_at([(0, GIVEN - 1)])
        at = last.root, last.lbs
        past = StepHistory(states[1, ..., None], states[0, ..., None], *at, matrices=last.matrices)
        for each in simulator.carry_on([past], [range(GIVEN, motion.frame_count)], poses_at):
            yield each.state.last[..., 0].cpu().numpy()

    def _stored(self, take: int, points: Floats) -> Floats:
        """Return vertices as a bake's joints and blendshapes have them [m], shape (N, V, 3)."""
        motion, whole = self.take_set.takes[take].motion, self.player.deformer()
        own = replace(whole, shapes=whole.shapes[:0])
        poses = list(self.player.play(motion).poses())
        try:
            self.shots[take] = shot = decompose(own, motion, list(points), poses, device=self.dressed.device)
        except SsilkError:  # a bake writes them as points
            return points
        return np.concatenate([deform(shot.deformer, motion, pose) for pose in shot.poses])

    def unrefined(self, motion: Motion) -> Floats:
        """Return the vertices at the frames of a motion before refinement [m], shape (N, V, 3)."""
        if abs(self.fps - motion.fps) < 1e-6:
            playback = self.player.play(motion)
            return np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])
        shot = resample(motion, self.fps, cover=True)
        steps, last = motion.fps / self.fps, motion.frame_count - 1
        frames = np.minimum(np.arange(shot.frame_count) * steps, last)
        stored = sample_pose(GarmentPose.joined(list(self.player.play(motion).poses())), frames)
        # The last frame of a shot holds the end of the motion, however far that is from the one before.
        at = np.interp(np.arange(motion.frame_count), frames, np.arange(shot.frame_count))
        starts = range(0, motion.frame_count, BLOCK_FRAMES)
        return np.concatenate([self._between(shot, stored, at[start : start + BLOCK_FRAMES]) for start in starts])

    def _between(self, shot: Motion, stored: GarmentPose, at: Floats) -> Floats:
        """Return the vertices at fractional frames (N,) of a shot."""
        activations, transforms = self.player.decoder.network_pose(sample_pose(stored, at))
        moved = Motion(shot.path, shot.fps, *sample_motion(shot, at))
        character, origins = character_matrices(moved, self.player.skeleton)
        return skin_garment(
            self.player.tiles, activations, self.player.kinematics.matrices(transforms, character), origins
        )
