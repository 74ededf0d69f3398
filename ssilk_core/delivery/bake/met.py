# SPDX-License-Identifier: Apache-2.0
"""The colliders that the cloth of a baked shot met, found again from what the shot says of its bake."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SsilkError
from ...events import Message, Reporter
from ...scene.assets import ShotWorld
from ..gltf.outfit import GARMENTS, garments_in
from ..view.props import ShotProps
from .opened import open_shot, provenance_of
from .origin import ColliderOrigin, read_met
from .shots import finished, is_stage, place_of


def props_of(shot: Path, report: Reporter) -> ShotProps | None:
    """Return the colliders that the garments of a shot, or of the stage of a folder of layers, met.

    They are read from the stage that has them: neither model nor character has to be there. None where cloth met
    none; where they are not found any more, that is reported.

    Raises:
        SsilkError: not a readable shot.
    """
    player = open_shot(shot)
    try:
        met = dict.fromkeys(found for layer, said in _garments(shot) if (found := read_met(layer, said)))
        seconds = np.array(player.frame_times) / player.fps
        world = _read(list(met), seconds, player.fps) if met and len(seconds) else None
    except SsilkError as error:
        why = str(error).removeprefix(f"{shot}: ").rstrip(".")
        report(Message(f"{shot}: the colliders that it met are not drawn: {why}", "warning"))
        return None
    return ShotProps(world, lambda frame: frame / player.fps) if world else None


def _garments(shot: Path) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield what a shot says of each of its garments, and the file that says it."""
    if is_stage(shot):
        home = shot.absolute().parent
        layers = [home / name / "anim.usdc" for name, record in finished(*place_of(shot)).items() if record]
        yield from ((layer, provenance_of(layer)) for layer in layers)
        return
    said = provenance_of(shot)
    several = [said[GARMENTS][name] for name in garments_in(said)]
    yield from ((shot, own) for own in several or [said])


def _read(met: list[ColliderOrigin], seconds: np.ndarray, fps: float) -> ShotWorld:
    from ssilk_usd.reading.world import read_named

    found = [each for own in met for each in read_named(own.stage, own.prims, seconds)]
    return ShotWorld(fps, tuple({each.path: each for each in found}.values()))
