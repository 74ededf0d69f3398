# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's preferences: which Python has ssilk, with its versions and device."""

from __future__ import annotations

import json

import bpy
from bpy.props import BoolProperty, StringProperty

from .outside.python import Handshake

ROOT = __package__  # the extension's name, by which Blender knows its preferences and folders
CPU = ("cpu", "mps")  # begin the names of devices that want a draft


def _forget(preferences: Preferences, _: object) -> None:
    preferences.handshake = ""


class Preferences(bpy.types.AddonPreferences):
    """Shown in Blender's preferences, under the extension."""

    bl_idname = ROOT

    python: StringProperty(
        name="Python",
        description="Interpreter of the environment in which ssilk is installed",
        subtype="FILE_PATH",
        update=_forget,
    )
    source: StringProperty(
        name="Install From",
        description="A wheel of ssilk, or the folder of its project, to make an environment from; "
        "what came with the extension when empty",
        subtype="FILE_PATH",
    )
    stop_trainings: BoolProperty(
        name="Stop Trainings with Blender",
        description="End trainings when Blender closes; otherwise they go on. The best model is kept either way",
    )
    handshake: StringProperty(description="What the Python said of itself (JSON)", options={"HIDDEN"})

    def draw(self, _: bpy.types.Context) -> None:
        """Draw the settings."""
        from .panels.base import draw_work

        row = self.layout.row(align=True)
        row.prop(self, "python")
        row.operator("ssilk.find_python", text="", icon="VIEWZOOM")
        row.operator("ssilk.check_python", text="", icon="FILE_REFRESH")
        text, icon = state(self)
        self.layout.label(text=text, icon=icon)
        row = self.layout.row(align=True)
        row.prop(self, "source")
        row.operator("ssilk.create_environment", text="Create", icon="ADD")
        self.layout.prop(self, "stop_trainings")
        draw_work(self.layout)


def preferences(context: bpy.types.Context) -> Preferences:
    """Return the extension's preferences."""
    return context.preferences.addons[ROOT].preferences


def interpreter(settings: Preferences) -> str:
    """Return the path of the chosen Python, empty if none is."""
    return bpy.path.abspath(settings.python) if settings.python else ""


def handshake(settings: Preferences) -> Handshake | None:
    """Return what the chosen Python said of itself; None before it was asked."""
    if not settings.handshake:
        return None
    return Handshake.of(interpreter(settings), json.loads(settings.handshake))


def on_processor(context: bpy.types.Context) -> bool:
    """Return whether trainings run on a processor, as where nothing is known of a GPU."""
    met = handshake(preferences(context))
    return not (met and met.device) or met.device.startswith(CPU)


def state(settings: Preferences) -> tuple[str, str]:
    """Return one line about the chosen Python, and an icon."""
    met = handshake(settings)
    if met:
        return (met.mismatch, "ERROR") if met.mismatch else (met.summary, "CHECKMARK")
    return ("Not checked yet", "QUESTION") if settings.python else ("No Python with ssilk is chosen", "ERROR")


def unready(context: bpy.types.Context) -> str:
    """Return why nothing can run outside; empty if it can."""
    settings = preferences(context)
    met = handshake(settings)
    if not settings.python:
        return "No Python with ssilk is chosen; find one in the extension's preferences"
    if met is None:
        return "The Python with ssilk was not checked yet; do so in the extension's preferences"
    return met.mismatch


def no_certificates(context: bpy.types.Context) -> str:
    """Return why no bake can be certified, besides why none can run; empty if it can."""
    met = handshake(preferences(context))
    return met.no_certificates if met else ""


CLASSES = (Preferences,)
