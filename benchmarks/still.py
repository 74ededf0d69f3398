# SPDX-License-Identifier: Apache-2.0
"""Stop a moving character and see whether its garment comes to rest, and whether it hangs.

    python benchmarks/still.py cape.safetensors --stage character.usdc --motions FOLDER

A clip plays up to a moment, comes to a stop within a quarter of a second, and its pose is held for five seconds.
The reference is independent of the network: L-BFGS over the vertices themselves, in float64, on the same static
energy (stretch, bending, gravity, collision) with the pinned vertices where the skeleton has them, starting from
where the garment came to rest. What the garment floats is its gravity term above that minimum, as a share of
m g L: its mass, and its height at rest. A garment that floats is not at a minimum, so the search pulls it down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from reports import table, write_results
from subjects import Subject, arguments, clip_of, open_subject, parsed
from timing import stopped
from torch import Tensor

from ssilk_core.assets import PINNED
from ssilk_core.energy import GarmentEnergy
from ssilk_core.energy.collision import PosedBody, signed_distance
from ssilk_core.model.descriptors import GRAVITY
from ssilk_core.training.validation import roll_states

STOPS = (("02_04", 1.7), ("02_04", 3.7), ("02_02", 1.1), ("05_12", 4.0))
HOLD = 5.0  # [s]
CALM = 0.01  # [m/s], RMS over the mass
HEADER = ("garment", "stopped at", "kinetic energy at the stop [J]", "after 1 s", "after 5 s", "calm after [s]",
          "floats, of m g L", "plain skinning floats", "energy over the minimum [J]", "RMS off it [mm]",
          "inside the body", "at the minimum")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Still:
    """The static energy of a garment in one held pose, in float64."""

    energy: GarmentEnergy
    body: PosedBody
    down: Tensor

    def gravity(self, x: Tensor) -> Tensor:
        """Return the gravity term [J] of positions (V, 3, 1)."""
        return self.energy.gravity(x, GRAVITY * self.down)

    def total(self, x: Tensor) -> Tensor:
        """Return the static energy [J] of positions (V, 3, 1)."""
        return self.energy_at(x, signed_distance(x, self.body))

    def energy_at(self, x: Tensor, distance: Tensor) -> Tensor:
        """Return the static energy [J] of positions (V, 3, 1) at given distances to the body (V, 1)."""
        energy = self.energy
        return (energy.stretch(x) + energy.bending(x) + self.gravity(x) + energy.collision_of(distance)).sum()

    def inside(self, x: Tensor) -> float:
        """Return the share of positions (V, 3, 1) that are inside the body."""
        return float((signed_distance(x, self.body) < 0).double().mean())

    def plane(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return normals (V, 3, 1) and offsets (V, 1) of the planes that touch the body nearest to each vertex."""
        x = x.detach().requires_grad_(True)
        distance = signed_distance(x, self.body)
        (normal,) = torch.autograd.grad(distance.sum(), x)
        return normal, (normal * x).sum(1).detach() - distance.detach()

    def minimised(self, x: Tensor, free: Tensor, rounds: int, iterations: int = 100) -> Tensor:
        """Return positions of least static energy found from `x`, moving the vertices `free` alone.

        The planes of the body hold still within a round, so that each round minimises a smooth function.
        """
        moved = x[free].clone().requires_grad_(True)
        for _ in range(rounds):
            search = torch.optim.LBFGS([moved], max_iter=iterations, history_size=30, tolerance_grad=1e-9,
                                       tolerance_change=1e-13, line_search_fn="strong_wolfe")  # fmt: skip
            normal, offset = self.plane(x.index_copy(0, free, moved.detach()))

            def evaluate(
                search: torch.optim.Optimizer = search, normal: Tensor = normal, offset: Tensor = offset
            ) -> Tensor:
                search.zero_grad()
                at = x.index_copy(0, free, moved)
                loss = self.energy_at(at, (normal * at).sum(1) - offset)
                loss.backward()
                return loss

            search.step(evaluate)
        return x.index_copy(0, free, moved.detach())


def rolled(subject: Subject, clip: str, stop: float, options: Any) -> tuple[Tensor, Tensor, PosedBody]:
    """Return positions (V, 3, N) [m] while the pose is held, plain skinning's (V, 3, 1), and the body then."""
    motion, first = stopped(clip_of(options, clip, subject), subject.file.config.fps, stop, HOLD)
    validator = subject.validator(motion)
    bank, frames = validator.bank, torch.arange(motion.frame_count)
    with torch.no_grad():
        z = roll_states(subject.model, bank, [range(motion.frame_count)], validator.down)[0][first - 1 :]
        x = subject.model.vertices(z, bank.character(frames[first - 1 :]))
    last = bank.character(frames[-1:])
    posed = subject.body.posed(last)
    body = PosedBody(posed.points.double(), posed.normals.double(), posed.rings)
    return x.double(), validator.plain_vertices(last).double(), body


def measure(subject: Subject, clip: str, stop: float, options: Any) -> dict[str, float]:
    """Return the figures of one stop."""
    mesh, fps = subject.scene.garment.mesh, subject.file.config.fps
    energy = GarmentEnergy(mesh, subject.file.fabric, dtype=torch.float64)
    x, plain, body = rolled(subject, clip, stop, options)
    kinetic = energy.mass @ (x.diff(dim=-1) * fps).square().sum(1) / 2
    speed = (2 * kinetic / energy.mass.sum()).sqrt()
    moving = (speed > CALM).nonzero()
    still = Still(energy, body, torch.tensor([[0.0], [-1.0], [0.0]], dtype=torch.float64))
    free = torch.as_tensor((subject.scene.classes != PINNED).nonzero()[0])
    held = x[..., -1:]
    best = still.minimised(held, free, options.rounds)
    weight = float(energy.mass.sum()) * GRAVITY * float(mesh.points[:, 1].max() - mesh.points[:, 1].min())
    distance = energy.mass @ (held - best).square().sum(1)[:, 0] / energy.mass.sum()
    return {
        "kinetic at the stop [J]": float(kinetic[0]),
        "kinetic after 1 s [J]": float(kinetic[round(fps)]),
        "kinetic after 5 s [J]": float(kinetic[-1]),
        "calm after [s]": (int(moving[-1]) + 1) / fps if len(moving) else 0.0,
        "floats [m g L]": float(still.gravity(held) - still.gravity(best)) / weight,
        "plain floats [m g L]": float(still.gravity(plain) - still.gravity(best)) / weight,
        "over the minimum [J]": float(still.total(held) - still.total(best)),
        "distance [m]": float(distance.sqrt()),
        "inside": still.inside(held),
        "inside at the minimum": still.inside(best),
    }


def row(garment: str, where: str, found: dict[str, float]) -> list[str]:
    """Return one line of the table."""
    start, second, end, calm, floats, plain, over, distance, *inside = found.values()
    calm_text = f"{calm:.2f}" if calm < HOLD else "never"
    return [garment, where, f"{start:.2e}", f"{second:.2e}", f"{end:.2e}", calm_text, f"{floats:.2%}", f"{plain:.2%}",
            f"{over:.4f}", f"{1000 * distance:.0f}", *(f"{share:.2%}" for share in inside)]  # fmt: skip


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--rounds", type=int, default=40, help="of 100 iterations of L-BFGS (default 40)")
    options = parsed(parser)
    rows, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        for clip, stop in STOPS:
            where = f"{clip}, {stop:g} s"
            measured[f"{subject.name} {where}"] = found = measure(subject, clip, stop, options)
            rows.append(row(subject.name, where, found))
            print(table(HEADER, rows), flush=True)
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
