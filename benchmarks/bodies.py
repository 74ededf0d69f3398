# SPDX-License-Identifier: Apache-2.0
"""A model for a family of bodies on bodies that its training never saw, beside models for one of these alone.

    python benchmarks/bodies.py draw FOLDER                                   # more bodies, with Anny
    python benchmarks/bodies.py train BODY.usdc --start-from CAPE -o BODY.safetensors --motions FOLDER --index FILE
    python benchmarks/bodies.py simulate BODIES --clips NAMES -o FOLDER --motions FOLDER --index FILE
    python benchmarks/bodies.py measure BODIES --alone NAME=MODEL --simulated FOLDER -o FOLDER --motions FOLDER ...
    python benchmarks/bodies.py join FOLDER

A model for one body starts where that of the family started, from a cape for the first body, laid on that body. It is
trained with the family's settings for as many iterations, all of them on that body, on the motions between its bones.
Its garment is the family's: sewn for the first body. What is drawn are Anny's parameters: mixtures of those of three
members, a tenth beyond their mean, as training draws bodies among their shapes. Single steps are measured as in a
validation: the energy that a Newton step from the model's own past would win.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.reports import RESULTS, provenance, rounded, write_document
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.reading.motion import read_motion

from ssilk_core.delivery.bake import WornModel, worn
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.devices import select_device
from ssilk_core.events import TextReporter
from ssilk_core.files import replacing
from ssilk_core.network.checkpoint import ModelFile, load_model, network
from ssilk_core.physics.simulate import simulate
from ssilk_core.quality.evaluation.asked import EvaluationClips, EvaluationOptions
from ssilk_core.quality.evaluation.bodies import base_of
from ssilk_core.quality.evaluation.methods import EvaluatedMethod, EvaluationScene, Network
from ssilk_core.quality.evaluation.run import evaluate
from ssilk_core.quality.evaluation.splits import chosen, read_index
from ssilk_core.scene.assets import Floats, Motion
from ssilk_core.scene.family import motion_on
from ssilk_core.training.bodies import BEYOND, CORNERS
from ssilk_core.training.budget import scale_schedule
from ssilk_core.training.job import TrainJob
from ssilk_core.training.motion_bank import build_bank, roll_states
from ssilk_core.training.run import train
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.step_errors import StepErrors
from ssilk_core.training.validation import Validator

FAMILY = shipped_path("cape_family")
DRAWN, SEED = 7, 49  # bodies beside the three that ship and that training never saw
CLIPS = "02_04", "05_12", "06_05", "07_09", "09_11"  # of `test`, as docs/training.md has them
STEPS = 128  # single steps on each body
KEPT = "frames", "total", "shown_skin", "reference", "steps"  # figures that tables and documents have


@dataclass(frozen=True, eq=False)
class Dressed:
    """The family's model on the body of a stage, and the motions there."""

    name: str
    family: ModelFile
    on: WornModel

    @classmethod
    def of(cls, stage: Path) -> Dressed:
        family = load_model(FAMILY)
        return cls(stage.stem.removeprefix("demo_body_"), family, worn(family, open_stage(stage), None))

    @property
    def beyond(self) -> float:
        """How far the body is beyond those of the training, relative to their spread."""
        assert self.family.bodies
        return self.family.bodies.family.bodies.place_of(self.on.scene.character).beyond

    def motions(self, folder: Path, clips: Sequence[str]) -> dict[str, Motion]:
        """Return clips of the first body, between the bones of this one."""
        own, base = self.on.scene.character.skeleton, base_of(self.family, self.on.member)
        read = {name: read_motion(folder / f"{name}.usdc", own) for name in clips}
        if base is None:
            return read
        return {name: motion_on(motion, base[0], own, base[1]) for name, motion in read.items()}


def draw(options: argparse.Namespace) -> None:
    """Write bodies whose parameters are mixtures of those of the family's members."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "usd" / "tools"))
    import make_demo_body as maker

    members = [maker.PHENOTYPES[name] for name in ("", "tall", "heavy", "slight", "muscular")]
    names = sorted({name for member in members for name in member})
    known = np.array([[member.get(name, 0.5) for name in names] for member in members])
    generator, middle, base = np.random.default_rng(SEED), known.mean(axis=0), maker.anny_body({})
    for number in range(DRAWN):
        corners = generator.choice(len(known), CORNERS, replace=False)
        mixed = generator.dirichlet(np.ones(CORNERS)) @ known[corners]
        parameters = dict(zip(names, (middle + (1 + BEYOND) * (mixed - middle)).round(3).tolist()))
        output = options.folder / f"drawn_{number + 1}.usdc"
        with replacing(output) as temporary:
            temporary.unlink()
            maker.write_stage(str(temporary), maker.of_family(base, maker.anny_body(parameters)), output.stem)
        print(output, parameters)


def train_alone(options: argparse.Namespace) -> None:
    """Train a model for one body alone, from where the family's began, with its settings."""
    dressed, index = Dressed.of(options.stage), read_index(options.index)
    known, first, scene = dressed.family.provenance, load_model(options.start_from), dressed.on.scene
    settings = TrainConfig(**known["train"])
    iterations = options.iterations or known["planned"]
    job = TrainJob(
        scene=scene,
        motions=list(dressed.motions(options.motions, chosen(index, "train")).values()),
        held_out=list(dressed.motions(options.motions, chosen(index, "valid")).values()),
        model=dressed.family.config,
        train=scale_schedule(settings, iterations),
        fabric=dressed.family.fabric,
        output=options.output,
        device=options.device,
        base=replace(first, scene=replace(scene, character=dressed.on.file.scene.character)),
        whole=True,
    )
    print(train(job, TextReporter()))


def simulate_bodies(options: argparse.Namespace) -> None:
    """Simulate clips on bodies, from rest in their first frames."""
    for stage in options.stages:
        dressed = Dressed.of(stage)
        motions = dressed.motions(options.motions, options.clips)
        found = simulate(dressed.on.scene, dressed.family.fabric, list(motions.values()), device=options.device)
        for name, points in zip(motions, found):
            folder = options.output / dressed.name
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(folder / f"{name}.npy") as temporary, temporary.open("wb") as file:
                np.save(file, points.astype(np.float32))
            print(f"{dressed.name}, {name}: {len(points)} frames", flush=True)


def measure(options: argparse.Namespace) -> None:
    """Measure the family's model, and that for one body alone where there is one, on each body."""
    device, alone = select_device(options.device), dict(option.split("=", 1) for option in options.alone)
    for stage in options.stages:
        dressed = Dressed.of(stage)
        models = {"family": dressed.on.file}
        if dressed.name in alone:
            models["alone"] = load_model(alone[dressed.name])
        found = {"beyond": dressed.beyond, **measured(dressed, models, options, device)}
        with replacing(options.output / f"{dressed.name}.json") as temporary:
            temporary.write_text(json.dumps({**provenance(options), "measured": rounded(found)}))


def measured(
    dressed: Dressed, models: Mapping[str, ModelFile], options: argparse.Namespace, device: torch.device
) -> dict[str, Any]:
    """Return the figures of linear blend skinning, of the simulator and of models on one body, by their names."""
    file, scene = dressed.on.file, dressed.on.scene
    motions, fps = dressed.motions(options.motions, options.clips), file.config.fps
    methods = [
        EvaluatedMethod(name, each.joints, partial(Network, network(each).to(device)))
        for name, each in models.items()
    ]
    shots = {
        clip: path
        for clip in options.clips
        if options.simulated and (path := options.simulated / dressed.name / f"{clip}.npy").is_file()
    }

    def read(clip: str, frames: range) -> Floats:
        return np.load(shots[clip], mmap_mode="r")[frames.start : frames.stop].astype(np.float64)

    clips = EvaluationClips(motions, {"test": options.clips}, frozenset(shots), read if shots else None)
    asked = EvaluationOptions(stops=0, loop=0, linearised=0)
    evaluation = EvaluationScene(scene, file.fabric, fps, device, character=dressed.name)
    rows = {row.method: asdict(row.figures) for row in evaluate(evaluation, methods, clips, asked, TextReporter())}
    for name, each in models.items():
        model = network(each).to(device)
        bank = build_bank(list(motions.values()), scene.character.skeleton, each.joints, fps, device)
        rest = torch.tensor(scene.garment.mesh.points, dtype=torch.float32, device=device)
        validator = Validator(bank, evaluation.energy, evaluation.body, scene, rest, fps, bank.frame_count)
        states = roll_states(model, bank, validator.clips, validator.down)
        energy, square = validator.missed_by_steps(model, states, options.steps)
        errors = StepErrors(len(energy), float(energy.mean()), float(square.mean().sqrt()))
        rows[name]["steps"] = asdict(errors)
    return rows


def join(options: argparse.Namespace) -> None:
    """Write what `measure` wrote of several bodies to the result file, as far as tables read it."""
    found = {path.stem: json.loads(path.read_text()) for path in sorted(options.folder.glob("*.json"))}
    source = {name: next(iter(found.values()))[name] for name in ("command", "hardware", "versions")}
    every = {name: {key: kept(value) for key, value in each["measured"].items()} for name, each in found.items()}
    write_document(RESULTS / "bodies.json", source, every)


def kept(figures: Any) -> Any:
    """Return those of the figures of a method that tables read."""
    return {name: figures[name] for name in KEPT if figures.get(name)} if isinstance(figures, dict) else figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(required=True)

    def verb(name: str, run: Any, *words: str) -> argparse.ArgumentParser:
        found = verbs.add_parser(name, help=run.__doc__)
        found.set_defaults(run=run)
        if "motions" in words:
            found.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
            found.add_argument("--device", default="cpu", help="where it runs (default cpu)")
            found.add_argument("--threads", type=int, default=1, help="processor threads (default 1)")
            found.add_argument("-o", "--output", type=Path, required=True)
        if "stages" in words:
            found.add_argument("stages", type=Path, nargs="+", metavar="STAGE", help="bodies of the family")
            found.add_argument("--clips", nargs="+", default=list(CLIPS), metavar="NAME")
        return found

    verb("draw", draw).add_argument("folder", type=Path)
    own = verb("train", train_alone, "motions")
    own.add_argument("stage", type=Path)
    own.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    own.add_argument("--iterations", type=int, help="default: as many as the family's")
    own.add_argument("--start-from", type=Path, required=True, metavar="MODEL", help="that the family started from")
    verb("simulate", simulate_bodies, "motions", "stages")
    asked = verb("measure", measure, "motions", "stages")
    asked.add_argument("--alone", nargs="*", default=[], metavar="NAME=MODEL", help="models for one body alone")
    asked.add_argument("--simulated", type=Path, metavar="FOLDER", help="what 'simulate' wrote")
    asked.add_argument("--steps", type=int, default=STEPS)
    verb("join", join).add_argument("folder", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(getattr(options, "threads", 1))
    options.run(options)


if __name__ == "__main__":
    main()
