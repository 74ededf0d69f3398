# SPDX-License-Identifier: Apache-2.0
"""Trained models of the wardrobe that ship with the package, on the demo's body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import fail
from ..network.checkpoint import ModelFile, load_model
from ..scene.assets import Mesh

FOLDER = Path(__file__).with_name("models")
FAMILY_SUFFIX = "_family"  # behind a garment's name: its model for a family of bodies
TOLERANCE = 0.01  # [m] between the garment of a model, which was settled, and the one that is built here


def shipped_path(garment: str) -> Path:
    """Return where the shipped model of a garment of the wardrobe lies."""
    return FOLDER / f"{garment}.safetensors"


def garment_of(name: str) -> str:
    """Return the garment of the wardrobe that a shipped model is of."""
    return name.removesuffix(FAMILY_SUFFIX)


def open_shipped(garment: str, mesh: Mesh) -> ModelFile:
    """Load the shipped model of a garment.

    Args:
        garment: its name in the wardrobe.
        mesh: the garment as it is built here.

    Raises:
        SsilkError: there is no such file, it cannot be read, or it was trained on another mesh.
    """
    path = shipped_path(garment)
    if not path.is_file():
        fail(
            str(path),
            "the shipped model is missing",
            "it comes with the project's own wheel and clone, not with the Blender extension's",
            "install ssilk from a clone",
        )
    file = load_model(path)
    need_trained_on(mesh, file, path)
    return file


def need_trained_on(mesh: Mesh, file: ModelFile, path: Path) -> None:
    """Raise `SsilkError` unless a model's garment is `mesh`: as many faces, and points to within `TOLERANCE`.

    Where `rig` settled the garment, the other diagonal may divide a quad.
    """
    own, todo = file.scene.garment.mesh, "train it again on the garment as it is now"
    if own.faces.shape != mesh.faces.shape or own.vertex_count != mesh.vertex_count:
        fail(
            str(path),
            f"trained on a garment of {own.vertex_count} vertices and {len(own.faces)} triangles",
            f"{mesh.path} has {mesh.vertex_count} and {len(mesh.faces)} here",
            todo,
        )
    away = np.abs(own.points - mesh.points).max()
    if not away < TOLERANCE:
        fail(
            str(path),
            f"trained on a garment that is {away:.3g} m away from {mesh.path}",
            f"at most {TOLERANCE:g} m is allowed",
            todo,
        )


def origin(file: ModelFile) -> str:
    """Return in words how a shipped model came to be."""
    made, shipped, later = file.provenance, file.provenance["shipped"], list[str]()
    seed = made["seed"]
    while "base" in made:  # `train --stepper-of` or `--start-from`
        later.insert(0, f", then {made['iteration']:,}" + ("" if made.get("whole") else " of the stepper alone"))
        made = made["base"]
    return (
        f"{made['iteration']:,} iterations{''.join(later)} on {len(made['motions'])} motions, seed {seed}, "
        f"{made['device']}, ssilk {made['ssilk']}, {shipped['date']}; "
        f"on {shipped['held-out clips']} held-out motions "
        f"{shipped['energy [J]']:.3g} J, linear blend skinning {shipped['linear blend skinning [J]']:.3g} J, "
        f"{shipped['inside the body']:.2%} of its vertices inside the body; stored to 16 bits"
    )
