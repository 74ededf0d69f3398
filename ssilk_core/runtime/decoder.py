# SPDX-License-Identifier: Apache-2.0
"""The decoder D: blendshape activations and proxy rotations from latents, also as files store them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, GarmentPose, Scene
from ..config import ModelConfig
from ..kinematics import matrix_from_quaternion, quaternion_from_matrix
from .kinematics import rotation_from_six_d
from .networks import Parameters, evaluate, layers

IDENTITY = np.array([1, 0, 0, 0, 1, 0], dtype=np.float32)[:, None]


class NumpyDecoder:
    """The decoder D of one garment.

    Args:
        scene: rig and skeleton; parameters: of the whole network; config: sizes of the network.
    """

    def __init__(self, scene: Scene, parameters: Parameters, config: ModelConfig) -> None:
        self.layers, self.activation_count, self.shapes = (
            layers(parameters, "output"),
            config.activation_count,
            config.shapes,
        )
        self.proxies = scene.rig.proxy_count
        self.readout = parameters.get("decoder.readout")
        joints, binds = scene.character.skeleton.joint_count, scene.bind_transforms[:, :3, :3]
        self.parent_rotations, self.bind_rotations = binds[scene.rig.parents].swapaxes(-1, -2), binds[joints:]

    def decode(self, z: NDArray) -> tuple[NDArray, NDArray]:
        """Return activations (K, F) in [-1, 1] and rotations (P, 3, 3, F) of latents (F, latent)."""
        output = evaluate(self.layers, z.T)
        six_d = output[self.activation_count :].reshape(self.proxies, 6, len(z)) + IDENTITY
        activations = np.tanh(output[: self.activation_count])
        if self.readout is not None:
            activations = self.readout @ activations
        return activations, rotation_from_six_d(six_d)

    def file_pose(self, activations: NDArray, rotations: NDArray) -> tuple[Floats, Floats]:
        """Return quaternions (F, P, 4) and weights (F, K + 1) for files, as `GarmentModel.file_pose`."""
        turned = rotations.transpose(3, 0, 1, 2).astype(np.float64)
        weights = (activations.T.astype(np.float64) + 1) / 2
        if self.activation_count:
            weights = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
        return quaternion_from_matrix(self.parent_rotations @ turned @ self.bind_rotations), weights.clip(0, 1)

    def network_pose(self, pose: GarmentPose) -> tuple[NDArray, NDArray]:
        """Invert `file_pose`, as `GarmentModel.network_pose`: activations (K, F) and rotations (P, 3, 3, F)."""
        above, own = self.parent_rotations.swapaxes(-1, -2), self.bind_rotations.swapaxes(-1, -2)
        turned = above @ matrix_from_quaternion(pose.rotations) @ own
        activations = 2 * pose.weights[:, : self.shapes].T - 1
        rotations = turned.transpose(1, 2, 3, 0)
        return activations.astype(np.float32), np.ascontiguousarray(rotations, dtype=np.float32)
