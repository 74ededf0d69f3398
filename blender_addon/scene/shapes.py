# SPDX-License-Identifier: GPL-3.0-or-later
"""The shape that shape keys give a mesh now, which is what cloth is fitted to and collides with."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import bpy
import numpy as np

from .meshes import PREFIX, need_relative, rest_points
from .weights import read_groups


def mixed_points(thing: bpy.types.Object, *, baked: bool = True, without: Collection[str] = ()) -> np.ndarray:
    """Return the points as shape keys shape them now, in the object's own space, shape (V, 3).

    Args:
        baked: with the keys of a bake, or the artist's own alone.
        without: names of keys that are left out, unless one is pinned.
    """
    mixed, keys = rest_points(thing), thing.data.shape_keys
    if keys is None:
        return mixed
    if thing.show_only_shape_key and thing.active_shape_key is not None:
        pinned = thing.active_shape_key
        is_left = pinned.mute or (pinned.name.startswith(PREFIX) and not baked)
        return mixed if is_left else _points_of(pinned)
    for key in keys.key_blocks:
        if key.name in without:
            continue
        if key.value and not key.mute and key != keys.reference_key and (baked or not key.name.startswith(PREFIX)):
            share = key.value
            if key.vertex_group in thing.vertex_groups:
                share = share * read_groups(thing, thing.data, [key.vertex_group])
            mixed += share * (_points_of(key) - _points_of(key.relative_key))
    return mixed


def worn_points(thing: bpy.types.Object) -> np.ndarray:
    """Return the points in the shape that the artist's keys give them now, in the object's own space, shape (V, 3).

    Raises:
        SetupError: its keys are absolute.
    """
    need_relative(thing)
    return mixed_points(thing, baked=False)


def earlier_shapes(thing: bpy.types.Object) -> Iterator[np.ndarray]:
    """Yield `worn_points`, then without the last of the artist's keys, and so on: corrections of a bake come last."""
    keys = thing.data.shape_keys
    own = [key.name for key in keys.key_blocks if not key.name.startswith(PREFIX)] if keys else []
    for count in range(len(own) + 1):
        yield mixed_points(thing, baked=False, without=own[len(own) - count :])


def _points_of(key: bpy.types.ShapeKey) -> np.ndarray:
    points = np.empty(len(key.data) * 3, dtype=np.float32)
    key.data.foreach_get("co", points)
    return points.reshape(-1, 3)
