# SPDX-License-Identifier: Apache-2.0
"""Shapes of a network's parameters, to check files without building networks, and what becomes of trained ones."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ..scene.assets import PINNED, Floats, Ints, Scene
from .descriptors import VECTORS, inner_joints
from .feedback import feedback_points, feedback_size, feedback_vertices
from .proximity import proximity_size, proximity_vertices
from .schemes import SCHEMES
from .settings import ModelConfig

Shapes = dict[str, tuple[int, ...]]

# Outputs of D for a proxy at rest, a 6D rotation and a displacement, and their units: displacements in decimetres, so
# that outputs of one size turn and move a proxy about as far.
IDENTITY = np.array([1, 0, 0, 0, 1, 0, 0, 0, 0], dtype=np.float32)
OUTPUT_SCALE = np.array([1, 1, 1, 1, 1, 1, 0.1, 0.1, 0.1], dtype=np.float32)
INTERPOLATED = 3  # points from which a value elsewhere follows


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


def on_moved_garment(
    parameters: Mapping[str, Floats], before: Scene, after: Scene, config: ModelConfig
) -> dict[str, Floats]:
    """Return the parameters of a network on its garment with other rest points, or with fewer pinned vertices.

    Vertices that were pinned have no shapes yet. A network sees its garment at points that are spread over it at
    rest, others after that: what it saw at each is interpolated from those that it sees now.
    """
    found = dict(parameters)
    was, free = (np.flatnonzero(scene.classes != PINNED) for scene in (before, after))
    kept = np.isin(free, was)
    for name in ("decoder.skin_offset", "decoder.shapes", "decoder.offset"):
        if name in found:
            rows = np.zeros((len(free), *found[name].shape[1:]), found[name].dtype)
            rows[kept] = found[name][np.isin(was, free)]
            found[name] = rows
    points, none = before.garment.sewn_mesh.points, np.zeros((0, 0))
    near, seen = (
        _interpolation(points[chosen(before, config)], points[chosen(after, config)])
        for chosen in (proximity_vertices, feedback_vertices)
    )
    states = SCHEMES[config.scheme].states * config.latent
    last = feedback_size(before, config)
    for name, first, tail, far in (
        ("initialiser.0.weight", 0, 0, none),
        ("stepper.0.weight", states, last, seen),
    ):
        if name in found:
            weight = found[name]
            columns = weight.shape[1] - tail
            cuts = [first, first + 3 * len(near), columns, columns + 3 * len(far)]
            head, close, middle, moving, proxies = np.split(weight, cuts, axis=1)
            parts = [head, _turned(close, near), middle, _turned(moving, far), proxies]
            found[name] = np.hstack(parts).astype(weight.dtype)
    return found


def _interpolation(before: Floats, after: Floats) -> Floats:
    """Return the weights (M, N) by which values at points (M, 3) follow from those at points (N, 3)."""
    weights = np.zeros((len(before), len(after)))
    for row, point in enumerate(before):
        square = ((after - point) ** 2).sum(axis=1)
        nearest = np.argsort(square, kind="stable")[:INTERPOLATED]
        inverse = 1 / np.maximum(square[nearest], np.finfo(float).tiny)
        weights[row, nearest] = inverse / inverse.sum()
    return weights


def _turned(weight: Floats, interpolation: Floats) -> Floats:
    """Return what weights (O, 3 M) of three features for each of M points make of N points, (O, 3 N)."""
    parts = weight.reshape(len(weight), len(interpolation), 3)
    size = 3 * interpolation.shape[1]
    return np.einsum("omc,mn->onc", parts, interpolation).reshape(len(weight), size)


def _layers(name: str, sizes: tuple[int, ...], bias: bool = True) -> Shapes:
    """Return the shapes of an MLP's parameters; odd indices are activations, which have none."""
    shapes: Shapes = {}
    for index, (inputs, outputs) in enumerate(pairwise(sizes)):
        shapes[f"{name}.{2 * index}.weight"] = (outputs, inputs)
        if bias or index < len(sizes) - 2:
            shapes[f"{name}.{2 * index}.bias"] = (outputs,)
    return shapes
