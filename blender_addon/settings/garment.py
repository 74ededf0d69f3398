# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings that are stored with each garment object."""

from __future__ import annotations

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ssilk_core.scene.assets import SOFTEST, STIFFEST
from ssilk_core.scene.kinematics import MAX_HOLD

from ..scene.classes import tighten
from . import fabric, played, training, try_on
from .fabric import FabricSettings
from .played import PlayedFabric
from .training import RELATIVE, SHOTS, TrainingSettings
from .try_on import TryOnSettings

LIVE_QUALITIES = [
    ("NETWORK", "Network", "The network's own motion, at once"),
    (
        "latent",
        "Latent",
        "As Bake solves it: in the Python with ssilk, frame by frame in the background; meets no colliders",
    ),
    ("latent_few", "Latent, Few Elements", "Likewise in a quarter of the time, on a sample of the cloth: less exact"),
]


def _is_armature(_: object, thing: bpy.types.Object) -> bool:
    return thing.type == "ARMATURE"


def _tighten(settings: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    garment = settings.id_data
    if garment.type == "MESH" and garment.mode != "EDIT" and not garment.data.library:
        tighten(garment.data, settings.tightness)


def _play_otherwise(settings: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    from ..playback import playing

    playing.play_otherwise(settings.id_data)


class BoneMatch(bpy.types.PropertyGroup):
    """A bone that is called otherwise than when the garment was trained; its name is the one from then."""

    bone: StringProperty(
        name="Bone", description="What this bone of the training is called now; empty where it is not chosen",
        override=SHOTS,
    )  # fmt: skip


class GarmentSettings(bpy.types.PropertyGroup):
    """Choices for one garment; where one is empty, what is meant is found (see `scene.garment`)."""

    armature: PointerProperty(
        type=bpy.types.Object,
        poll=_is_armature,
        name="Armature",
        description="Armature of the character that wears the garment; found by its Armature modifier when empty",
        override=SHOTS,
    )
    bodies: PointerProperty(
        type=bpy.types.Collection,
        name="Bodies",
        description="Meshes that the garment collides with; all others bound to the armature when empty",
        override=SHOTS,
    )
    colliders: PointerProperty(
        type=bpy.types.Collection,
        name="Colliders",
        description="Meshes that the garment meets besides its bodies, with Collision physics or without",
        override=SHOTS,
    )
    layer: IntProperty(
        description="Place among the garments of the character, from the skin on; zero where it is in no order",
        default=0, min=0, options={"HIDDEN"}, override=SHOTS,
    )  # fmt: skip
    fabric: PointerProperty(type=FabricSettings, name="Fabric", description="What the garment is made of")
    played: PointerProperty(
        type=PlayedFabric, name="Played Fabric", description="What the garment is played and baked as", override=SHOTS
    )
    try_on: PointerProperty(type=TryOnSettings, name="Try On", description="Which other body it is tried on")
    tightness: FloatProperty(
        name="Tightness",
        description="How much of the garment is tight: nothing but what is pinned, or all; replaces what is painted, "
        "once classes were found automatically",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=_tighten,
    )
    pins: StringProperty(
        name="Pins",
        description="Vertex group of what is pinned when classes are found; the band it hangs from when empty",
    )
    model: StringProperty(
        name="Model",
        subtype="FILE_PATH",
        options=RELATIVE,
        description="Trained model of the garment; that of its own training when empty",
        override=SHOTS,
    )
    stiff: StringProperty(
        name="Stiffer",
        description="Vertex group in which the cloth is stiffer, such as a collar, or softer; weights lie between",
    )
    stiffness: FloatProperty(
        name="By",
        description="What stretching and bending are multiplied by where the weight is one; below one it is softer",
        default=10.0,
        min=SOFTEST,
        max=STIFFEST,
    )
    free: FloatProperty(
        name="Free",
        description="How much the network moves the garment: at 0 its bones carry it. Keyed, it holds the garment "
        "and lets it go",
        default=1.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        override=SHOTS,
    )
    part: StringProperty(
        name="Part",
        description="Vertex group that has a slider of its own: the proxies that move it are held with it",
        override=SHOTS,
    )
    part_free: FloatProperty(
        name="Part Free",
        description="How much the network moves the vertex group: at 0 its bones carry it",
        default=1.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        override=SHOTS,
    )
    hand_pose: PointerProperty(
        type=bpy.types.Action,
        name="Posed By",
        description="Action with keys of proxies, which these follow as far as their slider Posed says",
        override=SHOTS,
    )
    hold: IntProperty(
        name="Hold Frames",
        description="For how many frames each pose of the garment is held: 2 for animation on twos",
        default=1,
        min=1,
        max=MAX_HOLD,
        override=SHOTS,
    )
    loop: BoolProperty(
        name="Loop",
        description="The motion is a cycle: a bake plays it until the garment repeats, and its last frame flows into "
        "its first",
        override=SHOTS,
    )
    certify: BoolProperty(
        name="Certify",
        description="Move baked frames as little as it takes until the garment does not pass through itself and no "
        "skin shows that it covers; other garments of an outfit are not looked at. A wrong frame takes seconds",
        override=SHOTS,
    )
    bones: CollectionProperty(
        type=BoneMatch,
        description="Bones of the training that the artist has found again",
        options={"HIDDEN"},
        override={*SHOTS, "USE_INSERTION"},
    )
    live: BoolProperty(description="Whether the garment is played live", options={"HIDDEN"}, override=SHOTS)
    live_quality: EnumProperty(
        name="Quality",
        description="What is played live",
        items=LIVE_QUALITIES,
        update=_play_otherwise,
        override=SHOTS,
    )
    awaited: BoolProperty(description="Whether it is played as soon as its training has a model", options={"HIDDEN"})
    heat: StringProperty(description="What the heat map shows; empty for none", options={"HIDDEN"}, override=SHOTS)
    heat_told: StringProperty(
        description="What the heat map shows in this frame, in words", options={"HIDDEN"}, override=SHOTS
    )
    heat_red: FloatProperty(description="Value that is red", options={"HIDDEN"}, override=SHOTS)
    training: PointerProperty(
        type=TrainingSettings, name="Training", description="How the garment is trained", override=SHOTS
    )


CLASSES = (*training.CLASSES, *fabric.CLASSES, *played.CLASSES, *try_on.CLASSES, BoneMatch, GarmentSettings)


def attach() -> None:
    """Give every object the settings, and every bone those of a proxy, which Blender keys without a group alone."""
    bpy.types.Object.ssilk = PointerProperty(type=GarmentSettings, override=SHOTS)
    bpy.types.PoseBone.ssilk_free = FloatProperty(
        name="Free",
        description="How much the network moves this proxy: at 0 it goes where the garment's bones carry its cloth",
        default=1.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        override=SHOTS,
    )
    bpy.types.PoseBone.ssilk_posed = FloatProperty(
        name="Posed",
        description="How far this proxy follows the action that poses proxies by hand (Posed By)",
        default=0.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        override=SHOTS,
    )


def detach() -> None:
    """Remove them; chosen values stay in the file."""
    del bpy.types.Object.ssilk, bpy.types.PoseBone.ssilk_free, bpy.types.PoseBone.ssilk_posed
