# SPDX-License-Identifier: Apache-2.0
"""The trained garment as files and host applications hold it: shapes for weights in [0, 1], and its skin."""

from __future__ import annotations

import numpy as np

from ...scene.assets import PINNED, Deformer, SkinWeights
from ..checkpoint import ModelFile
from .skinning import trained_weights


def deformer(file: ModelFile) -> Deformer:
    """Return the same as `GarmentModel.deformer`: shapes 2 r B_k, then a constant shape that recentres them."""
    scene, parameters = file.scene, file.parameters
    free = scene.classes != PINNED
    trained = parameters["decoder.shapes"].astype(np.float64)
    shapes = np.zeros((trained.shape[2], scene.garment.mesh.vertex_count, 3))
    shapes[:, free] = 2 * file.config.activation_range * trained.transpose(2, 0, 1)
    if file.config.activation_count:
        constant = -shapes.sum(axis=0, keepdims=True) / 2
        if "decoder.offset" in parameters:
            constant[0, free] += parameters["decoder.offset"]
        shapes = np.concatenate([shapes, constant])
    weights = trained_weights(scene, parameters)
    return Deformer(scene, SkinWeights(scene.rig.path, scene.rig.skin.indices, weights), shapes)
