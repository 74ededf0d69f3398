# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that report what they did, or why they could not, in one sentence."""

from __future__ import annotations

import bpy

from ssilk_core.errors import SsilkError


class RefusingOperator:
    """Base of operators that say why they cannot be used now; subclasses give `refusal`."""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """Return why this cannot be done now; empty if it can."""
        return ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return whether this can be done now; the tooltip says why not."""
        reason = cls.refusal(context)
        cls.poll_message_set(reason)
        return not reason


class ReportingOperator(RefusingOperator):
    """Base of operators that do their work at once; subclasses give `apply`."""

    def apply(self, context: bpy.types.Context) -> str:
        """Do the work; return what to tell, empty if it shows. Raise `SetupError` before anything is changed."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the work and report it."""
        try:
            told = self.apply(context)
        except SsilkError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if told:
            self.report({"INFO"}, told)
        return {"FINISHED"}
