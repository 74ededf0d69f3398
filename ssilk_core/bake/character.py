# SPDX-License-Identifier: Apache-2.0
"""A trained garment on the character of a stage."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..assets import Scene, Skeleton
from ..checkpoint import ModelFile
from ..errors import fail

if TYPE_CHECKING:
    from pxr import Usd

BIND_TOLERANCE = 1e-3  # [m] between positions, and between the entries of rotation matrices


def on_character(file: ModelFile, stage: Usd.Stage, root: str | None) -> Scene:
    """Return a model's scene with the character of a stage; a model file keeps only the body near the garment.

    Raises:
        SsilkError: the stage's character is not the one that the model was trained with.
    """
    from ssilk_usd.read_character import read_character

    character = read_character(stage, root=root, garment=None)
    skeleton = file.scene.character.skeleton
    need_same_skeleton(character.skeleton, skeleton)
    return replace(file.scene, character=replace(character, skeleton=skeleton))


def need_same_skeleton(found: Skeleton, trained: Skeleton) -> None:
    """Raise `SsilkError` unless a skeleton has the joints of the model, with its bind transforms."""
    allowed, todo = "a model bakes on the character it was trained with", "train on this character"
    missing = sorted(set(trained.joint_names) - set(found.joint_names))
    if missing:
        fail(
            found.path, f"{len(missing)} of the model's joints are missing ({', '.join(missing[:3])})", allowed, todo
        )
    if found.joint_names != trained.joint_names:
        fail(found.path, "its joints are more than the model's, or in another order", allowed, todo)
    difference = found.bind_transforms - trained.bind_transforms
    away = np.linalg.norm(difference[:, :3, 3], axis=1)
    joint = int(away.argmax())
    if not away[joint] < BIND_TOLERANCE:
        fail(
            found.path,
            f"joint '{found.joint_names[joint]}' is bound {away[joint]:.3g} m from where the model has it",
            allowed,
            todo,
        )
    turned = np.abs(difference[:, :3, :3]).max(axis=(1, 2))
    joint = int(turned.argmax())
    if not turned[joint] < BIND_TOLERANCE:
        fail(
            found.path,
            f"joint '{found.joint_names[joint]}' is bound at another rotation than the model has it",
            allowed,
            todo,
        )
