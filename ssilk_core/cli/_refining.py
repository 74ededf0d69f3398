# SPDX-License-Identifier: Apache-2.0
"""A bake whose garment the solver refines: its points, or poses that come as near to them as joints can."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import tee
from typing import TYPE_CHECKING, Any

import numpy as np

from ..assets import Floats, GarmentPose
from ..devices import chosen_device
from ..errors import VerificationError, fail
from ..events import Progress, Reporter, silent

if TYPE_CHECKING:
    from ..refine import Refiner
    from ._baking import Bake

OUTPUTS = ("points", "joints")
SLACK = 1e-6  # [J] by which rounding points to float32 may raise the energy of a frame near the origin
STIFFNESS = 1e3  # [N/m] of every vertex against rounding, more than any fabric's: it counts far from the origin


class Refinement:
    """The refined frames of a bake, computed once and kept: 65 MB for 1,000 frames of 2,700 vertices.

    Attributes:
        points: garment vertices of each frame in the world [m], shape (V, 3).
        poses: the poses that are nearest to them, where joints were asked for.
        figures: what a shot states of its refinement, once it is computed.
    """

    def __init__(self, bake: Bake) -> None:
        request = bake.request
        if request.refined not in OUTPUTS:
            fail("--refined-output", f"'{request.refined}'", f"it is one of {OUTPUTS}")
        if not (bake.model is not None or request.refined == "points"):
            fail(
                "--lbs",
                "linear blend skinning has no proxies and no blendshapes to put refined vertices back onto",
                "they can be written as points",
                "use --refined-output points",
            )
        self.bake = bake
        self.points: list[Floats] = []
        self.poses: list[GarmentPose] = []
        self.figures: dict[str, Any] = {}

    def compute(self, report: Reporter) -> None:
        """Refine all frames, unless that is done."""
        if self.figures:
            return
        from ..refine import Summary

        summary, bake = Summary(), self.bake
        for frame in self._refiner().frames(bake.motion, bake.rolled(silent)):
            self.points.append(frame.points)
            summary.changes.append(frame.change)
            report(Progress(len(self.points), bake.motion.frame_count))
        rounded = {name: float(f"{value:.4g}") for name, value in summary.figures().items()}
        lost = self._put_back() if bake.request.refined == "joints" else {}
        self.figures.update({"iterations": bake.request.refine, **rounded, **lost})

    def _refiner(self) -> Refiner:
        from ..refine import RefineOptions, Refiner

        bake = self.bake
        options = RefineOptions(iterations=bake.request.refine, feedback=bake.request.feedback)
        device = chosen_device(bake.request.device)
        return Refiner(bake.deformer.scene, bake.fabric, options, fps=bake.motion.fps, device=device)

    def _put_back(self) -> dict[str, float]:
        """Fit poses to the points; return what that loses, in mm."""
        from ..energy import GarmentEnergy
        from ..refine import Refitter

        bake = self.bake
        assert bake.model is not None
        mass = GarmentEnergy(bake.deformer.scene.garment.mesh, bake.fabric).mass.numpy()
        refitter = Refitter(bake.model.deformer(), mass, device=chosen_device(bake.request.device))
        fits = list(refitter.fit(bake.motion, bake.rollout(), self.points))
        self.poses = [fit.pose for fit in fits]
        rms = np.concatenate([fit.rms for fit in fits])
        largest = max(float(fit.largest.max()) for fit in fits)
        return {
            "joints lose, RMS [mm]": float(f"{1000 * np.sqrt((rms**2).mean()):.4g}"),
            "joints lose, at most [mm]": float(f"{1000 * largest:.4g}"),
        }

    def judge(self, points: Iterable[Floats], report: Reporter) -> dict[str, object]:
        """Check points that an earlier bake refined, without refining again; return figures.

        The last digits of a refinement depend on the machine, and grow. What must hold anywhere: no frame has more
        energy than the network's state, with the past that it was refined with.

        Raises:
            VerificationError: a frame has.
        """
        bake, after = self.bake, []
        judged, measured = tee(points)
        changes = self._refiner().changes(bake.motion, bake.rolled(silent), judged)
        for frame, (change, vertices) in enumerate(zip(changes, measured)):
            rounding = len(vertices) * STIFFNESS * (float(np.finfo(np.float32).eps) * np.abs(vertices).max()) ** 2
            if not change.after <= change.before + SLACK + rounding:
                raise VerificationError(
                    f"{bake.request.motion}: refined frame {frame} has an energy of {change.after:.6g} J; at most "
                    f"the {change.before:.6g} J of the network's state is allowed."
                )
            after.append(change.after)
            report(Progress(frame + 1, bake.motion.frame_count))
        return {"frames of lower energy than the network's": len(after), "mean energy [J]": f"{np.mean(after):.4g}"}
