# SPDX-License-Identifier: GPL-3.0-or-later
"""What a garment is made of, in physical units; lengths are shown in the scene's."""

from __future__ import annotations

import math
from dataclasses import fields

import bpy
from bpy.props import EnumProperty, FloatProperty

from ssilk_core.scene.fabrics import FABRICS, Fabric

WORDS = ("stretch_model", "contact_model")
LENGTHS = ("margin", "thickness")  # shown in the scene's units
NUMBERS = [field.name for field in fields(Fabric) if field.name not in ("name", "friction", *WORDS)]  # it trains
SAME = 1e-5  # relative difference that single precision makes

ABOUT = {
    "default": "Light and soft",
    "paper": "The paper's energy of contact, which depends on the mesh",
    "silk": "Light and very soft, 80 g/m²",
    "cotton": "A shirt, 150 g/m²",
    "denim": "Very stiff and heavy, 400 g/m²",
    "wool": "A coat, soft and heavy, 300 g/m²",
    "leather": "Stiff and very heavy, 600 g/m²",
}
CHOICES = [(name, name.capitalize(), ABOUT[name]) for name in FABRICS]
MODELS = [
    ("stvk", "St. Venant-Kirchhoff", "Membrane with Lamé parameters"),
    ("baraff_witkin", "Baraff-Witkin", "Stretch along the threads and shear across, by texture coordinates"),
]

CONTACTS = [
    ("surface", "Surface", "The body pushes each area of the cloth, whatever its mesh"),
    ("vertex", "Vertex", "The body pushes each vertex, as in the paper; a coarse mesh resists less"),
]


def take_preset(fabric: FabricSettings, _: object = None) -> None:
    """Set all values to those of the preset."""
    preset = FABRICS[fabric.preset]
    for name in NUMBERS:
        fabric[_property(name)] = getattr(preset, name)
    for name in WORDS:
        setattr(fabric, name, getattr(preset, name))


def _property(name: str) -> str:
    """Return the property that holds one of a fabric's numbers in SI units."""
    return f"{name}_meters" if name in LENGTHS else name


def _meters_per_unit() -> float:
    return bpy.context.scene.unit_settings.scale_length


def _number(name: str, label: str, description: str, least: float = 0.0, precision: int = 3):  # type: ignore[no-untyped-def]
    return FloatProperty(
        name=label, description=description, default=getattr(FABRICS["default"], name), min=least, precision=precision
    )


def _length(name: str, label: str, description: str):  # type: ignore[no-untyped-def]
    """Return a property in the scene's units of a length that is stored in meters."""

    def get(fabric: FabricSettings) -> float:
        return getattr(fabric, _property(name)) / _meters_per_unit()

    def put(fabric: FabricSettings, value: float) -> None:
        setattr(fabric, _property(name), value * _meters_per_unit())

    return FloatProperty(
        name=label, description=description, subtype="DISTANCE", min=0.0, precision=4, get=get, set=put
    )


def _meters(name: str, description: str):  # type: ignore[no-untyped-def]
    return FloatProperty(description=description, default=getattr(FABRICS["default"], name), options={"HIDDEN"})


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
    contact_model: EnumProperty(name="Contact Model", description="What the body pushes away", items=CONTACTS)
    contact: _number(
        "contact", "Contact", "How hard the body pushes each area away at the skin, in N/m³", precision=0
    )
    loose_contact: _number(
        "loose_contact", "Loose Contact", "The same of loose cloth; a soft one slides off hands", precision=0
    )
    collision: _number("collision", "Collision", "How hard the body pushes each vertex away, in N/m")
    margin_meters: _meters("margin", "Gap at which the body begins to push, in m")
    margin: _length("margin", "Margin", "Gap between cloth and body at which the body begins to push")
    thickness_meters: _meters("thickness", "Thickness of the cloth, in m")
    thickness: _length("thickness", "Thickness", "Thickness of the cloth, whose mesh lies in its middle")
    tether: _number(
        "tether", "Tether", "How firmly tight cloth stays over its skin, in N/m³; zero lets it slide", precision=0
    )
    stitch: _number(
        "stitch",
        "Stitch",
        "How firmly parts that lie on others hold there, such as straps and pockets, in N/m³; zero lets them part",
        precision=0,
    )
    drag: _number("drag", "Air Drag", "Resistance of the air for each area and speed, in kg/(m² s); zero is a vacuum")


def fabric_options(fabric: FabricSettings) -> list[str]:
    """Return the options by which `ssilk train` takes a garment's fabric."""
    preset, given = FABRICS[fabric.preset], ["--fabric", fabric.preset]
    for name in WORDS:
        if getattr(fabric, name) != getattr(preset, name):
            given += ["--material", f"{name}={getattr(fabric, name)}"]
    for name in NUMBERS:
        value = getattr(fabric, _property(name))
        if not math.isclose(value, getattr(preset, name), rel_tol=SAME):
            given += ["--material", f"{name}={value:.7g}"]
    return given


CLASSES = (FabricSettings,)
