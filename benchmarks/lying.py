# SPDX-License-Identifier: Apache-2.0
"""How far P's states are from the least energy that the latents reach, where bodies are turned over.

    python benchmarks/lying.py cape.safetensors --stage character.usdc --motions FOLDER --index FOLDER/index.json

Poses of a split are drawn and turned over at random, as in training (`training.obstacles`). Of those that training
would lay on a floor, the energy of P's state is compared with the least that L-BFGS finds from there over latents
within their bound: with the floor, and in the same poses without it.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from static_states import energy_of, least
from torch import Tensor

from ssilk_core.network.descriptors import place_of_hub
from ssilk_core.quality.evaluation.splits import read_index
from ssilk_core.training.motion_bank import MotionBank
from ssilk_core.training.objective import Objective
from ssilk_core.training.obstacles import LARGE, ObstacleDrawer, Obstacles
from ssilk_core.training.windows import random_directions

HEADER = ("garment", "split", "floor", "P [J]", "least [J]", "apart, mean [J]", "median [J]", "median [mm]")
NEVER = 1e-9  # share of other obstacles


def measure(subject: Subject, options: Namespace) -> dict[str, dict[str, float]]:
    """Return the figures with and without a floor; energies are means over poses."""
    clips = [entry.clip for entry in read_index(options.index) if entry.split == options.split]
    validator = subject.validator(*(clip_of(options, clip, subject) for clip in clips))
    bank, generator = validator.bank, torch.Generator().manual_seed(options.seed)
    hub = place_of_hub(subject.scene.character.skeleton, subject.model.joints)
    drawer = ObstacleDrawer(subject.model, bank, hub, NEVER, generator)
    objective = Objective(subject.model, subject.energy, subject.body, bank, drawer=drawer)
    frames = torch.randint(bank.frame_count, (4 * options.poses,), generator=generator)
    gravity = random_directions(len(frames), 1.0, generator, torch.device("cpu"))
    drawn = drawer.draw(frames[None], gravity)
    lies = (drawn.radius[0] > -LARGE).nonzero()[: options.poses, 0]
    floors = Obstacles(*(part[:, lies] for part in drawn.parts))
    frames, gravity = frames[lies], gravity[lies]
    lbs = validator.lbs_vertices(bank.character(frames))
    return {
        name: _compared(subject, objective, bank, frames, gravity, lbs, given)
        for name, given in (("yes", floors), ("no", None))
    }


def _compared(
    subject: Subject,
    objective: Objective,
    bank: MotionBank,
    frames: Tensor,
    gravity: Tensor,
    lbs: Tensor,
    floors: Obstacles | None,
) -> dict[str, float]:
    model, character, bound = subject.model, bank.character(frames), subject.model.config.latent_bound
    seen, drawer = bank.static_descriptor(frames, gravity), objective.drawer
    if floors and drawer:
        seen = torch.cat([drawer.seen(drawer.near(floors, frames, gravity), frames), seen], dim=1)
    height = objective.quasi_static_terms(lbs, gravity, character)["gravity"]

    def energy(x: Tensor) -> Tensor:
        return energy_of(objective.quasi_static_terms(x, gravity, character, obstacles=floors)) - height

    def decoded(free: Tensor) -> Tensor:
        return model.vertices(bound * torch.tanh(free / bound), character)

    with torch.no_grad():
        z = model.initial(seen)
        rest = model.vertices(z, character)
    free = least(bound * torch.atanh((z / bound).clamp(-0.99, 0.99)), lambda given: energy(decoded(given)))
    with torch.no_grad():
        best = decoded(free)
        own, lowest = energy(rest), energy(best)
    apart = (rest - best).square().sum(1).mean(0).sqrt()
    return {
        "P": float(own.mean()),
        "least": float(lowest.mean()),
        "mean": float((own - lowest).mean()),
        "median": float((own - lowest).median()),
        "distance": float(apart.median()),
    }


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--split", default="valid", help="of the clips (default valid)")
    parser.add_argument("--poses", type=int, default=24, help="that lie on a floor (default 24)")
    parser.add_argument("--seed", type=int, default=0, help="of the poses (default 0)")
    options = parsed(parser)

    def rows(garment: str, found: dict[str, dict[str, float]]) -> list[list[str]]:
        return [
            [garment, options.split, floor, *(f"{at[name]:.3f}" for name in ("P", "least", "mean", "median")),
             f"{1000 * at['distance']:.0f}"]
            for floor, at in found.items()
        ]  # fmt: skip

    measure_each(options, HEADER, measure, rows)


if __name__ == "__main__":
    main()
