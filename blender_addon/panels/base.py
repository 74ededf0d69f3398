# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions and base classes that panels share."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from functools import wraps
from typing import Any

import bpy

from ssilk_core.errors import SsilkError

from ..operators import tasks
from ..scene.garment import unplayable, unusable

LETTER = 7  # how wide a letter is on average [pixels, at an interface scale of one]
MARGIN = 40  # beside text in a panel [pixels, likewise]


def draw_text(layout: bpy.types.UILayout, text: str, icon: str = "NONE") -> None:
    """Draw text in as many lines as the region needs; labels would be cut short."""
    column = layout.column(align=True)
    for number, line in enumerate(lines(text, bpy.context.region.width if bpy.context.region else 0)):
        column.label(text=line, icon=icon if number == 0 else "NONE", translate=False)


def lines(text: str, width: int) -> list[str]:
    """Return text in lines that fit into a region's width [pixels]; zero stands for a usual one."""
    scale = bpy.context.preferences.system.ui_scale or 1.0  # zero where there is no display
    return textwrap.wrap(text, max(20, int(((width or 300) / scale - MARGIN) / LETTER)))


def draw_work(layout: bpy.types.UILayout) -> None:
    """Draw what runs outside, with a button that stops it."""
    work = tasks.current
    if work is None:
        draw_failure(layout)
        return
    draw_text(layout, f"{work.title}: stopping" if work.cancelled else work.title)
    row = layout.row(align=True)
    row.progress(factor=work.fraction or 0.0, text=work.share)
    row.operator("ssilk.cancel", text="", icon="CANCEL")
    if work.text:
        draw_text(layout, work.text)


def draw_failure(layout: bpy.types.UILayout) -> None:
    """Draw why the latest work failed, until it is dismissed or other work begins."""
    if tasks.failed:
        row = layout.row()
        draw_text(row, tasks.failed, icon="ERROR")
        row.operator("ssilk.dismiss_failure", text="", icon="X")


def saying_errors(draw: Callable[[Any, bpy.types.Context], None]) -> Callable[[Any, bpy.types.Context], None]:
    """Return a panel's `draw` that says what is wrong with the scene in place of the rest of the panel."""

    @wraps(draw)
    def told(panel: Any, context: bpy.types.Context) -> None:
        try:
            draw(panel, context)
        except SsilkError as error:
            draw_text(panel.layout, str(error), icon="ERROR")

    return told


class SidebarPanel:
    """Base of all panels, whose `draw` is `saying_errors`.

    Attributes:
        section: chapter of the guide that is about the panel.
    """

    section = ""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SSILK"

    def draw_header_preset(self, _: bpy.types.Context) -> None:
        """Draw a button that opens the guide, at the right end of the panel's header."""
        self.layout.operator("ssilk.open_guide", text="", icon="HELP", emboss=False).section = self.section


class PlayableGarmentPanel(SidebarPanel):
    """Base of the panels that are there for a garment that a shot links and overrides, too."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unplayable(context.object)


class UsableGarmentPanel(SidebarPanel):
    """Base of the panels that are there for a garment alone, and not for one that cannot be used."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)
