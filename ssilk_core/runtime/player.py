# SPDX-License-Identifier: Apache-2.0
"""A trained garment, ready to play motions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..assets import Deformer, Motion
from ..checkpoint import ModelFile, load_model
from ..errors import fail
from ..parameters import descriptor_sizes
from .decoder import NumpyDecoder
from .deformer import deformer
from .kinematics import ProxyKinematics
from .networks import evaluate, layers
from .playback import BLOCK, Playback
from .skinning import tiles
from .stepper import SoftClamp, SpringStepper, diverged


class Player:
    """A trained garment, ready to play motions.

    Raises:
        SsilkError: the runtime does not support the model's integration scheme.
    """

    def __init__(self, file: ModelFile) -> None:
        scene, config = file.scene, file.config
        if config.scheme not in ("spring_verlet", "quasi_static"):
            fail(
                scene.garment.mesh.path,
                f"the model's scheme is '{config.scheme}'",
                "the runtime plays 'spring_verlet' and 'quasi_static'",
                "play it in PyTorch with ssilk_core.rollout, or train with one of these",
            )
        self.file, self.skeleton = file, scene.character.skeleton
        static, _ = descriptor_sizes(scene, file.joints)
        self.initialiser = layers(file.parameters, "initialiser")
        steps = config.scheme == "spring_verlet"
        self.stepper = SpringStepper(config, file.parameters, static) if steps else None
        self.decoder = NumpyDecoder(scene, file.parameters, config)
        self.kinematics = ProxyKinematics(scene.rig, self.skeleton.joint_count)
        self.tiles = tiles(scene, file.parameters)

    @classmethod
    def load(cls, path: str | Path) -> Player:
        """Read a model file; raise `SsilkError` as `checkpoint.load_model` does."""
        return cls(load_model(path))

    def play(self, motion: Motion, *, pre_roll: float = 0.0, block: int = BLOCK) -> Playback:
        """Return the garment over a motion of any rate, with or without cuts; frames are computed on request.

        Args:
            motion: of the model's skeleton, at the shot's rate.
            pre_roll: time for which the garment settles before the first frame and after each cut [s].
            block: frames computed together; smaller blocks take more time per frame, but deliver the first one
                sooner.

        Raises:
            SsilkError: the motion belongs to another skeleton.
        """
        joints = self.skeleton.joint_count
        if motion.rotations.shape[1] != joints:
            fail(
                motion.path, f"a motion of {motion.rotations.shape[1]} joints", f"the model's character has {joints}"
            )
        return Playback(self, motion, block, pre_roll)

    def deformer(self) -> Deformer:
        """Return the trained garment's skin and shapes, as files and host applications hold them."""
        return deformer(self.file)

    def quasi_static(self, static: NDArray) -> NDArray:
        """Return the quasi-static latents (F, latent) of static descriptors (F, S) (Eq. 1)."""
        rest = np.ascontiguousarray(evaluate(self.initialiser, static.T).T)
        SoftClamp(self.file.config.latent_bound, rest.shape)(rest)
        rest[diverged(rest)] = 0
        return rest
