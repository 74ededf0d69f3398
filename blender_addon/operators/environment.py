# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding, checking and creating the Python that has ssilk installed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy

from ..errors import SetupError
from ..outside import python as pythons
from ..outside.work import Work
from ..preferences import ROOT, handshake, interpreter, preferences, state
from . import tasks


class CheckPython(tasks.OutsideOperator, bpy.types.Operator):
    """Ask the chosen Python for its versions and its device"""

    bl_idname = "ssilk.check_python"
    bl_label = "Check Python"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return tasks.busy() or ("" if preferences(context).python else "Choose a Python first")

    def prepare(self, context: bpy.types.Context) -> Work:
        return ask(interpreter(preferences(context)))

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        return remember_handshake(context, work)


class FindPython(tasks.OutsideOperator, bpy.types.Operator):
    """Look for a Python that has ssilk: on the PATH, in common environments, beside the blend file"""

    bl_idname = "ssilk.find_python"
    bl_label = "Find Python"

    def prepare(self, context: bpy.types.Context) -> Work:
        found = pythons.find(places())
        if not found:
            raise SetupError("No Python with ssilk was found; choose it, or create an environment.")
        preferences(context).python = found[0]
        return ask(found[0])

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        return remember_handshake(context, work)


class CreateEnvironment(tasks.OutsideOperator, bpy.types.Operator):
    """Make a Python environment for ssilk, with what pip downloads: up to several gigabytes with PyTorch"""

    bl_idname = "ssilk.create_environment"
    bl_label = "Create Environment for SSILK"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if not bpy.app.online_access:
            return "Blender may not go online; allow it in the preferences under System, Network"
        return tasks.busy() or (
            "" if source(context) else "Choose a wheel or a project folder of ssilk to install from"
        )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        message = f"ssilk and what it needs will be downloaded into {folder()}"
        return context.window_manager.invoke_confirm(self, event, title=self.bl_label, message=message)

    def prepare(self, context: bpy.types.Context) -> Work:
        wheel = source(context)
        if not Path(wheel).exists():
            raise SetupError(f"'{wheel}' does not exist; choose a wheel or a project folder of ssilk.")
        made = folder()
        python = str(pythons.venv_python(made))
        commands = [*pythons.venv_commands(sys.executable, made, wheel), pythons.probe_command(python)]
        return Work("Creating the environment", lambda _: commands)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        preferences(context).python = str(pythons.venv_python(folder()))
        return remember_handshake(context, work)


def source(context: bpy.types.Context) -> str:
    """Return what ssilk is installed from: the choice in the preferences, else the wheel of the extension."""
    chosen = preferences(context).source
    return bpy.path.abspath(chosen) if chosen else pythons.bundled()


def ask(python: str) -> Work:
    """Start asking a Python what it has."""
    return Work("Asking the Python", lambda _: [pythons.probe_command(python)])


def remember_handshake(context: bpy.types.Context, work: Work) -> str:
    """Keep a Python's versions and device; return them in one line.

    Raises:
        SetupError: it does not fit.
    """
    settings = preferences(context)
    settings.handshake = json.dumps(work.result)
    if handshake(settings).mismatch:
        raise SetupError(handshake(settings).mismatch)
    return state(settings)[0]


def places() -> list[Path]:
    """Return folders that may hold an environment: the extension's own, and those above the blend file."""
    above = Path(bpy.data.filepath).parents if bpy.data.filepath else ()
    return [*own_folder(), *above]


def folder() -> Path:
    """Return where the extension's own environment stands.

    Raises:
        SetupError: it is not installed as an extension, and so has no place to write to.
    """
    try:
        return Path(bpy.utils.extension_path_user(ROOT, path="python"))
    except ValueError as error:
        raise SetupError("Only the installed extension can make an environment; install its zip.") from error


def own_folder() -> list[Path]:
    """Return `folder` as a list, empty where there is none."""
    try:
        return [folder()]
    except SetupError:
        return []


CLASSES = (CheckPython, FindPython, CreateEnvironment)
