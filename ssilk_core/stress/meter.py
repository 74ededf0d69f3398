# SPDX-License-Identifier: Apache-2.0
"""What a rolled garment is measured by: latents, speeds, distance from plain skinning, energies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ..assets import Floats, GarmentPose, Motion, Scene
from ..energy import GarmentEnergy
from ..fabrics import Fabric
from ..kinematics import motion_transforms, skinning_matrices
from ..model.network import GarmentModel
from ..model.skinning import Skinning
from ..rollout import decode, garment_poses, roll_blocks
from .drives import Drive

ENERGY_EVERY = 8  # frames: energies take ten times as long as all else
SHARE = 5  # the first and the last of so many parts are compared for growth
FAR = 2.0  # times the garment's own size from plain skinning: cloth that hangs the other way is no further off
LONG = 4096  # frames; more are streamed, and only so many of them decoded


@dataclass(frozen=True)
class Extent:
    """How far a garment went.

    Attributes:
        frames: that were rolled.
        finite: whether every number was.
        speed: largest of any vertex, relative to the character's root [m/s].
        distance: largest of any vertex from plain skinning [m].
        size: of the garment at rest: the diagonal of its box [m].
        latent: largest entry of any latent.
        growth: elastic and kinetic energy in the last fifth of the frames over that in the first.
        recovered: frames at which the rollout was lost.
    """

    frames: int
    finite: bool
    speed: float
    distance: float
    size: float
    latent: float
    growth: float
    recovered: int

    @property
    def bounded(self) -> bool:
        return self.finite and self.distance <= FAR * self.size


@dataclass(eq=False)
class Latents:
    """Largest latent that a model decodes while it is watched; a hook, so that the rollout is the product's own."""

    largest: float = 0.0

    def watched(self, model: GarmentModel) -> torch.utils.hooks.RemovableHandle:
        """Begin to watch; the handle ends it."""
        return model.output.register_forward_pre_hook(self._see)

    def _see(self, module: torch.nn.Module, inputs: tuple[Tensor, ...]) -> None:
        self.largest = max(self.largest, float(inputs[0].abs().max()))


class Meter:
    """Takes blocks of frames of one garment and keeps what an `Extent` needs."""

    def __init__(self, scene: Scene, fabric: Fabric, fps: float) -> None:
        self.scene, self.fps = scene, fps
        self.energy = GarmentEnergy(scene.garment.mesh, fabric, dtype=torch.float64)
        self.skin = Skinning(scene.plain_skin).double()
        self.rest = torch.tensor(scene.garment.mesh.points)
        self.speed, self.distance, self.finite = 0.0, 0.0, True
        self.energies: list[float] = []

    def add(self, motion: Motion, points: Floats) -> None:
        """Take the frames of a block and the garment's points (F, V, 3) [m] there."""
        self.finite &= bool(np.isfinite(points).all())
        matrices, origin = matrices_about_root(motion, self.scene)
        x = torch.as_tensor((points - origin).transpose(1, 2, 0))
        plain = self.skin(self.rest, None, self.skin.weights, matrices)
        self.distance = max(self.distance, float((x - plain).norm(dim=1).max()))
        velocity = x.diff(dim=2) * self.fps
        if velocity.shape[2]:
            self.speed = max(self.speed, float(velocity.norm(dim=1).max()))
            self.energies += self._energies(x[..., 1::ENERGY_EVERY], velocity[..., ::ENERGY_EVERY])

    def _energies(self, x: Tensor, velocity: Tensor) -> list[float]:
        kinetic = self.energy.mass @ (velocity**2).sum(1) / 2
        return (self.energy.stretch(x) + self.energy.bending(x) + kinetic).tolist()

    @property
    def growth(self) -> float:
        """Energy in the last part of the frames over that in the first; 1 for one frame."""
        part = max(1, len(self.energies) // SHARE)
        first, last = (
            float(np.mean(values)) for values in (self.energies[:part] or [1], self.energies[-part:] or [1])
        )
        return last / first if first else float(last == 0) or float("inf")


def matrices_about_root(motion: Motion, scene: Scene) -> tuple[Tensor, Floats]:
    """Return the character's skinning matrices about its root (J, 3, 4, F), float64, and the root (F, 1, 3) [m]."""
    skeleton = scene.character.skeleton
    world = motion_transforms(motion, skeleton.parents)
    origin = world[:, :1, :3, 3].copy()
    world[..., :3, 3] -= origin
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    return torch.as_tensor(np.ascontiguousarray(matrices.transpose(1, 2, 3, 0))), origin


@dataclass(eq=False)
class Course:
    """A drive as a model plays it, block by block: the motion of a block and the garment's pose on it."""

    model: GarmentModel
    drive: Drive
    recovered: list[range] = field(default_factory=list)

    def __iter__(self) -> Iterator[tuple[Motion, GarmentPose]]:
        return self._streamed() if self.drive.frames > LONG else self._baked()

    def _baked(self) -> Iterator[tuple[Motion, GarmentPose]]:
        """Yield what a bake of the whole motion writes."""
        motion = self.drive.motion()
        for pose in garment_poses(self.model, motion, motion.fps, on_recovery=self.recovered.append):
            yield motion.clip(pose.start, pose.start + pose.frame_count), replace(pose, start=0)

    def _streamed(self) -> Iterator[tuple[Motion, GarmentPose]]:
        """Yield the same in constant memory, for drives at the model's rate that are never cut."""
        for block, step in zip(self.drive.blocks(), roll_blocks(self.model, self.drive.blocks())):
            frames = step.recovered.nonzero().flatten().tolist()
            self.recovered += [range(step.start + frame, step.start + frame + 1) for frame in frames]
            yield block, GarmentPose(0, *self.model.file_pose(step.activation, step.rotations))


def extent(model: GarmentModel, fabric: Fabric, drive: Drive) -> Extent:
    """Roll a model over a drive and measure it; of more than `LONG` frames some blocks are decoded, evenly spread.

    Raises:
        SsilkError: the motion cannot be played.
    """
    course, latents = Course(model, drive), Latents()
    meter = Meter(model.scene, fabric, drive.fps)
    skipped = -(-drive.frames // LONG)
    handle = latents.watched(model)
    try:
        for number, (motion, pose) in enumerate(course):
            if number % skipped == 0:
                meter.add(motion, decode(model, motion, pose))
    finally:
        handle.remove()
    points = model.scene.garment.mesh.points
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    lost = sum(map(len, course.recovered))
    return Extent(drive.frames, meter.finite, meter.speed, meter.distance, size, latents.largest, meter.growth, lost)


def positions(model: GarmentModel, drive: Drive) -> Floats:
    """Return the garment's points over a drive, relative to the root (F, V, 3) [m]; all are held in memory."""
    found = []
    for motion, pose in Course(model, drive):
        found.append(decode(model, motion, pose) - matrices_about_root(motion, model.scene)[1])
    return np.concatenate(found)


def precision_errors(model: GarmentModel, exact: GarmentModel, drive: Drive) -> tuple[float, float]:
    """Return how far any vertex is off [m]: by the networks of `model` alone, and by its skinning as well."""
    networks, whole = 0.0, 0.0
    for (motion, pose), (_, true) in zip(Course(model, drive), Course(exact, drive)):
        expected = decode(exact, motion, true)
        networks = max(networks, float(np.linalg.norm(decode(exact, motion, pose) - expected, axis=2).max()))
        whole = max(whole, float(np.linalg.norm(decode(model, motion, pose) - expected, axis=2).max()))
    return networks, whole
