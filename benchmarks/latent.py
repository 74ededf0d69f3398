# SPDX-License-Identifier: Apache-2.0
"""Time the solver in latents on a garment that ships, in motions of the demo, with growing numbers of iterations.

    OMP_NUM_THREADS=1 python benchmarks/latent.py --garment cape --threads 1
    python benchmarks/latent.py --device cuda --motion walk --elements chosen --shots 1 16 64 256

All shots of a motion are solved at once, each a frame later in the motion than the one before; those that would not
end within the motion begin again at the first one. Times are those of a frame of one shot, in processor time on a
processor: medians over frames, without the first two. What it takes to choose elements for a motion comes before the
first frame ("begins"). Energies are means over frames and shots, of the best start, and as solved, on the elements
that the solver has; each row has its own past, so rows differ in these.
"Whole" is the first shot's on all elements, of the same states. "Left" is the share of the gain that the solver's own
prediction has still left. The first row of a motion is the network; "all" rows solve for the whole garment. With
--simulate the simulator goes through the first shot, and RMS distances from it, after five frames and at the end, are
told; a frame of a cape takes it seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from helpers.reports import table
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path
from torch import Tensor

from ssilk_core.demo.motions import MOTIONS, build_motion
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.devices import select_device
from ssilk_core.network.checkpoint import ModelFile, load_model, network
from ssilk_core.network.latent_solver import LatentOptions
from ssilk_core.network.latent_solver.roller import LatentTally
from ssilk_core.network.latent_solver.shots import LatentShots
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.physics.simulate import SimulationOptions, simulate
from ssilk_core.physics.simulate.history import StepHistory
from ssilk_core.scene.assets import Floats, Motion

HEADER = ("motion", "shots", "elements", "iterations", "begins [s]", "ms a frame and shot", "energy before [J]",
          "energy [J]", "whole [J]", "inside [%]", "left", "not converged", "failed",
          "from the simulator [mm]")  # fmt: skip
SHOWN = 5, -1  # frames whose distances are told


def rms(points: Floats, reference: Floats | None) -> str:
    """Return RMS distances of vertices from the simulator's in two frames [mm], where there are any."""
    if reference is None:
        return ""
    apart = 1000 * np.sqrt(((points - reference) ** 2).sum(axis=-1).mean(axis=1))
    return ", ".join(f"{apart[frame]:.0f}" for frame in SHOWN)


def on_all_elements(solver: LatentShots, shot: Motion, states: Sequence[Tensor]) -> tuple[Floats, float, float]:
    """Return the vertices of a shot's states (F, V, 3) [m], their mean energy [J], and the share inside the body."""
    simulator, potential, past = solver.simulator, solver.simulator.potential, None
    points, figures = [], []
    for number, z in enumerate(states):
        at = slice(number, number + 1)
        poses = simulator.poser.pose(shot.rotations[at], shot.translations[at])
        inputs = simulator.inputs(poses, past)
        x = solver.solver.decode(z, poses.matrices, inputs)
        distance = potential.body_distance(x, inputs)
        figures.append((float(potential.energy(x, inputs, distance)), float(potential.inside(x, distance))))
        past = StepHistory(x.double() + poses.root, past.last if past else None, poses.root, poses.lbs)
        points.append(past.last[..., 0].cpu().numpy())
    energy, inside = np.mean(figures, axis=0)
    return np.stack(points), float(energy), float(inside)


def rows(
    model: GarmentModel,
    file: ModelFile,
    shots: Sequence[Motion],
    tried: Sequence[LatentOptions],
    reference: Floats | None,
) -> Iterator[tuple[str, ...]]:
    """Yield the network's row, then one for each of the options."""
    name, first = shots[0].path, shots[0]
    played = np.concatenate([decode(model, first, pose) for pose in garment_poses(model, first, first.fps)])
    yield name, "", "", "network", *[""] * (len(HEADER) - 5), rms(played, reference)
    clock = time.perf_counter if next(model.parameters()).is_cuda else time.process_time
    for options in tried:
        solver, tally = LatentShots(model, file.fabric, options), LatentTally()
        states, ends = [], [clock()]
        for frame in solver.frames(shots):
            tally.add(frame)
            states.append(frame.solution.z[:1])
            ends.append(clock())
        points, whole, inside = on_all_elements(solver, first, states)
        yield (
            name,
            str(len(shots)),
            "chosen" if options.sampled else "all",
            str(options.iterations),
            f"{ends[1] - ends[0]:.1f}",
            f"{1000 * float(np.median(np.diff(ends[2:]))) / len(shots):.3g}",
            f"{tally.mean('start_energy'):.4f}",
            f"{tally.mean('energy'):.4f}",
            f"{whole:.4f}",
            f"{100 * inside:.2f}",
            f"{tally.mean('left_share'):.3f}",
            f"{tally.unconverged} of {tally.frames}",
            str(tally.failed),
            rms(points, reference),
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garment", default="cape", help="garment that ships (default cape)")
    parser.add_argument("--motion", nargs="+", choices=MOTIONS, default=["walk", "cartwheel"], help="of the demo")
    parser.add_argument("--first", type=int, default=20, help="first frame of the first shot (default 20)")
    parser.add_argument("--frames", type=int, default=30, help="of each shot (default 30)")
    parser.add_argument("--shots", type=int, nargs="+", default=[1], help="solved at once (default 1)")
    parser.add_argument("--iterations", type=int, nargs="+", default=[1, 2, 4], help="of the solver (default 1 2 4)")
    parser.add_argument("--elements", nargs="+", choices=("all", "chosen"), default=["all", "chosen"])
    parser.add_argument("--simulate", action="store_true", help="tell distances from the simulator")
    parser.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    parser.add_argument("--threads", type=int, default=1, help="processor threads (default 1)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    character, file = read_character(demo_body_path()), load_model(shipped_path(options.garment))
    scene, device = replace(file.scene, character=character), select_device(options.device)
    model = network(file, scene).to(device)
    found: list[tuple[str, ...]] = []
    tried = [
        LatentOptions(iterations=count, sampled=kind == "chosen")
        for count in options.iterations
        for kind in options.elements
    ]
    for name in options.motion:
        whole = build_motion(name, character.skeleton)
        starts = max(1, whole.frame_count - options.first - options.frames + 1)
        clips = [whole.clip(options.first + start, options.first + start + options.frames) for start in range(starts)]
        clips, reference = [replace(clip, path=name) for clip in clips], None
        if options.simulate:
            reference = simulate(scene, file.fabric, clips[:1], SimulationOptions(fps=clips[0].fps), device=device)[0]
        for count in options.shots:
            shots = [clips[number % len(clips)] for number in range(count)]
            found.extend(rows(model, file, shots, tried, reference))
    print(table(HEADER, found))


if __name__ == "__main__":
    main()
