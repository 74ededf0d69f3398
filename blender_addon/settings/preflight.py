# SPDX-License-Identifier: GPL-3.0-or-later
"""The latest preflight, as the interface holds it: neither saved nor undone."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty

from ssilk_core.authoring.preflight.finding import Finding

from ..quality.checks import mark_of

INDICES = "indices"  # custom property: what the finding is about


class FindingItem(bpy.types.PropertyGroup):
    """A finding; see `findings`."""

    severity: StringProperty(description="How bad it is")
    code: StringProperty(description="What kind it is of")
    target: StringProperty(description="Object that it is about")
    found: StringProperty(description="What was found")
    why: StringProperty(description="Why it matters")
    fix: StringProperty(description="What to do")
    fixable: BoolProperty(description="Whether it can be repaired without asking")
    elements: StringProperty(description="What the indices count")
    size: IntProperty(description="How many vertices the object had")
    mark: StringProperty(description="What differs once the object has changed; empty where it is no mesh")
    old: BoolProperty(description="Whether the object has changed since")

    @property
    def indices(self) -> list[int]:
        """What it is about."""
        return list(self.get(INDICES, ()))

    def take(self, finding: Finding, mark: str) -> None:
        """Show how many things a finding is about by now."""
        self.found, self.elements, self[INDICES] = finding.found, finding.elements, finding.indices
        self.size, self.mark, self.old = size_of(self.target), mark, False


class Preflight(bpy.types.PropertyGroup):
    """The findings on one garment."""

    garment: StringProperty(description="Garment that was inspected")
    findings: CollectionProperty(type=FindingItem, description="What was found")
    active: IntProperty(description="The finding that is shown")


def keep_findings(context: bpy.types.Context, garment: str, findings: Sequence[Finding]) -> None:
    """Show findings, in place of earlier ones."""
    preflight = context.window_manager.ssilk_preflight
    preflight.findings.clear()
    preflight.garment, preflight.active = garment, 0
    for finding in findings:
        item = preflight.findings.add()
        for name in ("severity", "code", "found", "why", "fix", "fixable", "elements"):
            setattr(item, name, getattr(finding, name))
        item.target, item[INDICES] = finding.prim, finding.indices
        item.size, item.mark = size_of(finding.prim), mark_of(finding.prim)


def shown_finding(context: bpy.types.Context) -> FindingItem | None:
    """Return the finding that is shown; None where there is none."""
    preflight = context.window_manager.ssilk_preflight
    return preflight.findings[preflight.active] if preflight.active < len(preflight.findings) else None


def size_of(name: str) -> int:
    """Return how many vertices an object has; -1 where there is no such mesh."""
    thing = bpy.data.objects.get(name)
    return len(thing.data.vertices) if thing and thing.type == "MESH" else -1


CLASSES = (FindingItem, Preflight)


def attach() -> None:
    """Give the interface the latest preflight."""
    bpy.types.WindowManager.ssilk_preflight = PointerProperty(type=Preflight)


def detach() -> None:
    """Remove it."""
    del bpy.types.WindowManager.ssilk_preflight
