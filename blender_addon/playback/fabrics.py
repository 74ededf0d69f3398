# SPDX-License-Identifier: GPL-3.0-or-later
"""The fabric that is chosen for a garment, for those who play and bake it."""

from __future__ import annotations

import bpy
import numpy as np

from ssilk_core.network.checkpoint import ModelFile
from ssilk_core.scene.fabric_range import FACTORS, fabric_with

SAME = 1e-5  # relative difference that single precision makes


def played_factors(garment: bpy.types.Object) -> np.ndarray:
    """Return the factors that are chosen for a garment, shape (5,), in the order of `FACTORS`."""
    return np.array([getattr(garment.ssilk.played, name) for name in FACTORS])


def played_options(garment: bpy.types.Object) -> list[str]:
    """Return the options by which `ssilk bake` and `ssilk live` take them."""
    chosen = zip(FACTORS, played_factors(garment).tolist())
    factors = [f"{name}={factor:.7g}x" for name, factor in chosen if abs(factor - 1) > SAME]
    return [word for factor in factors for word in ("--material", factor)]


def friction_options(garment: bpy.types.Object) -> list[str]:
    """Return the option by which `ssilk bake` takes the friction that is chosen for a garment."""
    chosen = garment.ssilk.played.friction
    return ["--material", f"friction={chosen:.7g}"] if chosen else []


def in_fabric(file: ModelFile, factors: np.ndarray) -> ModelFile:
    """Return a model in a fabric of its range; as it is where it knows none."""
    return file.on_fabric(fabric_with(file.fabric, factors)) if file.fabrics else file
