# SPDX-License-Identifier: Apache-2.0
"""Tasks: one garment in one shot of a folder of layers, named so that no two write the same file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from ...errors import fail
from ...network.checkpoint import load_model
from ..targets import check_influences
from .inputs import InputHashes
from .naming import file_name, location_stem, need_unique, prim_leaf, prim_name
from .request import BakeRequest, need_body

LONGEST_NAME = 255  # [bytes] of a file or folder
OF_ASSET = {"asset_version": "--asset-version", "asset_identifier": "--asset-identifier"}  # and their options


@dataclass(frozen=True, kw_only=True)
class BakeTask:
    """One garment in one shot of a folder of layers.

    Attributes:
        garment: name of its prim and its folder.
        shot: name of its folder.
        request: what is baked.
        include_body: write the character's body meshes into the asset as well.
        points: write a point cache as well.
        verify: re-skin the written layer and compare it.
        pinned: what its inputs have to hold, as they did when its job was submitted; None for whatever they hold.
        replace: bake even where one of the names was used for another input.
        level_of: name of the garment of its shot that it is a level of quality of; None for one of its own.
        asset_version, asset_identifier: as the request asks for them. They are of the asset, which shots share, and
            none of them is baked again for another version.
        over: names of garments of its shot that it is refined or certified over, which have to be finished before.
    """

    garment: str
    shot: str
    request: BakeRequest
    include_body: bool = True
    points: bool = False
    verify: bool = True
    pinned: InputHashes | None = None
    replace: bool = False
    level_of: str | None = None
    asset_version: str | None = None
    asset_identifier: str | None = None
    over: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.shot}/{self.garment}"


def plan_layers(
    requests: Iterable[BakeRequest],
    *,
    include_body: bool = True,
    points: bool = False,
    verify: bool = True,
    replace_names: bool = False,
) -> list[BakeTask]:
    """Return a task for each request; tasks of one garment follow each other.

    Garments and shots that a request does not name are named after their models, with the SkelRoot in front where one
    is named, and after their motions. Each asset has the body of its character, whichever garments are baked with it;
    a shot shows one of them.

    Args:
        points: write point caches as well; refined points are always written.
        replace_names: bake even where a name was used for another input before.

    Raises:
        SsilkError: two garments or two shots would have one name, a garment two versions or identifiers, or a request
            is not for layers: its target takes none, or all shots of a garment could not share one asset.
    """
    requests = list(requests)
    _need_for_layers(requests, include_body)
    tasks = [
        BakeTask(
            garment=garment_name(request),
            shot=_shot_name(request),
            request=replace(
                request, garment=None, shot=None, level_of=None, asset_version=None, asset_identifier=None
            ),
            include_body=include_body,
            points=points or request.writes_points,
            verify=verify,
            replace=replace_names,
            level_of=prim_name(request.level_of) if request.level_of else None,
            asset_version=request.asset_version,
            asset_identifier=request.asset_identifier,
        )
        for request in requests
    ]
    for task in tasks:
        if task.level_of == task.garment:
            found, allowed = f"a level of '{task.garment}', and of the same name", "each level has a name of its own"
            fail(task.request.model, found, allowed, "name it with --garment-name")
    need_unique([(task.garment, _worn(task.request)) for task in tasks], "MODEL", "garment", "--garment-name")
    need_unique([(task.shot, task.request.motion) for task in tasks], "--motion", "shot", "--shot-name or --shots")
    _need_one_info(tasks)
    order = list(dict.fromkeys(task.garment for task in tasks))
    seen: set[str] = set()
    for task in tasks:
        if task.name in seen:
            fail(task.request.model, f"'{task.name}' is to be baked twice", "a garment is baked once in a shot")
        seen.add(task.name)
    return sorted(tasks, key=lambda task: order.index(task.garment))


def _need_one_info(tasks: Iterable[BakeTask]) -> None:
    """Check that the shots of each garment ask for one version and one identifier of its asset."""
    first: dict[tuple[str, str], str] = {}
    for task in tasks:
        for name, option in OF_ASSET.items():
            if (asked := getattr(task, name)) and first.setdefault((task.garment, name), asked) != asked:
                both = f"'{first[task.garment, name]}' and '{asked}' for the garment '{task.garment}'"
                fail(option, both, "all its shots share one asset", "give one of them")


def has_possible_names(task: BakeTask) -> bool:
    """Return whether file systems take the names of a task's folders."""
    return max(len(os.fsencode(name)) for name in (task.garment, task.shot)) <= LONGEST_NAME


def need_possible_names(task: BakeTask) -> None:
    """Raise `SsilkError` where the name of a task's folder is longer than file systems take."""
    if not has_possible_names(task):
        fail(
            f"{task.name[:60]}...",
            f"a name of {max(len(task.garment), len(task.shot))} characters",
            f"folders are named by it, and file systems take {LONGEST_NAME}",
            "rename the model or the motion",
        )


def _need_for_layers(requests: Sequence[BakeRequest], include_body: bool) -> None:
    for request in requests:
        need_body(request, include_body)
        if request.keep:
            fail(
                request.model,
                "a size to keep, for layers",
                "their assets are the same for all shots",
                "bake models that 'ssilk reduce' made",
            )
        if request.start_cloth:
            found, allowed = "a shot that goes on from another, in a folder of layers or a job", "one file is needed"
            fail("--start-cloth", found, allowed, "bake it to a file, such as -o shot.usdc")
        if ".usdc" not in request.receiver.suffixes:
            fail(
                f"--target {request.target}",
                "layers",
                f"it takes {', '.join(request.receiver.suffixes)}",
                "bake one garment over one motion into such a file",
            )
    capped = {(each.model, each.target) for each in requests if each.receiver.influences and not each.lbs}
    for model, target in sorted(capped):
        check_influences(load_model(model).scene.rig.skin.indices.shape[1], target, model)


def named_by_bodies(requests: Iterable[BakeRequest], bodies: Mapping[str, str]) -> list[BakeRequest]:
    """Return requests whose garments and shots have the names of their bodies in front.

    Both have it: the shots of a garment share one asset, which lies on one body, and a shot shows one body for each
    motion.

    Args:
        bodies: name of the body of each stage that a request has.

    Raises:
        SsilkError: two stages would have one name.
    """
    names = {stage: prim_name(name) for stage, name in bodies.items()}
    need_unique([(name, stage) for stage, name in names.items()], "--stage", "body", "--body-name")
    return [
        replace(
            request,
            garment=f"{names[request.stage]}_{garment_name(request)}",
            shot=f"{names[request.stage]}_{_shot_name(request)}",
            level_of=f"{names[request.stage]}_{prim_name(request.level_of)}" if request.level_of else None,
        )
        for request in requests
    ]


def garment_name(request: BakeRequest) -> str:
    """Return the name of a request's garment, where it is one of several."""
    stem = location_stem(request.model)
    return prim_name(request.garment or (f"{prim_leaf(request.root)}_{stem}" if request.root else stem))


def _shot_name(request: BakeRequest) -> str:
    return file_name(request.shot or location_stem(request.motion))


def _worn(request: BakeRequest) -> str:
    return f"{request.model}:{request.root}" if request.root else request.model
