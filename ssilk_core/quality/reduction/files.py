# SPDX-License-Identifier: Apache-2.0
"""Model files with parts of a trained one replaced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...errors import fail
from ...network.checkpoint import ModelFile
from ...scene.assets import PINNED, Floats, ProxyRig, Scene, SkinWeights
from .shapes import Basis


def with_basis(file: ModelFile, basis: Basis) -> ModelFile:
    """Return a model with other blendshapes, activated by linear combinations of what its network gives."""
    config = replace(file.config, shapes=basis.shapes.shape[2], activations=file.config.activation_count)
    changed = {"shapes": basis.shapes, "offset": basis.offset, "readout": basis.readout}
    single = {f"decoder.{name}": value.astype(np.float32) for name, value in changed.items()}
    return replace(file, config=config, parameters={**file.parameters, **single})


def with_weights(file: ModelFile, weights: Floats, gone: list[int]) -> ModelFile:
    """Return a model with other skinning weights and without some of its proxies.

    Args:
        weights: of all joints, shape (V, J + P), zero for those that go.
        gone: combined indices of the proxies that go, none of which carries one that stays.

    Raises:
        SsilkError: one would go that the model's stepper sees.
    """
    if gone and file.config.feedback_proxies:
        fail(
            file.scene.garment.mesh.path,
            "a model whose stepper sees its proxies",
            "none of them can go",
            "keep all joints, or train with --set feedback_proxies=false",
        )
    scene, character = file.scene, file.scene.character.skeleton.joint_count
    stays = np.setdiff1d(np.arange(len(scene.parents)), gone)
    skin = SkinWeights.from_dense(scene.rig.path, weights[:, stays])
    free = int((scene.classes != PINNED).sum())
    rig = _rig(scene, stays[character:] - character, skin)
    parameters = {
        **file.parameters,
        **_last_layer(file, stays[character:] - character),
        "decoder.skin_offset": np.zeros((free, skin.indices.shape[1]), dtype=np.float32),
    }
    bodies = file.bodies and file.bodies.with_proxies(stays[character:] - character)
    return replace(file, scene=Scene(scene.character, scene.garment, rig), parameters=parameters, bodies=bodies)


def _rig(scene: Scene, proxies: np.ndarray, skin: SkinWeights) -> ProxyRig:
    rig, character = scene.rig, scene.character.skeleton.joint_count
    place = np.concatenate([np.arange(character), np.full(rig.proxy_count, -1)])
    place[character + proxies] = character + np.arange(len(proxies))
    names = tuple(rig.joint_names[proxy] for proxy in proxies)
    return ProxyRig(rig.path, names, place[rig.parents[proxies]], rig.bind_transforms[proxies], skin)


def _last_layer(file: ModelFile, proxies: np.ndarray) -> dict[str, np.ndarray]:
    """Return the decoder's last layer with the rows of activations and of these proxies."""
    given, size = file.config.activation_count, file.config.proxy_outputs
    own = given + size * proxies[:, None] + np.arange(size)
    rows = np.concatenate([np.arange(given), own.reshape(-1)]).astype(int)
    last = 2 * len(file.config.widths)
    return {name: file.parameters[name][rows] for name in (f"output.{last}.weight", f"output.{last}.bias")}
