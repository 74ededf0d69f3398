# SPDX-License-Identifier: GPL-3.0-or-later
"""The guide, opened at the chapter that is about a panel."""

from __future__ import annotations

import tomllib
import webbrowser
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..errors import SetupError
from .reporting import ReportingOperator

HERE = Path(__file__).parents[1]
MANIFEST = HERE / "blender_manifest.toml"
GUIDES = HERE / "guide" / "index.html", HERE.parent / "docs" / "artist_guide.md"  # in the zip; in the repository


class OpenGuide(ReportingOperator, bpy.types.Operator):
    """Open the guide at what it says of this panel"""

    bl_idname = "ssilk.open_guide"
    bl_label = "Help"

    section: StringProperty(description="Chapter of the guide", options={"HIDDEN", "SKIP_SAVE"})

    def apply(self, context: bpy.types.Context) -> str:
        address = guide(self.section)
        if not webbrowser.open(address):
            raise SetupError(f"No browser could be opened; the guide is {address}.")
        return ""


def guide(section: str) -> str:
    """Return the address of a chapter of the guide: on the website that the manifest names, else beside the sources.

    Raises:
        SetupError: the installation is incomplete.
    """
    website = tomllib.loads(MANIFEST.read_text(encoding="utf-8")).get("website", "")
    page = website or next((path.as_uri() for path in GUIDES if path.is_file()), "")
    if not page:
        raise SetupError(f"There is no guide at {GUIDES[0]}; install the extension again.")
    return f"{page}#{section}" if section else page


CLASSES = (OpenGuide,)
