# SPDX-License-Identifier: Apache-2.0
"""Pack trained models of the wardrobe and put them where 'ssilk demo' finds them, if nothing is lost by that.

    python benchmarks/ship.py cape.safetensors --stage demo_body.usdc --motions FOLDER --index FOLDER/index.json

A model is called as its garment is, and trained on what 'ssilk demo' writes into its folder `wardrobe`. It is refused
when it was trained on another mesh, or when packing moves a vertex or changes an energy by more than `precision.py`
allows on the held-out clips.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

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
from ssilk_core.demo.shipped import need_trained_on, shipped_path
from ssilk_core.errors import SsilkError, fail
from ssilk_core.files import split_location
from ssilk_core.network.checkpoint import ModelFile, save_model
from ssilk_core.physics.energy import TERMS
from ssilk_core.scene.assets import Motion, Scene


def ship(path: Path, options: Namespace) -> tuple[list[str], dict[str, Any]]:
    """Pack and write one model; return a line for the table and its figures.

    Raises:
        SsilkError: it is of another garment, or packing it loses something.
    """
    subject = open_subject(path, options.stage, options.device)
    if "shipped" in subject.file.provenance:
        fail(str(path), "packed already", "'ssilk train' writes what is needed")
    need_trained_on(build_garment(subject.name, subject.scene.character).mesh, subject.file, path)
    motions = held_out(options, subject, HELD_OUT)
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
    target = shipped_path(subject.name)
    save_model(target, published(subject.file, record(subject, found, motions)), pack=True)
    size = target.stat().st_size
    return [*loss_row(subject.name, found), f"{size:,}"], {**asdict(found), "bytes": size}


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
    return replace(file, scene=public, provenance={**without_folders(file.provenance), "shipped": shipped})


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
