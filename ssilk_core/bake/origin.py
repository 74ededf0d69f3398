# SPDX-License-Identifier: Apache-2.0
"""Where a shot came from: what is written into it, and how its inputs are found again."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import fail
from .request import BakeRequest
from .rollout import BakeRollout


def shot_metadata(rollout: BakeRollout, output: Path, skin: Mapping[str, object]) -> dict[str, object]:
    """Return what a shot says of its origin and quality; `recovered` and `skin` fill while the poses are written.

    Args:
        skin: figures of the covered skin that shows.
    """
    refined = {"refined": rollout.refinement.summary.to_metadata()} if rollout.refinement else {}
    beside = _beside(rollout.request, output)
    return {**rollout.provenance, "beside": beside, "recovered": rollout.recovered, "shown_skin": skin, **refined}


def _beside(request: BakeRequest, output: Path) -> dict[str, str]:
    """Return the inputs' paths relative to the output's folder: they hold when everything moves together."""
    folder = output.absolute().parent
    try:
        return {name: os.path.relpath(path, folder) for name, path in request.inputs.items()}
    except ValueError:  # on another drive
        return {}


@dataclass(frozen=True)
class ShotOrigin:
    """What a shot says of its origin.

    Attributes:
        request: what was baked, with the present paths of its inputs.
        hashes: SHA-256 of "model" and "motion" when the shot was baked.
    """

    request: BakeRequest
    hashes: Mapping[str, object]


def read_origin(shot: Path, elsewhere: Mapping[str, str | os.PathLike[str] | None]) -> ShotOrigin:
    """Read what a shot was baked from.

    Args:
        elsewhere: new paths of inputs that have moved, and not together with the shot.

    Raises:
        SsilkError: no such shot, one that does not say how it was baked, or an input that is not found.
    """
    from ssilk_usd.provenance import read_provenance

    allowed = "a shot written by 'ssilk bake' is needed"
    if not shot.is_file():
        fail(str(shot), "there is no such shot", allowed)
    provenance = read_provenance(shot)
    if "request" not in provenance:
        fail(str(shot), "the file does not say how it was baked", allowed)
    try:
        stored = BakeRequest.from_metadata(provenance["request"])
    except (TypeError, ValueError) as error:
        fail(str(shot), f"the file does not say how it was baked as this version does ({error})", allowed,
             "bake it again")  # fmt: skip
    beside = provenance.get("beside")
    folder = shot.parent
    found: dict[str, str] = {}
    for name, path in stored.inputs.items():
        then = Path(path)
        near = folder / str(beside[name]) if isinstance(beside, Mapping) and name in beside else then
        found[name] = str(elsewhere.get(name) or _existing(shot, name, then, near))
    hashes = {name: provenance.get(f"{name}_sha256") for name in ("model", "motion")}
    return ShotOrigin(replace(stored, model=found["model"], stage=found["stage"], motion=found["motion"]), hashes)


def _existing(shot: Path, name: str, then: Path, near: Path) -> Path:
    """Return the place of an input where there is a file."""
    from ssilk_usd.read_stage import split_location

    there = next((path for path in (then, near) if Path(split_location(str(path))[0]).exists()), None)
    if there is None:
        fail(str(shot), f"the {name} that it was baked from is not at {then}", f"--{name} gives its present path")
    return there
