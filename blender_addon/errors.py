# SPDX-License-Identifier: GPL-3.0-or-later
"""What an artist can mend: one sentence that names the object, what was found and what to do."""

from __future__ import annotations

from ssilk_core.errors import SsilkError


class SetupError(SsilkError):
    """A scene, a setting or a process is not as it must be; operators report it and change nothing."""
