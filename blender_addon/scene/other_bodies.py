# SPDX-License-Identifier: GPL-3.0-or-later
"""Other bodies of a character, to try garments on: of its own shape keys, or of the stage of another character."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import bpy
import numpy as np

from ssilk_core.files import split_body, split_location

from ..arrays.joints import Joints
from ..arrays.try_on import member_points
from ..errors import SetupError
from .beside import remove_mesh
from .garment import armature_of, bodies_of
from .gather import GatheredScene, evaluated, read_body
from .handover import expose_usd
from .linked import local_copy, own_copy
from .meshes import PREFIX

SAME = 1e-5  # [m] that no body differs by


def names_of_keys(garment: bpy.types.Object) -> list[str]:
    """Return the names of the artist's shape keys on a garment's bodies, each once; none where it has no body."""
    try:
        bodies = bodies_of(garment, armature_of(garment))
    except SetupError:  # panels and operators tell
        return []
    keys = [thing.data.shape_keys for thing in bodies if thing.data.shape_keys]
    found = (block.name for each in keys for block in each.key_blocks if block != each.reference_key)
    return [name for name in dict.fromkeys(found) if not name.startswith(PREFIX)]


def points_with_keys(
    garment: bpy.types.Object, scene: GatheredScene, values: Mapping[str, float]
) -> list[np.ndarray]:
    """Return where a garment's bodies have their points at rest with other values of shape keys [m], (V, 3) each.

    What shapes bodies before their bones move them counts, as in `gather`. The artist's keys stay as they are.

    Args:
        scene: the garment with its bodies as they are.

    Raises:
        SetupError: no body has such a key, one shows a single key or has other points in that shape, or none
            changes.
    """
    if not values:
        raise SetupError("No shape key is chosen; add one that makes the body to try on.")
    known = names_of_keys(garment)
    for name in values:
        if name not in known:
            there = ", ".join(f"'{each}'" for each in known) or "none"
            raise SetupError(f"No body of '{garment.name}' has a shape key '{name}' (there is {there}); choose one.")
    armature, found = armature_of(garment), []
    for thing, body in zip(bodies_of(garment, armature), scene.character.bodies):
        own = thing.data.shape_keys
        here = {name: value for name, value in values.items() if own and name in own.key_blocks}
        points = _points_of(thing, armature, scene.joints.character, here) if here else body.mesh.points
        if len(points) != body.mesh.vertex_count:
            raise SetupError(
                f"'{thing.name}' has {body.mesh.vertex_count} vertices, and {len(points)} with these shape keys; "
                "apply the modifiers that change how many it has."
            )
        found.append(points)
    if all(np.abs(points - body.mesh.points).max() < SAME for points, body in zip(found, scene.character.bodies)):
        raise SetupError("The bodies have these values of their shape keys already; choose others.")
    return found


def points_of_stage(scene: GatheredScene, path: str) -> list[np.ndarray]:
    """Return where the character of a stage has the points of a scene's bodies [m], shape (V, 3) each.

    Args:
        path: of the file, which may begin with "//" and end with ":SHAPE=WEIGHT,..." or ":/Root".

    Raises:
        SsilkError: there is no such file, or none that can be read; its character is none of the family.
    """
    file, root = split_location(bpy.path.abspath(path))
    if not path or not Path(split_body(file)[0]).is_file():
        raise SetupError(f"There is no file '{file}'; choose the stage of another character of the family.")
    expose_usd()
    from ssilk_usd.reading.character import read_character

    return member_points(scene.character, read_character(file, root=root))


def _points_of(
    thing: bpy.types.Object, armature: bpy.types.Object, joints: Joints, values: Mapping[str, float]
) -> np.ndarray:
    """Return where a body has its points at rest with other values of shape keys [m], (V, 3); on a copy of it."""
    if thing.show_only_shape_key:
        raise SetupError(f"'{thing.name}' shows one shape key alone; unpin it (Object Data > Shape Keys).")
    copy = local_copy(thing)
    copy.data = own_copy(thing.data)
    try:
        keys = copy.data.shape_keys
        keys.animation_data_clear()  # drivers and keys would set them back
        for name, value in values.items():
            block = keys.key_blocks[name]
            block.slider_min, block.slider_max = min(block.slider_min, value), max(block.slider_max, value)
            block.value, block.mute = value, False
        with evaluated([copy]):
            return read_body(copy, armature, joints, thing.name).mesh.points
    finally:
        remove_mesh(copy.data)
