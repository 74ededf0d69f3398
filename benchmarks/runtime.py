# SPDX-License-Identifier: Apache-2.0
"""Time playing a trained garment on one processor thread, every way there is, and Blender's cloth on the same shot.

    OMP_NUM_THREADS=1 python benchmarks/runtime.py cape.safetensors --stage character.usdc --motions FOLDER \\
        --threads 1 --bpy BPY_PYTHON

As in the paper's Table 3, the networks, the kinematics, and blendshapes with skinning are told apart; besides, what
depends on the character's poses alone, which a player computes for blocks of frames. Each repeat plays a whole clip,
the ways in turn; times are processor times of a repeat divided by its frames. "Frame by frame" is how the papers run
PyTorch; "in chunks" is what `ssilk bake` does. Levels of quality are those of `ssilk reduce --quality` for this clip.
"Products alone" are the products of a frame's matrices without anything between them, the least that its network can
take while weights are single precision. How cost grows with mesh and network is measured on a synthetic cloak.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from helpers import synthetic
from helpers.playing import BLOCK, PARTS, SKINNING, TOTALS, Times, measured, spread, ways, with_numpy
from helpers.reports import table, write_results
from helpers.subjects import arguments, open_subject, parsed
from ssilk_usd.reading.motion import read_motion

from ssilk_core.errors import fail
from ssilk_core.network.checkpoint import ModelFile, model_file
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.runtime import Player
from ssilk_core.network.settings import ModelConfig
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.quality.reduction import Reducer
from ssilk_core.scene.assets import PINNED, Motion, Scene
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import motion_transforms, resample, skin_points, skinning_matrices

VERTICES = (500, 2_500, 10_000, 30_000, 100_000)
NETWORKS = ((32, (128, 128)), (64, (256, 256)), (128, (256, 256, 256)), (128, (256, 512, 512)))
GROWTH_FRAMES = 64
ALL, CHUNKS = {"in chunks": BLOCK, "frame by frame": 1}, {"in chunks": BLOCK}
CLOTH, LIVE = (Path(__file__).parent / "helpers" / f"blender_{name}.py" for name in ("cloth", "live"))


def times_table(found: Times) -> str:
    rows = [
        [row, *(f"{found[name][row][0]:,.1f} ({found[name][row][1]:,.1f})" for name in found)]
        for row in (*PARTS, *TOTALS)
    ]
    return table(("µs per frame: median (95th percentile)", *found), rows)


def levels(file: ModelFile, motion: Motion, repeats: int) -> tuple[dict[str, Times], str]:
    """Measure the whole model and its levels of quality with numpy; return times, and a table with what they lose."""
    reducer, found, rows = Reducer(file, [motion]), {}, []
    for level in ("", *QUALITIES):
        reduced = reducer.reduce(QUALITIES[level].size.within(reducer.whole) if level else reducer.whole)
        way = partial(with_numpy, Player(reduced.file))
        found[level or "whole"] = measured({"numpy": way}, motion, repeats)
        taken = found[level or "whole"]["numpy"]
        shown = [f"{taken[row][0]:.1f}" for row in ("+ kinematics", SKINNING, "full, poses included")]
        rows.append([level or "whole", *shown, f"{1e3 * reduced.rms:.2f}", f"{1e3 * reduced.largest:.1f}"])
    header = ("level", "network and kinematics", SKINNING, "full", "loses [mm RMS]", "at most [mm]")
    return found, table(header, rows)


def products(player: Player) -> tuple[dict[str, float], str]:
    """Return the medians [us] per frame of the products of matrices of stepper and decoder alone, and a sentence."""
    stepper, decoder = player.stepper, player.decoder.layers
    assert stepper is not None
    steps = [(np.ones(len(rows), np.float32), rows, np.empty(rows.shape[1], np.float32))
             for rows in (stepper.first, *(layer.rows for layer in stepper.later))]  # fmt: skip
    blocks = [(layer.weights, np.ones((layer.weights.shape[1], BLOCK), np.float32)) for layer in decoder]
    ways = {"latents": lambda: [np.dot(*each) for each in steps],
            "decoder": lambda: [weights @ seen for weights, seen in blocks]}  # fmt: skip
    found = {name: _median(way) / (1 if name == "latents" else BLOCK) for name, way in ways.items()}
    size = sum(rows.nbytes for _, rows, _ in steps) / 1e6
    text = f"Products alone: latents {found['latents']:.1f} µs ({size:.1f} MB of weights for each frame), decoder "
    return found, text + f"{found['decoder']:.1f} µs (in blocks of {BLOCK} frames)\n"


def _median(way: Callable[[], object]) -> float:
    """Return the median processor time [us] of a call, in tens."""
    taken = []
    for _ in range(100):
        start = time.process_time()
        for _ in range(10):
            way()
        taken.append(1e5 * (time.process_time() - start))
    return float(np.median(taken))


def cloth(scene: Scene, motion: Motion, python: str) -> dict[str, list[float]]:
    """Return median and 95th percentile [us] per frame of Blender's cloth modifier, and of the scene without it."""
    body, skeleton = scene.character.merged_body(), scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    with tempfile.TemporaryDirectory() as folder:
        shot, times = Path(folder) / "shot.npz", Path(folder) / "times.json"
        np.savez(
            shot,
            body=skin_points(body.mesh.points, body.skin, matrices) @ z_up.T,
            body_faces=body.mesh.faces,
            garment=skin_points(scene.garment.mesh.points, scene.lbs_skin, matrices) @ z_up.T,
            garment_faces=scene.garment.mesh.faces,
            pinned=np.flatnonzero(scene.classes == PINNED),
            fps=motion.fps,
        )
        subprocess.run([python, str(CLOTH), str(shot), str(times)], check=True)
        found = json.loads(times.read_text())
    if not found["moved"] > 0.01:
        fail(python, f"Blender's cloth moved by {found['moved']:.3g} m", "it must move")
    without = np.median(found["without"])
    return {
        "cloth modifier": spread(np.array(found["with"][1:]) - without),
        "body and caches without it": spread(found["without"][1:]),
    }


def live(path: Path, python: str) -> dict[str, list[float]]:
    """Return median and 95th percentile [us] per frame of what the extension does in Blender to play a model live."""
    with tempfile.TemporaryDirectory() as folder:
        times = Path(folder) / "times.json"
        subprocess.run([python, str(LIVE), str(path), str(times)], check=True)
        return {"live playback, the extension's part": spread(json.loads(times.read_text())["show"])}


def cloak(vertices: int, config: ModelConfig) -> tuple[GarmentModel, Motion]:
    """Return an untrained network on a cloak, and a motion."""
    size = synthetic.Size(
        vertices=vertices, body=600, proxies=20, shapes=config.shapes, batch=1, window=3, static_batch=0
    )
    scene = synthetic.scene(size)
    model = GarmentModel(scene, config, np.arange(synthetic.JOINTS))
    return model, synthetic.motion(scene.character.skeleton, config.fps, 0).clip(0, GROWTH_FRAMES)


def mesh_growth(repeats: int) -> dict[int, Times]:
    """Measure networks of the default size on cloaks of more and more vertices."""
    found = {}
    for vertices in VERTICES:
        model, motion = cloak(vertices, ModelConfig())
        found[vertices] = measured(ways(model_file(model, Fabric("default"), {}), CHUNKS), motion, repeats)
    return found


def network_growth(repeats: int) -> dict[str, Times]:
    """Measure larger and larger networks, with numpy, on a cloak of 2,500 vertices."""
    found = {}
    for latent, widths in NETWORKS:
        model, motion = cloak(2500, ModelConfig(latent=latent, widths=widths))
        player = Player(model_file(model, Fabric("default"), {}))
        name = f"{latent}: {', '.join(map(str, widths))}"
        found[name] = measured({"numpy": partial(with_numpy, player)}, motion, repeats)
    return found


def mesh_table(found: dict[int, Times]) -> str:
    columns = [(row, name) for row in (SKINNING, "full, poses included") for name in found[VERTICES[0]]]
    rows = [
        [f"{vertices:,}", *(f"{times[name][row][0]:,.0f}" for row, name in columns)]
        for vertices, times in found.items()
    ]
    return table(("vertices", *(f"{row}: {name}" for row, name in columns)), rows)


def network_table(found: dict[str, Times]) -> str:
    shown = (*PARTS, "+ kinematics", "full, poses included")
    rows = [[name, *(f"{times['numpy'][row][0]:.1f}" for row in shown)] for name, times in found.items()]
    return table(("latent: widths", *shown), rows)


def options_of_run() -> argparse.Namespace:
    """Parse the command line; refuse a run in which numpy may use several threads."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--clip", default="02_04", help="file in the motions' folder (default 02_04)")
    parser.add_argument("--repeats", type=int, default=40, help="of each clip (default 40)")
    parser.add_argument("--bpy", help="Python with the bpy module, to time Blender's cloth too")
    options = parsed(parser)
    threads = os.environ.get("OMP_NUM_THREADS")
    if not (threads == "1" and options.threads == 1):
        fail(
            "benchmarks/runtime.py",
            f"OMP_NUM_THREADS={threads}, --threads {options.threads}",
            "one thread is measured",
            "set both to 1",
        )
    return options


def garment(path: Path, options: argparse.Namespace) -> tuple[str, dict[str, Times]]:
    """Measure one trained garment over the clip; return what to tell and the figures."""
    subject = open_subject(path, options.stage, "cpu")
    scene, config = subject.scene, subject.file.config
    motion = resample(read_motion(options.motions / f"{options.clip}.usdc", scene.character.skeleton), config.fps)
    found = {path.stem: measured(ways(subject.file, ALL), motion, options.repeats)}
    text = f"{path.stem}: {scene.garment.mesh.vertex_count:,} vertices, K = {config.shapes}, "
    text += f"{scene.rig.proxy_count} proxies, {scene.character.skeleton.joint_count} joints, "
    text += f"{motion.frame_count} frames of {options.clip}\n\n{times_table(found[path.stem])}\n"
    least, sentence = products(Player(subject.file))
    by_level, level_table = levels(subject.file, motion, options.repeats)
    found.update({f"{path.stem}, {level}": times for level, times in by_level.items()})
    found[f"{path.stem}, products alone"] = {"numpy": {name: [value, value] for name, value in least.items()}}
    text += f"{sentence}\nLevels of quality, µs per frame with numpy\n\n{level_table}\n"
    if options.bpy:
        taken = {**cloth(scene, motion, options.bpy), **live(path, options.bpy)}
        found[f"{path.stem}, Blender"] = {"Blender": taken}
        text += "".join(
            f"Blender's {name}: {median:,.0f} ({late:,.0f})  \n" for name, (median, late) in taken.items()
        )
    return text + "\n", found


def main() -> None:
    options = options_of_run()
    text = ""
    found: dict[str, Times] = {}
    for path in options.models:
        told, times = garment(path, options)
        text, found = text + told, {**found, **times}
    meshes, networks = mesh_growth(max(3, options.repeats // 8)), network_growth(options.repeats)
    text += f"µs per frame of a synthetic cloak, by vertices\n\n{mesh_table(meshes)}\n"
    text += f"µs per frame of 2,500 vertices with numpy, by latents and widths\n\n{network_table(networks)}"
    text += f"\nLoad of the machine meanwhile: {os.getloadavg()[2]:.1f} on {os.cpu_count()} cores.\n"
    write_results(options, text, {"models": found, "meshes": meshes, "networks": networks})


if __name__ == "__main__":
    main()
