# SPDX-License-Identifier: Apache-2.0
"""Shots solved in latents, frame by frame, several at once; frame by frame they follow from the two before.

The first frame of a shot is quasi-static, as the simulator's is: the garment hangs still in the first pose. The
second one has the velocity of linear blend skinning. A state that is lost, with an energy that is not finite, is
replaced by the network's quasi-static one for `RECOVERY_FRAMES` frames; the shot then goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...physics.simulate import SimulationOptions, Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.cubature import spread_evenly
from ...physics.simulate.history import StepHistory
from ...physics.simulate.incremental_potential import StepInputs
from ...scene.assets import Motion
from ...scene.fabrics import Fabric
from ...scene.kinematics import motion_transforms
from ..descriptors import pose_features
from ..model.descriptors import motion_descriptors
from ..model.feedback import BodyFrames, DecodedState
from ..model.network import GarmentModel
from ..settings import DIVERGENCE_BOUND, RECOVERY_FRAMES
from .elements import choose_elements
from .options import LatentOptions
from .solver import LatentSolution, LatentSolver
from .warm_start import Course, FrameDescriptors, NetworkSteps

LOOK_BACK = 2  # earlier frames that descriptors need
DESCRIBED, POSED = 256, 16  # frames of each motion at once
CHOSEN_FROM, CHOSEN_STATES = 8, 32  # motions and states that elements are chosen for, at most
Sampled = tuple[Simulator, LatentSolver]  # both on few elements


@dataclass(frozen=True, eq=False)
class LatentPast:
    """The two latest states of N shots, from which the next frame follows.

    Attributes:
        before, now: latents two frames and one frame ago, shape (N, m).
        course: both, as the network looks back on them.
        cloth: positions.
        roots: of the character in both frames [m], float64, shape (2, 3, N).
        recovering: frames for which a lost shot still rests, shape (N,).
    """

    before: Tensor
    now: Tensor
    course: Course
    cloth: StepHistory
    roots: Tensor
    recovering: Tensor

    def first(self, count: int) -> LatentPast:
        """Return those of the first shots."""
        before, now = (DecodedState(each.output[:count], each.points[..., :count]) for each in self.course)
        own = self.before[:count], self.now[:count], (before, now), self.cloth.first(count)
        return LatentPast(*own, self.roots[..., :count], self.recovering[:count])

    def followed_by(self, poses: PosedCharacters) -> BodyFrames:
        """Return the character in the next frame."""
        bend = poses.root - 2 * self.roots[1] + self.roots[0]
        return BodyFrames(poses.matrices[None], bend[None])


@dataclass(frozen=True, eq=False)
class LatentFrame:
    """One frame of N shots.

    Attributes:
        number: of the frame.
        solution: of each shot; where it was lost, the state that replaces it.
        lost: whose state was lost, shape (N,).
        past: what the next frame follows from; None where that is not kept.
    """

    number: int
    solution: LatentSolution
    lost: Tensor
    past: LatentPast | None


class LatentShots:
    """Solves shots of one garment in its model's latents.

    Attributes:
        simulator, solver: over the whole garment, even where the options say that few elements are solved for.

    Args:
        model: on the device to use.
        fabric: of the garment.
        precision: "float32" or "float64", of everything but the network.
    """

    def __init__(
        self, model: GarmentModel, fabric: Fabric, options: LatentOptions, *, precision: str = "float32"
    ) -> None:
        self.model, self.options, self.fps = model, options, model.config.fps
        device = next(model.parameters()).device
        self.simulator = Simulator(
            model.scene, fabric, SimulationOptions(fps=self.fps, precision=precision), device=device
        )
        self.solver = LatentSolver(model, self.simulator.potential, options)
        self.steps = NetworkSteps(model)

    @torch.no_grad()
    def sampled(self, motions: Sequence[Motion]) -> Sampled:
        """Return a simulator and a solver on few elements, chosen for what the network does in some motions.

        States are taken from at most `CHOSEN_FROM` of the motions, `CHOSEN_STATES` in all.
        """
        motions = [motions[number] for number in spread_evenly(len(motions), CHOSEN_FROM)]
        share = CHOSEN_STATES // len(motions)
        kept = [spread_evenly(motion.frame_count, share) for motion in motions]
        rolled = [self._rolled(motion)[torch.as_tensor(rows)] for motion, rows in zip(motions, kept)]
        z = torch.cat(rolled).to(self.solver.potential.dtype).clamp(-self.solver.bound, self.solver.bound)
        rotations, translations = (
            np.concatenate([getattr(motion, name)[rows] for motion, rows in zip(motions, kept)])
            for name in ("rotations", "translations")
        )
        poses = self.simulator.poser.pose(rotations, translations, self.simulator.poser.moves(zip(motions, kept)))
        scene = self.model.scene
        cubature = choose_elements(scene, self.simulator, self.solver, z, poses)
        simulator = self.simulator.sampled(scene, cubature)
        return simulator, LatentSolver(self.model, simulator.potential, self.options, cubature)

    def _rolled(self, motion: Motion) -> Tensor:
        """Return the network's states over a motion (F, m), its quasi-static ones where it is lost."""
        skeleton = self.model.scene.character.skeleton
        parts = [
            self._described(motion, start, start + DESCRIBED) for start in range(0, motion.frame_count, DESCRIBED)
        ]
        rest, pose = (torch.cat(values)[:, None] for values in zip(*parts))
        body = BodyFrames.of(motion_transforms(motion, skeleton.parents), skeleton, rest)
        states = torch.stack(self.model.roll([rest[0], *rest[1:LOOK_BACK]], rest[LOOK_BACK:], pose[LOOK_BACK:], body))
        sound = states.abs().amax(dim=2, keepdim=True) < DIVERGENCE_BOUND
        return torch.where(sound, states, rest)[:, 0]

    @torch.no_grad()
    def frames(
        self, motions: Sequence[Motion], after: LatentFrame | None = None, elements: Sampled | None = None
    ) -> Iterator[LatentFrame]:
        """Yield the frames of motions without cuts, at the model's rate, all motions at once.

        Args:
            motions: of decreasing length; a frame holds those that have not ended.
            after: a frame of motions that are these as far as it; those that follow it are yielded. All by default.
            elements: as `sampled` returns them, where the options ask for few; chosen for the motions by default.

        Raises:
            SsilkError: a motion is not at the model's rate.
        """
        for motion in motions:
            if not abs(motion.fps - self.fps) < 1e-6:
                fail(motion.path, f"{motion.fps:g} frames per second", f"the model steps at {self.fps:g}")
        lengths = [motion.frame_count for motion in motions]
        if lengths != sorted(lengths, reverse=True):
            fail("latent solver", "motions of increasing length", "the longest must come first")
        simulator, solver = self.simulator, self.solver
        if self.options.sampled:
            simulator, solver = elements or self.sampled(motions)
        first, past = 0, None
        if after:
            first, past = after.number + 1, after.past
            assert past is not None
        seen, posed = self._descriptors(motions, first), self._poses(simulator, motions, first)
        for number, (described, poses) in enumerate(zip(seen, posed), first):
            past = past and past.first(len(described.rest))
            inputs, running = simulator.inputs(poses, past.cloth if past else None), motions[: len(described.rest)]
            if any(motion.gravity is not None for motion in running):
                inputs = replace(inputs, gravity=_gravity(running, number, inputs.gravity))
            frame = self._advance(inputs, solver, number, past, poses, described)
            past = frame.past
            yield frame

    def _poses(self, simulator: Simulator, motions: Sequence[Motion], first: int) -> Iterator[PosedCharacters]:
        """Yield the characters in each frame from `first` on of the motions that have not ended.

        Some frames are posed at once, the same ones wherever frames begin, so that rounding is the same.
        """
        device = simulator.gravity.device
        for start in range(first - first % POSED, motions[0].frame_count, POSED):
            running = [motion for motion in motions if motion.frame_count > start]
            spans = [motion.clip(start, start + POSED) for motion in running]
            counts = torch.tensor([span.frame_count for span in spans], device=device)
            rotations, translations = (
                np.concatenate([getattr(span, name) for span in spans]) for name in ("rotations", "translations")
            )
            moves = simulator.poser.moves((span, slice(None)) for span in spans)
            posed = simulator.poser.pose(rotations, translations, moves)
            rows = counts.cumsum(0) - counts
            for frame in range(max(first - start, 0), spans[0].frame_count):
                yield posed.select(rows[counts > frame] + frame)

    def _descriptors(self, motions: Sequence[Motion], first: int) -> Iterator[FrameDescriptors]:
        """Yield what the network sees in each frame from `first` on of the motions that have not ended."""
        for start in range(first - first % DESCRIBED, motions[0].frame_count, DESCRIBED):
            stop = start + DESCRIBED
            parts = [
                self.steps.described(*self._described(motion, start, stop))
                for motion in motions
                if motion.frame_count > start
            ]
            for frame in range(max(first - start, 0), len(parts[0].rest)):
                running = [part for part in parts if len(part.rest) > frame]
                yield FrameDescriptors(
                    torch.stack([part.rest[frame] for part in running]),
                    tuple(torch.stack([v[frame] for v in values]) for values in zip(*(p.given for p in running))),
                )

    def _described(self, motion: Motion, start: int, stop: int) -> tuple[Tensor, Tensor]:
        """Return quasi-static latents (F, m) and dynamic descriptors (F, D) in consecutive frames of a motion."""
        model, parameter = self.model, next(self.model.parameters())
        seen = motion.clip(max(0, start - LOOK_BACK), stop)
        count = min(stop, motion.frame_count) - start
        skeleton, kind = model.scene.character.skeleton, model.config.descriptors
        features = pose_features(seen, skeleton, model.joints, kind=kind)
        static, dynamic = (values[-count:] for values in motion_descriptors(features, parameter))
        rest = model.initial(static)
        sound = rest.abs().amax(dim=1, keepdim=True) < DIVERGENCE_BOUND  # NaN is not less than anything
        rest = torch.where(sound, rest, torch.zeros_like(rest))
        return rest, model.completed(dynamic, model.described)

    def _advance(
        self,
        inputs: StepInputs,
        solver: LatentSolver,
        number: int,
        past: LatentPast | None,
        poses: PosedCharacters,
        seen: FrameDescriptors,
    ) -> LatentFrame:
        """Return the frame after those that have passed."""
        rest = seen.rest.to(solver.potential.dtype)
        if past is None:
            starts, iterations = [rest], self.options.first_iterations
        else:
            body = past.followed_by(poses)
            starts, iterations = self.steps.starts(past.before, past.now, past.course, seen, body), None
        found = solver.solve(starts, poses.matrices, inputs, iterations)
        lost = ~(found.energy.isfinite() & found.z.isfinite().all(1))
        recovering = torch.zeros_like(found.iterations) if past is None else past.recovering
        recovering = torch.where(lost, RECOVERY_FRAMES, recovering)
        lost = recovering > 0
        if bool(lost.any()):
            found = found.where(lost, solver.given(rest, poses.matrices, inputs))
        cloth = StepHistory(found.x.double() + poses.root, past.cloth.last if past else None, poses.root, poses.lbs)
        now = self.steps.decoded(found.z, poses.matrices)
        before, earlier, root = (past.now, past.course[1], past.roots[1]) if past else (found.z, now, poses.root)
        roots, recovering = torch.stack([root, poses.root]), (recovering - 1).clamp_min(0)
        passed = LatentPast(before, found.z, (earlier, now), cloth, roots, recovering)
        return LatentFrame(number, found, lost, passed)


def _gravity(motions: Sequence[Motion], frame: int, usual: Tensor) -> Tensor:
    """Return what the cloth of each motion feels in a frame [m/s2], shape (3, N); that of `usual` by default."""
    found = usual.clone()
    for number, motion in enumerate(motions):
        if motion.gravity is not None:
            found[:, number] = torch.as_tensor(motion.gravity[frame].copy()).to(found)
    return found
