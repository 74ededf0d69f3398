# SPDX-License-Identifier: Apache-2.0
"""Tasks: one garment in one shot of a folder of layers, named so that no two write the same file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..checkpoint import load_model
from ..errors import fail
from ..targets import check_influences
from .request import BakeRequest, need_body


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
    """

    garment: str
    shot: str
    request: BakeRequest
    include_body: bool = True
    points: bool = False
    verify: bool = True

    @property
    def name(self) -> str:
        return f"{self.shot}/{self.garment}"


def plan_layers(
    requests: Iterable[BakeRequest], *, include_body: bool = True, points: bool = False, verify: bool = True
) -> list[BakeTask]:
    """Return a task for each request; tasks of one garment follow each other.

    Garments are named after their models, with the SkelRoot in front where one is named, and shots after their
    motions.
    Each asset has the body of its character, whichever garments are baked with it; a shot shows one of them.

    Args:
        points: write point caches as well; refined points are always written.

    Raises:
        SsilkError: two garments or two shots would have one name, or a request is not for layers: its target takes
            none, or all shots of a garment could not share one asset.
    """
    requests = list(requests)
    _need_for_layers(requests, include_body)
    garments = {(request.model, request.root): _garment_name(request) for request in requests}
    shots = {request.motion: _shot_name(request) for request in requests}
    _need_unique(list(garments.values()), "MODEL", "garments")
    _need_unique(list(shots.values()), "--motion", "shots")
    tasks = [
        BakeTask(
            garment=garment,
            shot=shots[request.motion],
            request=request,
            include_body=include_body,
            points=points or request.writes_points,
            verify=verify,
        )
        for worn, garment in garments.items()
        for request in requests
        if (request.model, request.root) == worn
    ]
    _need_unique([task.name for task in tasks], "MODEL", "tasks")
    return tasks


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


def _garment_name(request: BakeRequest) -> str:
    stem = _stem(request.model)
    return identifier(f"{_leaf(request.root)}_{stem}" if request.root else stem)


def _shot_name(request: BakeRequest) -> str:
    return re.sub(r"[^\w-]", "_", _stem(request.motion), flags=re.ASCII)


def identifier(text: str) -> str:
    """Return text as the name of a prim, and of a folder."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"\W", "_", text, flags=re.ASCII))


def _stem(location: str) -> str:
    file, _, prim = location.partition(":/")
    return Path(file).stem + (f"_{_leaf(prim)}" if prim else "")


def _leaf(path: str) -> str:
    return path.rstrip("/").rpartition("/")[2]


def _need_unique(names: Sequence[str], where: str, what: str) -> None:
    name, times = Counter(names).most_common(1)[0] if names else ("", 1)
    if times != 1:
        fail(
            where,
            f"{times} {what} are named '{name}'",
            "files and folders are named by them",
            "rename one of the files",
        )
