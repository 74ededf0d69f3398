# SPDX-License-Identifier: Apache-2.0
"""The cost of detecting collisions with the body as a surface or as points, all of them or a subset.

Training, refining and measuring pay it; playing needs no body.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from ..collision import CollisionBody, Contacts
from ..evaluation.methods import EvaluationScene, Method, TakeSet

BODIES = (("triangles", True, 1), ("vertices", False, 1), ("every 4th vertex", False, 4))
FRAMES = 64  # that are measured


@dataclass(frozen=True)
class Judged:
    """Collisions with one representation of the body.

    Attributes:
        body: name of the representation.
        vertices: of the body.
        milliseconds: of a frame, to pose the body and compute the garment's distances from it.
        collision: energy [J]; tight vertices collide with the part of the body under them.
        inside: share of the garment's vertices inside any part of the body.
    """

    body: str
    vertices: int
    milliseconds: float
    collision: float
    inside: float


@torch.no_grad()
def judged(dressed: EvaluationScene, reel: TakeSet, method: Method) -> list[Judged]:
    """Measure the first frames of the first take with each representation of the body."""
    frames = range(min(FRAMES, reel.takes[0].frame_count))
    x, character = method.vertices(0, frames), reel.character(0, frames)
    whole, joints = dressed.scene.character.merged_body(), dressed.scene.character.skeleton.joint_count
    found = []
    for name, surface, every in BODIES:
        chosen = np.arange(0, whole.mesh.vertex_count, every)
        body = CollisionBody(whole, joints, vertices=chosen, device=dressed.device)
        contacts = Contacts(dressed.scene, vertices=chosen, device=dressed.device)
        begun = time.perf_counter()
        met, nearest = contacts.distances(x, body.pose(character, surface=surface))
        inside, energy = float((nearest < 0).double().mean()), float(dressed.energy.collision_at(met).mean())
        each = 1000 * (time.perf_counter() - begun) / len(frames)
        found.append(Judged(name, len(chosen), each, energy, inside))
    return found
