# SPDX-License-Identifier: Apache-2.0
"""Time the reference simulator, and hold its energies against L-BFGS on the very same frames.

    python benchmarks/simulate.py cape.usdc --motions FOLDER --device cuda --batch 1 16 64

Shots are stretches of the clips, side by side; the quasi-static start is not timed. L-BFGS (PyTorch's, strong Wolfe)
minimises each compared frame of the first shot from the same start, in float64, in rounds between which the nearest
body points are found anew; its table rows are budgets of iterations. Energies are means over the compared frames,
with the nearest body points of the final states.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from helpers.clock import now
from helpers.reports import table, write_results
from helpers.subjects import parsed
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene
from torch import Tensor

from ssilk_core.authoring.setup.prepare import prepare_scene
from ssilk_core.devices import select_device
from ssilk_core.events import TextReporter
from ssilk_core.physics.simulate import SimulationOptions, Simulator
from ssilk_core.physics.simulate.characters import PosedCharacters
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.physics.simulate.newton import Search, Solution, SolverOptions
from ssilk_core.physics.simulate.simulator import PosesAt, Stepped
from ssilk_core.scene.assets import Motion, Scene
from ssilk_core.scene.fabrics import Fabric

HEADER = ("method", "shots at once", "ms per frame and shot", "iterations", "of conjugate gradients",
          "out of balance, median [g]", "within the tolerance", "energy [J]")  # fmt: skip
ROUND = 50  # iterations of L-BFGS between looks at the body


class Watched(Simulator):
    """A simulator that keeps all solutions, and every problem of the first shot, and times the steps."""

    def __init__(self, scene: Scene, options: SimulationOptions, device: torch.device) -> None:
        super().__init__(scene, Fabric("default"), options, device=device)
        self.seconds = 0.0
        self.problems: list[tuple[Tensor, StepInputs]] = []
        self.solutions: list[Solution] = []
        self.first: list[Solution] = []

    def search(self, poses: PosedCharacters, past: StepHistory, numbers: Sequence[int], dt: float | Tensor) -> Search:
        """Begin with steps of shots."""
        found = super().search(poses, past, numbers, dt)
        if 0 in numbers:
            row = torch.tensor([list(numbers).index(0)], device=found.residual.device)
            self.problems.append((found.state.x[..., row], found.inputs.select(row)))
        return found

    def carry_on(self, past: Iterable[StepHistory], steps: Sequence[range], poses_at: PosesAt) -> Iterator[Stepped]:
        """Take the steps of shots; what is at rest before is not timed."""
        device = self.poser.rest.device
        begun = now(device)
        for each in super().carry_on(past, steps, poses_at):
            self.solutions.append(each.solution)
            if each.shot == 0:
                self.first.append(each.solution)
            yield each
        self.seconds += now(device) - begun


def shots(motions: Sequence[Motion], count: int, frames: int, fps: float) -> list[Motion]:
    """Return `count` stretches of so many frames, spread over the clips in turn."""
    found: list[Motion] = []
    step = 0
    while len(found) < count:
        for motion in motions:
            length = round(frames * motion.fps / fps)
            start = step * length
            if start + length <= motion.frame_count:
                found.append(motion.clip(start, start + length))
        step = step + 1 if any((step + 2) * frames * m.fps / fps <= m.frame_count for m in motions) else 0
    return found[:count]


def newton(scene: Scene, motions: Sequence[Motion], count: int, options: argparse.Namespace) -> Watched:
    """Simulate `count` shots at once."""
    settings = SimulationOptions(
        batch=count, precision=options.precision, solver=SolverOptions(tolerance=options.tolerance)
    )
    simulator = Watched(scene, settings, select_device(options.device))
    for _ in simulator.frames(shots(motions, count, options.frames, settings.fps)):
        pass
    return simulator


def newton_figures(simulator: Watched, count: int) -> dict[str, Any]:
    """Return the figures of one run; energies are those of the first shot."""
    residual = torch.cat([s.residual for s in simulator.solutions])
    return {
        "shots": count,
        "seconds": simulator.seconds / len(simulator.solutions),
        "iterations": float(torch.cat([s.iterations for s in simulator.solutions]).double().mean()),
        "cg_iterations": float(torch.cat([s.cg_iterations for s in simulator.solutions]).double().mean()),
        "residual": float(residual.median()),
        "solved": float((residual <= simulator.options.solver.tolerance).double().mean()),
        "energy": sum(float(s.energy) for s in simulator.first) / len(simulator.first),
    }


def by_lbfgs(potential: IncrementalPotential, start: Tensor, inputs: StepInputs, iterations: int) -> Tensor:
    """Return the lowest state that L-BFGS passes at the ends of its rounds, (V, 3, 1)."""
    free, best, lowest = potential.free, start, torch.inf
    moved = start[free].clone().requires_grad_(True)
    for _ in range(max(1, iterations // ROUND)):
        body_distance = potential.body_distance(start.index_copy(0, free, moved.detach()), inputs)
        search = torch.optim.LBFGS([moved], max_iter=min(ROUND, iterations), history_size=20, tolerance_grad=1e-9,
                                   tolerance_change=1e-14, line_search_fn="strong_wolfe")  # fmt: skip

        def evaluate(search: torch.optim.Optimizer = search, body_distance: Any = body_distance) -> Tensor:
            search.zero_grad()
            value = potential.energy(start.index_copy(0, free, moved), inputs, body_distance).sum()
            value.backward()
            return value

        search.step(evaluate)
        x = start.index_copy(0, free, moved.detach())
        energy = float(potential.energy(x, inputs, potential.body_distance(x, inputs)))
        best, lowest = (x, energy) if energy < lowest else (best, lowest)
    return best


def lbfgs_figures(simulator: Watched, iterations: int, frames: int) -> dict[str, Any]:
    """Return the figures of L-BFGS on the first frames of the first shot."""
    potential, problems = simulator.potential, simulator.problems[:frames]
    begun = now(potential.free.device)
    states = [by_lbfgs(potential, start, inputs, iterations) for start, inputs in problems]
    seconds = (now(potential.free.device) - begun) / len(problems)
    energy, residual = [], []
    for x, (_, inputs) in zip(states, problems):
        body_distance = potential.body_distance(x, inputs)
        energy.append(float(potential.energy(x, inputs, body_distance)))
        residual.append(float(potential.residual(potential.gradient(x, inputs, body_distance))))
    tolerance = simulator.options.solver.tolerance
    return {
        "shots": 1,
        "seconds": seconds,
        "iterations": iterations,
        "residual": float(torch.tensor(residual).median()),
        "solved": sum(value <= tolerance for value in residual) / len(residual),
        "energy": sum(energy) / len(energy),
    }


def row(method: str, found: dict[str, Any]) -> list[str]:
    """Return one line of the table."""
    cg_iterations = f"{found['cg_iterations']:.0f}" if "cg_iterations" in found else ""
    return [method, str(found["shots"]), f"{1000 * found['seconds']:.1f}", f"{found['iterations']:.1f}",
            cg_iterations, f"{found['residual']:.1e}",
            f"{found['solved']:.0%}", f"{found['energy']:.6f}"]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stage", type=Path, help="USD file with character and garment")
    parser.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
    parser.add_argument("--clips", nargs="+", default=["02_04"], help="their names (default 02_04)")
    parser.add_argument("--frames", type=int, default=30, help="of each shot (default 30)")
    parser.add_argument("--batch", type=int, nargs="+", default=[1], help="shots at once (default 1)")
    parser.add_argument("--lbfgs", type=int, nargs="*", default=[100, 1000], help="budgets (default 100 1000)")
    parser.add_argument("--compared", type=int, default=10, help="frames that L-BFGS minimises too (default 10)")
    parser.add_argument("--tolerance", type=float, default=1e-2, help="[g] (default 0.01)")
    parser.add_argument("--precision", default="float64", help="float64 (default) or float32")
    parser.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    parser.add_argument("--name", help="of the result files (default: the script's)")
    options = parsed(parser)
    scene = prepare_scene(*read_scene(options.stage), report=TextReporter())
    motions = [read_motion(options.motions / f"{clip}.usdc", scene.character.skeleton) for clip in options.clips]
    rows, measured = [], {}
    for count in options.batch:
        simulator = newton(scene, motions, count, options)
        measured[f"newton {count}"] = found = newton_figures(simulator, count)
        rows.append(row("Newton", found))
        print(table(HEADER, rows), flush=True)
    compared = simulator.first[: options.compared]
    energy = sum(float(s.energy[0]) for s in compared) / len(compared)
    measured["newton compared"] = found = {**measured[f"newton {count}"], "energy": energy}
    rows.append(row("Newton, compared frames", found))
    for budget in options.lbfgs:
        measured[f"lbfgs {budget}"] = found = lbfgs_figures(simulator, budget, options.compared)
        rows.append(row(f"L-BFGS, {budget} iterations", found))
        print(table(HEADER, rows), flush=True)
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
