# SPDX-License-Identifier: Apache-2.0
"""What measurements of trained models share: a model on its character, its energies, and the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion
from torch import Tensor

from helpers.reports import table, write_results
from ssilk_core.delivery.bake import worn
from ssilk_core.devices import select_device
from ssilk_core.errors import fail
from ssilk_core.network.checkpoint import ModelFile, load_model, network
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.quality.evaluation.bodies import base_of
from ssilk_core.quality.evaluation.methods import EvaluationScene
from ssilk_core.scene.assets import Motion, Scene, Skeleton
from ssilk_core.scene.family import has_bones, motion_on
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.validation import Validator


@dataclass(frozen=True, eq=False)
class Subject:
    """A trained garment on a whole character; `dressed` holds every body vertex, reachable or not.

    `base` is the skeleton of the first body of a family, and this one's ratio of heights; None for that body.
    """

    name: str
    file: ModelFile
    model: GarmentModel
    dressed: EvaluationScene
    base: tuple[Skeleton, float] | None = None

    @property
    def scene(self) -> Scene:
        return self.dressed.scene

    @property
    def energy(self) -> GarmentEnergy:
        return self.dressed.energy

    @property
    def body(self) -> CollisionBody:
        return self.dressed.body

    @property
    def device(self) -> torch.device:
        return self.dressed.device

    def on_body(self, motion: Motion) -> Motion:
        """Return a motion on this body, where it has the bones of the first body of its family."""
        if self.base is None or not has_bones(motion, self.base[0]):
            return motion
        return motion_on(motion, self.base[0], self.scene.character.skeleton, self.base[1])

    def validator(self, *motions: Motion) -> Validator:
        """Return a validator of this garment that holds whole motions at the model's rate."""
        skeleton, fps = self.scene.character.skeleton, self.file.config.fps
        bank = build_bank(motions, skeleton, self.model.joints, fps, self.device)
        return Validator(bank, self.energy, self.body, self.scene, self.model.decoder.rest, fps, bank.frame_count)

    def frame_terms(self, motion: Motion, *, lbs: bool = False) -> dict[str, Tensor]:
        """Return `Validator.frame_terms` over all frames of a motion, shape (N,)."""
        validator = self.validator(motion)
        spans = [validator.frame_terms(span, None if lbs else self.model) for span in validator.clips]
        return {name: torch.cat([span[name] for span in spans]) for name in spans[0]}


def open_subject(path: Path, stage: Path, device: str) -> Subject:
    """Load a model and put it on the character of a stage; one for a family of bodies is on that body then."""
    file = load_model(path)
    if file.bodies:
        on = worn(file, open_stage(stage), None)
        dressed = EvaluationScene(on.scene, file.fabric, file.config.fps, select_device(device))
        base = base_of(file, on.member)
        return Subject(path.stem, on.file, network(on.file, on.scene).to(dressed.device), dressed, base)
    dressed = dressed_in(file, stage, device)
    return Subject(path.stem, file, network(file, dressed.scene).to(dressed.device), dressed)


def open_subjects(paths: Sequence[Path], stage: Path, device: str) -> list[Subject]:
    """Load models of one garment, to be compared on the same motions; those of one file name get their folders' too.

    Raises:
        SsilkError: their garments, fabrics, rates or vertex classes differ.
    """
    subjects = [open_subject(path, stage, device) for path in paths]
    stems = [path.stem for path in paths]
    if len(set(stems)) < len(stems):
        subjects = [replace(one, name=str(path.with_suffix(""))) for one, path in zip(subjects, paths)]
    first = subjects[0]
    for other, path in zip(subjects[1:], paths[1:]):
        if _garment(other) != _garment(first):
            fail(str(path), f"its garment, fabric or rate is not that of {paths[0]}", "models of one are compared")
    return subjects


def _garment(subject: Subject) -> tuple[object, ...]:
    """Return what models must share so that one simulator serves them all."""
    file, mesh = subject.file, subject.scene.garment.mesh
    return mesh.points.tobytes(), mesh.faces.tobytes(), subject.scene.classes.tobytes(), file.fabric, file.config.fps


def dressed_in(file: ModelFile, stage: Path, device: str) -> EvaluationScene:
    """Put the garment of a model or a baseline on the character of a stage."""
    skeleton = file.scene.character.skeleton
    character = read_character(open_stage(stage), root=None, garment=None)
    if character.skeleton.joint_names != skeleton.joint_names:
        fail(str(stage), "its joints are not the model's", "a model is measured on the character it was trained with")
    scene = replace(file.scene, character=replace(character, skeleton=skeleton))
    return EvaluationScene(scene, file.fabric, file.config.fps, select_device(device))


def arguments(purpose: str) -> argparse.ArgumentParser:
    """Return a parser of what every measurement is asked: models, the character, a device, threads."""
    parser = argparse.ArgumentParser(description=purpose)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="files written by 'ssilk train'")
    parser.add_argument("--stage", type=Path, required=True, help="USD file with the character")
    parser.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
    parser.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    parser.add_argument("--name", help="of the result files (default: the script's)")
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the command line and set the number of threads."""
    options = parser.parse_args()
    options.name = options.name or Path(sys.argv[0]).stem
    torch.set_num_threads(options.threads)
    return options


def measure_each(
    options: argparse.Namespace,
    header: Sequence[str],
    measure: Callable[[Subject, argparse.Namespace], dict[str, Any]],
    rows: Callable[[str, dict[str, Any]], list[list[str]]],
) -> None:
    """Measure one model after the other; after each, print the table so far and write the figures.

    Args:
        rows: returns the lines of a model from its name and figures.
    """
    lines, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        measured[subject.name] = found = measure(subject, options)
        lines += rows(subject.name, found)
        write_results(options, table(header, lines), measured)


def clip_of(options: argparse.Namespace, name: str, subject: Subject) -> Motion:
    """Read one clip of the motions' folder, on the subject's body."""
    return subject.on_body(read_motion(options.motions / f"{name}.usdc", subject.scene.character.skeleton))
