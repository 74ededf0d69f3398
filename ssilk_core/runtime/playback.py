# SPDX-License-Identifier: Apache-2.0
"""A garment over a motion, any frame in any order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, GarmentPose, Motion
from ..checkpoint import ModelFile, load_model
from ..errors import need
from ..parameters import descriptor_sizes
from .decoder import Decoder
from .drive import Drive, drive
from .kinematics import ProxyKinematics
from .networks import evaluated, layers
from .skinning import posed, tiles
from .stepper import Limit, SpringStepper

BLOCK = 64  # frames decoded together, because a product of matrices takes a third of the time of 64 with vectors
POSED = 16  # frames whose vertices are computed together


@dataclass(frozen=True, eq=False)
class Block:
    """Decoded frames, F of them.

    Attributes:
        activations: of the blendshapes, shape (K, F), in [-1, 1].
        rotations: of the proxies in the axes of the bind pose, shape (P, 3, 3, F).
        matrices: skinning matrices of all joints about the root, shape (J + P, 3, 4, F).
    """

    activations: NDArray
    rotations: NDArray
    matrices: NDArray


class Player:
    """A trained garment, ready to play motions.

    Raises:
        SsilkError: the model's integration scheme is none that is played here.
    """

    def __init__(self, file: ModelFile) -> None:
        scene, config = file.scene, file.config
        need(
            config.scheme == "spring_verlet",
            scene.garment.mesh.path,
            f"the model's scheme is '{config.scheme}'",
            "the runtime plays 'spring_verlet'",
            "use 'ssilk bake'",
        )
        self.file, self.skeleton = file, scene.character.skeleton
        static, _ = descriptor_sizes(scene, file.joints)
        self.initialiser = layers(file.parameters, "initialiser")
        self.stepper = SpringStepper(config, file.parameters, static)
        self.decoder = Decoder(scene, file.parameters, config)
        self.kinematics = ProxyKinematics(scene.rig, self.skeleton.joint_count)
        self.tiles = tiles(scene, file.parameters)

    @classmethod
    def load(cls, path: str | Path) -> Player:
        """Read a model file; raise `SsilkError` as `checkpoint.load_model` does."""
        return cls(load_model(path))

    def play(self, motion: Motion) -> Playback:
        """Roll the garment over a motion without cuts.

        Raises:
            SsilkError: the motion is not at the model's rate, or of another skeleton.
        """
        fps, joints = self.file.config.fps, self.skeleton.joint_count
        need(abs(motion.fps - fps) < 1e-6, motion.path, f"{motion.fps:g} frames per second",
             f"the model steps at {fps:g}")  # fmt: skip
        need(motion.rotations.shape[1] == joints, motion.path, f"a motion of {motion.rotations.shape[1]} joints",
             f"the model's character has {joints}")  # fmt: skip
        driven = drive(motion, self.skeleton, self.file.joints)
        course = self.stepper.prepared(self.at_rest(driven), driven.static, driven.rates)
        return Playback(self, driven, self.stepper.rolled(course))

    def at_rest(self, driven: Drive) -> NDArray:
        """Return the quasi-static latents of each frame, shape (F, latent) (Eq. 1)."""
        rest = np.ascontiguousarray(evaluated(self.initialiser, driven.static.T).T)
        Limit(self.file.config.bound, rest.shape)(rest)
        return rest


class Playback:
    """A garment over one motion. Frames come out alike in whatever order they are asked for.

    A frame that is not there raises `IndexError`; negative ones count from the end.

    Attributes:
        states: latents of all frames, shape (F, latent).
    """

    def __init__(self, player: Player, driven: Drive, states: NDArray) -> None:
        self.player, self.driven, self.states = player, driven, states
        # What was decoded last; blocks begin at fixed frames, so that rounding does not depend on who asks.
        self._block = lru_cache(2)(self._decoded)
        self._vertices = lru_cache(2)(self._posed)

    @property
    def frame_count(self) -> int:
        return len(self.states)

    def matrices(self, frame: int) -> tuple[NDArray, Floats]:
        """Return skinning matrices (J + P, 3, 4) of a frame about its root, and where the root is (3,) [m]."""
        frame = range(self.frame_count)[frame]
        return self._block(frame // BLOCK).matrices[..., frame % BLOCK], self.driven.origins[frame]

    def vertices(self, frame: int) -> Floats:
        """Return the garment's vertices at a frame in world space [m], shape (V, 3)."""
        frame = range(self.frame_count)[frame]
        return self._vertices(frame // POSED)[frame % POSED]

    def poses(self) -> Iterator[GarmentPose]:
        """Yield what a shot stores, some frames at a time."""
        for number in range(-(-self.frame_count // BLOCK)):
            block = self._block(number)
            yield GarmentPose(number * BLOCK, *self.player.decoder.stored(block.activations, block.rotations))

    def _decoded(self, number: int) -> Block:
        frames = slice(number * BLOCK, (number + 1) * BLOCK)
        activations, rotations = self.player.decoder.decoded(self.states[frames])
        matrices = self.player.kinematics.matrices(rotations, self.driven.matrices[..., frames])
        return Block(activations, rotations, matrices)

    def _posed(self, number: int) -> Floats:
        """Return vertices (F, V, 3) of a few frames."""
        first = number * POSED
        block, chosen = self._block(first // BLOCK), slice(first % BLOCK, first % BLOCK + POSED)
        origins = self.driven.origins[first : first + POSED]
        return posed(self.player.tiles, block.activations[:, chosen], block.matrices[..., chosen], origins)
