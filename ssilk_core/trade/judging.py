# SPDX-License-Identifier: Apache-2.0
"""What it costs to tell collisions, with the body as a surface or as points, whole or thinned out.

Playing needs no body at all: this is what training, refining and measuring pay.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from ..collision.body import CollisionBody
from ..collision.contacts import Contacts
from ..evaluation.methods import EvaluationScene, Method, TakeSet

BODIES = (("triangles", True, 1), ("vertices", False, 1), ("every 4th vertex", False, 4))
FRAMES = 64  # that are judged


@dataclass(frozen=True)
class Judged:
    """Collisions as one body has them.

    Attributes:
        body: what the nearest point is looked for on; vertices: of it.
        milliseconds: of a frame, to pose the body and find the garment's distances from it.
        collision: energy [J], of tight vertices with the part of the body that they lie over.
        inside: share of the garment's vertices inside any part of the body.
    """

    body: str
    vertices: int
    milliseconds: float
    collision: float
    inside: float


@torch.no_grad()
def judged(dressed: EvaluationScene, reel: TakeSet, method: Method) -> list[Judged]:
    """Judge the first frames of the first take with each body."""
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
