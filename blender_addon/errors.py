# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors that an artist can fix: one sentence that names the object, what was found and what to do."""

from __future__ import annotations

from ssilk_core.errors import SsilkError


class SetupError(SsilkError):
    """A scene, a setting or a process is wrong; operators report it and change nothing."""
