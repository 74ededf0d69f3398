# SPDX-License-Identifier: Apache-2.0
"""How far methods depart from the simulator that starts from their own two states, on windows of clips.

    python benchmarks/own_starts.py --model a.safetensors b.safetensors --stage character.usdc --motions FOLDER \\
        --index index.json --device cuda --output benchmarks/results/own_starts.json

Methods are linear blend skinning, each model's network, and the solver in its latents with each number of
--iterations. Each plays the first frames of each clip; windows are spread over these, the same for all methods. The
simulator goes on from a method's first two states in a window. All figures are of the window's frames after these:
RMS distances over mass, RMS velocity errors over mass and frames, vertices inside the body, total energies (gravity
relative to skinning), those above skinning's, and gravity above skinning's.

Tables tell the median over windows, with quartiles. Files after one --model are one training with several seeds:
beside each, they get the mean over seeds of these medians, with the range. Other trainings follow another --model.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.methods import SKINNING, methods_of
from helpers.own_windows import STATES, spread_windows
from helpers.reports import provenance, table, write_document
from helpers.subjects import Subject, clip_of, open_subjects
from ssilk_usd.stages import demo_body_path

from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import fail
from ssilk_core.events import Countdown, Message, Reporter, TextReporter
from ssilk_core.physics.energy import TERMS
from ssilk_core.quality.evaluation.methods import (
    EvaluationScene,
    LinearBlendSkinning,
    Method,
    TakeSet,
    build_take_set,
)
from ssilk_core.quality.evaluation.own_starts import MethodWindow, Window, departures
from ssilk_core.quality.evaluation.record import frame_energies
from ssilk_core.quality.evaluation.splits import read_index, splits_of
from ssilk_core.quality.evaluation.takes import Take, takes_of, within

NO_MODEL = "none"
Figures = dict[str, list[float]]
"""Values of windows by name; NaN where a window is too short for one."""


@dataclass(frozen=True, eq=False)
class Playlist:
    """Takes of all clips, and the windows of each split, longest first."""

    takes: list[Take]
    windows: dict[str, list[Window]]


def playlist(options: argparse.Namespace, subject: Subject) -> Playlist:
    """Read the clips that options name.

    Raises:
        SsilkError: no clip is chosen, or all are too short.
    """
    index = read_index(options.index or options.motions / "index.json")
    splits = {name: clips for name, clips in splits_of(index, options.clips).items() if name in options.splits}
    if not splits:
        fail("clips", f"none of the splits {', '.join(options.splits)} is chosen", "one at least is needed")
    takes: list[Take] = []
    windows: dict[str, list[Window]] = {split: [] for split in splits}
    for split, clips in splits.items():
        for clip in clips:
            skeleton, fps = subject.scene.character.skeleton, subject.file.config.fps
            own = takes_of(clip, clip_of(options, clip, subject), skeleton, fps)
            own = within(own, options.within)
            numbered = dict(enumerate(own, start=len(takes)))
            takes += own
            windows[split] += spread_windows(numbered, options.windows, options.after)
        windows[split].sort(key=lambda window: -len(window[1]))
        if not windows[split]:
            fail(split, "its clips are too short", f"{STATES + min(options.after)} frames at least are needed")
    return Playlist(takes, windows)


@torch.no_grad()
def energies_of(dressed: EvaluationScene, take_set: TakeSet, method: Method, window: Window) -> dict[str, float]:
    """Return means over a window's frames after the first two: share inside the body, total and gravity [J]."""
    take, frames = window
    terms = frame_energies(dressed, take_set, take, frames[STATES:], method.vertices(take, frames))
    mean = {name: float(values.double().mean()) for name, values in terms.items()}
    return {"inside": mean["collisions"], "total": sum(mean[name] for name in TERMS), "gravity": mean["gravity"]}


def measured(
    dressed: EvaluationScene,
    take_set: TakeSet,
    method: Method,
    windows: Sequence[Window],
    after: Sequence[int],
    report: Reporter,
) -> Figures:
    """Return the figures of the windows in which a method is finite [m], [m/s], [J]."""
    played = [(window, MethodWindow(dressed, take_set, method, window)) for window in windows]
    played = [(window, own) for window, own in played if own.is_finite]
    if not played:
        return {}
    own = [window for _, window in played]
    told = Countdown(sum(len(window.x) - STATES for window in own), report)
    away = departures(dressed.simulator, own, dressed.energy.mass, told)
    skinning = LinearBlendSkinning(dressed, take_set)
    ours, theirs = (
        [energies_of(dressed, take_set, each, window) for window, _ in played] for each in (method, skinning)
    )
    return {
        **{f"after {frames}": away.position_after(frames).sqrt().tolist() for frames in after},
        "velocity": (away.velocity.nanmean(0).sqrt() * dressed.fps).tolist(),
        **{name: [each[name] for each in ours] for name in ours[0]},
        "above skinning": [mine["total"] - its["total"] for mine, its in zip(ours, theirs)],
    }


def summary(figures: Figures, windows: int) -> dict[str, Any]:
    """Return median and quartiles over windows of each figure, how many windows there are, and how many were lost."""
    kept = len(next(iter(figures.values()), []))
    found: dict[str, Any] = {"windows": kept, "lost": windows - kept}
    for name, values in figures.items():
        if not np.isnan(values).all():
            low, median, high = np.nanquantile(values, [0.25, 0.5, 0.75]).tolist()
            found[name] = {"median": median, "quartiles": [low, high], "mean": float(np.nanmean(values))}
    return found


def over_seeds(single: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return mean and range over seeds of each figure's median over windows."""
    names = [name for name in single[0] if name not in ("windows", "lost") and all(name in one for one in single)]
    found: dict[str, Any] = {"seeds": len(single)}
    for name in names:
        medians = [one[name]["median"] for one in single]
        found[name] = {"mean": float(np.mean(medians)), "range": [min(medians), max(medians)]}
    return found


def header(after: Sequence[int]) -> list[str]:
    """Return the heads of the columns of `row`."""
    distances = [f"RMS distance after {frames} frames [mm]" for frames in after]
    return ["model", "split", "method", "windows", *distances, "RMS velocity error [m/s]",
            "vertices inside the body [%]", "total [J]", "above skinning [J]", "gravity [J]"]  # fmt: skip


def row(words: Sequence[str], found: Mapping[str, Any], after: Sequence[int]) -> list[str]:
    """Return a line of the table, of a summary over windows or over seeds."""
    scales = {f"after {frames}": (1000.0, 1) for frames in after}
    scales |= {"velocity": (1.0, 3), "inside": (100.0, 2)} | dict.fromkeys(
        ("total", "above skinning", "gravity"), (1.0, 4)
    )
    count = f"{found['windows']}" if "windows" in found else f"mean of {found['seeds']} seeds"
    lost = f", {found['lost']} lost" if found.get("lost") else ""
    return [*words, count + lost, *(cell(found.get(name), *scale) for name, scale in scales.items())]


def cell(figure: Mapping[str, Any] | None, factor: float, digits: int) -> str:
    """Return a figure with its spread in brackets."""
    if figure is None:
        return ""
    spread = figure.get("quartiles") or figure["range"]
    middle = figure["median"] if "median" in figure else figure["mean"]
    return f"{factor * middle:.{digits}f} [{', '.join(f'{factor * value:.{digits}f}' for value in spread)}]"


def measure_all(options: argparse.Namespace, report: Reporter) -> tuple[list[list[str]], dict[str, Any]]:
    """Return the lines of the table, and the figures by model or training, split and method."""
    subjects = open_subjects([path for training in options.model for path in training], options.stage, options.device)
    chosen, after = playlist(options, subjects[0]), options.after
    found: dict[str, Any] = {}
    lines: list[list[str]] = []

    def add(name: str, dressed: EvaluationScene, take_set: TakeSet, label: str, method: Method) -> None:
        for split, windows in chosen.windows.items():
            report(Message(f"{name}, {label}: {len(windows)} windows of {split}"))
            one = summary(measured(dressed, take_set, method, windows, after, report), len(windows))
            found.setdefault(name, {}).setdefault(split, {})[label] = one
            lines.append(row([name, split, label], one, after))

    first = subjects[0]
    plain = build_take_set(chosen.takes, first.dressed, first.model.joints)
    add(NO_MODEL, first.dressed, plain, SKINNING, LinearBlendSkinning(first.dressed, plain))
    for subject in subjects:
        model = subject.model
        take_set = build_take_set(chosen.takes, subject.dressed, model.joints, model.config.descriptors)
        for label, method in methods_of(subject, take_set, options.iterations, report):
            add(subject.name, subject.dressed, take_set, label, method)
    names = iter([subject.name for subject in subjects])
    for training in options.model:
        seeds = [next(names) for _ in training]
        for split, methods in found[seeds[0]].items() if len(seeds) > 1 else ():
            for label in methods:
                one = over_seeds([found[seed][split][label] for seed in seeds])
                found.setdefault(", ".join(seeds), {}).setdefault(split, {})[label] = one
                lines.append(row([", ".join(seeds), split, label], one, after))
    return sorted(lines, key=lambda line: list(chosen.windows).index(line[1])), found


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--model", type=Path, nargs="+", action="append", metavar="FILE",
                       help="of one garment, written by 'ssilk train' (default: the cape that ships)")  # fmt: skip
    found.add_argument("--stage", type=Path, default=demo_body_path(),
                       help="USD file with the character (default: the demo's body)")  # fmt: skip
    found.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
    found.add_argument("--index", type=Path, metavar="JSON",
                       help="list of clips with their splits (default: index.json of that folder)")  # fmt: skip
    found.add_argument("--splits", nargs="+", default=["test", "flips"], help="(default test flips)")
    found.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="only these clips of the splits")
    found.add_argument("--windows", type=int, default=6, help="of each clip, at most (default 6)")
    found.add_argument("--within", type=int, default=200, metavar="FRAMES", help="played of each clip (default 200)")
    found.add_argument("--after", type=int, nargs="+", default=[5, 10, 30],
                       help="frames to tell distances after; the last ends a window (default 5 10 30)")  # fmt: skip
    found.add_argument("--iterations", type=int, nargs="*", default=[1, 2, 4],
                       help="of the solver in latents; none to leave it out (default 1 2 4)")  # fmt: skip
    found.add_argument("--output", type=Path, metavar="JSON", help="figures to write, in SI units")
    found.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    found.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    return found


def main() -> None:
    options = parser().parse_args()
    options.model = options.model or [[shipped_path("cape")]]
    torch.set_num_threads(options.threads)
    if options.windows < 1 or min(options.after) < 1:
        fail("windows", f"{options.windows} windows, after {options.after} frames", "at least 1 is needed of each")
    lines, found = measure_all(options, TextReporter())
    source = provenance(options)
    print("\n".join(f"{name}: {text}" for name, text in source.items()))
    print(f"\n{table(header(options.after), lines)}")
    if options.output:
        write_document(options.output, source, {"units": "SI", **found})


if __name__ == "__main__":
    main()
