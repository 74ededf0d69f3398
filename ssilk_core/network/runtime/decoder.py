# SPDX-License-Identifier: Apache-2.0
"""The decoder D: blendshape activations and proxy transforms from latents, also as files store them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, GarmentPose, Scene
from ...scene.kinematics import ProxyAxes
from ..parameters import IDENTITY, OUTPUT_SCALE
from ..settings import FREE_ACTIVATION, ModelConfig
from .kinematics import limited, transform_of
from .networks import Parameters, evaluate, layers


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
        self.tanh, self.range = config.tanh, config.activation_range
        self.readout = parameters.get("decoder.readout")
        self.axes, self.moves, size = ProxyAxes.of(scene), config.translations, config.proxy_outputs
        self.reach = np.float32(scene.garment.sewn_mesh.diagonal)
        self.identity, self.scale = IDENTITY[:size, None], OUTPUT_SCALE[:size, None]

    def decode(self, z: NDArray) -> tuple[NDArray, NDArray]:
        """Return activations (K, F) and transforms (P, 3, 4, F) of latents (F, latent)."""
        return self.pose_of(evaluate(self.layers, z.T))

    def pose_of(self, output: NDArray) -> tuple[NDArray, NDArray]:
        """Return activations and transforms of outputs of the decoder's network (outputs, F)."""
        delta = output[self.activation_count :].reshape(self.proxies, len(self.scale), output.shape[1])
        values = self.identity + self.scale * delta
        if self.moves:
            values[:, 6:] = limited(values[:, 6:], self.reach)
        return self.activations(output[: self.activation_count]), transform_of(values)

    def activations(self, output: NDArray) -> NDArray:
        """Return activations of the blendshapes (K, F) of the network's outputs for them (outputs, F)."""
        found = np.tanh(output) if self.tanh else output.clip(-FREE_ACTIVATION, FREE_ACTIVATION)
        return found if self.readout is None else (self.readout @ found).clip(-1, 1)

    def file_pose(self, activations: NDArray, transforms: NDArray) -> tuple[Floats, Floats, Floats | None]:
        """Return quaternions (F, P, 4), weights (F, K + 1) and translations, as `GarmentModel.file_pose`."""
        turned, moved = self.axes.to_local(transforms.transpose(3, 0, 1, 2))
        weights = (activations.T.astype(np.float64) / self.range + 1) / 2
        if self.activation_count:
            weights = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
        return turned, weights.clip(0, 1), moved if self.moves else None

    def network_pose(self, pose: GarmentPose) -> tuple[NDArray, NDArray]:
        """Invert `file_pose`, as `GarmentModel.network_pose`: activations (K, F) and transforms (P, 3, 4, F)."""
        activations = self.range * (2 * pose.weights[:, : self.shapes].T - 1)
        transforms = self.axes.to_bind(pose.rotations, pose.translations).transpose(1, 2, 3, 0)
        return activations.astype(np.float32), np.ascontiguousarray(transforms, dtype=np.float32)
