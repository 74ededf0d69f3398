# SPDX-License-Identifier: Apache-2.0
"""Whether what a command names is there, before anything heavy is loaded to read it."""

from __future__ import annotations

import argparse
import stat
from dataclasses import dataclass
from pathlib import Path

from ..errors import did_you_mean, fail
from ..files import split_body, split_location
from ..scene.shape_weights import ALLOWED, is_shapes, need_weights
from .options.files import LIST


@dataclass(frozen=True)
class Kind:
    """What an option names: how it is called where it is missing, what is needed, and whether a folder may be one."""

    name: str
    needed: str
    folder: bool = False


MODEL = Kind("model file", "a file of 'ssilk train' is needed")
MOTIONS = Kind("file or folder", "motions are USD files or folders of them", folder=True)
SHOT = Kind("file", "each motion of a shot is a USD file")
CHARACTER = Kind("file", "a USD stage with a character is needed")
GARMENTS = Kind("list of garments", "a TOML file with one table for each garment is needed")
KINDS = {
    "model": MODEL,
    "models": MODEL,
    "stepper_of": MODEL,
    "start_from": MODEL,
    "stage": CHARACTER,
    "onto": CHARACTER,
    "family": CHARACTER,
    "motion": MOTIONS,
    "motions": MOTIONS,
    "valid": MOTIONS,
    "cache": Kind("file", "a USD file with points is needed"),
}
"""By the names under which options are parsed."""

OF_STAGE = ("family", "onto")
"""Options that also take weights of shapes alone, which are of the command's stage."""

LISTED = {"bake": "model", "farm": "model", "inspect": "stage"}
"""By verbs, the input that may also be a list of garments."""

INDEPENDENT = ("bake", "farm")
"""Verbs with tasks: where one of several inputs is missing, the others are baked."""


def need_inputs(options: argparse.Namespace) -> None:
    """Raise `SsilkError` where an input of a command is not there, or is no file, and suggest one that is."""
    for name, kind in KINDS.items():
        value = getattr(options, name, None)
        values = value if isinstance(value, list) else [value] if value else []
        if options.verb in INDEPENDENT:
            if len(values) > 1:
                continue
            kind = SHOT if kind is MOTIONS else kind
        for each in values:
            if name in OF_STAGE and is_shapes(str(each)):
                continue
            is_list = LISTED.get(options.verb) == name and split_location(str(each))[0].endswith(LIST)
            meant = _shape_meant(str(each), options.stage) if name in OF_STAGE else ""
            need_input(str(each), GARMENTS if is_list else kind, meant)


def _shape_meant(named: str, stage: Path) -> str:
    """Return a question that suggests weights of a stage's shape in place of a file that is not there; or ""."""
    if Path(named).suffix or Path(named).exists() or not Path(split_body(str(stage))[0]).is_file():
        return ""
    from ssilk_usd.opening.shaped import body_parameters
    from ssilk_usd.opening.stage import open_stage

    shapes = body_parameters(open_stage(stage))
    return did_you_mean(f"{named}=1", (f"{name}={min(each.high, 1) or each.low:g}" for name, each in shapes.items()))


def need_input(named: str, kind: Kind, meant: str = "") -> None:
    """Raise `SsilkError` where there is no such input. It may be FILE:/PRIM.

    Names that USD resolves in its own way, such as a file in a package, are left to it.

    Args:
        meant: a question that suggests what else than a file may be meant.
    """
    path = Path(split_body(split_location(named)[0])[0])
    if "[" in named or "://" in named or path.is_file() or (kind.folder and path.is_dir()):
        return
    need_weights(named)
    if is_shapes(named):
        fail(named, "weights of shapes without their stage", ALLOWED)
    found, near = f"there is no such {kind.name}", meant
    if path.is_symlink():
        found = "a link that leads to no file"
    elif path.is_dir():
        found = f"a folder, and no {kind.name}"
    elif path.exists():
        found = f"{_special(path)}, and no {kind.name}"
    elif path.parent.is_dir() and not meant:
        beside = (each.stem for each in path.parent.iterdir() if each.suffix == path.suffix)
        near = did_you_mean(path.stem, beside, ending=path.suffix)
    fail(named, found, kind.needed, near)


def _special(path: Path) -> str:
    """Return what a path is that is no file and no folder."""
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
    return kinds.get(stat.S_IFMT(path.stat().st_mode), "something else")
