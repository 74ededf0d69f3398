# SPDX-License-Identifier: Apache-2.0
"""Measure the peak memory of one training step and hold it against what training.memory predicts.

Each measurement has a process of its own: a tube of cloth close around a tube of body, so that every vertex meets
the body's surface, trained for a few steps of both phases with the default network.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import torch
from helpers.peak import Peak
from helpers.reports import table, write_results

from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import PROXIMITY_POINTS, ModelConfig
from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    Body,
    Character,
    Garment,
    Ints,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import local_transforms, rigid
from ssilk_core.training.memory import StepMemory, decoded_frames
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.objective import Objective
from ssilk_core.training.obstacles import ObstacleDrawer
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.shape_smoothing import ShapeSmoothing
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

VERTICES, FRAMES, BODY = (500, 1500, 3000), (32, 64, 128), 4000
JOINTS, PROXIES, WINDOW, MOTION = 24, 20, 16, 200
COLLIDERS = 0.25  # share of poses with obstacles
HEADER = [
    "garment vertices",
    "body vertices",
    "frames",
    "surface",
    "with obstacles",
    "measured [MiB]",
    "predicted [MiB]",
    "predicted / measured",
]


def tube(name: str, count: int, radius: float) -> tuple[Mesh, Ints]:
    """Return an open tube of about `count` vertices about the y axis, and the row of each vertex."""
    columns = max(8, round((count * 1.5) ** 0.5))
    rows = count // columns
    row, column = (part.reshape(-1) for part in np.mgrid[0:rows, 0:columns])
    angle = column * 2 * np.pi / columns
    points = np.stack([radius * np.sin(angle), 1.5 - row * (0.9 / rows), radius * np.cos(angle)], axis=1)
    a = (row * columns + column)[row < rows - 1]
    b = (row * columns + (column + 1) % columns)[row < rows - 1]
    faces = np.concatenate([np.stack([a, a + columns, b], axis=1), np.stack([b, a + columns, b + columns], axis=1)])
    return Mesh(name, points, faces), row


def skeleton() -> Skeleton:
    places = np.stack([np.zeros(JOINTS), np.linspace(0.6, 1.5, JOINTS), np.zeros(JOINTS)], axis=1)
    binds = rigid(np.tile(np.eye(3), (JOINTS, 1, 1)), places)
    parents = np.arange(-1, JOINTS - 1)
    return Skeleton("/bones", tuple(map(str, range(JOINTS))), parents, binds, local_transforms(binds, parents))


def scene(vertices: int, body_vertices: int) -> Scene:
    bones, (cloth, row), (skin, ring) = skeleton(), tube("/cloth", vertices, 0.2), tube("/body", body_vertices, 0.18)
    on_bones = np.tile(np.arange(4), (len(ring), 1)) + (ring % (JOINTS - 4))[:, None]
    body = Body(skin, SkinWeights("/body", on_bones, np.ones(on_bones.shape)))
    lbs = SkinWeights("/cloth", np.tile([JOINTS - 1, JOINTS - 2], (len(row), 1)), np.ones((len(row), 2)))
    on_proxies = JOINTS + np.tile(np.arange(4), (len(row), 1)) + (row % (PROXIES - 4))[:, None]
    on_proxies[row == 0] = JOINTS - 1
    places = np.stack([np.zeros(PROXIES), np.linspace(1.4, 0.7, PROXIES), np.full(PROXIES, 0.2)], axis=1)
    rig = ProxyRig(
        "/rig",
        tuple(f"P{index}" for index in range(PROXIES)),
        np.where(np.arange(PROXIES) % 4 == 0, JOINTS - 1, JOINTS + np.arange(-1, PROXIES - 1)),
        rigid(np.tile(np.eye(3), (PROXIES, 1, 1)), places),
        SkinWeights("/rig", on_proxies, np.ones(on_proxies.shape)),
    )
    garment = Garment(cloth, lbs, np.where(row == 0, PINNED, LOOSE))
    return Scene(Character("/character", bones, (body,)), garment, rig)


def stepper(whole: Scene, config: TrainConfig, device: torch.device) -> Stepper:
    bones, model = whole.character.skeleton, model_config(config)
    turns = np.random.default_rng(0).normal(scale=0.02, size=(MOTION, JOINTS, 4)) + [1, 0, 0, 0]
    places = np.broadcast_to(bones.rest_transforms[:, :3, 3], (MOTION, JOINTS, 3))
    joints = np.arange(JOINTS)
    bank = build_bank([Motion("/motion", model.fps, turns, places)], bones, joints, model.fps, device)
    network = GarmentModel(whole, model, joints).to(device)
    energy = GarmentEnergy(whole.garment.mesh, Fabric("default"), whole.classes, device=device)
    body = CollisionBody(whole.character.merged_body(), JOINTS, device=device)
    generator = torch.Generator(device).manual_seed(0)
    drawer = None
    if config.collider_fraction:
        drawer = ObstacleDrawer(network, bank, 0, config.collider_fraction, generator)
    sampler = WindowSampler(bank, config, model.latent, generator, drawer)
    objective = Objective(network, energy, body, bank, config.closest_point == "triangles", drawer=drawer)
    return Stepper(network, objective, sampler, config, smoothing=ShapeSmoothing.of(network, config.shape_smoothing))


def model_config(config: TrainConfig) -> ModelConfig:
    return ModelConfig(proximity_points=PROXIMITY_POINTS if config.collider_fraction else 0)


def measure(
    vertices: int, body_vertices: int, frames: int, surface: str, colliders: float, device: torch.device
) -> dict[str, int]:
    """Return the measured and the predicted peak of a step that decodes `frames` at once [bytes]."""
    whole = scene(vertices, body_vertices)
    config = TrainConfig(
        batch=frames // (2 * WINDOW), static_batch=frames // 2, window=WINDOW, pretraining_batch=frames,
        closest_point=surface, collider_fraction=colliders,
    )  # fmt: skip
    assert decoded_frames(config, config.batch) == frames
    steps = stepper(whole, config, device)
    peak = Peak(device)
    for iteration in (0, config.static_iterations):
        steps.run(iteration)
        steps.run(iteration + 1)  # beside the optimiser's moments, which the first step makes
    body = whole.character.bodies[0].mesh.vertex_count
    memory = StepMemory.of(whole, model_config(config), replace(config, shape_smoothing=0), Fabric("default"), body)
    predicted = replace(memory, contours=False).needed(frames)
    return {"measured": peak.bytes(), "predicted": predicted}


def measured_apart(case: tuple[int, int, int, str, float], options: argparse.Namespace) -> dict[str, int]:
    """Measure in a process of its own: what another measurement left behind would hide a peak."""
    words = [sys.executable, __file__, "--threads", str(options.threads), "--device", options.device, "--only"]
    done = subprocess.run([*words, json.dumps(case)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu", help="'cpu' or 'cuda' (default cpu)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.only:
        vertices, body, frames, surface, colliders = json.loads(options.only)
        print(json.dumps(measure(vertices, body, frames, surface, colliders, torch.device(options.device))))
        return
    cases = [(vertices, BODY, frames, "triangles", 0.0) for vertices in VERTICES for frames in FRAMES]
    cases += [(vertices, BODY // 4, FRAMES[-1], "triangles", 0.0) for vertices in VERTICES]
    cases += [(vertices, BODY, FRAMES[-1], "vertices", share) for vertices in VERTICES for share in (0.0, COLLIDERS)]
    rows, results = [], []
    for case in cases:
        found = measured_apart(case, options)
        measured, predicted = found["measured"], found["predicted"]
        rows.append([*case, measured >> 20, predicted >> 20, f"{predicted / measured:.2f}"])
        results.append({"case": case, **found})
        print(*rows[-1], flush=True)
    options.name = "memory" if options.device == "cpu" else f"memory_{options.device}"
    write_results(options, table(HEADER, rows), {"cases": results})


if __name__ == "__main__":
    main()
