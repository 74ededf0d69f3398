# SPDX-License-Identifier: Apache-2.0
"""By how much a motion's blendshapes move a character's meshes, to be told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .body_shape import OFF, shaped
from .character import Character
from .motion import Motion

FRAMES_AT_ONCE = 64
NAMED = 3  # shapes, those that move points farthest


@dataclass(frozen=True)
class Reshaped:
    """By how much a motion's shapes move points of a mesh in the bind pose [m], at most, and in which of its frames.

    `shapes` are the names of some, those that move points farthest first.
    """

    mesh: str
    metres: float
    frame: int
    shapes: tuple[str, ...]

    def __str__(self) -> str:
        names = ", ".join(f"'{name}'" for name in self.shapes)
        return f"blendshapes move {self.mesh} by up to {1000 * self.metres:.3g} mm ({names})"


def reshaped(character: Character, motion: Motion) -> list[Reshaped]:
    """Return by how much a motion reshapes each of a character's meshes, the most first, and of no other."""
    found = []
    for number, body in enumerate((*character.bodies, *character.stand_ins)):
        own = [index for index, shape in enumerate(motion.shapes) if shape.body == number]
        if not own or motion.shape_weights is None:
            continue
        shapes, weights = [motion.shapes[index] for index in own], motion.shape_weights[:, own]
        most, points = np.zeros(len(weights)), np.zeros((body.mesh.vertex_count, 3))
        for first in range(0, len(weights), FRAMES_AT_ONCE):
            part = slice(first, first + FRAMES_AT_ONCE)
            moved = shaped(points, shapes, weights[part], number)
            most[part] = np.linalg.norm(moved, axis=2).max(axis=1, initial=0)
        far = sorted(shapes, key=lambda shape: -np.linalg.norm(shape.offsets, axis=1).max(initial=0))
        names = tuple(dict.fromkeys(shape.name.removesuffix(OFF) for shape in far))[:NAMED]
        path = body.mesh.path.rpartition("/")[2]
        found.append(Reshaped(path, float(most.max()), int(most.argmax()), names))
    return sorted(found, key=lambda each: -each.metres)
