# SPDX-License-Identifier: GPL-3.0-or-later
"""The shape that shape keys give a mesh now, which is what cloth is fitted to and collides with."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import bpy
import numpy as np

from .meshes import PREFIX, need_relative, rest_points
from .weights import has_weights, read_groups


def mixed_points(thing: bpy.types.Object, *, baked: bool = True) -> np.ndarray:
    """Return the points as shape keys shape them now, in the object's own space, shape (V, 3).

    Args:
        baked: with the keys of a bake, or the artist's own alone.
    """
    return deque(_mixes(thing, baked=baked), maxlen=1)[0]


def worn_points(thing: bpy.types.Object) -> np.ndarray:
    """Return the points in the shape that the artist's keys give them now, in the object's own space, shape (V, 3).

    Raises:
        SetupError: its keys are absolute.
    """
    need_relative(thing)
    return mixed_points(thing, baked=False)


def earlier_shapes(thing: bpy.types.Object) -> list[np.ndarray]:
    """Return `worn_points`, then without the last of the artist's keys that are on, and so on down to none.

    Keys that correct a bake come last.
    """
    return [*_mixes(thing, baked=False)][::-1]


def shape_bytes(thing: bpy.types.Object) -> bytes:
    """Return what differs once the artist's keys are set or edited; not for masks that are painted, slow to read."""
    pinned, keys = thing.active_shape_key, _keys_on(thing, baked=False)
    if thing.show_only_shape_key and pinned is not None:
        keys = [pinned]
    settings = [(key.name, key.value, key.mute, key.vertex_group, key.relative_key.name) for key in keys]
    return b"".join(
        [repr((thing.show_only_shape_key, settings)).encode(), *(_points_of(key).tobytes() for key in keys)]
    )


def key_offsets(thing: bpy.types.Object, keys: Sequence[bpy.types.ShapeKey]) -> list[np.ndarray]:
    """Return by how much each key moves the points where its value is one, in the object's own space, (V, 3) each."""
    masks = _masks(thing, keys)
    return [masks.get(key.vertex_group, 1.0) * (_points_of(key) - _points_of(key.relative_key)) for key in keys]


def _mixes(thing: bpy.types.Object, *, baked: bool) -> Iterator[np.ndarray]:
    """Yield the points without keys, with the first that is on, with two, and so on; or as one is pinned."""
    mixed, keys, pinned = rest_points(thing), thing.data.shape_keys, thing.active_shape_key
    if keys and thing.show_only_shape_key and pinned is not None:
        if not pinned.mute and (baked or not pinned.name.startswith(PREFIX)):
            mixed = mixed + _masks(thing, [pinned]).get(pinned.vertex_group, 1.0) * (_points_of(pinned) - mixed)
        yield mixed
        return
    yield mixed
    on = _keys_on(thing, baked=baked)
    masks = _masks(thing, on)
    for key in on:
        share = key.value * masks.get(key.vertex_group, 1.0)
        mixed = mixed + share * (_points_of(key) - _points_of(key.relative_key))
        yield mixed


def _keys_on(thing: bpy.types.Object, *, baked: bool) -> list[bpy.types.ShapeKey]:
    """Return the keys that shape a mesh now, where none is pinned."""
    keys = thing.data.shape_keys
    on = [key for key in keys.key_blocks if key.value and not key.mute and key != keys.reference_key] if keys else []
    return [key for key in on if baked or not key.name.startswith(PREFIX)]


def _masks(thing: bpy.types.Object, keys: Sequence[bpy.types.ShapeKey]) -> dict[str, np.ndarray]:
    """Return how far keys shape each vertex, shape (V, 1), by vertex group.

    Keys without a group shape all, and so do all of a mesh without weights, as in Blender.
    """
    names = sorted({key.vertex_group for key in keys} & set(thing.vertex_groups.keys()))
    if not names or not has_weights(thing.data):
        return {}
    return dict(zip(names, read_groups(thing, thing.data, names).T[..., None]))


def _points_of(key: bpy.types.ShapeKey) -> np.ndarray:
    points = np.empty(len(key.data) * 3, dtype=np.float32)
    key.data.foreach_get("co", points)
    return points.reshape(-1, 3)
