# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/pipeline.md and docs/training.md."""

from __future__ import annotations

import numpy as np

from ssilk_core.training.settings import PRESETS

from .forms import digits, fixed, percent, result, table

TARGETS = {
    "usd": ("all", "the stage's", "layers or a file"),
    "blender": ("all", "z up, metres", "layers or a file"),
    "game8": ("8", "y up, metres (as glTF)", "layers or a file"),
    "game4": ("4", "y up, metres", "layers or a file"),
    "arkit": ("4", "y up, metres", "one `.usdz`"),
    "glb": ("all", "y up, metres", "one `.glb`"),
    "glb4": ("4", "y up, metres", "one `.glb`"),
}
PURPOSES = {
    "draft": "a first look, on a CPU",
    "preview": "a look on a GPU",
    "light": "many characters",
    "final": "shots",
    "paper": "the paper's own, for comparison",
}


def targets() -> str:
    """How far the vertices of each target are from the network's."""
    found, rows = {row["name"]: row for row in result("compact")["rows"]}, []
    for name, words in TARGETS.items():
        at = found[f"one file for {name}, garment alone"]
        rows.append([f"`{name}`", *words, *(digits(1000 * at[error], 2) for error in ("largest", "mean"))])
    header = ("target", "influences", "axes, units", "packaging", "largest error [mm]", "mean error [mm]")
    return table(header, rows, 4)


def growth() -> str:
    """What a frame takes of garments of more and more vertices, and how fast that grows."""
    found, rows = result("growth"), []
    sizes = found["sizes"]["vertices"]
    for way, taken in found["microseconds"]["vertices"].items():
        rows.append([f"{way} [µs]", *(f"{time:,.0f}" for time in taken)])
    return table(("vertices", *(f"{size:,}" for size in sizes)), rows)


def presets() -> str:
    """Sizes and schedules of the presets."""
    rows = []
    for name, purpose in PURPOSES.items():
        model, train = PRESETS[name].model, PRESETS[name].train
        widths = ", ".join(map(str, model.widths))
        rows.append([f"`{name}`", model.latent, model.shapes, widths, f"{train.iterations:,}",
                     f"{train.batch} of {train.window}", purpose])  # fmt: skip
    header = ("preset", "latent", "blendshapes", "hidden layers", "iterations", "windows of poses", "for")
    return table(header, rows, 7)


PUBLISHED_DRAPE = {  # [%] of real cloth
    "silk": "20 to 40", "cotton": "68", "denim": "70 to 90", "wool": "40 to 70", "leather": "47 to 70",
}  # fmt: skip
STATED_DRAPE = {"silk": 35, "cotton": 70, "denim": 87, "wool": 62, "leather": 68}  # [%] of another simulator


def drape() -> str:
    """How the presets of fabrics hang."""
    rows = []
    for name, found in result("drape").items():
        coarse, fine = found["10 mm"], found["5 mm"]
        others = found["drape coefficients with other waves [%]"].values()
        lengths, shares = ([each[key] for each in (fine, coarse)] for key in ("bending length [mm]",
                                                                              "drape coefficient [%]"))  # fmt: skip
        rows.append([f"`{name}`", fixed(found["density [g/m2]"]), f"{found['bending [N m]']:.1e}",
                     fixed(found["rigidity's bending length [mm]"], 1), *(fixed(length, 1) for length in lengths),
                     *(fixed(share) for share in shares), f"{fixed(min(others))} to {fixed(max(others))}",
                     PUBLISHED_DRAPE.get(name, ""), STATED_DRAPE.get(name, "")])  # fmt: skip
    header = ("preset", "weight [g/m²]", "`bending` [N m]", "(D / w)^(1/3) [mm]", "bending length [mm]", "on 10 mm",
              "drape coefficient [%]", "on 10 mm", "5 to 9 waves", "published [%]",
              "another simulator's [%]")  # fmt: skip
    return table(header, rows)


def peers() -> str:
    """The simulator beside the engine newton, two clips at once on a GPU and one on a processor."""
    rows = []
    for file, where in (("peers_cuda", "GPU"), ("peers", "one core")):
        for number, found in enumerate(result(file).values()):
            times, terms = np.quantile(found["milliseconds"], (0.5, 0.25, 0.75)), found["terms"]
            shares = [f"{np.mean(found[name]):.2f}, {np.max(found[name]):.1f}" for name in ("shares", "inside")]
            energies = sum(terms.values()), terms["stretch"], terms["inertia"]
            rows.append([
                "" if number else where, found["method"], found["cloth"], *map(digits, map(float, times)), *shares,
                *map(digits, energies),
            ])  # fmt: skip
    header = ("on", "method", "cloth through cloth", "ms a frame", "a quarter below", "above", "intersect [%]",
              "inside the body [%]", "total [J]", "stretch [J]", "inertia [J]")  # fmt: skip
    return table(header, rows, 3)


def self_contact() -> str:
    """Cloth that is kept apart beside cloth that passes through cloth, two clips at once on a GPU."""
    rows = []
    for cloth, found in result("self_contact_cuda")["cape"].items():
        times = 1e3 * np.quantile(found["seconds"], (0.5, 0.25, 0.75))
        shares = f"{percent(np.mean(found['shares']), 2)}, {percent(np.max(found['shares']), 1)}"
        rows.append([cloth, *map(digits, map(float, times)), fixed(found["iterations"], 1), shares])
    header = ("cloth through cloth", "ms a frame and shot", "a quarter below", "above", "iterations", "intersect [%]")
    return table(header, rows)


def bodies() -> str:
    """The cape for a family on bodies that its training never saw, beside a cape for one of these alone."""
    rows = []
    for name, found in result("bodies").items():
        models = [found[model] for model in ("family", "alone") if model in found]
        skin = [each["shown_skin"] for each in models]
        rows.append([
            name.replace("_", " "), percent(found["beyond"], 0), fixed(found["LBS"]["total"], 2),
            ", ".join(fixed(each["total"], 3) for each in models),
            fixed(found["simulator"]["total"], 3) if "simulator" in found else "",
            ", ".join(fixed(each["steps"]["energy"], 1, 1e-3) for each in models),
            ", ".join(percent(each["mean"], 3) for each in skin),
            ", ".join(percent(each["worst"], 2) for each in skin),
        ])  # fmt: skip
    header = ("body", "beyond [%]", "LBS [J]", "energy [J]", "simulator [J]", "steps miss [mJ]",
              "skin that shows [%]", "in the worst frame [%]")  # fmt: skip
    return table(header, rows)
