# SPDX-License-Identifier: Apache-2.0
"""Stages that ship with the package: the body of the demo."""

from __future__ import annotations

from pathlib import Path


def demo_body_path() -> Path:
    """Return the path of the stage of the demo's body; LICENSE.md beside it states its licence and origin."""
    return Path(__file__).with_name("demo_body.usdc")
