# SPDX-License-Identifier: GPL-3.0-or-later
"""Training settings that are stored with each garment object."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ssilk_core.training.settings import PRESETS

from ..motions.sources import FILE, KINDS

# Paths may begin with "//", the folder of the blend file; Blender wants to be told since 4.5.
RELATIVE = {"ANIMATABLE", "PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else {"ANIMATABLE"}

SHOTS = {"LIBRARY_OVERRIDABLE"}  # what a shot may choose for a garment that it links, besides its own file

ABOUT = {
    "draft": "A first look, after minutes on any machine",
    "preview": "Nearly the final quality, after minutes on a GPU",
    "light": "A small network for many characters, after minutes on a GPU",
    "final": "What shots are made with, after ten to twenty minutes on a fast GPU",
    "paper": "The paper's own model and training, for comparison; far slower",
}
CHOICES = [(name, name.capitalize(), ABOUT[name]) for name in PRESETS]


class MotionChoice(bpy.types.PropertyGroup):
    """A motion that can be trained on; its name is that of the action, the strip, or the path of the file."""

    @property
    def called(self) -> str:
        """What people call it."""
        return bpy.path.basename(self.name) if self.kind == FILE else self.name

    kind: EnumProperty(name="Kind", items=KINDS)
    track: StringProperty(name="Track", description="NLA track of the strip")
    use: BoolProperty(name="Use", description="Train on this motion", default=True)


class TrainingSettings(bpy.types.PropertyGroup):
    """Choices for the training of one garment."""

    def listed(self) -> list[bool]:
        """Return of each motion whether the filter leaves it in the list."""
        return [self.search.lower() in item.called.lower() for item in self.motions]

    motions: CollectionProperty(type=MotionChoice, name="Motions", description="What can be trained on")
    active: IntProperty(description="The motion that is marked in the list", options={"HIDDEN"})
    search: StringProperty(
        name="Filter",
        description="List only motions with this in their names; All and None then choose among these",
        options={"TEXTEDIT_UPDATE"},
    )
    preset: EnumProperty(name="Preset", items=CHOICES, default="preview")
    iterations: IntProperty(
        name="Iterations",
        description="Optimiser steps; zero for as many as the preset has",
        default=0,
        min=0,
        max=10_000_000,
    )
    minutes: FloatProperty(
        name="Minutes",
        description="Wall time to fill with as many steps as fit, in place of the preset's; zero for these",
        default=0.0,
        min=0.0,
        soft_max=600.0,
        precision=1,
    )
    fabrics: BoolProperty(
        name="Range of Fabrics",
        description="Train for soft and stiff, light and heavy cloth at once, as all presets are, so that the fabric "
        "can be chosen while the garment is played",
    )
    folder: StringProperty(
        name="Folder",
        subtype="DIR_PATH",
        description="Folder of the garment's training, relative to the blend file",
        options=RELATIVE,
        override=SHOTS,
    )


CLASSES = (MotionChoice, TrainingSettings)
