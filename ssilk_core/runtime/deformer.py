# SPDX-License-Identifier: Apache-2.0
"""The trained garment as files and hosts hold it: blendshapes for weights in [0, 1], and skinning weights."""

from __future__ import annotations

import numpy as np

from ..assets import PINNED, Deformer, SkinWeights
from ..checkpoint import ModelFile
from .skinning import trained_weights


def deformer(file: ModelFile) -> Deformer:
    """Return what `GarmentModel.deformer` does: 2 B_k, then a constant shape that puts their middle back."""
    scene, parameters = file.scene, file.parameters
    free = scene.classes != PINNED
    trained = parameters["decoder.shapes"].astype(np.float64)
    shapes = np.zeros((trained.shape[2], scene.garment.mesh.vertex_count, 3))
    shapes[:, free] = 2 * trained.transpose(2, 0, 1)
    if file.config.given:
        constant = -shapes.sum(axis=0, keepdims=True) / 2
        if "decoder.offset" in parameters:
            constant[0, free] += parameters["decoder.offset"]
        shapes = np.concatenate([shapes, constant])
    weights = trained_weights(scene, parameters)
    return Deformer(scene, SkinWeights(scene.rig.path, scene.rig.skin.indices, weights), shapes)
