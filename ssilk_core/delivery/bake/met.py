# SPDX-License-Identifier: Apache-2.0
"""The colliders that the cloth of a baked shot met, found again from what the shot says of its bake."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import SsilkError
from ...events import Message, Reporter
from ...scene.assets import ShotWorld
from ..view.props import ShotProps
from .opened import open_shot
from .origin import ColliderOrigin, read_met
from .shots import STAGE, finished


def props_of(shot: Path, report: Reporter) -> ShotProps | None:
    """Return the colliders that the garments of a shot, or of the stage of a folder of layers, met.

    They are read from the stage that has them: neither model nor character has to be there. None where cloth met
    none; where they are not found any more, that is reported.

    Raises:
        SsilkError: not a readable shot.
    """
    player = open_shot(shot)
    try:
        met = dict.fromkeys(found for layer in _layers(shot) if (found := read_met(layer)))
        seconds = np.array(player.frame_times) / player.fps
        world = _read(list(met), seconds, player.fps) if met and len(seconds) else None
    except SsilkError as error:
        why = str(error).removeprefix(f"{shot}: ").rstrip(".")
        report(Message(f"{shot}: the colliders that it met are not drawn: {why}", "warning"))
        return None
    return ShotProps(world, lambda frame: frame / player.fps) if world else None


def _layers(shot: Path) -> list[Path]:
    """Return the files that say what a shot met."""
    if shot.name != STAGE:
        return [shot]
    home = shot.absolute().parent
    return [home / name / "anim.usdc" for name, record in finished(home.parent.parent, home.name).items() if record]


def _read(met: list[ColliderOrigin], seconds: np.ndarray, fps: float) -> ShotWorld:
    from ssilk_usd.reading.world import read_named

    found = [each for own in met for each in read_named(own.stage, own.prims, seconds)]
    return ShotWorld(fps, tuple({each.path: each for each in found}.values()))
