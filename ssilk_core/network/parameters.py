# SPDX-License-Identifier: Apache-2.0
"""Compute the shapes of a network's parameters, so that a file can be checked without building the network."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ..scene.assets import PINNED, Floats, Ints, Scene
from .descriptors import VECTORS, inner_joints
from .feedback import feedback_points, feedback_size
from .proximity import proximity_size
from .schemes import SCHEMES
from .settings import ModelConfig

Shapes = dict[str, tuple[int, ...]]

# Outputs of D for a proxy at rest, a 6D rotation and a displacement, and their units: displacements in decimetres, so
# that outputs of one size turn and move a proxy about as far.
IDENTITY = np.array([1, 0, 0, 0, 1, 0, 0, 0, 0], dtype=np.float32)
OUTPUT_SCALE = np.array([1, 1, 1, 1, 1, 1, 0.1, 0.1, 0.1], dtype=np.float32)


def parameter_shapes(scene: Scene, config: ModelConfig, joints: Ints) -> Shapes:
    """Return the shape of each parameter of `model.network.GarmentModel` by name."""
    free, proxies = int((scene.classes != PINNED).sum()), scene.rig.proxy_count
    static, dynamic = descriptor_sizes(scene, joints, config)
    scheme, z, widths = SCHEMES[config.scheme], config.latent, config.widths
    inputs = scheme.states * z + static + dynamic + feedback_size(scene, config)
    reduced: Shapes = {"decoder.readout": (config.shapes, config.activation_count), "decoder.offset": (free, 3)}
    return {
        "decoder.skin_offset": (free, scene.rig.skin.indices.shape[1]),
        "decoder.shapes": (free, 3, config.shapes),
        **(reduced if config.activations else {}),
        **{f"integrator.{name}": (z,) for name in scheme.parameters},
        **_layers("initialiser", (static, *widths, z)),
        **(_layers("stepper", (inputs, *widths, z), scheme.bias) if scheme.states else {}),
        **_layers("output", (z, *widths, config.activation_count + config.proxy_outputs * proxies)),
    }


def descriptor_sizes(scene: Scene, joints: Ints, config: ModelConfig) -> tuple[int, int]:
    """Return the number of static features, gravity and proximity included, and that of dynamic features."""
    inner = len(inner_joints(scene.character.skeleton, joints))
    posed = 6 * inner + 3 * len(joints)
    dynamic = 2 * posed + 3 * VECTORS if config.descriptors == "absolute" else 12 * inner + 12 + 3 * len(joints)
    return proximity_size(scene, config) + posed, dynamic


def seeing_more(
    parameters: Mapping[str, Floats], scene: Scene, before: ModelConfig, after: ModelConfig
) -> dict[str, Floats]:
    """Return the parameters of a network that sees colliders and cloth at more points, which count nothing yet.

    Points are those of before and others, so that the features of others come after theirs.
    """
    proximity, points = proximity_size(scene, before), feedback_points(scene, before)
    near = proximity_size(scene, after) - proximity
    more = 3 * (feedback_points(scene, after) - points)
    proxies = feedback_size(scene, before) - 3 * points  # which come last
    states = SCHEMES[before.scheme].states * before.latent
    found = dict(parameters)
    for name, first, added, last in (("initialiser.0.weight", 0, 0, 0), ("stepper.0.weight", states, more, proxies)):
        if name in found:
            parts = np.split(found[name], [first + proximity, found[name].shape[1] - last], axis=1)
            blank = np.zeros((len(parts[0]), near + added), parts[0].dtype)
            found[name] = np.hstack([parts[0], blank[:, :near], parts[1], blank[:, near:], parts[2]])
    return found


def _layers(name: str, sizes: tuple[int, ...], bias: bool = True) -> Shapes:
    """Return the shapes of an MLP's parameters; odd indices are activations, which have none."""
    shapes: Shapes = {}
    for index, (inputs, outputs) in enumerate(pairwise(sizes)):
        shapes[f"{name}.{2 * index}.weight"] = (outputs, inputs)
        if bias or index < len(sizes) - 2:
            shapes[f"{name}.{2 * index}.bias"] = (outputs,)
    return shapes
