# SPDX-License-Identifier: Apache-2.0
"""The dial between fast and near to the simulator, as a table and as a picture, of the garments that ship."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

from ssilk_core.errors import fail
from ssilk_core.quality.charts import ChartPanel, write_chart

from .forms import GARMENTS, digits, document, fixed, percent, table

SPLITS = {"test": "`test`", "flips": "flips"}
SIMULATOR, OFF = "simulator", "simulator, 1 mm off"
DEVICES = {"cpu": "one core", "cuda": "GPU"}
SHOWN = {"refine 4": "`--refine 4`", **{level: f"`{level}`" for level in ("crowd", "game", "latent", "hero")}}
WHOLE, PACKED = "as trained", "hero"  # in `ssilk trade`: the whole model with its shots, and as it ships, in 16 bits
DRAWN_AFTER = "10"  # frames
PANEL = (3.5, 2.7)  # [inches]
NAMED = {"2 in latents": "2", "4 in latents": "4"}  # in the picture, behind "1 in latents"

Row = dict[str, Any]


def times(garment: str) -> dict[tuple[str, str], float]:
    """Return the time of a frame and shot by place and device [ms]."""
    found = document(f"dial_{garment}").get("times", [])
    return {(each["place"], each["device"]): each["milliseconds"] for each in found}


def places(garment: str) -> dict[str, dict[str, Row]]:
    """Return the rows of a garment by place and split."""
    found: dict[str, dict[str, Row]] = {}
    for row in document(f"dial_{garment}")["figures"]:
        found.setdefault(row["place"], {})[row["split"]] = row
    return found


def dial() -> str:
    """What each place on the dial costs and misses; figures are of `test` and of flips."""
    sizes = {(at["model"], at["variant"]): at for at in document("trade_cuda")["points"]}
    rows = []
    for garment, words in GARMENTS.items():
        took = times(garment)
        for number, (place, splits) in enumerate(places(garment).items()):
            own = [splits.get(split) for split in SPLITS]
            spent = (took.get((place, device)) for device in DEVICES)
            rows.append([
                "" if number else words,
                SHOWN.get(place, place),
                *("" if ms is None else digits(ms, 2) for ms in spent),
                *(_pair(own, _after(frames)) for frames in ("10", "30")),
                _pair(own, lambda row: fixed(median(row["velocity"]), 2)),
                _pair(own, lambda row: digits(mean(row["total"]))),
                _pair(own, lambda row: percent(mean(row["shown"]), 2)),
                _pair(own, lambda row: percent(mean(row["limbs"]), 0)),
                _pair(own, lambda row: percent(mean(row["intersecting"]), 1)),
                _pair(own, lambda row: fixed(median(row["jitter"]), 1, 1e-3)),
                *_sizes(place, {variant: at for (model, variant), at in sizes.items() if model == garment}),
            ])  # fmt: skip
    header = ("garment", "place", "one core [ms]", "GPU [ms]", "after 10 [mm]", "30 [mm]", "velocity [m/s]",
              "energy [J]", "shows [%]", "limbs [%]", "intersect [%]", "jitter [mm]", "model [MB]",
              "shot [MB]")  # fmt: skip
    return table(header, rows, 2)


def _sizes(place: str, variants: dict[str, Row]) -> tuple[str, str]:
    """Return the sizes of the model and of a shot of a place [MB], with the variants of `ssilk trade`."""
    if place == OFF:
        return "", ""
    reduced = place in ("crowd", "game")
    solved = place in (SIMULATOR, "hero", "refine 4")  # whose shots are fitted to vertices
    model = variants[place if reduced else PACKED]["model_bytes"]
    shot = variants[place if reduced or place == SIMULATOR else PACKED if solved else WHOLE]["shot_bytes"]
    return "" if place == SIMULATOR else fixed(model, 1, 1e6), fixed(shot, 1, 1e6)


def _after(frames: str) -> Callable[[Row], str]:
    """Return what tells the distance after so many frames [mm]."""
    return lambda row: fixed(median(row["distance"][frames]), 0, 1e-3)


def _pair(rows: Sequence[Row | None], figure: Callable[[Row], str]) -> str:
    """Return a figure of each split, a dash for one that was not measured."""
    return ", ".join("–" if row is None else figure(row) for row in rows)


def draw(path: Path) -> None:
    """Draw distances after ten frames over times on one core, a column for each garment.

    Raises:
        SsilkError: a garment was not timed.
    """
    write_chart(path, [[panel(garment) for garment in GARMENTS]], size=PANEL)


def panel(garment: str, device: str = "cpu") -> ChartPanel:
    """Return the places of a garment on a device; lines are those of the simulator that begins 1 mm off."""
    took, rows = times(garment), places(garment)
    drawn = [place for place in rows if (place, device) in took]
    if not drawn:
        missing = f"no times of {DEVICES[device]}"
        fail(f"dial_{garment}.json", missing, "both devices are drawn", "measure them by 'dial.py times'")
    points = {
        split: [
            (
                took[place, device],
                _distance(rows[place][split]),
                NAMED.get(place, place) if split == [*rows[place]][-1] else "",
            )
            for place in drawn
            if split in rows[place]
        ]
        for split in SPLITS
    }  # above each other, so that the names of one split do
    return ChartPanel(
        title=GARMENTS[garment],
        x=f"time of a frame, {DEVICES[device]} [ms]",
        y=f"off after {DRAWN_AFTER} frames [mm]",
        points=points,
        levels=tuple(_distance(row) for row in rows.get(OFF, {}).values()),
        log_x=True,
    )


def _distance(row: Row) -> float:
    return 1000 * median(row["distance"][DRAWN_AFTER])
