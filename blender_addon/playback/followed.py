# SPDX-License-Identifier: GPL-3.0-or-later
"""Bodies whose shape keys change over the timeline: a bake follows them, and its solver meets them.

The values of their keys are sampled as Blender evaluates them. What modifiers make of a body's shape is not followed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ..arrays.joints import Joints, identifiers
from ..errors import SetupError
from ..motions.evaluating import evaluating
from ..motions.sampling import SLICE
from ..motions.shapes import changing_shapes
from ..scene.garment import armature_of, bodies_of
from ..scene.gather import SKELETON
from ..scene.meshes import PREFIX
from ..scene.modifiers import reshapes
from ..scene.objects import found_again
from ..scene.shapes import key_offsets
from .bodies import at_rest_without_keys, trained_meshes

SAME = 1e-6  # [m] that a shape may move a point and still count as none


def followed_bodies(garment: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the bodies of a garment that a bake follows in their shape keys."""
    armature = armature_of(garment)
    return [body for body in bodies_of(garment, armature) if changing_shapes(body) and not reshapes(body)]


@dataclass(eq=False)
class SampledKeys:
    """The shape keys of bodies over frames, while they are sampled.

    Attributes:
        bodies: session uid and name of each.
        values: by frame, the value of each body's own keys.
    """

    bodies: Sequence[tuple[int, str]]
    frames: range
    values: list[list[list[float]]] = field(default_factory=list)

    @classmethod
    def of(cls, garment: bpy.types.Object, frames: range) -> SampledKeys:
        """Return what is to be sampled of a garment's bodies; nothing where none is followed."""
        return cls([(body.session_uid, body.name) for body in followed_bodies(garment)], frames)

    def sample(self) -> Iterator[float]:
        """Fill the values, yielding the part that is done after each slice of time.

        Raises:
            SetupError: a body was deleted meanwhile.
        """
        while self.bodies and len(self.values) < len(self.frames):
            self._slice([found_again(*body) for body in self.bodies])
            yield len(self.values) / len(self.frames)

    def _slice(self, bodies: Sequence[bpy.types.Object]) -> None:
        until = time.monotonic() + SLICE
        with evaluating(*bodies) as at:
            while len(self.values) < len(self.frames):
                depsgraph = at(self.frames[len(self.values)])
                keys = [body.data.shape_keys.evaluated_get(depsgraph) for body in bodies]
                self.values.append([[0.0 if key.mute else key.value for key in _own(each)] for each in keys])
                if time.monotonic() > until:
                    return

    def write(self, path: Path, stage: Path, motion: Path, garment: bpy.types.Object, joints: Joints) -> bool:
        """Write a stage over the character's with the shapes of the bodies, and let the motion weigh them.

        Args:
            joints: the character's, by the paths that the garment knows.

        Returns:
            Whether there is anything to follow. In a Blender that has read USD.
        """
        meshes, back = trained_meshes(garment, joints, stage)
        if back is None:
            return False
        things = [garment, *bodies_of(garment, armature_of(garment))]
        prims = dict(
            zip((thing.name for thing in things), identifiers((thing.name for thing in things), taken=(SKELETON,)))
        )
        found = {}
        for at, body in enumerate(found_again(*body) for body in self.bodies):
            mesh = meshes.get(prims[body.name])
            if mesh is None or mesh.vertex_count != len(body.data.vertices):
                continue
            values = np.array([frame[at] for frame in self.values])
            keys = _own(body.data.shape_keys)
            if values.shape[1] != len(keys):
                raise SetupError(f"'{body.name}' has other shape keys than before; begin again.")
            rest, linear = at_rest_without_keys(body, back)
            moves = key_offsets(body, keys)
            shapes = {
                name: (moved @ linear.T, course)
                for name, moved, course in zip(identifiers(key.name for key in keys), moves, values.T)
            }
            if np.abs(rest - mesh.points).max(initial=0) > SAME:
                shapes = {"Basis": (rest - mesh.points, np.ones(len(values))), **shapes}
            found["/" + mesh.path.rpartition(":/")[2]] = shapes
        if found:
            from ssilk_usd.writing.body_shapes import write_body_shapes

            write_body_shapes(path, stage, motion, found)
        return bool(found)


def _own(keys: bpy.types.Key) -> list[bpy.types.ShapeKey]:
    """Return the artist's keys but the first, from which the others start."""
    return [key for key in keys.key_blocks if not key.name.startswith(PREFIX) and key.name != keys.reference_key.name]
