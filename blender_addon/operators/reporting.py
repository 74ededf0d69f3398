# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that tell what they did, or in one sentence why they could not."""

from __future__ import annotations

import bpy

from ..errors import SetupError


class ReportingOperator:
    """Base of operators that do their work at once; subclasses give `apply`."""

    def apply(self, context: bpy.types.Context) -> str:
        """Do the work; return what to tell, empty if it shows. Raise `SetupError` before anything is changed."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the work and report it."""
        try:
            told = self.apply(context)
        except SetupError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if told:
            self.report({"INFO"}, told)
        return {"FINISHED"}
