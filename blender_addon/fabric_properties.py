# SPDX-License-Identifier: GPL-3.0-or-later
"""What a garment is made of, in physical units; lengths are shown in the scene's."""

from __future__ import annotations

import math
from dataclasses import fields

import bpy
from bpy.props import EnumProperty, FloatProperty

from ssilk_core.fabrics import FABRICS, Fabric

NUMBERS = [field.name for field in fields(Fabric) if field.name not in ("name", "stretch_model")]
SAME = 1e-5  # relative difference that single precision makes

ABOUT = {
    "default": "The paper's: light and soft",
    "silk": "Light and very soft, 80 g/m²",
    "cotton": "A shirt, 150 g/m²",
    "denim": "Stiff and heavy, 400 g/m²",
    "wool": "A coat, soft and heavy, 300 g/m²",
    "leather": "Very stiff and heavy, 600 g/m²",
}
CHOICES = [(name, name.capitalize(), ABOUT[name]) for name in FABRICS]
MODELS = [
    ("stvk", "St. Venant-Kirchhoff", "Membrane with Lamé parameters"),
    ("baraff_witkin", "Baraff-Witkin", "Stretch along the threads and shear across, by texture coordinates"),
]


def take_preset(fabric: FabricSettings, _: object = None) -> None:
    """Set all values to those of the preset."""
    for name in NUMBERS:
        fabric[_property(name)] = getattr(FABRICS[fabric.preset], name)


def _property(name: str) -> str:
    """Return the property that holds one of a fabric's numbers in SI units."""
    return "margin_meters" if name == "margin" else name


def _meters_per_unit() -> float:
    return bpy.context.scene.unit_settings.scale_length


def _get_margin(fabric: FabricSettings) -> float:
    return fabric.margin_meters / _meters_per_unit()


def _set_margin(fabric: FabricSettings, value: float) -> None:
    fabric.margin_meters = value * _meters_per_unit()


def _number(name: str, label: str, description: str, least: float = 0.0, precision: int = 3):  # type: ignore[no-untyped-def]
    return FloatProperty(
        name=label, description=description, default=getattr(FABRICS["default"], name), min=least, precision=precision
    )


class FabricSettings(bpy.types.PropertyGroup):
    """The material of one garment."""

    preset: EnumProperty(
        name="Preset", description="Cloth to start from; sets all values", items=CHOICES, update=take_preset
    )
    stretch_model: EnumProperty(name="Stretch Model", description="How the cloth resists stretching", items=MODELS)
    density: _number("density", "Density", "Mass for each area, in kg/m²", 1e-3)
    lame_mu: _number("lame_mu", "Lamé μ", "Resistance to shear of the membrane, in N/m")
    lame_lambda: _number("lame_lambda", "Lamé λ", "Resistance to changes of area of the membrane, in N/m")
    stretch: _number("stretch", "Stretch", "Stiffness along the threads, in N/m")
    shear: _number("shear", "Shear", "Stiffness across the threads, in N/m")
    bending: _number("bending", "Bending", "Stiffness of folds, in N m", precision=6)
    collision: _number("collision", "Collision", "How hard the body pushes each vertex away, in N/m")
    margin_meters: FloatProperty(
        description="Distance at which the body begins to push, in m",
        default=FABRICS["default"].margin,
        options={"HIDDEN"},
    )
    margin: FloatProperty(
        name="Margin", description="Distance at which the body begins to push", subtype="DISTANCE", min=0.0,
        precision=4, get=_get_margin, set=_set_margin,
    )  # fmt: skip
    drag: _number("drag", "Air Drag", "Resistance of the air for each area and speed, in kg/(m² s); zero is a vacuum")


def fabric_options(fabric: FabricSettings) -> list[str]:
    """Return the options by which `ssilk train` takes a garment's fabric."""
    preset, given = FABRICS[fabric.preset], ["--fabric", fabric.preset]
    if fabric.stretch_model != preset.stretch_model:
        given += ["--material", f"stretch_model={fabric.stretch_model}"]
    for name in NUMBERS:
        value = getattr(fabric, _property(name))
        if not math.isclose(value, getattr(preset, name), rel_tol=SAME):
            given += ["--material", f"{name}={value:.7g}"]
    return given


CLASSES = (FabricSettings,)
