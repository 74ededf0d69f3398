# SPDX-License-Identifier: Apache-2.0
"""Short trials of training and simulation on a scene, and the error of single precision in its energies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...network.model.network import GarmentModel
from ...network.settings import ModelConfig
from ...physics.energy import GarmentEnergy
from ...physics.simulate import SimulationOptions, Simulator
from ...physics.skinning import Skinning
from ...scene.assets import PINNED, Floats, Motion, Scene, ShotWorld
from ...scene.fabrics import Fabric
from ...training.job import TrainJob
from ...training.parts import build_parts
from ...training.settings import TrainConfig
from .drives import ProceduralMotion
from .meter import MAX_LBS_DISTANCE, Extent, ExtentMeter, extent, matrices_about_root

TRIAL_MODEL = ModelConfig(latent=16, widths=(32, 32), shapes=8)
PERTURBATION = 1e-3  # [garment sizes] displacement of points at which forces in two precisions are compared


@dataclass(frozen=True)
class Trial:
    """Result of a short training: extent of its rollout, undone steps, and error of single precision."""

    extent: Extent
    undone: int
    steps: int
    error: float


def train_trial(scene: Scene, fabric: Fabric, drive: ProceduralMotion, steps: int, *, windows: int = 2) -> Trial:
    """Train a small network for some steps, roll it out over the same drive, and compare forces in two precisions.

    Raises:
        SsilkError: the scene, the fabric or the motion is refused.
    """
    error = gradient_error(scene, fabric, drive.motion(0, 1))
    motion = drive.motion()
    config = TrainConfig(
        iterations=steps,
        static_fraction=0.5,
        pretraining_batch=2 * windows,
        batch=windows,
        window=4,
        static_batch=windows,
        recombinations=0,
    )
    job = TrainJob(
        scene=scene, motions=[motion], held_out=[motion], model=replace(TRIAL_MODEL, fps=drive.fps), train=config,
        fabric=fabric, output=Path("stress"), device="cpu",
    )  # fmt: skip
    parts = build_parts(job, torch.device("cpu"))
    stepper = parts.stepper(config, 0)
    for step in range(steps):
        stepper.run(step)
    model: GarmentModel = stepper.ema_model
    return Trial(extent(model, fabric, drive), int(stepper.skipped.count), steps, error)


def simulate_trial(
    scene: Scene, fabric: Fabric, motion: Motion, world: ShotWorld | None = None, most: float = MAX_LBS_DISTANCE
) -> tuple[Extent, float, Floats]:
    """Simulate a motion in a world; return its extent, the largest residual of a frame [g], and points [m] (F, V, 3).

    The garment is bounded within `most` times its size. Frames whose final residual exceeds the solver's tolerance
    count as recovered.
    """
    options = SimulationOptions(fps=motion.fps)
    meter = ExtentMeter(scene, fabric, motion.fps)
    frames = list(Simulator(scene, fabric, options).frames([motion], [world]))
    residual, points = [frame.residual for frame in frames], np.stack([frame.points for frame in frames])
    meter.add(motion, points)
    unsolved = sum(value > options.solver.tolerance for value in residual)
    return meter.extent(len(frames), recovered=unsolved, max_distance=most), max(residual), points


def gradient_error(scene: Scene, fabric: Fabric, motion: Motion) -> float:
    """Return the relative error of stretch and bending forces in single precision, by their norm.

    Forces are evaluated at linear blend skinning in the first frame, with points displaced at random by
    `PERTURBATION`.
    """
    matrices, _ = matrices_about_root(motion, scene)
    skin, rest = Skinning(scene.lbs_skin).double(), torch.tensor(scene.garment.mesh.points)
    x = skin(rest, None, skin.weights, matrices[..., :1])
    size = float((rest.amax(0) - rest.amin(0)).norm())
    free = torch.tensor(scene.classes != PINNED)[:, None, None]
    x = x + PERTURBATION * size * free * torch.randn(
        x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype
    )
    exact, single = (_force(scene, fabric, x.to(dtype)).double() for dtype in (torch.float64, torch.float32))
    return float((single - exact).norm() / exact.norm().clamp_min(1e-300))


def _force(scene: Scene, fabric: Fabric, x: Tensor) -> Tensor:
    x = x.detach().requires_grad_(True)
    energy = GarmentEnergy(scene.garment.rest_mesh, fabric, dtype=x.dtype)
    (force,) = torch.autograd.grad((energy.stretch(x) + energy.bending(x)).sum(), x)
    return force
