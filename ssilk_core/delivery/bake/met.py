# SPDX-License-Identifier: Apache-2.0
"""The colliders that the cloth of a baked shot met, found again from what the shot says of its bake."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ...errors import SsilkError
from ...events import Message, Reporter
from ..view.props import ShotProps
from .counted import STAGE, SUNK
from .load import load_rollout
from .opened import provenance_of
from .origin import read_origin
from .shots import finished


def props_of(shot: Path, report: Reporter) -> ShotProps | None:
    """Return the colliders of a shot, or of the stage of a folder of layers; None where it met none.

    Where they are not found any more, that is reported.

    Raises:
        SsilkError: not a readable shot.
    """
    if shot.name == STAGE:
        home = shot.absolute().parent
        records = finished(home.parent.parent, home.name)
        layers = [home / name / "anim.usdc" for name, record in records.items() if record and record.result.sunk]
        shot = layers[0] if layers else shot
    if SUNK not in provenance_of(shot):
        return None
    try:
        asked = read_origin(shot, {}).request
        # Nothing is played again.
        still = replace(asked, lbs=True, refine=0, feedback=False, latent_iterations=0, keep=None)
        rollout = load_rollout(still)
        world = rollout.around.seen
    except (SsilkError, ModuleNotFoundError) as error:  # a place for pictures alone may have no torch
        why = str(error).removeprefix(f"{shot}: ").partition("; ")[0]
        report(Message(f"{shot}: the colliders that it met are not drawn: {why}", "warning"))
        return None
    samples = asked.samples_per_frame
    return ShotProps(world, lambda frame: rollout.seconds(frame * samples)) if world else None
