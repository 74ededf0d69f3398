# SPDX-License-Identifier: Apache-2.0
"""Rollouts refined by the simulator's solver, as points or as the joints and blendshapes nearest to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import tee
from typing import TYPE_CHECKING

import numpy as np

from ..assets import Floats
from ..devices import select_device
from ..errors import VerificationError
from ..events import Progress, Reporter, silent
from .result import RefinementSummary, Verification
from .rollout import BakeRollout, Refinement

if TYPE_CHECKING:
    from ..refine import PoseFit, Refiner

# Rounding points to float32 may raise the energy of a frame: by this near the origin [J], ...
ROUNDING_ENERGY = 1e-6
# ... and far from it as if each vertex were held by a spring stiffer than any fabric [N/m].
ROUNDING_STIFFNESS = 1e3


def refined(rollout: BakeRollout, report: Reporter = silent) -> BakeRollout:
    """Return a rollout with its refined frames, or the rollout itself where its request asks for none.

    Raises:
        SsilkError: a number of iterations that is not allowed.
    """
    if not rollout.request.refine or rollout.refinement is not None:
        return rollout
    from ..refine import RefinementMeans

    points, summary = [], RefinementMeans()
    for frame in _refiner(rollout).frames(rollout.motion, rollout.network_vertices()):
        points.append(frame.points)
        summary.changes.append(frame.change)
        report(Progress(len(points), rollout.motion.frame_count))
    fits = [] if rollout.request.writes_points else list(_fitted(rollout, points))
    found = _summary(rollout.request.refine, summary.figures(), fits)
    return replace(rollout, refinement=Refinement(tuple(points), tuple(fit.pose for fit in fits), found))


def _refiner(rollout: BakeRollout) -> Refiner:
    from ..refine import RefineOptions, Refiner

    request = rollout.request
    options = RefineOptions(iterations=request.refine, feedback=request.feedback)
    device = select_device(request.device)
    return Refiner(rollout.deformer.scene, rollout.fabric, options, fps=rollout.motion.fps, device=device)


def _fitted(rollout: BakeRollout, points: Sequence[Floats]) -> Iterator[PoseFit]:
    """Yield joints and blendshape weights fitted to refined vertices by least squares over the mass."""
    from ..energy import GarmentEnergy
    from ..refine import PoseFitter

    assert rollout.model is not None  # a request refuses joints under linear blend skinning
    mass = GarmentEnergy(rollout.deformer.scene.garment.mesh, rollout.fabric).mass.numpy()
    refitter = PoseFitter(rollout.model.deformer(), mass, device=select_device(rollout.request.device))
    yield from refitter.fit(rollout.motion, rollout.network_poses(), points)


def _summary(iterations: int, means: dict[str, float], fits: Sequence[PoseFit]) -> RefinementSummary:
    rms = np.concatenate([fit.rms for fit in fits]) if fits else None
    return RefinementSummary(
        iterations=iterations,
        energy_before_j=means["energy before [J]"],
        energy_j=means["energy [J]"],
        inside_before=means["inside the body before"],
        inside=means["inside the body"],
        moved_m=means["moved [m]"],
        fit_rms_mm=None if rms is None else 1000 * float(np.sqrt((rms**2).mean())),
        fit_max_mm=1000 * max(float(fit.largest.max()) for fit in fits) if fits else None,
    )


def verify_energies(rollout: BakeRollout, points: Iterable[Floats], report: Reporter) -> Verification:
    """Check points [m], shape (V, 3) each, that an earlier bake refined, without refining them again.

    The last digits of a refinement depend on the machine, and the solver amplifies them. On any machine, no frame
    may have more energy than the network's state, with the past that it was refined with.

    Raises:
        VerificationError: a frame has more.
    """
    energies, (judged, measured) = [], tee(points)
    changes = _refiner(rollout).changes(rollout.motion, rollout.network_vertices(), judged)
    for frame, (change, vertices) in enumerate(zip(changes, measured)):
        spacing = float(np.finfo(np.float32).eps) * np.abs(vertices).max()
        rounding = ROUNDING_ENERGY + len(vertices) * ROUNDING_STIFFNESS * spacing**2
        if not change.after <= change.before + rounding:
            raise VerificationError(
                f"{rollout.request.motion}: refined frame {frame} has an energy of {change.after:.6g} J; at most "
                f"the {change.before:.6g} J of the network's state is allowed."
            )
        energies.append(change.after)
        report(Progress(frame + 1, rollout.motion.frame_count))
    return Verification(frames=len(energies), mean_energy_j=float(np.mean(energies)))
