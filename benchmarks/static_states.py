# SPDX-License-Identifier: Apache-2.0
"""Where the energy of quasi-static states is lost: in P, in the latents, in the decoder, or in the basin they lie in.

    python benchmarks/static_states.py cape.safetensors --stage character.usdc --motions FOLDER --index index.json

In the first pose of clips of `valid`, the energy of P's state is compared with the least energy that the latents
reach from there, with the least that blendshape activations and proxy transforms reach from there, and with the
solver's minima, from P's state and from linear blend skinning. Distances are RMS, from P's state.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.evaluation.splits import read_index
from ssilk_core.kinematics import resample
from ssilk_core.simulate import SimulationOptions, Simulator
from ssilk_core.training.objective import Objective

TERMS = ("stretch", "gravity", "collision", "tether")
HEADER = ("garment", "state", "energy [J]", *(f"{name} [J]" for name in TERMS), "from P [mm]")
STEPS = 300  # of L-BFGS


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
    motion, model, energy = clip_of(options, clip, subject), subject.model, subject.energy
    validator = subject.validator(motion)
    bank, direction, frame = validator.bank, validator.down[None], torch.zeros(1, dtype=torch.int64)
    objective, character = Objective(model, energy, subject.body, bank), bank.character(frame)
    lbs = validator.lbs_vertices(character)
    height = {"gravity": objective.quasi_static_terms(lbs, direction, character)["gravity"]}

    def terms(x: Tensor) -> dict[str, Tensor]:
        values = objective.quasi_static_terms(x, direction, character)
        return {name: value - height.get(name, 0.0) for name, value in values.items()}

    def total(x: Tensor) -> Tensor:
        return torch.stack([*terms(x).values()]).sum(0)

    with torch.no_grad():
        z = model.initial(bank.static_descriptor(frame, direction))
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
        for name, start in (("solver, from P", states["P"]), ("solver, from LBS", lbs)):
            states[name] = simulator.quasi_static(poses, simulator.apply_pins(start, poses)).x
        return {
            name: {
                "energy": float(total(x)),
                **{term: float(terms(x)[term]) for term in TERMS},
                "distance": float((x - states["P"]).square().sum(1).mean().sqrt()),
            }
            for name, x in states.items()
        }


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--poses", type=int, default=4, help="clips whose first pose is measured (default 4)")
    options = parsed(parser)
    lines, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        measured[subject.name] = found = measure(subject, options)
        for state, at in found.items():
            figures = (f"{at[name]:.3f}" for name in ("energy", *TERMS))
            lines.append([subject.name, state, *figures, f"{1000 * at['distance']:.0f}"])
        write_results(options, table(HEADER, lines), measured)


if __name__ == "__main__":
    main()
