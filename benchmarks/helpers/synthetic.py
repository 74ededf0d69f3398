# SPDX-License-Identifier: Apache-2.0
"""A scene of any exact size without any file: a cloak around a capsule on a chain of joints, in smooth motion.

Both surfaces are coils: vertex i lies 1/c of a turn after vertex i - 1 and just below vertex i - c, so that any
number of vertices makes a regular triangulation, two triangles for each vertex as in any cloth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

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
    Floats,
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
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.objective import Objective
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.shape_smoothing import ShapeSmoothing
from ssilk_core.training.step import Stepper
from ssilk_core.training.windows import WindowSampler

JOINTS, CHAINS, INFLUENCES = 31, 4, 4
BODY_TOP, BODY_RADIUS = 1.6, 0.13  # [m]
NECK, HEM, NECK_RADIUS, HEM_RADIUS = 1.4, 0.4, 0.16, 0.4  # [m]
CLIPS, CLIP_FRAMES = 8, 300


@dataclass(frozen=True, kw_only=True)
class Size:
    """How large a training step is: vertices, proxies P, blendshapes K, windows, poses in each, and single poses."""

    vertices: int
    body: int
    proxies: int
    shapes: int
    batch: int
    window: int
    static_batch: int

    @property
    def decoded(self) -> int:
        """Frames that are decoded for their energy: the two before a window's first new one are not."""
        return self.batch * (self.window - 2) + self.static_batch


def coil(path: str, count: int, top: float, bottom: float, radius: Callable[[Floats], Floats]) -> tuple[Mesh, Floats]:
    """Return a surface of revolution of exactly `count` vertices, and how many turns from the top each lies."""
    height = np.linspace(top, bottom, count)
    around = max(6, round(float(np.sqrt(2 * np.pi * radius(height).mean() * count / (top - bottom)))))
    angle = 2 * np.pi * np.arange(count) / around
    points = np.stack([radius(height) * np.sin(angle), height, radius(height) * np.cos(angle)], axis=1)
    a, b = np.arange(count - around), np.arange(count - around - 1)
    faces = np.concatenate(
        [np.stack([a, a + around, a + 1], axis=1), np.stack([b + 1, b + around, b + around + 1], axis=1)]
    )
    return Mesh(path, points, faces), np.arange(count) / around


def capsule_radius(height: Floats) -> Floats:
    """Return the radius of the body [m], round at both ends."""
    inside = np.minimum(height, BODY_TOP - height).clip(0, BODY_RADIUS)
    return np.sqrt(BODY_RADIUS**2 - (BODY_RADIUS - inside) ** 2).clip(0.1 * BODY_RADIUS)


def cloak_radius(height: Floats) -> Floats:
    """Return the radius of the cloak at rest [m]."""
    return NECK_RADIUS + (HEM_RADIUS - NECK_RADIUS) * (NECK - height) / (NECK - HEM)


def falloff(points: Floats, centres: Floats, radius: float) -> Floats:
    """Return weights exp(-(d / radius)^2) of points (V, 3) towards centres (C, 3), shape (V, C), never all zero."""
    squared = ((points[:, None] - centres) ** 2).sum(-1) / radius**2
    return np.exp(squared.min(axis=1, keepdims=True) - squared)


def chain() -> Skeleton:
    """Return a chain of joints up the middle of the body."""
    places = np.stack([np.zeros(JOINTS), np.linspace(0, BODY_TOP, JOINTS), np.zeros(JOINTS)], axis=1)
    binds, parents = rigid(np.tile(np.eye(3), (JOINTS, 1, 1)), places), np.arange(-1, JOINTS - 1)
    return Skeleton("/chain", joint_paths(parents), parents, binds, local_transforms(binds, parents))


def joint_paths(parents: Ints) -> tuple[str, ...]:
    """Return paths that spell a hierarchy, a parent's before its children's."""
    paths: list[str] = []
    for joint, parent in enumerate(parents):
        paths.append(f"{paths[parent]}/J{joint}" if parent >= 0 else f"J{joint}")
    return tuple(paths)


def hanging_proxies(count: int) -> tuple[Floats, np.ndarray]:
    """Return places (P, 3) and combined parents (P,) of proxies in chains down the cloak."""
    index = np.arange(count)
    level, angle = index // CHAINS, 2 * np.pi * (index % CHAINS) / CHAINS
    height = NECK - (NECK - HEM) * (level + 0.5) / (level.max() + 1)
    places = np.stack([cloak_radius(height) * np.sin(angle), height, cloak_radius(height) * np.cos(angle)], axis=1)
    return places, np.where(level == 0, JOINTS - 5, JOINTS + index - CHAINS)


def cloak_rig(mesh: Mesh, lbs: Floats, classes: np.ndarray, proxies: int) -> ProxyRig:
    """Return a rig that moves loose vertices by their nearest proxies and the others as plain weights (V, J) do."""
    places, parents = hanging_proxies(proxies)
    loose = (classes == LOOSE)[:, None]
    dense = np.concatenate([lbs * ~loose, falloff(mesh.points, places, 0.2) * loose], axis=1)
    binds = rigid(np.tile(np.eye(3), (proxies, 1, 1)), places)
    skin = SkinWeights.from_dense("/rig", dense, INFLUENCES)
    names = joint_paths(np.concatenate([np.arange(-1, JOINTS - 1), parents]))[JOINTS:]
    return ProxyRig("/rig", names, parents, binds, skin)


def scene(size: Size) -> Scene:
    """Return a garment of `size` on its character."""
    skeleton = chain()
    joints = skeleton.bind_transforms[:, :3, 3]
    surface, _ = coil("/body", size.body, BODY_TOP, 0.0, capsule_radius)
    skin = SkinWeights.from_dense("/body", falloff(surface.points, joints, 0.1), INFLUENCES)
    cloak, turns = coil("/cloak", size.vertices, NECK, HEM, cloak_radius)
    lbs = falloff(cloak.points, joints, 0.1)
    classes = np.where(turns < 1, PINNED, np.where(turns < 2, TIGHT, LOOSE))
    garment = Garment(cloak, SkinWeights.from_dense("/cloak", lbs, INFLUENCES), classes)
    rig = cloak_rig(cloak, lbs, classes, size.proxies)
    return Scene(Character("/character", skeleton, (Body(surface, skin),)), garment, rig)


def motion(skeleton: Skeleton, fps: float, seed: int) -> Motion:
    """Return a smooth random motion: each joint turns and the root moves as sines of random phase and speed."""
    random = np.random.default_rng(seed)
    time = np.arange(CLIP_FRAMES)[:, None, None] / fps

    def waves(count: int, size: float) -> Floats:
        speed, phase = random.uniform(1, 6, (2, count, 3))  # [rad/s], [rad]
        return size * np.sin(time * speed + phase)

    half = waves(JOINTS, 0.03)  # [rad]
    rotations = np.concatenate([np.ones_like(half[..., :1]), half], axis=-1)
    places = np.tile(skeleton.rest_transforms[:, :3, 3], (CLIP_FRAMES, 1, 1))
    places[:, :1] += waves(1, 0.2)  # [m]
    return Motion(f"/motion{seed}", fps, rotations, places)


def stepper(size: Size, device: torch.device) -> Stepper:
    """Return what trains the default network at a size, as a training run puts it together."""
    whole, model = scene(size), ModelConfig(shapes=size.shapes)
    # Both phases decode as many frames, so that one measurement of a part serves both.
    config = TrainConfig(
        batch=size.batch, window=size.window, static_batch=size.static_batch, pretraining_batch=size.decoded
    )
    skeleton, joints = whole.character.skeleton, np.arange(JOINTS)
    motions = [motion(skeleton, model.fps, seed) for seed in range(CLIPS)]
    bank = build_bank(motions, skeleton, joints, model.fps, device)
    network = GarmentModel(whole, model, joints).to(device)
    energy = GarmentEnergy(whole.garment.mesh, Fabric("default"), whole.classes, device=device)
    body = CollisionBody(whole.character.merged_body(), JOINTS, device=device)
    sampler = WindowSampler(bank, config, model.latent, torch.Generator(device).manual_seed(0))
    smoothing = ShapeSmoothing.of(network, config.shape_smoothing)
    return Stepper(network, Objective(network, energy, body, bank), sampler, config, smoothing=smoothing)
