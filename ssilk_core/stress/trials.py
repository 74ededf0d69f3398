# SPDX-License-Identifier: Apache-2.0
"""Short trials of training and simulation on a scene, and what single precision costs its energies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..assets import PINNED, Motion, Scene
from ..config import ModelConfig, TrainConfig
from ..constants import GRAVITY
from ..energy import GarmentEnergy
from ..fabrics import Fabric
from ..model.network import GarmentModel
from ..simulate import SimulationOptions
from ..simulate.simulator import Simulator
from ..skinning import Skinning
from ..training.job import TrainJob
from ..training.parts import build_parts
from .drives import ProceduralMotion
from .meter import Extent, ExtentMeter, extent, matrices_about_root

SMALL = ModelConfig(latent=16, widths=(32, 32), shapes=8)
WIGGLE = (
    1e-3  # of the garment's size: by how much points are moved off linear blend skinning to have energies compared
)
ELASTIC = 1e4  # times its size: how far the softest fabric may hang, which is physics


@dataclass(frozen=True)
class Trial:
    """What came of a short training: how far its rollout goes, steps that were undone, and precision's error."""

    extent: Extent
    undone: int
    steps: int
    error: float


def trained(scene: Scene, fabric: Fabric, drive: ProceduralMotion, steps: int, *, windows: int = 2) -> Trial:
    """Train a small network for some steps, roll it over the same drive, and compare energies' precisions.

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
        scene=scene, motions=[motion], held_out=[motion], model=replace(SMALL, fps=drive.fps), train=config,
        fabric=fabric, output=Path("stress"), device="cpu",
    )  # fmt: skip
    parts = build_parts(job, torch.device("cpu"))
    stepper = parts.stepper(config, 0)
    for step in range(steps):
        stepper.run(step)
    model: GarmentModel = stepper.ema_model
    return Trial(extent(model, fabric, drive), int(stepper.skipped.count), steps, error)


def simulated(scene: Scene, fabric: Fabric, motion: Motion, gravity: float = GRAVITY) -> tuple[Extent, float]:
    """Simulate a motion under a gravity [m/s2]; return its extent and the largest residual of a frame [g].

    Frames that the solver left out of balance by more than its tolerance count as recovered.
    """
    options = SimulationOptions(fps=motion.fps, gravity=(0.0, -gravity, 0.0))
    meter = ExtentMeter(scene, fabric, motion.fps)
    frames = list(Simulator(scene, fabric, options).frames([motion]))
    residual = [frame.residual for frame in frames]
    meter.add(motion, np.stack([frame.points for frame in frames]))
    unsolved = sum(value > options.solver.tolerance for value in residual)
    return meter.extent(len(frames), recovered=unsolved, far=ELASTIC), max(residual)


def gradient_error(scene: Scene, fabric: Fabric, motion: Motion) -> float:
    """Return how far single precision is off in the force of stretch and bending, relative to it, in the norm.

    Forces are those on linear blend skinning in the first frame, its points moved at random by a thousandth of the
    garment.
    """
    matrices, _ = matrices_about_root(motion, scene)
    skin, rest = Skinning(scene.lbs_skin).double(), torch.tensor(scene.garment.mesh.points)
    x = skin(rest, None, skin.weights, matrices[..., :1])
    size = float((rest.amax(0) - rest.amin(0)).norm())
    free = torch.tensor(scene.classes != PINNED)[:, None, None]
    x = x + WIGGLE * size * free * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    exact, single = (_force(scene, fabric, x.to(dtype)).double() for dtype in (torch.float64, torch.float32))
    return float((single - exact).norm() / exact.norm().clamp_min(1e-300))


def _force(scene: Scene, fabric: Fabric, x: Tensor) -> Tensor:
    x = x.detach().requires_grad_(True)
    energy = GarmentEnergy(scene.garment.mesh, fabric, dtype=x.dtype)
    (force,) = torch.autograd.grad((energy.stretch(x) + energy.bending(x)).sum(), x)
    return force
