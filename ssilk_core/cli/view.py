# SPDX-License-Identifier: Apache-2.0
"""Film a shot (.mp4), lay out its moments on a sheet (.png), or write a page that plays it (.html).

Several shots stand side by side. The page plays in any browser, loads nothing, and can be turned.

Shots are stages of USD, or what 'ssilk bake --target glb' wrote. Works without a display and without a GPU.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EXIT_OK, fail
from ..events import Reporter, Result
from ..files import replacing
from .options.files import check_output
from .options.numbers import RATE, NumberRange

if TYPE_CHECKING:
    from ..delivery.view.player import ShotPlayer
    from ..delivery.view.props import ShotProps

PAGE = ".html"


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("shots", type=Path, nargs="+", metavar="SHOT", help="shots of one length and rate")
    verb.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="film (.mp4), contact sheet (.png) or page that plays (.html)",
    )
    verb.add_argument("--label", action="append", default=[], help="caption of a shot (repeatable)")
    verb.add_argument("--fps", type=RATE, default=30.0, help="most frames per second of a film (default 30)")
    verb.add_argument(
        "--columns", type=NumberRange(1, 100, int), default=6, help="moments that the sheet shows (default 6)"
    )
    verb.add_argument(
        "--azimuth", type=NumberRange(-3600, 3600), default=None, help="side from which the camera looks [degrees]"
    )
    verb.add_argument("--size", metavar="WxH", help="pixels of one panel")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Draw."""
    from ..delivery.bake.met import props_of
    from ..delivery.bake.opened import open_shot
    from ..delivery.view.output import FILM, PICTURE, check_suffix
    from ..delivery.view.shots import film_of_shots, sheet_of_shots

    suffix = check_suffix(options.output, (FILM, PICTURE, PAGE))
    film = suffix == FILM
    check_output(options.output, *options.shots)
    players = [open_shot(path) for path in options.shots]
    labels = options.label or (captions(options.shots) if len(players) > 1 else [])
    look = _look(options, film)
    props = [props_of(path, report) for path in options.shots]
    if suffix == PAGE:
        count = _write_page(options.output, players, labels, props, report)
    elif film:
        count = film_of_shots(
            options.output, players, labels=labels, fps=options.fps, look=look, props=props, report=report
        )
    else:
        count = sheet_of_shots(
            options.output,
            players,
            labels=labels,
            columns=options.columns,
            look=look,
            props=props,
            report=report,
        )
    kind = "film" if film else "page" if suffix == PAGE else "picture"
    report(Result("view", {kind: str(options.output), "frames": count}))
    return EXIT_OK


def captions(shots: Sequence[Path]) -> list[str]:
    """Return the names of files, with as many folders above as tell them apart."""
    parts = [path.absolute().with_suffix("").parts for path in shots]
    depths = range(1, 1 + max(map(len, parts)))
    depth = next((depth for depth in depths if len({each[-depth:] for each in parts}) == len(parts)), 1)
    return ["/".join(each[-depth:]) for each in parts]


def _write_page(
    path: Path,
    players: Sequence[ShotPlayer],
    labels: Sequence[str],
    props: Sequence[ShotProps | None],
    report: Reporter,
) -> int:
    """Write a page that plays shots; return the number of their frames."""
    from ..delivery.report.page import Section, page
    from ..delivery.report.player import played

    title = ", ".join(labels) or path.stem
    text = page(title, [Section("The shot", played(players, labels, report, props), plays=True)])
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return len(players[0].frame_times)


def _look(options: argparse.Namespace, film: bool):  # type: ignore[no-untyped-def]  # Look is heavy to import
    from ..delivery.view.shots import Look

    width, height = (480, 640) if film else (320, 440)
    if options.size is not None:
        parts = options.size.lower().split("x")
        if not (len(parts) == 2 and all(re.fullmatch(r"[0-9]{1,9}", part) for part in parts)):
            fail(f"--size {options.size[:40]}", "not a size", "WIDTHxHEIGHT in pixels is needed")
        width, height = int(parts[0]), int(parts[1])
    azimuth = Look.azimuth if options.azimuth is None else options.azimuth
    return Look(width=width, height=height, azimuth=azimuth, workers=os.cpu_count() or 1)
