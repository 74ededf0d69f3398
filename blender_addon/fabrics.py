# SPDX-License-Identifier: GPL-3.0-or-later
"""The fabrics that ssilk has, and how one is asked for on its command line."""

from __future__ import annotations

import math
from collections.abc import Mapping

STRETCH_MODELS = ("stvk", "baraff_witkin")
_DEFAULT = {
    "density": 0.15, "lame_mu": 22.2, "lame_lambda": 41.8, "stretch": 20.0, "shear": 2.0, "bending": 1e-5,
    "collision": 10.0, "margin": 4e-3, "drag": 0.3,
}  # fmt: skip
PRESETS: dict[str, dict[str, float]] = {
    "default": _DEFAULT,
    "silk": {**_DEFAULT, "density": 0.08, "lame_mu": 15.0, "lame_lambda": 28.0, "stretch": 14.0, "shear": 1.2,
             "bending": 3e-6},
    "cotton": {**_DEFAULT, "density": 0.15, "lame_mu": 30.0, "lame_lambda": 45.0, "stretch": 27.0, "shear": 3.0,
               "bending": 1.5e-5},
    "denim": {**_DEFAULT, "density": 0.40, "lame_mu": 80.0, "lame_lambda": 100.0, "stretch": 70.0, "shear": 10.0,
              "bending": 1e-4},
    "wool": {**_DEFAULT, "density": 0.30, "lame_mu": 35.0, "lame_lambda": 50.0, "stretch": 30.0, "shear": 4.0,
             "bending": 5e-5},
    "leather": {**_DEFAULT, "density": 0.60, "lame_mu": 120.0, "lame_lambda": 160.0, "stretch": 110.0, "shear": 25.0,
                "bending": 4e-4},
}  # fmt: skip
SAME = 1e-5  # relative difference that single precision makes


def options(preset: str, stretch_model: str, values: Mapping[str, float]) -> list[str]:
    """Return the options by which `ssilk train` takes a preset with these values in SI units."""
    given = ["--fabric", preset]
    if stretch_model != STRETCH_MODELS[0]:
        given += ["--material", f"stretch_model={stretch_model}"]
    for name, value in values.items():
        if not math.isclose(value, PRESETS[preset][name], rel_tol=SAME):
            given += ["--material", f"{name}={value:.7g}"]
    return given
