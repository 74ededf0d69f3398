# SPDX-License-Identifier: Apache-2.0
"""Refine trained models on the beginning of clips with growing budgets, and say what each buys and costs.

    python benchmarks/refine.py cape.safetensors --stage cape.usdc --motions FOLDER --clips 01_walk

Energies are means over frames, inertia by each method's own past, gravity from the root. Jitter is the RMS of the
third difference of positions. Skin that shows and limbs through the cloth are those of the solver's points. What
joints lose is measured on what `bake --refine` stores: proxy rotations, and blendshapes of the shot's own in place of
the model's. The last row of each clip is the simulator, which starts from no network.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.errors import SsilkError
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.physics.intersections.figures import EVERY
from ssilk_core.physics.refine import RefineOptions, Refiner
from ssilk_core.physics.simulate import SimulationOptions, simulate
from ssilk_core.physics.skin.covered_skin import ShownCounts
from ssilk_core.scene.assets import Floats, GarmentPose, Motion
from ssilk_core.scene.decomposition import decompose
from ssilk_core.scene.kinematics import deform, motion_transforms, resample, skinning_matrices

HEADER = ("garment, clip", "iterations", "looks back on", "s a frame", "energy [J]", "inside the body",
          "shows, worst frame", "limbs through", "moved [mm]", "from the simulator [mm]", "jitter [mm]", "own shapes",
          "joints lose [mm]", "at most [mm]", "energy of the joints [J]", "inside")  # fmt: skip
CHUNK = 256  # frames in memory at once
Blocks = Iterator[tuple[Tensor, Tensor]]  # of frames: vertices (V, 3, N) and the character's matrices (J, 3, 4, N)


@dataclass(frozen=True, eq=False)
class NetworkTake:
    """A garment over a stretch of a clip, as the network has it."""

    subject: Subject
    motion: Motion
    poses: list[GarmentPose]
    points: Floats

    @classmethod
    def of(cls, subject: Subject, clip: Motion, frames: int | None = None) -> NetworkTake:
        """Roll the network over the first frames of a clip, or over all of it."""
        whole = resample(clip, subject.file.config.fps)
        motion = whole if frames is None else whole.clip(0, frames)
        poses = list(garment_poses(subject.model, motion, motion.fps))
        points = np.concatenate([decode(subject.model, motion, pose) for pose in poses])
        return cls(subject, motion, poses, points)

    def clip(self, start: int, stop: int) -> NetworkTake:
        """Return the frames from `start` to `stop`."""
        motion, poses = self.motion.clip(start, stop), self.poses[start:stop]
        return replace(self, motion=motion, poses=poses, points=self.points[start:stop])

    def blocks(self, points: Floats) -> Blocks:
        """Yield vertices (F, V, 3) in blocks of frames."""
        skeleton, device = self.subject.scene.character.skeleton, self.subject.device
        matrices = skinning_matrices(motion_transforms(self.motion, skeleton.parents), skeleton.bind_transforms)
        for start in range(0, len(points), CHUNK):
            block = slice(start, start + CHUNK)
            x, character = points[block].transpose(1, 2, 0), matrices[block, :, :3].transpose(1, 2, 3, 0)
            yield (
                torch.tensor(x, dtype=torch.float32, device=device),
                torch.tensor(character, dtype=torch.float32, device=device),
            )

    def refiner(self, iterations: int, feedback: bool, batch: int = RefineOptions.batch) -> Refiner:
        options, dressed = RefineOptions(iterations=iterations, feedback=feedback, batch=batch), self.subject.dressed
        return Refiner(dressed.scene, dressed.fabric, options, fps=self.motion.fps, device=dressed.device)

    def measured(self, points: Floats) -> dict[str, float]:
        """Return the figures of vertices (F, V, 3), by their own past."""
        changes = list(self.refiner(1, True).changes(self.motion, points, points))
        skin = self.subject.dressed.covered
        counts = ShownCounts.joined([ShownCounts.of(skin.states(*block)) for block in self.blocks(points)])
        cloth = self.subject.dressed.intersections
        return {
            "energy": float(np.mean([change.after for change in changes])),
            "inside": float(np.mean([change.inside_after for change in changes])),
            "shows": float(counts.shares.max()),
            "limbs": counts.pierced_share or 0.0,
            "intersect": float(cloth.counts(list(points[::EVERY]), range(0, len(points), EVERY)).shares.mean()),
            "moved": rms(points - self.points),
            "jitter": rms(np.diff(points, 3, axis=0)),
        }

    def stored(self, points: Floats) -> dict[str, float]:
        """Return what the joints and blendshapes of the shot's own lose; nothing where these cannot reach."""
        whole = self.subject.model.deformer()
        own = replace(whole, shapes=whole.shapes[:0])
        try:
            shot = decompose(own, self.motion, list(points), self.poses, device=self.subject.device)
        except SsilkError as error:
            print(error, flush=True)
            return {}
        found = self.measured(np.concatenate([deform(shot.deformer, self.motion, pose) for pose in shot.poses]))
        return {
            "shapes": shot.own_shapes,
            "lost": shot.rms,
            "lost at most": shot.largest,
            "joints energy": found["energy"],
            "joints inside": found["inside"],
        }


def refined(take: NetworkTake, iterations: int, feedback: bool, reference: Floats) -> dict[str, float]:
    """Return the figures of one budget, none for no iterations, with the distance from the simulator's vertices."""
    if not iterations:
        return {"seconds": 0.0, **take.measured(take.points), "apart": rms(take.points - reference)}
    begun = time.perf_counter()
    points = np.stack([frame.points for frame in take.refiner(iterations, feedback).frames(take.motion, take.points)])
    seconds = (time.perf_counter() - begun) / len(points)
    return {
        "seconds": seconds, **take.measured(points), "apart": rms(points - reference), **take.stored(points)
    }  # fmt: skip


def rms(away: Floats) -> float:
    return float(np.sqrt((away**2).sum(-1).mean()))


def simulated(take: NetworkTake) -> tuple[dict[str, float], Floats]:
    """Return the figures of the simulator, and its vertices (F, V, 3)."""
    dressed, begun = take.subject.dressed, time.perf_counter()
    options = SimulationOptions(fps=take.motion.fps)
    (points,) = simulate(dressed.scene, dressed.fabric, [take.motion], options, device=dressed.device)
    return {"seconds": (time.perf_counter() - begun) / len(points), **take.measured(points), "apart": 0.0}, points


def row(where: str, iterations: str, past: str, found: dict[str, float]) -> list[str]:
    """Return one line of the table."""
    line = [where, iterations, past, f"{found['seconds']:.3g}", f"{found['energy']:.4f}", f"{found['inside']:.2%}",
            f"{found['shows']:.2%}", f"{found['limbs']:.0%}"]  # fmt: skip
    line += [f"{1000 * found[name]:.1f}" for name in ("moved", "apart")] + [f"{1000 * found['jitter']:.2f}"]
    if "lost" not in found:
        return [*line, "", "", "", "", ""]
    lost = [f"{1000 * found[name]:.2f}" for name in ("lost", "lost at most")]
    return [*line, str(found["shapes"]), *lost, f"{found['joints energy']:.4f}", f"{found['joints inside']:.2%}"]


def measure(take: NetworkTake, where: str, budgets: list[int]) -> tuple[list[list[str]], dict[str, Any]]:
    """Return the rows of one garment and clip, and their figures."""
    rows, figures = [], {}
    own, reference = simulated(take)
    for iterations in budgets:
        for feedback in (False, True) if iterations else (False,):
            past = ("refined" if feedback else "network") if iterations else ""
            figures[f"{iterations} {past}".strip()] = found = refined(take, iterations, feedback, reference)
            rows.append(row(where, str(iterations), past, found))
            print(rows[-1], flush=True)
    figures["simulator"] = own
    return [*rows, row(where, "simulator", "itself", own)], figures


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--clips", nargs="+", required=True, help="names of motion files")
    parser.add_argument("--frames", type=int, default=30, help="from the beginning of each clip (default 30)")
    parser.add_argument("--budgets", type=int, nargs="+", default=[0, 1, 2, 4, 8, 16], help="iterations a frame")
    options = parsed(parser)
    rows, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        for clip in options.clips:
            take = NetworkTake.of(subject, clip_of(options, clip, subject), options.frames)
            more, measured[f"{subject.name} {clip}"] = measure(take, f"{subject.name}, {clip}", options.budgets)
            rows += more
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
