# SPDX-License-Identifier: Apache-2.0
"""Pack trained models of the wardrobe and put them where 'ssilk demo' finds them, if nothing is lost by that.

    python benchmarks/ship.py cape.safetensors --stage demo_body.usdc --motions FOLDER --index FOLDER/index.json

A model is called as its garment is, and trained on what 'ssilk demo' writes into its folder `wardrobe`. It is refused
when it was trained on another mesh, or when packing moves a vertex or changes an energy by more than `precision.py`
allows on the held-out clips. One for a family of bodies, such as cape_family.safetensors, is measured on its first
body, and on those of --family, on which clips are played as in training.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, open_subject, parsed
from precision import (
    HELD_OUT,
    LOSS_HEADER,
    MOST_CHANGED,
    MOST_MOVED,
    MOST_RMS,
    Loss,
    held_out,
    loss,
    loss_row,
    means,
    packed_subject,
)

from ssilk_core.demo.garments import build_garment
from ssilk_core.demo.motions import demo_shot
from ssilk_core.demo.shipped import garment_of, need_trained_on, shipped_path
from ssilk_core.errors import SsilkError, fail
from ssilk_core.files import split_location
from ssilk_core.network.checkpoint import ModelFile, load_model, save_model
from ssilk_core.physics.energy import TERMS
from ssilk_core.scene.assets import Motion, Scene
from ssilk_core.scene.family import BodyFamily

SAME_BODY = 1e-4  # between coordinates


def ship(path: Path, options: Namespace) -> tuple[list[str], dict[str, Any]]:
    """Pack and write one model; return a line for the table and its figures.

    Raises:
        SsilkError: it is of another garment, or packing it loses something.
    """
    subject, whole = open_subject(path, options.stage, options.device), load_model(path)
    if "shipped" in subject.file.provenance:
        fail(str(path), "packed already", "'ssilk train' writes what is needed")
    garment = garment_of(subject.name)
    need_trained_on(build_garment(garment, subject.scene.character).mesh, subject.file, path)
    motions = held_out(options, subject, HELD_OUT)
    found = bearable(path, subject, options, motions)
    target, told = shipped_path(subject.name), record(subject, found, motions)
    if options.family:
        told["bodies"] = {stage.stem: on_body(path, stage, options, motions) for stage in options.family}
    save_model(target, published(whole, told), pack=True)
    size = target.stat().st_size
    return [*loss_row(subject.name, found), f"{size:,}"], {**asdict(found), "bytes": size}


def bearable(path: Path, subject: Subject, options: Namespace, motions: list[Motion]) -> Loss:
    """Return what packing costs; raise `SsilkError` where it is too much."""
    found = loss(subject, packed_subject(subject, options), motions)
    most = max(map(abs, found.changes.values()))
    if not found.bearable:
        fail(
            str(path),
            f"packing moves a vertex by {1e3 * found.largest:.3g} mm (RMS {1e3 * found.rms:.3g} mm) and changes "
            f"an energy by {most:.2%} of all",
            f"at most {1e3 * MOST_MOVED:g} mm, {1e3 * MOST_RMS:g} mm and {MOST_CHANGED:.1%} are allowed",
            "train it again",
        )
    return found


def on_body(path: Path, stage: Path, options: Namespace, motions: list[Motion]) -> dict[str, float | bool]:
    """Return the score of a model for a family on the held-out clips on one more body, seen in training or not."""
    subject, bodies = open_subject(path, stage, options.device), need_bodies(load_model(path), path)
    place, clips = bodies.place_of(subject.scene.character), [subject.on_body(motion) for motion in motions]
    found = bearable(path, subject, Namespace(**{**vars(options), "stage": stage}), clips)
    lbs = means(subject, clips, lbs=True)
    return {
        "energy [J]": sum(found.energies.values()),
        "linear blend skinning [J]": sum(lbs[name] for name in TERMS),
        "inside the body": found.inside,
        "trained for": bool((np.abs(bodies.members - place.coordinates).max(axis=1) < SAME_BODY).any()),
    }


def need_bodies(file: ModelFile, path: Path) -> BodyFamily:
    """Return the bodies of a model's family; raise `SsilkError` where it is of one body."""
    if file.bodies is None:
        fail(str(path), "a model of one body", "--family measures one of a family", "leave --family out")
    return file.bodies.family.bodies


def record(subject: Subject, found: Loss, motions: list[Motion]) -> dict[str, Any]:
    """Return what is known about a model that ships: the day, the loss, and its score on the held-out clips.

    Its stretching on the demo's own shot tells later versions whether it still does what it did.
    """
    lbs, shot = means(subject, motions, lbs=True), demo_shot(subject.scene.character.skeleton)
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "largest error [m]": found.largest,
        "held-out clips": len(motions),
        "energy [J]": sum(found.energies.values()),
        "linear blend skinning [J]": sum(lbs[name] for name in TERMS),
        "inside the body": found.inside,
        "stretch on the demo's shot [J]": means(subject, [shot])["stretch"],
    }


def published(file: ModelFile, shipped: dict[str, Any]) -> ModelFile:
    """Return a model with its record, and with the names of files but not of the folders they were in."""
    scene = file.scene
    skeleton, mesh = scene.character.skeleton, scene.garment.mesh
    public = Scene(
        replace(scene.character, skeleton=replace(skeleton, path=without_folder(skeleton.path))),
        replace(scene.garment, mesh=replace(mesh, path=without_folder(mesh.path))),
        replace(scene.rig, path=without_folder(scene.rig.path)),
    )
    bodies = file.bodies
    if bodies:
        known = bodies.family.bodies
        known = replace(known, names=tuple(map(without_folder, known.names)))
        bodies = replace(bodies, family=replace(bodies.family, bodies=known))
    told = {**without_folders(file.provenance), "shipped": shipped}
    return replace(file, scene=public, provenance=told, bodies=bodies)


def without_folder(location: str) -> str:
    """Return "file.usd:/Prim" from "folder/file.usd:/Prim"."""
    name, prim = split_location(location)
    return f"{Path(name).name}:{prim}" if prim else Path(name).name


def without_folders(value: Any) -> Any:
    """Apply `without_folder` to every key and every text of a JSON document."""
    if isinstance(value, dict):
        return {without_folder(key): without_folders(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_folders(item) for item in value]
    return without_folder(value) if isinstance(value, str) else value


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips with their splits and tags")
    parser.add_argument("--family", type=Path, nargs="+", default=[], help="stages of other bodies to measure on")
    options = parsed(parser)
    rows, measured = [], {}
    for path in options.models:
        try:
            row, measured[path.stem] = ship(path, options)
        except SsilkError as error:
            raise SystemExit(f"error: {error}") from error
        rows.append(row)
        write_results(options, table((*LOSS_HEADER, "bytes"), rows), measured)


if __name__ == "__main__":
    main()
