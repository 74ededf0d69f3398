# SPDX-License-Identifier: Apache-2.0
"""What a garment over another costs to bake, refine and certify, beside the same garment alone, in processor time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ssilk_core.network.checkpoint import ModelFile, network
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.physics.certify.certifier import Certifier, Frames
from ssilk_core.physics.collision.inner_cloth import InnerSurface
from ssilk_core.physics.refine import RefineOptions, Refiner
from ssilk_core.scene.assets import Deformer, Floats, GarmentPose, Motion, Scene
from ssilk_core.scene.decomposition.rest import turns
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices

WAYS = ("alone", "over another")
ITERATIONS = 4  # of refinement
INSIDE, ASIDE = 0.985, 0.02  # of its radius that the inner garment has, and to which side it leans: it comes through


def inner_of(scene: Scene) -> InnerSurface:
    """Return a garment like that of a scene, a little narrower, which leans to a side from the top down."""
    mesh = scene.garment.mesh
    points = mesh.points * [INSIDE, 1, INSIDE]
    points[:, 0] += ASIDE * (points[:, 1].max() - points[:, 1])
    return InnerSurface(replace(mesh, points=points), 1e-3)


def layered(
    file: ModelFile, inner: ModelFile, scene: Scene, motion: Motion, rounds: int
) -> dict[str, dict[str, float]]:
    """Return the figures of a garment in both ways: medians of rounds in which these take turns, for each frame [s].

    Wrong frames are freed once.

    Args:
        file: its model; inner: that of the garment beneath.
        scene: it on its character, with the body.
        motion: few frames.
    """
    below, count = _played(inner, motion)[1], motion.frame_count
    deformer, points, poses = _played(file, motion)
    alone, surface = frames_of(scene, deformer, motion, poses, points), inner_of(scene)
    work, wrong = dict[str, dict[str, Callable[[], object]]](), dict[str, Callable[[], tuple[int, float]]]()
    for way, is_over in zip(WAYS, (False, True)):
        options, beneath = RefineOptions(iterations=ITERATIONS), [surface] if is_over else []
        refiner = Refiner(scene, file.fabric, options, fps=motion.fps, beneath=beneath)
        certifier = Certifier(scene, surface.mesh.faces if is_over else None)
        frames = replace(alone, beneath=below.__getitem__) if is_over else alone
        work[way] = {
            "play": partial(_played, file, motion),
            "refine": partial(_refined, refiner, motion, points, [[each] for each in below] if is_over else []),
            "look": partial(certifier.faults, frames),
        }
        wrong[way] = partial(_freed, certifier, frames)
    times = [{way: {key: _timed(run) / count for key, run in each.items()} for way, each in work.items()}
             for _ in range(rounds)]  # fmt: skip
    found = {}
    for way in WAYS:
        faulty, seconds = wrong[way]()
        medians = {key: float(np.median([each[way][key] for each in times])) for key in work[way]}
        found[way] = {**medians, "wrong": faulty / count, "free": seconds / max(faulty, 1)}
    return found


def _refined(refiner: Refiner, motion: Motion, points: list[Floats], beneath: list[list[Floats]]) -> None:
    deque(refiner.frames(motion, points, beneath=beneath), maxlen=0)


def _freed(certifier: Certifier, frames: Frames) -> tuple[int, float]:
    """Return how many frames are wrong, and how long it takes to free them [s]."""
    faults = certifier.faults(frames)
    return len(faults), _timed(partial(certifier.certify, frames, faults))


def frames_of(
    scene: Scene, deformer: Deformer, motion: Motion, poses: list[GarmentPose], points: list[Floats]
) -> Frames:
    """Return the frames of a garment and its body as a certificate looks at them."""
    skeleton, body = scene.character.skeleton, scene.character.merged_body()
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    whole = np.concatenate([turns(deformer, motion, pose) for pose in poses])

    def body_at(frame: int) -> Floats:
        return skin_points(body.mesh.points, body.skin, matrices[frame : frame + 1])[0]

    return Frames(motion.frame_count, motion.fps, points.__getitem__, body_at, whole.__getitem__)


def _played(file: ModelFile, motion: Motion) -> tuple[Deformer, list[Floats], list[GarmentPose]]:
    model = network(file)
    poses = list(garment_poses(model, motion, motion.fps))
    return model.deformer(), [points for pose in poses for points in decode(model, motion, pose)], poses


def _timed(work: Callable[[], object]) -> float:
    """Return the processor time of some work [s]."""
    began = time.process_time()
    work()
    return time.process_time() - began
