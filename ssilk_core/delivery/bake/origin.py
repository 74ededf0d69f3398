# SPDX-License-Identifier: Apache-2.0
"""Where a shot came from: what is written into it, and how its inputs are found again."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ...errors import fail
from ...files import relative_path, sha256, split_body, split_location
from ...scene.assets import ShotWorld
from .computed_frames import Refinement
from .opened import provenance_of
from .record import RECORD
from .request import AT, BakeRequest, split_start
from .rollout import BakeRollout
from .shots import need_no_folder

REFINED = "refined"  # what a shot says of its refinement, under this name
COLLIDERS = "colliders"  # what a shot says of those that its cloth met, under this name


def shot_metadata(rollout: BakeRollout, output: Path, part: Path | None = None) -> dict[str, object]:
    """Return what a shot says of its origin and quality; `recovered` fills while poses are written.

    Args:
        part: where it lies before it becomes a part of the output, beside parts that it was refined over.
    """
    refined = _refined(rollout.refinement, (part or output).parent) if rollout.refinement else {}
    solved = {"solved in latents": rollout.latents.summary.to_metadata()} if rollout.latents else {}
    loop = {"loop": rollout.loop_summary.to_metadata()} if rollout.loop_summary else {}
    request = rollout.request.relocated(lambda path: _from_folder(path, output.absolute().parent)).to_metadata()
    return {
        **rollout.provenance,
        "request": request,
        "recovered": rollout.recovered,
        **solved,
        **loop,
        **refined,
        **met_metadata(rollout.around.seen, output),
    }


def _refined(refinement: Refinement, folder: Path) -> dict[str, object]:
    over = refinement.beneath.to_metadata(folder) if refinement.beneath else {}
    return {REFINED: {**refinement.summary.to_metadata(), **over}}


def met_metadata(world: ShotWorld | None, output: Path) -> dict[str, object]:
    """Return what a shot says of the colliders that its cloth met, so that they are found again; they are of one
    stage."""
    if world is None or not world.colliders:
        return {}
    stage = split_location(world.colliders[0].path)[0]
    prims = [each.name for each in world.colliders]
    return {COLLIDERS: {"stage": _from_folder(stage, output.absolute().parent), "prims": prims}}


@dataclass(frozen=True)
class ColliderOrigin:
    """The colliders that the cloth of a shot met: the present path of their stage, and their prims in it."""

    stage: str
    prims: tuple[str, ...]


def read_met(shot: Path, provenance: Mapping[str, object]) -> ColliderOrigin | None:
    """Return the colliders that a shot, or one of its garments, says its cloth met; None where it says of none.

    Raises:
        SsilkError: their stage is not found.
    """
    said = provenance.get(COLLIDERS)
    if not isinstance(said, Mapping):
        return None
    near = str(said.get("stage"))
    if (found := _existing(shot, near, None)) is None:
        fail(str(shot), f"the stage of its colliders is not at {near}", "it is looked for as seen from the shot")
    return ColliderOrigin(str(found), tuple(map(str, said.get("prims", ()))))


def _from_folder(location: str, folder: Path) -> str:
    """Return the path of an input from a shot's folder; its name alone where they share nothing but the root.

    So nothing tells where a studio keeps its files, and the same files give the same bytes wherever they lie.
    """
    return relative_path(location, folder) or _name(location)


def _name(location: str) -> str:
    """Return the name of a location's file, with the prim that it names."""
    file, prim = split_location(location)
    return Path(file).name + (f":{prim}" if prim else "")


@dataclass(frozen=True)
class ShotOrigin:
    """What a shot says of its origin.

    Attributes:
        request: what was baked, with the present paths of its inputs.
        hashes: SHA-256 of "model", "motion" and, where it has one, "start_cloth" when the shot was baked.
    """

    request: BakeRequest
    hashes: Mapping[str, object]


def read_origin(
    shot: Path,
    elsewhere: Mapping[str, str | os.PathLike[str] | None],
    provenance: Mapping[str, object] | None = None,
) -> ShotOrigin:
    """Read what a shot was baked from.

    Args:
        elsewhere: new paths of inputs that have moved, and not together with the shot.
        provenance: what it says of one of several garments; what it says by default.

    Raises:
        SsilkError: no such shot, one that does not say how it was baked, or an input that is not found.
    """
    allowed = "a shot written by 'ssilk bake' is needed"
    need_no_folder(shot, allowed)
    if not shot.is_file():
        fail(str(shot), "there is no such shot", allowed)
    provenance = provenance_of(shot) if provenance is None else provenance
    if "request" not in provenance:
        fail(str(shot), "the file does not say how it was baked", allowed)
    try:
        stored = BakeRequest.from_metadata(provenance["request"])
    except (TypeError, ValueError) as error:
        fail(str(shot), f"the file does not say how it was baked as this version does ({error})", allowed,
             "bake it again")  # fmt: skip
    hashes = {name: provenance.get(f"{name}_sha256") for name in ("model", "motion")}
    found: dict[str, str] = {}
    for name, path in stored.inputs.items():
        place = elsewhere.get(name) or _existing(shot, path, hashes.get(name))
        if place is None:
            what = f"the {name} that it was baked from is not at {path}"
            fail(str(shot), what, f"--{name} gives its present path")
        found[name] = str(place)
        if name == "stage" and (shapes := split_body(path)[1]) and not split_body(found[name])[1]:
            found[name] += f":{shapes}"  # another path of the stage, which is baked as the same body
    start = stored.start_cloth
    if start is not None:
        place, code = split_start(start)
        hashes["start_cloth"] = held = provenance.get("start_cloth_sha256")
        if (there := _existing(shot, place, held, baked=True)) is None:
            fail(
                str(shot),
                f"the cloth that it begins with is not at {place}",
                "it is looked for as seen from the shot",
            )
        start = f"{there}" if code is None else f"{there}{AT}{code:.9g}"
    moved = replace(stored, model=found["model"], stage=found["stage"], motion=found["motion"], start_cloth=start)
    return ShotOrigin(moved, hashes)


def _existing(shot: Path, near: str, held: object, *, baked: bool = False) -> Path | None:
    """Return the place of an input where there is a file; None where there is none.

    It is looked for where it lay as seen from the shot, then in the same place as seen from the working folder and
    from each folder above the shot, because some inputs may have stayed where they were. Of several files the first
    that holds what the input held is taken. What bakes wrote is no input, unless it is cloth to begin with.

    Args:
        held: SHA-256 of the input when the shot was baked, where the shot says it.
        baked: whether a layer that a bake wrote is one.
    """
    parts = Path(near).parts
    tail = Path(*parts[next((at for at, part in enumerate(parts) if part != ".."), 0) :])
    places = [shot.parent / near, Path(near), Path(tail), *(above / tail for above in shot.absolute().parents)]
    there = [
        path
        for path in places
        if _file(path).is_file() and not (_file(path).samefile(shot) if baked else _is_baked(_file(path), shot))
    ]
    if len({_file(path).resolve() for path in there}) == 1:
        return there[0]
    return next((path for path in there if sha256(_file(path)) == held), next(iter(there), None))


def _file(place: Path) -> Path:
    """Return the file of a place, which may name a prim in it, or a body by weights of shapes."""
    return Path(split_body(split_location(str(place))[0])[0])


def _is_baked(file: Path, shot: Path) -> bool:
    """Return whether a file is the shot itself, or of the layers that bakes wrote for garments and shots.

    Layers may be written into a folder that holds inputs too, so it is not the folder that tells.
    """
    of_garment = (file.parent / RECORD).is_file()
    of_shot = file.name == "shot.usda" and any(file.parent.glob(f"*/{RECORD}"))
    of_asset = file.name in ("asset.usda", "geometry.usdc", "info.usda") and file.parent.parent.name == "assets"
    return file.samefile(shot) or of_garment or of_shot or of_asset
