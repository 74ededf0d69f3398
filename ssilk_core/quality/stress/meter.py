# SPDX-License-Identifier: Apache-2.0
"""Measure rollouts: latents, speeds, distances from linear blend skinning, and energies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ...network.model.network import GarmentModel
from ...network.rollout import decode, garment_poses, roll_blocks
from ...physics.energy import GarmentEnergy
from ...physics.skinning import Skinning
from ...scene.assets import Floats, GarmentPose, Motion, Scene
from ...scene.fabrics import Fabric
from ...scene.kinematics import motion_transforms, skinning_matrices
from .drives import ProceduralMotion
from .worlds import garment_size

ENERGY_EVERY = 4  # frames: energies take ten times as long as all else
MAX_LBS_DISTANCE = 2.0  # [garment sizes] bound on the distance from LBS; cloth that hangs upside down stays within
STREAMING_FRAMES = 4096  # longer rollouts are streamed, and about this number of their frames is decoded


@dataclass(frozen=True)
class Extent:
    """Extreme values of a rollout.

    Attributes:
        frames: number of frames.
        finite: whether all values are finite.
        speed: largest speed of a vertex relative to the character's root [m/s].
        distance: largest distance of a vertex from linear blend skinning [m].
        allowed: largest distance that counts as bounded [m].
        latent: largest magnitude of a latent.
        growth: ratio of the mean elastic and kinetic energy in the last loop of the motion to that in the second. The
            first loop has the transient. 1 for fewer than three loops.
        recovered: number of frames at which the state diverged, or a solver missed its tolerance.
    """

    frames: int
    finite: bool
    speed: float
    distance: float
    allowed: float
    latent: float
    growth: float
    recovered: int

    @property
    def bounded(self) -> bool:
        return self.finite and self.distance <= self.allowed


@dataclass(eq=False)
class Latents:
    """Records the largest latent that a model decodes, with a hook, so that the rollout code is unchanged."""

    largest: float = 0.0

    def watch(self, model: GarmentModel) -> torch.utils.hooks.RemovableHandle:
        """Start recording; remove the returned handle to stop."""
        return model.output.register_forward_pre_hook(self._see)

    def _see(self, module: torch.nn.Module, inputs: tuple[Tensor, ...]) -> None:
        self.largest = max(self.largest, float(inputs[0].abs().max()))


class ExtentMeter:
    """Measures an `Extent` from blocks of frames of one garment, and energies in `spans` of frames."""

    def __init__(self, scene: Scene, fabric: Fabric, fps: float, spans: Sequence[range] = ()) -> None:
        self.scene, self.fps, self.spans = scene, fps, [span[::ENERGY_EVERY] for span in spans]
        self.energy = GarmentEnergy(scene.garment.rest_mesh, fabric, dtype=torch.float64)
        self.skin = Skinning(scene.lbs_skin).double()
        self.rest = torch.tensor(scene.garment.mesh.points)
        self.speed, self.distance, self.finite = 0.0, 0.0, True
        self.energies: list[list[float]] = [[] for _ in spans]

    def add(self, motion: Motion, points: Floats) -> None:
        """Add a block of frames, which starts at frame `motion.start`, with the garment's points [m], (F, V, 3)."""
        self.finite &= bool(np.isfinite(points).all())
        matrices, origin = matrices_about_root(motion, self.scene)
        x = torch.as_tensor((points - origin).transpose(1, 2, 0))
        lbs = self.skin(self.rest, None, self.skin.weights, matrices)
        self.distance = max(self.distance, float((x - lbs).norm(dim=1).max()))
        velocity = x.diff(dim=2) * self.fps
        if not velocity.shape[2]:
            return
        self.speed = max(self.speed, float(velocity.norm(dim=1).max()))
        for span, energies in zip(self.spans, self.energies):
            frames = [frame for frame in range(1, x.shape[2]) if motion.start + frame in span]
            if frames:
                energies += self._energies(x[..., frames], velocity[..., [frame - 1 for frame in frames]])

    def _energies(self, x: Tensor, velocity: Tensor) -> list[float]:
        kinetic = self.energy.mass @ (velocity**2).sum(1) / 2
        return (self.energy.stretch(x) + self.energy.bending(x) + self.energy.stitch(x) + kinetic).tolist()

    @property
    def growth(self) -> float:
        """Ratio of the mean energy in the last span to that in the first; 1 without spans."""
        if not self.energies or not all(self.energies):
            return 1.0
        return float(np.mean(self.energies[-1]) / np.mean(self.energies[0]))

    def extent(
        self, frames: int, *, latent: float = 0.0, recovered: int = 0, max_distance: float = MAX_LBS_DISTANCE
    ) -> Extent:
        """Return the extent; a garment is bounded within `max_distance` times its size."""
        allowed = max_distance * garment_size(self.scene)
        return Extent(frames, self.finite, self.speed, self.distance, allowed, latent, self.growth, recovered)


def compared_loops(drive: ProceduralMotion) -> tuple[range, ...]:
    """Return the frames of a drive's second and last loops, or nothing if it has fewer than three."""
    length = round(drive.loop * drive.fps)
    loops = drive.frames // length if length else 0
    return tuple(range(loop * length, (loop + 1) * length) for loop in (1, loops - 1)) if loops >= 3 else ()


def matrices_about_root(motion: Motion, scene: Scene) -> tuple[Tensor, Floats]:
    """Return the character's skinning matrices about its root (J, 3, 4, F), float64, and the root (F, 1, 3) [m]."""
    skeleton = scene.character.skeleton
    world = motion_transforms(motion, skeleton.parents)
    origin = world[:, skeleton.hub : skeleton.hub + 1, :3, 3].copy()
    world[..., :3, 3] -= origin
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    return torch.as_tensor(np.ascontiguousarray(matrices.transpose(1, 2, 3, 0))), origin


@dataclass(eq=False)
class StressRollout:
    """Rollout of a model over a drive, as blocks of the motion with the garment's poses."""

    model: GarmentModel
    drive: ProceduralMotion
    recovered: list[range] = field(default_factory=list)

    def __iter__(self) -> Iterator[tuple[Motion, GarmentPose]]:
        steady = self.drive.fps == self.model.config.fps
        return self._streamed() if steady and self.drive.frames > STREAMING_FRAMES else self._baked()

    def _baked(self) -> Iterator[tuple[Motion, GarmentPose]]:
        """Yield the poses that a bake of the entire motion writes."""
        motion = self.drive.motion()
        for pose in garment_poses(self.model, motion, motion.fps, on_recovery=self.recovered.append):
            yield motion.clip(pose.start, pose.start + pose.frame_count), replace(pose, start=0)

    def _streamed(self) -> Iterator[tuple[Motion, GarmentPose]]:
        """Yield the same poses in constant memory, for drives at the model's rate without cuts."""
        for block, step in zip(self.drive.blocks(), roll_blocks(self.model, self.drive.blocks())):
            frames = step.recovered.nonzero().flatten().tolist()
            self.recovered += [range(step.start + frame, step.start + frame + 1) for frame in frames]
            yield block, GarmentPose(0, *self.model.file_pose(step.activation, step.transforms))


def extent(model: GarmentModel, fabric: Fabric, drive: ProceduralMotion) -> Extent:
    """Roll a model out over a drive and measure it.

    If there are more than `STREAMING_FRAMES` frames, only evenly spaced blocks and the compared loops are decoded.

    Raises:
        SsilkError: the motion cannot be played.
    """
    course, latents = StressRollout(model, drive), Latents()
    spans = compared_loops(drive)
    meter = ExtentMeter(model.scene, fabric, drive.fps, spans)
    skipped = -(-drive.frames // STREAMING_FRAMES)
    handle = latents.watch(model)
    try:
        for number, (motion, pose) in enumerate(course):
            own = range(int(motion.start), int(motion.start) + motion.frame_count)
            if number % skipped == 0 or any(own.start < span.stop and span.start < own.stop for span in spans):
                meter.add(motion, decode(model, motion, pose))
    finally:
        handle.remove()
    lost = sum(map(len, course.recovered))
    return meter.extent(drive.frames, latent=latents.largest, recovered=lost)


def positions(model: GarmentModel, drive: ProceduralMotion) -> Floats:
    """Return the garment's points over a drive relative to the root [m], shape (F, V, 3), all in memory."""
    found = []
    for motion, pose in StressRollout(model, drive):
        found.append(decode(model, motion, pose) - matrices_about_root(motion, model.scene)[1])
    return np.concatenate(found)


def precision_errors(model: GarmentModel, exact: GarmentModel, drive: ProceduralMotion) -> tuple[float, float]:
    """Return the largest error of a vertex [m]: from the networks of `model` only, and including its skinning."""
    networks, whole = 0.0, 0.0
    for (motion, pose), (_, true) in zip(StressRollout(model, drive), StressRollout(exact, drive)):
        expected = decode(exact, motion, true)
        networks = max(networks, float(np.linalg.norm(decode(exact, motion, pose) - expected, axis=2).max()))
        whole = max(whole, float(np.linalg.norm(decode(model, motion, pose) - expected, axis=2).max()))
    return networks, whole
