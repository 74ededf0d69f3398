# SPDX-License-Identifier: Apache-2.0
"""How the network follows wind: the hem beside the simulator's in even winds and in gusts, and pictures of it.

    python benchmarks/wind.py hem --motion FOLDER/02_01.usdc --simulation winds.npz --device cuda
    python benchmarks/wind.py look --motion FOLDER/02_01.usdc --wind 0,0,-4 --simulation look.npz -o s.png
    python benchmarks/wind.py gusts --motion FOLDER/06_05.usdc --frames 96 --wind 0,0,-5 --gusts 4,6 --azimuth 205
        --simulation gusts.npz --film docs/images/cape_gusts.mp4 --chart docs/images/cape_gusts.png

`hem` plays the first --frames of a motion in still air that moves along, and in winds from ahead, from behind and
from one side, in the world's axes, at each speed. The wind blows from the first frame on, in which the garment is at
rest in it. Told are how far the lowest tenth of the loose vertices is moved by it on average, in the simulator and in
the network, and by what share of the simulator's mean displacement the network's differs from it, as vectors: in
all frames, and in the second half, since the simulator does not find its rest in strong wind.
`look` draws network and simulator side by side. `gusts` does so in a wind with gusts, and tells by how much the gusts
move the hem beside the even wind: from frame to frame, as the mean of its vertices. --simulation is read, or written
where there is no such file, so that a GPU can write it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from helpers.pictures import add_pictures, draw_rows, simulated_worlds
from helpers.reports import table
from helpers.subjects import Subject, open_subject
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.stages import demo_body_path

from ssilk_core.delivery.bake.world import parse_world
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.events import Reporter, TextReporter
from ssilk_core.network.runtime import Player
from ssilk_core.physics.world.felt import felt_gravity
from ssilk_core.quality.charts import ChartPanel, write_chart
from ssilk_core.scene.assets import LOOSE, Air, Floats, Ints, Motion, ShotWorld
from ssilk_core.scene.kinematics import resample

SIDES = {"ahead": (0.0, 0.0, -1.0), "behind": (0.0, 0.0, 1.0), "side": (1.0, 0.0, 0.0)}
AXES = ("across the walk, x", "up, y", "along the walk, z")
HEM = 0.1  # of the loose vertices


def played(subject: Subject, motion: Motion, world: ShotWorld | None) -> Floats:
    """Return the network's positions in a world [m], shape (F, V, 3)."""
    felt = felt_gravity(world, motion, subject.scene, subject.file.fabric)
    playback = Player(subject.file).play(replace(motion, gravity=felt))
    return np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])


def hem_of(subject: Subject) -> Ints:
    """Return the lowest of the loose vertices at rest, shape (P,)."""
    loose = np.flatnonzero(subject.scene.classes == LOOSE)
    return loose[np.argsort(subject.scene.garment.mesh.points[loose, 1])[: round(HEM * len(loose))]]


def hem(options: argparse.Namespace, subject: Subject, motion: Motion, report: Reporter) -> None:
    """Print how far each wind moves the hem."""
    lowest = hem_of(subject)
    winds = [(speed, side) for speed in options.speeds for side in SIDES]
    blown = [Air(speed * np.array([SIDES[side]]), np.zeros(1)) for speed, side in winds]
    worlds = [None, *(ShotWorld(motion.fps, air=air) for air in blown)]
    still, *solved = simulated_worlds(options.simulation, subject, motion, worlds, report)
    calm, rows = played(subject, motion, None), []
    for (speed, side), world, points in zip(winds, worlds[1:], solved):
        wanted, found = (points - still)[:, lowest], (played(subject, motion, world) - calm)[:, lowest]
        sizes = (f"{np.linalg.norm(each, axis=-1).mean():.2f}" for each in (wanted, found))
        late = len(wanted) // 2
        shares = (apart(wanted, found), apart(wanted[late:], found[late:]))
        rows.append([f"{speed:g}", side, *sizes, *(f"{100 * share:.0f}" for share in shares)])
    heads = ["wind [m/s]", "from", "simulator [m]", "network [m]", "apart [%]", "in the second half [%]"]
    print(table(heads, rows))


def apart(wanted: Floats, found: Floats) -> float:
    """Return how far two mean displacements are from each other, as a share of the first."""
    mean, other = wanted.mean((0, 1)), found.mean((0, 1))
    return float(np.linalg.norm(other - mean) / np.linalg.norm(mean))


def look(options: argparse.Namespace, subject: Subject, motion: Motion, report: Reporter) -> None:
    """Draw network and simulator side by side in one wind."""
    world = blown_world(options, motion)
    solved = simulated_worlds(options.simulation, subject, motion, [world], report)[0]
    rows = {
        "simulator": solved,
        "network": played(subject, motion, world),
        "network, no wind": played(subject, motion, None),
    }
    draw_rows(rows, subject.dressed, motion, options, report)


def gusts(options: argparse.Namespace, subject: Subject, motion: Motion, report: Reporter) -> None:
    """Print how far gusts move the hem beside the even wind, frame by frame, and draw network and simulator."""
    gusty = blown_world(options, motion)
    assert gusty.air is not None
    worlds = [None, replace(gusty, air=replace(gusty.air, gusts=np.zeros(1))), gusty]
    simulated = simulated_worlds(options.simulation, subject, motion, worlds, report)
    network, lowest = np.stack([played(subject, motion, world) for world in worlds]), hem_of(subject)
    rows = []
    for name, one, other in (("wind", 1, 0), ("wind and gusts", 2, 0), ("gusts", 2, 1)):
        moved = [(each[one] - each[other])[:, lowest] for each in (simulated, network)]
        sizes = (f"{np.linalg.norm(each, axis=-1).mean():.2f}" for each in moved)
        rows.append([name, *sizes, f"{100 * apart(*moved):.0f}" if other == 0 else "–"])
    print(table(["moved by", "simulator [m]", "network [m]", "apart [%]"], rows) + "\n")
    wanted, own = (each.mean(axis=1) for each in moved)
    alike = [np.corrcoef(wanted[:, axis], own[:, axis])[0, 1] for axis in range(3)]
    each = zip(AXES, wanted.std(axis=0), own.std(axis=0), alike)
    rows = [[axis, *(f"{value:.2f}" for value in values)] for axis, *values in each]
    print(table(["hem by the gusts", "simulator, deviation [m]", "network [m]", "correlation"], rows))
    if options.chart:
        seconds = np.arange(len(wanted)) / motion.fps
        panels = [
            ChartPanel(
                x="time [s]", y=f"{axis} [m]",
                curves={"simulator": (seconds, wanted[:, at]), "network": (seconds, own[:, at])},
            )
            for at, axis in enumerate(AXES)
        ]  # fmt: skip
        write_chart(options.chart, [panels], size=(3.2, 2.2))
    draw_rows({"simulator": simulated[2], "network": network[2]}, subject.dressed, motion, options, report)


def blown_world(options: argparse.Namespace, motion: Motion) -> ShotWorld:
    """Return the air that options ask for."""
    wind, turbulence, _ = parse_world(options.wind, options.gusts, None)
    speed, size, seed = turbulence or (0.0, 2.0, 0)
    air = Air(np.array([wind or (0.0, 0.0, 0.0)]), np.array([speed]), length=size, seed=seed)
    return ShotWorld(motion.fps, air=air)


def main() -> None:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("what", choices=list(TASKS))
    found.add_argument("--model", type=Path, default=shipped_path("cape"), metavar="FILE")
    found.add_argument("--stage", type=Path, default=demo_body_path(), help="USD file with the character")
    found.add_argument("--motion", type=Path, required=True, help="a motion file")
    found.add_argument("--frames", type=int, default=40, help="of the motion, at the model's rate (default 40)")
    found.add_argument("--speeds", type=float, nargs="+", default=[2, 5, 10, 20], help="[m/s] (default 2 5 10 20)")
    found.add_argument("--wind", help="X,Y,Z [m/s] in the world, y up")
    found.add_argument("--gusts", help="RMS[,SIZE[,SEED]]")
    found.add_argument("--simulation", type=Path, required=True, metavar="NPZ", help="positions, read or written")
    found.add_argument("--chart", type=Path, metavar="PNG", help="of the hem in gusts, to write")
    add_pictures(found)
    found.add_argument("--device", default="cpu", help="where the simulator runs (default cpu)")
    options = found.parse_args()
    torch.set_num_threads(2)
    subject = open_subject(options.model, options.stage, options.device)
    motion = resample(read_motion(options.motion, subject.scene.character.skeleton), subject.file.config.fps)
    TASKS[options.what](options, subject, motion.clip(0, options.frames), TextReporter())


TASKS = {"hem": hem, "look": look, "gusts": gusts}

if __name__ == "__main__":
    main()
