# SPDX-License-Identifier: Apache-2.0
"""Where the energy of quasi-static states is lost: in P, in the latents, in the decoder, or in the basin they lie in.

    python benchmarks/static_states.py cape.safetensors --stage character.usdc --motions FOLDER --index index.json

In the first pose of clips of `valid`, the energy of P's state is compared with the least energy that the latents
reach from there, with the least that blendshape activations and proxy transforms reach from there, and with the
solver's minima: from P's state, from linear blend skinning, and from the bind pose, as `ssilk simulate` carries the
garment into its first pose. Distances are RMS, from P's state.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from torch import Tensor

from ssilk_core.physics.simulate import SimulationOptions, Simulator
from ssilk_core.quality.evaluation.splits import read_index
from ssilk_core.scene.kinematics import resample
from ssilk_core.training.objective import Objective, Terms
from ssilk_core.training.validation import Validator

TERMS = ("stretch", "gravity", "collision", "tether")
HEADER = ("garment", "state", "energy [J]", *(f"{name} [J]" for name in TERMS), "from P [mm]")
STEPS = 300  # of L-BFGS


@dataclass(frozen=True, eq=False)
class StillFrames:
    """Frames without inertia and drag.

    Attributes:
        objective: the energies.
        direction: of gravity (N, 3); descriptor: the static one, P's input (N, D).
        character: its skinning matrices (J, 3, 4, N).
        lbs: the garment under linear blend skinning (V, 3, N), from which heights count.
    """

    objective: Objective
    direction: Tensor
    descriptor: Tensor
    character: Tensor
    lbs: Tensor

    @classmethod
    def of(cls, subject: Subject, validator: Validator, frames: Tensor) -> StillFrames:
        """Return those of a validator's bank with indices (N,)."""
        bank = validator.bank
        direction, character = validator.down.expand(len(frames), 3), bank.character(frames)
        objective = Objective(subject.model, subject.energy, subject.body, bank)
        descriptor = bank.static_descriptor(frames, direction)
        return cls(objective, direction, descriptor, character, validator.lbs_vertices(character))

    @cached_property
    def height(self) -> Tensor:
        """Gravity under linear blend skinning [J], shape (N,)."""
        return self.objective.quasi_static_terms(self.lbs, self.direction, self.character)["gravity"]

    def terms(self, x: Tensor) -> Terms:
        """Return the energies of positions (V, 3, N), each (N,) [J]."""
        found = self.objective.quasi_static_terms(x, self.direction, self.character)
        return found | {"gravity": found["gravity"] - self.height}


def energy_of(terms: Terms) -> Tensor:
    """Return the sum of all terms in each frame [J], shape (N,)."""
    return torch.stack([*terms.values()]).sum(0)


def least(start: Tensor, energy: Callable[[Tensor], Tensor]) -> Tensor:
    """Return a minimum of the summed energies of all poses, by L-BFGS."""
    found = start.detach().clone().requires_grad_()
    optimiser = torch.optim.LBFGS([found], max_iter=STEPS, history_size=20, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = energy(found).sum()
        value.backward()
        return value

    optimiser.step(closure)
    return found.detach()


def measure(subject: Subject, options: Namespace) -> dict[str, dict[str, float]]:
    """Return the figures of each state, means over poses."""
    clips = [entry.clip for entry in read_index(options.index) if entry.split == "valid"][: options.poses]
    found = [_pose(subject, options, clip) for clip in clips]
    return {
        state: {name: sum(each[state][name] for each in found) / len(found) for name in figures}
        for state, figures in found[0].items()
    }


def _pose(subject: Subject, options: Namespace, clip: str) -> dict[str, dict[str, float]]:
    motion, model = clip_of(options, clip, subject), subject.model
    still = StillFrames.of(subject, subject.validator(motion), torch.zeros(1, dtype=torch.int64))
    character, terms = still.character, still.terms

    def total(x: Tensor) -> Tensor:
        return energy_of(terms(x))

    with torch.no_grad():
        z = model.initial(still.descriptor)
        states = {"P": model.vertices(z, character)}
    z = least(z, lambda latent: total(model.vertices(latent, character)))
    with torch.no_grad():
        states["best latents"], output = model.vertices(z, character), model.output(z)
    output = least(output, lambda given: total(model.decoder.vertices(given, character)))
    with torch.no_grad():
        states["best shapes and proxies"] = model.decoder.vertices(output, character)
        fps = subject.file.config.fps
        simulator = Simulator(
            subject.scene,
            subject.dressed.fabric,
            SimulationOptions(fps=fps, precision="float32"),
            device=subject.device,
        )
        first = resample(motion, fps).clip(0, 1)
        poses = simulator.poser.pose(first.rotations, first.translations)
        for name, start in (("solver, from P", states["P"]), ("solver, from LBS", still.lbs)):
            states[name] = simulator.quasi_static(poses, simulator.apply_pins(start, poses)).x
        states["solver, from the bind pose"] = simulator.at_rest(first.rotations, first.translations)[1].x
        return {
            name: {
                "energy": float(total(x)),
                **{term: float(terms(x)[term]) for term in TERMS},
                "distance": float((x - states["P"]).square().sum(1).mean().sqrt()),
            }
            for name, x in states.items()
        }


def rows(garment: str, found: dict[str, dict[str, float]]) -> list[list[str]]:
    """Return the lines of a garment."""
    return [
        [garment, state, *(f"{at[name]:.3f}" for name in ("energy", *TERMS)), f"{1000 * at['distance']:.0f}"]
        for state, at in found.items()
    ]


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--poses", type=int, default=4, help="clips whose first pose is measured (default 4)")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
