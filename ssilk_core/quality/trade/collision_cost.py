# SPDX-License-Identifier: Apache-2.0
"""Measure the cost of collision detection against the body as a surface, as vertices, or as some of its vertices.

Training, refinement and measurement have this cost. Playback needs no body.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from ...physics.collision import CollisionBody, Contacts
from ..evaluation.methods import EvaluationScene, Method, TakeSet

BODIES = (("triangles", True, 1), ("vertices", False, 1), ("every 4th vertex", False, 4))
FRAMES = 64  # number of measured frames


@dataclass(frozen=True)
class CollisionCost:
    """Cost and result of collision detection with one representation of the body.

    Attributes:
        body: name of the representation.
        vertices: number of vertices of the body.
        milliseconds: time per frame to pose the body and compute the garment's distances from it [ms].
        collision: collision energy [J]; tight vertices collide with the part of the body under them.
        inside: share of the garment's vertices inside any part of the body.
    """

    body: str
    vertices: int
    milliseconds: float
    collision: float
    inside: float


@torch.no_grad()
def measure_collisions(dressed: EvaluationScene, take_set: TakeSet, method: Method) -> list[CollisionCost]:
    """Measure collision detection in the first frames of the first take with each representation of the body."""
    frames = range(min(FRAMES, take_set.takes[0].frame_count))
    x, character = method.vertices(0, frames), take_set.character(0, frames)
    whole, joints = dressed.scene.character.merged_body(), dressed.scene.character.skeleton.joint_count
    cloth, found = dressed.energy.cloth, []
    for name, surface, every in BODIES:
        chosen = np.arange(0, whole.mesh.vertex_count, every)
        body = CollisionBody(whole, joints, vertices=chosen, device=dressed.device)
        contacts = Contacts(dressed.scene, cloth.samples, vertices=chosen, device=dressed.device)
        begun = time.perf_counter()
        met, nearest = contacts.distances(cloth.positions(x), body.pose(character, surface=surface))
        inside, energy = (
            float((nearest[: len(x)] < 0).double().mean()),
            float(dressed.energy.collision_at(met).mean()),
        )
        each = 1000 * (time.perf_counter() - begun) / len(frames)
        found.append(CollisionCost(name, len(chosen), each, energy, inside))
    return found
