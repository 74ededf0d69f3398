# SPDX-License-Identifier: Apache-2.0
"""A toy world for tests: a strip of cloth on turned joints, two proxies, and a ball for a body."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from importlib.util import find_spec

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    TIGHT,
    Body,
    Character,
    Garment,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import local_transforms, motion_transforms, quaternion_from_matrix, rigid
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.objective import Objective

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # kernels then run, slowly, on the CPU; read when Triton is imported


@pytest.fixture(scope="session", autouse=True)
def language_is_replaced_once() -> Iterator[None]:
    """Let Triton's interpreter replace the language once for a kernel, not for each call of a function by it."""
    if not find_spec("triton"):
        yield
        return
    from triton.runtime import interpreter

    replaced_for, run, done = interpreter._patch_lang, interpreter.GridExecutor.__call__, set()
    languages = interpreter.tl, interpreter.tl.core

    @cache
    def visible(function: Callable) -> frozenset[int]:
        """Which of the language's modules a function knows; each needs its own replacements."""
        return frozenset(id(value) for value in function.__globals__.values() if any(value is x for x in languages))

    def replaced_once(function: Callable) -> object:
        known = visible(function) in done
        done.add(visible(function))
        return None if known else replaced_for(function)

    def run_anew(self, *args: object, **options: object) -> None:  # a kernel, which takes its own back at its end
        done.clear()
        run(self, *args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpreter, "_patch_lang", replaced_once)
        patch.setattr(interpreter.GridExecutor, "__call__", run_anew)
        yield


ROWS, COLUMNS = 12, 5
JOINTS = np.array([[0.0, 1.0, 0.0], [0.0, 1.3, 0.02], [0.3, 1.5, 0.0]])
PROXIES = np.array([[0.0, 1.15, -0.15], [0.02, 0.95, -0.15]])


def grid(rows: int, columns: int, height: float = 0.55, width: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """A flat strip in the plane z = 0, from y = 0 down, its faces towards -z."""
    y, x = np.meshgrid(-np.linspace(0, height, rows), np.linspace(-width / 2, width / 2, columns), indexing="ij")
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0 : columns - 1])
    a = row * columns + column
    b, c, d = a + 1, a + columns, a + columns + 1
    return points, np.concatenate([np.c_[a, b, c], np.c_[b, d, c]])


def turned(positions: np.ndarray, seed: int) -> np.ndarray:
    return rigid(Rotation.random(len(positions), random_state=seed).as_matrix(), positions)


def dense_rig_weights(height: np.ndarray, proxies: int, classes: np.ndarray, lbs: np.ndarray) -> np.ndarray:
    weights = np.concatenate([lbs, np.zeros((len(lbs), proxies))], axis=1)
    for vertex in np.flatnonzero(classes == LOOSE) if proxies else ():
        distance = np.abs(height[vertex] - PROXIES[:proxies, 1]) + 0.05
        weights[vertex] = 0
        weights[vertex, len(JOINTS) :] = (1 / distance) / (1 / distance).sum()
    return weights


def build_scene(proxies: int = 2, shuffled: bool = False) -> Scene:
    """The toy scene; `shuffled` hangs both proxies from the character, else the second from the first."""
    binds = turned(JOINTS, 1)
    skeleton = Skeleton(
        "/toy", ("Hips", "Hips/Spine", "Hips/Spine/Arm"), [-1, 0, 1], binds, local_transforms(binds, [-1, 0, 1])
    )
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.12)
    body = Mesh("/toy/body", ball.vertices + [0, 1.15, 0], ball.faces)
    lean = ((body.points[:, 1] - 1.03) / 0.24).clip(0, 1)
    skin = SkinWeights("/toy/body", np.tile([0, 1], (body.vertex_count, 1)), np.stack([1 - lean, lean], axis=1))
    points, faces = grid(ROWS, COLUMNS)
    points = points + [0, 1.35, -0.15]
    row = np.repeat(np.arange(ROWS), COLUMNS)
    classes = np.where(row == 0, PINNED, np.where(row <= 2, TIGHT, LOOSE))
    lean = ((points[:, 1] - 0.9) / 0.5).clip(0.1, 0.9)
    lbs = np.stack([1 - lean, lean, np.zeros(len(points))], axis=1)
    garment = Garment(Mesh("/toy/strip", points, faces), SkinWeights.from_dense("/toy/strip", lbs), classes)
    parents = np.array([1, 0 if shuffled else 3])[:proxies]
    rig = ProxyRig(
        "/toy/rig",
        ("Hips/Spine/P0", "Hips/Spine/P0/P1")[:proxies],
        parents,
        turned(PROXIES[:proxies], 2) if proxies else np.zeros((0, 4, 4)),
        SkinWeights.from_dense("/toy/rig", dense_rig_weights(points[:, 1], proxies, classes, lbs)),
    )
    return Scene(Character("/toy", skeleton, (Body(body, skin),)), garment, rig)


def build_motion(
    scene: Scene, frames: int, fps: float = 30.0, speed: float = 1.0, path: str = "/toy/motion"
) -> Motion:
    """A root that sways, bobs and turns, and joints that bend, from smooth curves of time."""
    time = np.arange(frames)[:, None] / fps * speed
    rest = scene.character.skeleton.rest_transforms
    angles = 0.3 * np.sin(time[:, None] * [2.0, 3.0, 4.0] + np.arange(3)[:, None])  # (F, J, 3)
    bend = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(frames, 3, 3, 3)
    rotations = quaternion_from_matrix(rest[:, :3, :3] @ bend)
    translations = np.broadcast_to(rest[:, :3, 3], (frames, 3, 3)).copy()
    translations[:, 0] += 0.2 * np.concatenate([np.sin(3 * time), np.sin(5 * time) / 2, 1 - np.cos(2 * time)], axis=1)
    return Motion(path, fps, rotations, translations)


def build_model(scene: Scene, seed: int = 3, scale: float = 0.3, **options: object) -> GarmentModel:
    """An untrained network whose every parameter is moved at random, so that nothing is zero by initialisation."""
    config = ModelConfig(**({"latent": 8, "widths": (16,), "shapes": 4} | options))
    model = GarmentModel(scene, config, np.arange(3), seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in model.named_parameters():
            small = 0.05 if "shapes" in name or "integrator" in name else scale
            value.add_(small * torch.randn(value.shape, generator=generator))
    return model


def build_objective(scene: Scene, model: GarmentModel, *motions: Motion, surface: bool = True) -> Objective:
    """What a training run puts together, of one fabric with every term switched on."""
    cpu, skeleton = torch.device("cpu"), scene.character.skeleton
    energy = GarmentEnergy(scene.garment.mesh, Fabric("toy", bending=1e-4, margin=0.02), scene.classes)
    body = CollisionBody(scene.character.merged_body(), skeleton.joint_count, device=cpu)
    bank = build_bank(motions, skeleton, model.joints, model.config.fps, cpu, kind=model.config.descriptors)
    return Objective(model, energy, body, bank, surface)


@pytest.fixture(scope="session")
def toy_scene() -> Callable[..., Scene]:
    return build_scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return build_scene()


def with_patch(scene: Scene) -> Scene:
    """A scene whose garment has a patch, an island of its own, that lies a millimetre over its loose part."""
    mesh = scene.garment.mesh
    points, faces = grid(3, 3, height=0.06, width=0.06)
    points = points + mesh.points.mean(axis=0) + [0.01, -0.05, -0.001]
    host = np.linalg.norm(points[:, None] - mesh.points, axis=2).argmin(axis=1)
    rows = np.concatenate([np.arange(mesh.vertex_count), host])
    joined = Mesh(
        mesh.path, np.concatenate([mesh.points, points]), np.concatenate([mesh.faces, faces + mesh.vertex_count])
    )
    plain, rig = (SkinWeights(s.path, s.indices[rows], s.weights[rows]) for s in (scene.lbs_skin, scene.rig.skin))
    return replace(scene, garment=Garment(joined, plain, scene.classes[rows]), rig=replace(scene.rig, skin=rig))


@pytest.fixture(scope="session")
def patched_scene() -> Scene:
    return with_patch(build_scene())


@pytest.fixture(scope="session")
def toy_motion() -> Callable[..., Motion]:
    return build_motion


def build_body(scene: Scene, frames: int, motions: int) -> BodyFrames:
    """The character in so many frames of motions that differ in their speed."""
    skeleton, like = scene.character.skeleton, torch.zeros(())
    every = [build_motion(scene, frames, speed=1 + number) for number in range(motions)]
    parts = [BodyFrames.of(motion_transforms(motion, skeleton.parents), skeleton, like) for motion in every]
    return BodyFrames(torch.cat([part.matrices for part in parts], -1), torch.cat([part.bend for part in parts], -1))


@pytest.fixture(scope="session")
def toy_body() -> Callable[..., BodyFrames]:
    return build_body


@pytest.fixture(scope="session")
def toy_model() -> Callable[..., GarmentModel]:
    return build_model


@pytest.fixture(scope="session")
def toy_grid() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return grid


@pytest.fixture(scope="session")
def toy_objective() -> Callable[..., Objective]:
    return build_objective
