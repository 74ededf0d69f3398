# SPDX-License-Identifier: Apache-2.0
"""Where the energy of a moving garment's steps is lost: in the network, or in the decoder's joints and shapes.

    python benchmarks/moving_states.py cape.safetensors --stage character.usdc --motions FOLDER --clips 02_04 05_20

A step minimises one energy from a past. From the network's own past, three ways to take it are compared: the network;
Newton's method on blendshape activations and proxy transforms, which is the best that any network with this decoder
could do; and the solver, which moves every vertex. Then, from the network's first two states, the second and the
third each go on from their own past: the distances from the solver say how far that best network would drift.
Windows are those of `ssilk evaluate --solver`. One clip takes some minutes.
"""

from __future__ import annotations

import copy
import time
from argparse import Namespace
from dataclasses import dataclass

import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.physics.simulate.characters import PosedCharacters
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.incremental_potential import StepInputs
from ssilk_core.quality.evaluation.methods import Network, TakeSet, build_take_set
from ssilk_core.quality.evaluation.metrics import mean_square
from ssilk_core.quality.evaluation.solver_errors import windows_of
from ssilk_core.quality.evaluation.takes import takes_of

STEP_EVERY, SHOT = 5, 30  # frames between single steps; frames of a shot
AFTER = (5, 10, 30)  # frames of a shot after which distances are told
ITERATIONS, HALVINGS = 12, 8  # of Newton's method, and of its line search
LEAST_GAIN = 1e-5  # of an iteration [J], after which the method stops
DIFFERENCE = 1e-5  # of an output, for its derivative
COLUMNS = 64  # derivatives taken at once
DAMPING = 1e-6  # of each diagonal entry of the Hessian: outputs that move nothing have none


@dataclass(frozen=True, eq=False)
class Pose:
    """One frame of a take: the character, and where the decoder's coordinates begin in the simulator's (3,) [m]."""

    posed: PosedCharacters
    character: Tensor
    shift: Tensor


class BestOutputs:
    """The least energy that a model's blendshape activations and proxy transforms reach."""

    def __init__(self, subject: Subject) -> None:
        self.simulator, self.potential = subject.dressed.simulator, subject.dressed.simulator.potential
        self.decoder = copy.deepcopy(subject.model.decoder).double()

    def positions(self, outputs: Tensor, pose: Pose) -> Tensor:
        """Return positions (V, 3, N) of network outputs (N, outputs) in one pose, relative to its root."""
        character = pose.character.expand(-1, -1, -1, len(outputs)).contiguous()
        found = self.decoder.vertices(outputs, character) + pose.shift[:, None]
        free = self.potential.free
        return pose.posed.lbs.expand_as(found).index_copy(0, free, found[free])

    def energy(self, x: Tensor, inputs: StepInputs) -> float:
        return float(self.potential.energy(x, inputs, self.potential.body_distance(x, inputs)))

    def step(self, start: Tensor, pose: Pose, inputs: StepInputs) -> tuple[Tensor, Tensor, float]:
        """Minimise from outputs (1, outputs); return outputs, positions (V, 3, 1) and energy [J]."""
        potential, outputs = self.potential, start
        x = self.positions(outputs, pose)
        energy = self.energy(x, inputs)
        for _ in range(ITERATIONS):
            distance = potential.body_distance(x, inputs)
            moved = self._derivatives(outputs, pose)[potential.free].flatten(0, 1)
            force = potential.gradient(x, inputs, distance)[potential.free].flatten()
            hessian = moved.T @ (potential.hessian(x, inputs, distance).rows.double() @ moved)
            hessian.diagonal().mul_(1 + DAMPING).add_(DAMPING * float(hessian.diagonal().mean()))
            step, gain = torch.linalg.solve(hessian, -(moved.T @ force)), 0.0
            for halving in range(HALVINGS):
                tried = outputs + 0.5**halving * step
                there = self.positions(tried, pose)
                gain = energy - self.energy(there, inputs)
                if gain > 0:
                    outputs, x, energy = tried, there, energy - gain
                    break
            if gain < LEAST_GAIN:
                break
        return outputs, x, energy

    def _derivatives(self, outputs: Tensor, pose: Pose) -> Tensor:
        """Return the derivatives of the positions by each output, shape (V, 3, outputs)."""
        steps = DIFFERENCE * torch.eye(outputs.shape[1], dtype=outputs.dtype, device=outputs.device)
        parts = [
            (self.positions(outputs + part, pose) - self.positions(outputs - part, pose)) / (2 * DIFFERENCE)
            for part in steps.split(COLUMNS)
        ]
        return torch.cat(parts, dim=-1)


class PlayedWindow:
    """A window of a network's take, in the solver's terms.

    Attributes:
        world: the network's positions (V, 3, L) in the world [m], float64.
        outputs: of the network (L, outputs), float64.
    """

    def __init__(self, subject: Subject, take_set: TakeSet, played: Network, take: int, frames: range) -> None:
        self.subject, self.best = subject, BestOutputs(subject)
        motion = take_set.takes[take].motion
        self.motion = motion.clip(frames.start, frames.stop)
        self.origin = torch.as_tensor(take_set.origins[take].copy(), device=subject.device)
        self.character = take_set.character(take, frames).double()
        self.world = played.vertices(take, frames).double() + self.origin[:, None]
        self.outputs = subject.model.output(played.states[take][frames.start : frames.stop]).double()
        self.mass = subject.energy.mass.double()

    def pose(self, frame: int) -> Pose:
        simulator = self.subject.dressed.simulator
        chosen = slice(frame, frame + 1)
        posed = simulator.poser.pose(self.motion.rotations[chosen], self.motion.translations[chosen])
        return Pose(posed, self.character[..., chosen], self.origin - posed.root[:, 0])

    def history(self, last: Tensor, before: Tensor, frame: int) -> StepHistory:
        """Return the past of a frame, from positions (V, 3, 1) in the world."""
        posed = self.pose(frame - 1).posed
        return StepHistory(last, before, posed.root, posed.lbs)

    def apart(self, one: Tensor, other: Tensor) -> float:
        """Return the squared distance of positions (V, 3, 1) [m2], a mean weighted by mass."""
        return float(mean_square((one - other).double(), self.mass))

    def single_step(self, frame: int) -> list[float]:
        """Return energies [J] lost by the network and by the decoder, and squared distances [m2], in one frame."""
        simulator, pose = self.subject.dressed.simulator, self.pose(frame)
        last, before, here = (self.world[..., n : n + 1] for n in (frame - 1, frame - 2, frame))
        inputs = simulator.inputs(pose.posed, self.history(last, before, frame))
        own = simulator.apply_pins(here - pose.posed.root, pose.posed)
        _, x, energy = self.best.step(self.outputs[frame : frame + 1], pose, inputs)
        solved = simulator.solve(x, inputs)
        lost = self.best.energy(own, inputs) - energy, energy - float(solved.energy)
        return [*lost, self.apart(own, x), self.apart(x, solved.x), self.apart(own, solved.x)]

    def drift(self) -> tuple[list[float], list[float]]:
        """Return the squared distances from the solver's shot [m2] of the network and of the best outputs."""
        simulator, length = self.subject.dressed.simulator, min(2 + SHOT, self.world.shape[-1])
        first = [self.world[..., n : n + 1] for n in (0, 1)]
        solver, best, outputs = [*first], [*first], [self.outputs[n : n + 1] for n in (0, 1)]
        for frame in range(2, length):
            pose = self.pose(frame)
            past = self.history(solver[-1], solver[-2], frame)
            (found,) = simulator.carry_on([past], [range(frame, frame + 1)], lambda _: pose.posed)  # noqa: B023
            solver.append(found.state.last)
            inputs = simulator.inputs(pose.posed, self.history(best[-1], best[-2], frame))
            starts = outputs[-1], 2 * outputs[-1] - outputs[-2]
            start = min(starts, key=lambda each: self.best.energy(self.best.positions(each, pose), inputs))
            found_outputs, x, _ = self.best.step(start, pose, inputs)
            outputs.append(found_outputs)
            best.append(x + pose.posed.root)
        own = [self.apart(self.world[..., n : n + 1], solver[n]) for n in range(2, length)]
        return own, [self.apart(best[n], solver[n]) for n in range(2, length)]


@torch.no_grad()
def measure(subject: Subject, options: Namespace) -> dict[str, float]:
    """Return the figures of one garment over the windows of all clips."""
    fps = subject.file.config.fps
    skeleton, clips = subject.scene.character.skeleton, options.clips
    takes = [take for name in clips for take in takes_of(name, clip_of(options, name, subject), skeleton, fps)]
    take_set = build_take_set(takes, subject.dressed, subject.model.joints, subject.model.config.descriptors)
    played = Network(subject.model, take_set)
    steps, drifts, begun = [], [], time.perf_counter()
    for take, frames in windows_of(subject.dressed, take_set, range(len(takes))):
        window = PlayedWindow(subject, take_set, played, take, frames)
        steps += [window.single_step(frame) for frame in range(2, len(frames), STEP_EVERY)]
        drifts.append(window.drift())
        print(f"{subject.name}: {takes[take].clip}, {time.perf_counter() - begun:.0f} s", flush=True)
    found = torch.tensor(steps)
    energy, square = found[:, :2].mean(0), found[:, 2:].mean(0).sqrt()
    names = "network", "best outputs"
    whole = [[each[n] for each in drifts if len(each[n]) == SHOT] for n in range(2)]
    shots = {name: torch.tensor(own).mean(0).sqrt() for name, own in zip(names, whole)}
    return {
        "steps": len(steps),
        "shots": len(whole[0]),
        "lost by the network [mJ]": 1e3 * float(energy[0]),
        "lost by the decoder [mJ]": 1e3 * float(energy[1]),
        "network from best outputs [mm]": 1e3 * float(square[0]),
        "best outputs from solver [mm]": 1e3 * float(square[1]),
        "network from solver [mm]": 1e3 * float(square[2]),
        **{f"{name}, after {n} [mm]": 1e3 * float(shots[name][n - 1]) for name in names for n in AFTER},
    }


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", required=True, metavar="NAME", help="files in the motions' folder")
    options = parsed(parser)
    measured = {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        measured[subject.name] = measure(subject, options)
        names = list(measured[subject.name])
        rows = [[name, *(f"{found[name]:.1f}" for found in measured.values())] for name in names]
        write_results(options, table(("", *measured), rows), measured)


if __name__ == "__main__":
    main()
