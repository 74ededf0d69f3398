# SPDX-License-Identifier: Apache-2.0
"""Measure scenes of growing need: time, memory and bytes of training, rolling out and baking each of them.

    python benchmarks/scenes.py

The same cloak of synthetic.py around the same body, as the classes, the body and the motion ask for less or more: all
of it pinned, all of it tight, a fifth of it loose, the whole of it, away from the body, on a character that stands
still, four at once, and one for two bodies, graded to them or not, which is rolled and baked on the second. Each is
measured in a process of its own. Then the whole of it with what else a shot may ask for, each in a process of its own
in which three plays take turns: of a model without it, of one that knows it where nothing asks for it, and where
something does. Last the whole of it over another such cloak, a little narrower, which comes through it: what that
costs to refine and to certify, beside the same cloak alone. What a scene does not need must not be paid for.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers import synthetic
from helpers.layered import inner_of, layered
from helpers.peak import Peak
from helpers.reports import table, write_results
from ssilk_usd.shots.shot import write_shot
from ssilk_usd.units import StageUnits

from ssilk_core.authoring.bodies.carry import dressed_family
from ssilk_core.delivery.bake.direction import DirectedPoses, Direction
from ssilk_core.network.checkpoint import ModelFile, model_file, network, save_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.rollout import garment_poses
from ssilk_core.network.runtime.garment import NumpyGarment
from ssilk_core.network.runtime.sight import seen_proximity
from ssilk_core.network.settings import PROXIMITY_POINTS, ModelConfig
from ssilk_core.physics.world.felt import felt_gravity
from ssilk_core.scene.assets import (
    LOOSE,
    PINNED,
    TIGHT,
    Air,
    Character,
    Collider,
    Deformer,
    Floats,
    GarmentPose,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    ShotWorld,
)
from ssilk_core.scene.fabric_range import FabricRange, fabric_with
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.family import BodyFamily, DressedFamily, motion_on, with_joints
from ssilk_core.scene.riders import Attachment, Rider, RiderJoints
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import build_parts
from ssilk_core.training.settings import TrainConfig

SIZE = synthetic.Size(vertices=2500, body=4000, proxies=20, shapes=64, batch=8, window=6, static_batch=8)
STEPS, CLIPS, TIMES = 6, 4, 6
ROUNDS = 5  # in which three plays take turns
HEADER = ("scene", "free vertices", "proxies", "body vertices", "train step [ms]", "memory [MiB]", "roll [ms/frame]",
          "bake [ms/frame]", "model [kB]", "shot [kB]")  # fmt: skip
PAIRED = ("loose, with", "", *HEADER[4:5], *HEADER[6:])
PLAYS = ("without", "unused", "used")
LAYERED = "loose, over another"
LAYERS = (LAYERED, "play [ms/frame]", "refine 4 [ms/frame]", "look for what is wrong [ms/frame]", "frames wrong [%]",
          "free one [ms]")  # fmt: skip
SOME = slice(30, 36)  # frames that are refined and certified


@dataclass(frozen=True, eq=False)
class World:
    """One scene: its garments, which are trained and baked one after another, what the character does, and whether
    they are for a second body as well."""

    garments: tuple[Scene, ...]
    motions: tuple[Motion, ...]
    two_bodies: bool = False


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
}


@dataclass(frozen=True, eq=False)
class Play:
    """How a garment is played: what surrounds it, what rides on it, and where it is held.

    Attributes:
        fabric, body: that it is put on; None for its own.
        riding, held: whether a button rides on it, and whether it is held for a second in each of ten; None where a
            bake does not ask.
    """

    world: ShotWorld | None = None
    fabric: Fabric | None = None
    body: Floats | None = None
    riding: bool | None = None
    held: bool | None = None

    def poses(self, file: ModelFile, motion: Motion) -> tuple[Deformer, Iterator[GarmentPose], RiderJoints | None]:
        """Return a garment with its poses, all made anew, and what rides on it."""
        file = file.on_fabric(self.fabric) if self.fabric else file
        model = network(file if self.body is None else file.on_body(self.body))
        if self.world:
            felt = felt_gravity(self.world, motion, model.scene, file.fabric)
            seen = seen_proximity(self.world, motion, NumpyGarment(file)) if self.world.colliders else None
            motion = replace(motion, gravity=felt, proximity=seen)
        deformer = model.deformer()
        found = garment_poses(model, motion, motion.fps)
        if self.held is not None:
            free = np.where(np.arange(motion.frame_count) % 300 < 30, 0.0, 1.0) if self.held else 1.0
            direction = Direction(np.broadcast_to(free, (motion.frame_count,)), 1, motion, 0)
            rolled = partial(_rolled, model, motion)
            found = DirectedPoses(direction, deformer, rolled).poses(0, motion.frame_count)
        if self.riding is None:
            return deformer, found, None
        riders = RiderJoints(deformer, [button(model.scene.garment.mesh)] if self.riding else [])
        return riders.deformer, riders.poses(motion, found), riders


def _rolled(model: GarmentModel, motion: Motion, first: int, stop: int, step: int) -> Iterator[GarmentPose]:
    return garment_poses(model, motion.picked(slice(first, stop, step)), motion.fps)


def button(mesh: Mesh) -> Rider:
    """Return a rider on the middle of a garment."""
    points = mesh.points[mesh.faces[len(mesh.faces) // 2]]
    return Rider(
        "/button",
        "button",
        (Mesh("/button", points, np.arange(3)[None]),),
        Attachment.beneath(points, mesh, "/button"),
    )


@dataclass(frozen=True, eq=False)
class Need:
    """What a shot may ask for: how a training differs that knows it, and how it is played, unused and used."""

    unused: Play
    used: Play
    model: Mapping[str, Any] = field(default_factory=dict)
    train: Mapping[str, Any] = field(default_factory=dict)
    fabrics: FabricRange | None = None


def level_floor(fps: float) -> ShotWorld:
    """Return a world with a floor beneath the feet."""
    corners = np.array([[[-50.0, 0, -50], [-50, 0, 50], [50, 0, 50], [50, 0, -50]]])
    there = np.ones(1, dtype=bool)
    return ShotWorld(fps, (Collider("/floor", np.array([[0, 1, 2], [0, 2, 3]]), corners, np.eye(4)[None], there),))


def needs() -> dict[str, Need]:
    fps, gusts = ModelConfig().fps, Air(np.array([[0.0, 0.0, -5.0]]), np.array([2.0]))
    ranged = FabricRange.of(Fabric("default"), ["4"])
    return {
        "a floor": Need(
            Play(), Play(level_floor(fps)), {"proximity_points": PROXIMITY_POINTS}, {"collider_fraction": 0.25}
        ),
        "wind": Need(Play(), Play(ShotWorld(fps, air=gusts)), train={"wind_fraction": 0.25}),
        "a range of fabrics": Need(
            Play(), Play(fabric=fabric_with(Fabric("default"), np.full(5, 2.0))), fabrics=ranged
        ),
        "a rider": Need(Play(riding=False), Play(riding=True)),
        "held for a tenth": Need(Play(held=False), Play(held=True)),
    }


def paired(name: str) -> dict[str, dict[str, float]]:
    """Return the figures of the three plays of one need, medians of rounds in which they take turns."""
    need, scene, motions = needs()[name], dressed(0.9), moving()
    jobs = [job_of(scene, motions), job_of(scene, motions, need=need)]
    parts = [build_parts(job, torch.device("cpu")) for job in jobs]
    steppers, first = [each.stepper(job.train, 0) for each, job in zip(parts, jobs)], jobs[0].train.static_iterations
    steps = [[timed(partial(each.run, first + step)) for each in steppers] for step in range(STEPS + 1)][1:]
    train = np.median(steps, axis=0)
    files = [model_file(each.model, Fabric("default"), {}, job.fabrics) for each, job in zip(parts, jobs)]
    ways = ((files[0], Play(), train[0]), (files[1], need.unused, train[1]), (files[1], need.used, train[1]))
    rounds = [[baked(file, play, repeated(motions[0], 2)) for file, play, _ in ways] for _ in range(ROUNDS)]
    return {
        kind: {"train": step} | {key: float(np.median([each[way][key] for each in rounds])) for key in rounds[0][way]}
        for way, (kind, (_, _, step)) in enumerate(zip(PLAYS, ways))
    }


def layered_ways() -> dict[str, dict[str, float]]:
    """Return the figures of a garment alone and over another."""
    scene, motions = dressed(0.9), moving()
    mesh = replace(scene.garment.mesh, points=inner_of(scene).mesh.points)
    both = (scene, replace(scene, garment=replace(scene.garment, mesh=mesh)))
    files = []
    for each in both:
        job = job_of(each, motions)
        parts = build_parts(job, torch.device("cpu"))
        parts.stepper(job.train, 0).run(job.train.static_iterations)
        files.append(model_file(parts.model, job.fabric, {}))
    return layered(files[0], files[1], scene, motions[0].picked(SOME), ROUNDS)


def timed(work: Callable[[], object]) -> float:
    """Return the processor time of some work [s]."""
    began = time.process_time()
    work()
    return time.process_time() - began


def measure(name: str) -> dict[str, float]:
    """Return the figures of one scene, summed over its garments."""
    world = WORLDS[name]()
    found = [measured(scene, world.motions, world.two_bodies) for scene in world.garments]
    return {key: sum(each[key] for each in found) for key in found[0]} | {"memory": max(f["memory"] for f in found)}


def measured(scene: Scene, motions: tuple[Motion, ...], two_bodies: bool) -> dict[str, float]:
    """Train a few steps, roll and bake one garment."""
    family = None
    if two_bodies:
        other = larger(scene.character)
        family = dressed_family(scene, BodyFamily.of([scene.character, other]), [other])[0]
    job = job_of(scene, motions, family)
    parts = build_parts(job, torch.device("cpu"))
    stepper, first = parts.stepper(job.train, 0), job.train.static_iterations
    peak = Peak(torch.device("cpu"))
    stepper.run(first)
    train = sum(timed(partial(stepper.run, first + 1 + step)) for step in range(STEPS)) / STEPS
    memory = peak.bytes()
    file, motion = model_file(parts.model, Fabric("default"), {}), repeated(motions[0])
    place = None
    if family:
        place = family.bodies.members[1]
        motion = motion_on(motion, scene.character.skeleton, file.on_body(place).scene.character.skeleton, 1.05)
    return {
        "free vertices": int((scene.classes != PINNED).sum()), "proxies": scene.rig.proxy_count,
        "body vertices": parts.reached, "train": train, "memory": memory, **baked(file, Play(body=place), motion),
    }  # fmt: skip


def job_of(
    scene: Scene, motions: tuple[Motion, ...], family: DressedFamily | None = None, need: Need | None = None
) -> TrainJob:
    """Return a training at `SIZE`."""
    asked = need or Need(Play(), Play())
    config = TrainConfig(batch=SIZE.batch, window=SIZE.window, static_batch=SIZE.static_batch,
                         pretraining_batch=SIZE.decoded,
                         recombinations=0, **asked.train)  # fmt: skip
    return TrainJob(scene=scene, motions=motions, held_out=motions[:1],
                    model=ModelConfig(shapes=SIZE.shapes, **asked.model), train=config, fabric=Fabric("default"),
                    output=Path("none"), device="cpu", family=family, fabrics=asked.fabrics)  # fmt: skip


def repeated(motion: Motion, times: int = TIMES) -> Motion:
    """Return a motion several times over: a minute, in which garments come to rest where they may."""
    rotations, translations = (np.tile(part, (times, 1, 1)) for part in (motion.rotations, motion.translations))
    return replace(motion, rotations=rotations, translations=translations)


def baked(file: ModelFile, play: Play, motion: Motion) -> dict[str, float]:
    """Roll and bake one garment of a file and write the file; times are for each frame [s], sizes in bytes."""
    rolled = timed(lambda: deque(play.poses(file, motion)[1], maxlen=0))
    with tempfile.TemporaryDirectory() as folder:
        shot, path = Path(folder) / "shot.usdc", Path(folder) / "model.safetensors"

        def write() -> None:
            deformer, poses, riders = play.poses(file, motion)
            units = StageUnits(1.0, "Y")
            write_shot(shot, deformer, motion, poses, units=units, include_body=False, riders=riders)

        bake = timed(write)
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
    return [name, *counts, *times, *each, *sizes(found)]


def sizes(found: dict[str, float]) -> list[str]:
    return [f"{found[key] / 1e3:,.0f}" for key in ("model", "shot")]


def paired_rows(name: str, found: dict[str, dict[str, float]]) -> list[list[str]]:
    """Return the lines of one need."""
    return [
        [
            name,
            kind,
            f"{1e3 * each['train']:.0f}",
            *(f"{1e3 * each[key]:.2f}" for key in ("roll", "bake")),
            *sizes(each),
        ]
        for kind, each in found.items()
    ]


def found_of(name: str) -> dict[str, Any]:
    """Return the figures of one scene, one need, or a garment over another."""
    if name == LAYERED:
        return layered_ways()
    return measure(name) if name in WORLDS else paired(name)


def layered_rows(found: dict[str, dict[str, float]]) -> list[list[str]]:
    """Return the lines of a garment alone and over another."""
    return [
        [way, *(f"{1e3 * each[key]:.1f}" for key in ("play", "refine", "look")), f"{100 * each['wrong']:.0f}",
         f"{1e3 * each['free']:.0f}" if each["wrong"] else "–"]
        for way, each in found.items()
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1, help="processor threads (default 1)")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.only:
        print(json.dumps(found_of(options.only)))
        return
    rows, pairs, layers, results = list[list[str]](), list[list[str]](), list[list[str]](), {}
    for name in [*WORLDS, *needs(), LAYERED]:
        words = [sys.executable, __file__, "--threads", str(options.threads), "--only", name]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        found = results[name] = json.loads(done.stdout)
        if name == LAYERED:
            layers = added = layered_rows(found)
        else:
            added = [row(name, found)] if name in WORLDS else paired_rows(name, found)
            (rows if name in WORLDS else pairs).extend(added)
        print(*added, sep="\n", flush=True)
    options.name, options.device = "scenes", "cpu"
    write_results(options, "\n".join([table(HEADER, rows), table(PAIRED, pairs), table(LAYERS, layers)]), results)


if __name__ == "__main__":
    main()
