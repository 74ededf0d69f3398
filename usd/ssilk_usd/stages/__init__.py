# SPDX-License-Identifier: Apache-2.0
"""Stages that ship with the package: the body of the demo, and others of its family."""

from __future__ import annotations

from pathlib import Path

# The neutral adult, those that garments of a family are trained for as well, and those that training never sees.
TRAINED_BODIES = ("tall", "heavy", "slight", "muscular")
DEMO_BODIES = ("", *TRAINED_BODIES, "man", "young", "stout")


def demo_body_path(name: str = "") -> Path:
    """Return the path of the stage of one of `DEMO_BODIES`; LICENSE.md beside it states its licence and origin."""
    return Path(__file__).with_name(f"demo_body_{name}.usdc" if name else "demo_body.usdc")
