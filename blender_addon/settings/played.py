# SPDX-License-Identifier: GPL-3.0-or-later
"""The fabric that a garment plays and bakes in, as factors of its model's own, which knows a range; its friction."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty

from ssilk_core.errors import SsilkError
from ssilk_core.scene.fabric_range import FACTORS
from ssilk_core.scene.fabrics import FABRICS, MOST_FRICTION

from .fabric import CHOICES
from .training import SHOTS

OWN = "OWN"  # the fabric of the model's training
PRESETS = [(OWN, "As Trained", "The fabric of its training"), *(each for each in CHOICES if each[0] != "paper")]
RANGED = [name for name in FABRICS if name not in ("default", "paper")]  # that trainings for a range span
ABOUT = {
    "stretch": "How much stiffer the cloth is than in its training",
    "shear": "How much stiffer it is against shear, beside Stretch",
    "bending": "How much stiffer folds are than in its training",
    "density": "How much heavier the cloth is than in its training",
    "drag": "How much more the air holds it than in its training",
}


def _play(played: PlayedFabric, _: object = None) -> None:
    from ..playback import playing

    playing.change_fabric(played.id_data)


def take_preset(played: PlayedFabric, _: object = None) -> None:
    """Set the factors to those of the preset; all are one for a preset that no model can be put on."""
    from ..playback.models import fabrics_of

    factors, known = np.ones(len(FACTORS)), None
    if played.preset != OWN:
        try:
            known = fabrics_of(played.id_data)
            factors = known[1].factors_of(known[0], played.preset) if known else factors
        except SsilkError:  # of which playing and baking tell
            pass
    for name, factor in zip(FACTORS, factors.tolist()):
        setattr(played, name, factor)


def _factor(name: str):  # type: ignore[no-untyped-def]
    return FloatProperty(
        name="Air Drag" if name == "drag" else name.capitalize(),
        description=ABOUT[name],
        default=1.0,
        min=1e-3,
        max=1e3,
        soft_min=0.25,
        soft_max=4.0,
        precision=2,
        update=_play,
        override=SHOTS,
    )


class PlayedFabric(bpy.types.PropertyGroup):
    """Factors of the fabric that a model was trained with, and friction, which solvers alone know."""

    preset: EnumProperty(
        name="Preset",
        description="Cloth to play; sets all factors",
        items=PRESETS,
        update=take_preset,
        override=SHOTS,
    )
    stretch: _factor("stretch")
    shear: _factor("shear")
    bending: _factor("bending")
    density: _factor("density")
    drag: _factor("drag")
    friction: FloatProperty(
        name="Friction",
        description="Coulomb's coefficient of the cloth, 0.2 to 1 on skin; bakes as Hero know it",
        min=0.0,
        max=MOST_FRICTION,
        precision=2,
        override=SHOTS,
    )


CLASSES = (PlayedFabric,)
