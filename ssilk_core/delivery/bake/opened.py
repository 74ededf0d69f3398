# SPDX-License-Identifier: Apache-2.0
"""Baked shots by their suffix: stages of USD, and glTF binaries."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..targets import GLB

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot

    from ..gltf.play import GlbShot


def open_shot(path: Path) -> Shot | GlbShot:
    """Open a shot, to play it.

    Raises:
        SsilkError: not a readable shot.
    """
    if path.suffix == GLB:
        from ..gltf.play import GlbShot

        return GlbShot(path)
    from ssilk_usd.shots.play import Shot

    return Shot(path)


def provenance_of(path: Path) -> Mapping[str, Any]:
    """Return what a shot says of its origin; nothing where another program wrote it.

    Raises:
        SsilkError: not a readable shot.
    """
    if path.suffix == GLB:
        from ..gltf.play import GlbShot

        return GlbShot(path).provenance
    from ssilk_usd.reading.facts import read_provenance

    return read_provenance(path)


def add_provenance(path: Path, facts: Mapping[str, object]) -> None:
    """Let a written shot say more of itself.

    Raises:
        SsilkError: not a readable shot, or it cannot be written.
    """
    if path.suffix == GLB:
        from ..gltf.shot import add_glb_provenance

        add_glb_provenance(path, facts)
    else:
        from ssilk_usd.shots import shot

        shot.add_provenance(path, facts)
