# SPDX-License-Identifier: Apache-2.0
"""Compute the shapes of a network's parameters, so that a file can be checked without building the network."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ..scene.assets import PINNED, Floats, Ints, Scene
from .descriptors import VECTORS, inner_joints
from .feedback import feedback_size
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


def seeing_colliders(parameters: Mapping[str, Floats], config: ModelConfig, features: int) -> dict[str, Floats]:
    """Return the parameters of a network that sees none with `features` of proximity, which count nothing yet."""
    found = dict(parameters)
    for name, before in (
        ("initialiser.0.weight", 0),
        ("stepper.0.weight", SCHEMES[config.scheme].states * config.latent),
    ):
        if name in found:
            blank = np.zeros((len(found[name]), features), found[name].dtype)
            found[name] = np.concatenate([found[name][:, :before], blank, found[name][:, before:]], axis=1)
    return found


def _layers(name: str, sizes: tuple[int, ...], bias: bool = True) -> Shapes:
    """Return the shapes of an MLP's parameters; odd indices are activations, which have none."""
    shapes: Shapes = {}
    for index, (inputs, outputs) in enumerate(pairwise(sizes)):
        shapes[f"{name}.{2 * index}.weight"] = (outputs, inputs)
        if bias or index < len(sizes) - 2:
            shapes[f"{name}.{2 * index}.bias"] = (outputs,)
    return shapes
