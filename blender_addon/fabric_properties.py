# SPDX-License-Identifier: GPL-3.0-or-later
"""What a garment is made of, in physical units; lengths are shown in the scene's."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, FloatProperty

from . import fabrics

CHOICES = [
    ("default", "Default", "The paper's: light and soft"),
    ("silk", "Silk", "Light and very soft, 80 g/m²"),
    ("cotton", "Cotton", "A shirt, 150 g/m²"),
    ("denim", "Denim", "Stiff and heavy, 400 g/m²"),
    ("wool", "Wool", "A coat, soft and heavy, 300 g/m²"),
    ("leather", "Leather", "Very stiff and heavy, 600 g/m²"),
]
MODELS = [
    ("stvk", "St. Venant-Kirchhoff", "Membrane with Lamé parameters"),
    ("baraff_witkin", "Baraff-Witkin", "Stretch along the threads and shear across, by texture coordinates"),
]


def take_preset(fabric: FabricSettings, _: object = None) -> None:
    """Set all values to those of the preset."""
    for name, value in fabrics.PRESETS[fabric.preset].items():
        fabric[name if name != "margin" else "margin_meters"] = value


def _meters_per_unit() -> float:
    return bpy.context.scene.unit_settings.scale_length


def _get_margin(fabric: FabricSettings) -> float:
    return fabric.margin_meters / _meters_per_unit()


def _set_margin(fabric: FabricSettings, value: float) -> None:
    fabric.margin_meters = value * _meters_per_unit()


def _number(name: str, label: str, description: str, least: float = 0.0, precision: int = 3):  # type: ignore[no-untyped-def]
    return FloatProperty(
        name=label, description=description, default=fabrics.PRESETS["default"][name], min=least, precision=precision
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
        description="Distance at which the body begins to push, in m", default=0.004, options={"HIDDEN"}
    )
    margin: FloatProperty(
        name="Margin", description="Distance at which the body begins to push", subtype="DISTANCE", min=0.0,
        precision=4, get=_get_margin, set=_set_margin,
    )  # fmt: skip
    drag: _number("drag", "Air Drag", "Resistance of the air for each area and speed, in kg/(m² s); zero is a vacuum")


def fabric_options(fabric: FabricSettings) -> list[str]:
    """Return the options by which `ssilk train` takes a garment's fabric."""
    values = {name: getattr(fabric, name) for name in fabrics.PRESETS["default"] if name != "margin"}
    return fabrics.options(fabric.preset, fabric.stretch_model, {**values, "margin": fabric.margin_meters})


CLASSES = (FabricSettings,)
