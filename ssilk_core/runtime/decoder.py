# SPDX-License-Identifier: Apache-2.0
"""What the decoder D says of latents: blendshape activations and proxy rotations, also as files store them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, GarmentPose, Scene
from ..config import ModelConfig
from ..kinematics import matrix_from_quaternion, quaternion_from_matrix
from .kinematics import rotation_from_six_d
from .networks import Parameters, evaluated, layers

IDENTITY = np.array([1, 0, 0, 0, 1, 0], dtype=np.float32)[:, None]


class NumpyDecoder:
    """D of one garment.

    Args:
        scene: its rig and skeleton; parameters: of the whole network; config: its sizes.
    """

    def __init__(self, scene: Scene, parameters: Parameters, config: ModelConfig) -> None:
        self.layers, self.given, self.shapes = layers(parameters, "output"), config.given, config.shapes
        self.proxies = scene.rig.proxy_count
        self.readout = parameters.get("decoder.readout")
        joints, binds = scene.character.skeleton.joint_count, scene.bind_transforms[:, :3, :3]
        self.above, self.binds = binds[scene.rig.parents].swapaxes(-1, -2), binds[joints:]

    def decoded(self, z: NDArray) -> tuple[NDArray, NDArray]:
        """Return activations (K, F) in [-1, 1] and rotations (P, 3, 3, F) of latents (F, latent)."""
        output = evaluated(self.layers, z.T)
        six_d = output[self.given :].reshape(self.proxies, 6, len(z)) + IDENTITY
        activations = np.tanh(output[: self.given])
        if self.readout is not None:
            activations = self.readout @ activations
        return activations, rotation_from_six_d(six_d)

    def stored(self, activations: NDArray, rotations: NDArray) -> tuple[Floats, Floats]:
        """Return what a file stores, as `GarmentModel.file_pose`: quaternions (F, P, 4) and weights (F, K + 1)."""
        turned = rotations.transpose(3, 0, 1, 2).astype(np.float64)
        weights = (activations.T.astype(np.float64) + 1) / 2
        if self.given:
            weights = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
        return quaternion_from_matrix(self.above @ turned @ self.binds), weights.clip(0, 1)

    def taken(self, pose: GarmentPose) -> tuple[NDArray, NDArray]:
        """Invert `stored`, as `GarmentModel.network_pose`: activations (K, F) and rotations (P, 3, 3, F)."""
        turned = self.above.swapaxes(-1, -2) @ matrix_from_quaternion(pose.rotations) @ self.binds.swapaxes(-1, -2)
        activations = 2 * pose.weights[:, : self.shapes].T - 1
        rotations = turned.transpose(1, 2, 3, 0)
        return activations.astype(np.float32), np.ascontiguousarray(rotations, dtype=np.float32)
