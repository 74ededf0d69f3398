# SPDX-License-Identifier: Apache-2.0
"""The dial between fast and near to the simulator, as a picture and a table."""

from __future__ import annotations

from pathlib import Path


def draw(path: Path) -> None:
    """Draw the dial."""
