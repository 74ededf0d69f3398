# SPDX-License-Identifier: Apache-2.0
"""Measure scenes of growing need: time, memory and bytes of training, rolling out and baking each of them.

    python benchmarks/scenes.py

The same cloak of synthetic.py around the same body, as the classes, the body and the motion ask for less or more: all
of it pinned, all of it tight, a fifth of it loose, the whole of it, away from the body, on a character that stands
still, four at once, and one for two bodies, graded to them or not, which is rolled and baked on the second; then
trained for wind, colliders and fabrics, and rolled without any of these and with them: in a wind, over a floor, in
another fabric. Each is measured in a process of its own. What a scene does not need must not be paid for.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from helpers import synthetic
from helpers.peak import Peak
from helpers.reports import table, write_results
from ssilk_usd.shots.shot import write_shot
from ssilk_usd.units import StageUnits

from ssilk_core.authoring.bodies.carry import dressed_family
from ssilk_core.network.checkpoint import ModelFile, model_file, network, save_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.rollout import garment_poses
from ssilk_core.network.runtime.garment import NumpyGarment
from ssilk_core.network.runtime.sight import seen_proximity
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.world.felt import felt_gravity
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    TIGHT,
    Air,
    Character,
    Collider,
    Motion,
    ProxyRig,
    Scene,
    ShotWorld,
)
from ssilk_core.scene.fabric_range import FabricRange
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.scene.family import BodyFamily, motion_on, with_joints
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import build_parts
from ssilk_core.training.settings import TrainConfig

SIZE = synthetic.Size(vertices=2500, body=4000, proxies=20, shapes=64, batch=8, window=6, static_batch=8)
STEPS, CLIPS, TIMES = 6, 4, 6
WORLD = ("wind", "colliders", "fabrics")
HEADER = ("scene", "free vertices", "proxies", "body vertices", "train step [ms]", "memory [MiB]", "roll [ms/frame]",
          "bake [ms/frame]", "model [kB]", "shot [kB]")  # fmt: skip


@dataclass(frozen=True, eq=False)
class World:
    """One scene.

    Attributes:
        garments: which are trained and baked one after another.
        motions: what the character does.
        two_bodies: whether they are for a second body as well.
        knows: what else training draws: "wind", "colliders", "fabrics".
        meets: what of it there is in the shot.
    """

    garments: tuple[Scene, ...]
    motions: tuple[Motion, ...]
    two_bodies: bool = False
    knows: tuple[str, ...] = ()
    meets: tuple[str, ...] = ()


def dressed(loose: float, *, tight: bool = True) -> Scene:
    """Return the cloak with a share of it loose, from the hem up; the rest tight or pinned, and no idle proxies."""
    whole = synthetic.scene(SIZE)
    height = whole.garment.mesh.points[:, 1]
    hangs = height < np.quantile(height, loose)
    held = np.where(whole.classes == PINNED, PINNED, TIGHT) if tight else PINNED
    classes = np.where(hangs, LOOSE, held)
    garment = replace(whole.garment, classes=classes)
    if not hangs.any():
        none = ProxyRig("/rig", (), np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4)), whole.lbs_skin)
        return Scene(whole.character, garment, none)
    proxies = max(synthetic.CHAINS, round(SIZE.proxies * loose))
    joints = whole.character.skeleton.joint_count
    lbs = whole.lbs_skin.dense(joints)
    return Scene(whole.character, garment, synthetic.cloak_rig(garment.mesh, lbs, classes, proxies))


def beside(scene: Scene) -> Scene:
    """Return the scene with the bodies too far away to be touched."""
    bodies = [
        replace(body, mesh=replace(body.mesh, points=body.mesh.points + [10.0, 0, 0]))
        for body in scene.character.bodies
    ]
    character = Character(scene.character.path, scene.character.skeleton, tuple(bodies))
    return replace(scene, character=character)


def graded(scene: Scene) -> Scene:
    """Return the scene with a garment whose rest shape follows the body."""
    return replace(scene, garment=replace(scene.garment, graded=True))


def larger(character: Character) -> Character:
    """Return another body of the character's family."""
    skeleton, grown = character.skeleton, np.array([1.15, 1.05, 1.15])
    bodies = [replace(body, mesh=replace(body.mesh, points=body.mesh.points * grown)) for body in character.bodies]
    joints = skeleton.bind_transforms[:, :3, 3] * grown
    return replace(character, path="/larger", skeleton=with_joints(skeleton, joints), bodies=tuple(bodies))


def moving() -> tuple[Motion, ...]:
    skeleton = synthetic.chain()
    return tuple(synthetic.motion(skeleton, ModelConfig().fps, seed) for seed in range(CLIPS))


def still() -> tuple[Motion, ...]:
    """Return the motions with the first frame held."""
    return tuple(
        replace(
            motion,
            rotations=np.repeat(motion.rotations[:1], motion.frame_count, axis=0),
            translations=np.repeat(motion.translations[:1], motion.frame_count, axis=0),
        )
        for motion in moving()
    )


def knowing(*meets: str) -> World:
    """Return the loose cloak, trained for winds, colliders and fabrics, in a shot with some of these."""
    return World((dressed(0.9),), moving(), knows=WORLD, meets=meets)


WORLDS: dict[str, Callable[[], World]] = {
    "all pinned": lambda: World((dressed(0, tight=False),), moving()),
    "all tight": lambda: World((dressed(0),), moving()),
    "a fifth loose": lambda: World((dressed(0.2),), moving()),
    "loose, no contact": lambda: World((beside(dressed(0.9)),), moving()),
    "loose, still character": lambda: World((dressed(0.9),), still()),
    "loose": lambda: World((dressed(0.9),), moving()),
    "four loose garments": lambda: World((dressed(0.9),) * 4, moving()),
    "loose, two bodies": lambda: World((dressed(0.9),), moving(), two_bodies=True),
    "loose, graded to two bodies": lambda: World((graded(dressed(0.9)),), moving(), two_bodies=True),
    "loose, knows a world, meets none": lambda: knowing(),
    "loose, meets wind": lambda: knowing("wind"),
    "loose, meets colliders": lambda: knowing("colliders"),
    "loose, meets fabrics": lambda: knowing("fabrics"),
    "loose, meets all of a world": lambda: knowing(*WORLD),
}


def measure(name: str) -> dict[str, float]:
    """Return the figures of one scene, summed over its garments."""
    world = WORLDS[name]()
    found = [measured(scene, world) for scene in world.garments]
    return {key: sum(each[key] for each in found) for key in found[0]} | {"memory": max(f["memory"] for f in found)}


def measured(scene: Scene, world: World) -> dict[str, float]:
    """Train a few steps, roll and bake one garment."""
    family, fabric, motions = None, Fabric("default"), world.motions
    if world.two_bodies:
        other = larger(scene.character)
        family = dressed_family(scene, BodyFamily.of([scene.character, other]), [other])[0]
    config = TrainConfig(batch=SIZE.batch, window=SIZE.window, static_batch=SIZE.static_batch,
                         pretraining_batch=SIZE.decoded, recombinations=0,
                         wind_fraction=0.25 * ("wind" in world.knows),
                         collider_fraction=0.25 * ("colliders" in world.knows))  # fmt: skip
    job = TrainJob(scene=scene, motions=motions, held_out=motions[:1], model=ModelConfig(shapes=SIZE.shapes),
                   train=config, fabric=fabric, output=Path("none"), device="cpu", family=family,
                   fabrics=FabricRange.of(fabric, ["4"]) if "fabrics" in world.knows else None)  # fmt: skip
    parts = build_parts(job, torch.device("cpu"))
    stepper, first = parts.stepper(job.train, 0), job.train.static_iterations
    peak = Peak(torch.device("cpu"))
    stepper.run(first)
    began = time.perf_counter()
    for step in range(STEPS):
        stepper.run(first + 1 + step)
    train = (time.perf_counter() - began) / STEPS
    memory = peak.bytes()
    file, motion = model_file(parts.model, fabric, {}, job.fabrics), repeated(motions[0])
    if not family:
        file = file.on_fabric(FABRICS["silk"]) if "fabrics" in world.meets else file
        model = network(file)
    else:
        model = network(file.on_body(family.bodies.members[1]))
        motion = motion_on(motion, scene.character.skeleton, model.scene.character.skeleton, 1.05)
    return {
        "free vertices": int((scene.classes != PINNED).sum()), "proxies": scene.rig.proxy_count,
        "body vertices": parts.reached, "train": train, "memory": memory, **baked(file, model, motion, world.meets),
    }  # fmt: skip


def repeated(motion: Motion) -> Motion:
    """Return a motion several times over: a minute, in which garments come to rest where they may."""
    rotations, translations = (np.tile(part, (TIMES, 1, 1)) for part in (motion.rotations, motion.translations))
    return replace(motion, rotations=rotations, translations=translations)


def surrounded(file: ModelFile, motion: Motion, meets: tuple[str, ...]) -> Motion:
    """Return a motion with the wind that cloth feels there, and the floor that it sees."""
    lowest = synthetic.scene(SIZE).character.merged_body().mesh.points[:, 1].min()
    square = np.array([[-9.0, lowest, -9], [-9, lowest, 9], [9, lowest, 9], [9, lowest, -9]])
    floor = Collider("floor", np.array([[0, 1, 2], [0, 2, 3]]), square[None], np.eye(4)[None], np.ones(1, bool))
    air = Air(np.array([[0.0, 0, -5]]), np.zeros(1)) if "wind" in meets else None
    world = ShotWorld(motion.fps, (floor,) if "colliders" in meets else (), air=air)
    motion = replace(motion, gravity=felt_gravity(world, motion, file.scene, file.fabric))
    return replace(motion, proximity=seen_proximity(world, motion, NumpyGarment(file)))


def baked(file: ModelFile, model: GarmentModel, motion: Motion, meets: tuple[str, ...]) -> dict[str, float]:
    """Roll and bake one garment of a file and write the file; times are for each frame [s], sizes in bytes.

    Rolling includes the search for what is met.
    """
    began = time.perf_counter()
    motion = surrounded(file, motion, meets) if {"wind", "colliders"} & {*meets} else motion
    for _ in garment_poses(model, motion, motion.fps):
        pass
    rolled = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        shot, path = Path(folder) / "shot.usdc", Path(folder) / "model.safetensors"
        began = time.perf_counter()
        poses = garment_poses(model, motion, motion.fps)
        write_shot(shot, model.deformer(), motion, poses, units=StageUnits(1.0, "Y"), include_body=False)
        bake = time.perf_counter() - began
        save_model(path, file, pack=True)
        count = motion.frame_count
        return {
            "roll": rolled / count, "bake": bake / count, "model": path.stat().st_size,
            "shot": shot.stat().st_size,
        }  # fmt: skip


def row(name: str, found: dict[str, float]) -> list[str]:
    """Return a line of the table."""
    counts = [f"{found[key]:,}" for key in ("free vertices", "proxies", "body vertices")]
    times = [f"{1e3 * found['train']:.0f}", f"{found['memory'] / 2**20:.0f}"]
    each = [f"{1e3 * found[key]:.2f}" for key in ("roll", "bake")]
    return [name, *counts, *times, *each, f"{found['model'] / 1e3:,.0f}", f"{found['shot'] / 1e3:,.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1, help="processor threads (default 1)")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.only:
        print(json.dumps(measure(options.only)))
        return
    rows, results = [], {}
    for name in WORLDS:
        words = [sys.executable, __file__, "--threads", str(options.threads), "--only", name]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        results[name] = json.loads(done.stdout)
        rows.append(row(name, results[name]))
        print(*rows[-1], flush=True)
    options.name, options.device = "scenes", "cpu"
    write_results(options, table(HEADER, rows), results)


if __name__ == "__main__":
    main()
