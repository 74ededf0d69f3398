# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/results.md, all of the garments that ship."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from statistics import mean
from typing import Any

from .forms import GARMENTS, digits, document, duration, fixed, percent, result, table

SPLITS = ("valid", "test", "flips")
METHODS = {
    "LBS": "LBS", "ncs": "NCS", "ncs*": "NCS*", "snug": "SNUG", "paper": "preset `paper`", "ssilk": "**SSILK**",
}  # fmt: skip
IN_RESULTS = {"cape": "Cape", "fringe_skirt": "FringeSkirt", "hooded_dress": "HoodedDress"}
LBS, REFINED = "linear blend skinning", "refine 4"
FULL = "full, poses included"


def cells() -> dict[tuple[str, str, str], dict[str, Any]]:
    """Return totals [J] and intersections by garment, method and split.

    Those of other methods are from `tables.py`, those of garments that ship and of the preset `paper` from
    `ssilk evaluate`.
    """
    found = {(row["garment"], row["method"], row["split"]): row for row in result("table1")["figures"]}
    sources = [(name, name, "ssilk") for name in GARMENTS] + [("cape", "cape_paper", "paper")]
    for name, file, method in sources:
        for row in measured(file):
            figures = row["figures"]
            found[IN_RESULTS[name], method, row["split"]] = {
                "total": [figures["total"]],
                **{f"intersections_{at}": [figures["intersections"][at]] for at in ("mean", "worst")},
            }
    return found


def measured(name: str) -> list[dict[str, Any]]:
    """Return what `ssilk evaluate` found of a network, a row for each split."""
    rows: list[dict[str, Any]] = document(f"evaluate_{name}")["figures"]
    return [row for row in rows if row["method"] == "ssilk" and row["split"] in SPLITS]


def overview() -> str:
    """Energy, skin that shows, limbs through cloth, bare skin, cloth through cloth: trained, refined, and skinned."""
    energies, rows, names = cells(), [], ("network", REFINED, LBS)
    crossed = any("intersections" in at for own in result("shown_skin").values() for split in SPLITS
                  for at in own[split].values())  # fmt: skip
    for name, words in GARMENTS.items():
        for split in SPLITS:
            own = [result("shown_skin")[name][split][method] for method in names]
            pairs = (energies[IN_RESULTS[name], method, split]["total"] for method in ("ssilk", "LBS"))
            row = [words if split == "valid" else "", split, *(digits(mean(each)) for each in pairs)]
            row += [f"{percent(at['mean'], 3)}, {percent(at['worst'])}" for at in own]
            row += [percent(at["pierced"]) for at in own]
            row += [percent(at["bare"]) for at in (own[0], own[2])]
            rows.append([*row, *(intersecting(at.get("intersections")) for at in own if crossed)])
    header = ("garment", "clips", "energy [J]", "LBS", "shows", "refined", "LBS", "limbs", "refined", "LBS", "bare",
              "LBS", *(("intersect", "refined", "LBS") if crossed else ()))  # fmt: skip
    return table(header, rows, 2)


def intersecting(figures: dict[str, Any] | None) -> str:
    """Return the mean and the worst share of triangles that intersect others [%]; nothing where none is known."""
    return f"{percent(figures['mean'], 2)}, {percent(figures['worst'])}" if figures else ""


def other_methods() -> str:
    """Energies of all methods, and cloth through cloth."""
    energies, rows = cells(), []
    crossed = any("intersections_mean" in row for row in energies.values())
    iterations = {(each["garment"], each["method"]): f"{each['iterations']:,}" for each in _trained()}
    for name, words in GARMENTS.items():
        own_methods = {method: words for method, words in METHODS.items()
                       if (IN_RESULTS[name], method, SPLITS[0]) in energies}  # fmt: skip
        for number, (method, shown) in enumerate(own_methods.items()):
            keys = [(IN_RESULTS[name], method, split) for split in SPLITS]
            row = ["" if number else words, shown, iterations.get((IN_RESULTS[name], method), "")]
            row += [digits(mean(energies[key]["total"])) for key in keys]
            for key in keys[1:] if crossed else ():
                own = {name: energies[key].get(f"intersections_{name}", ()) for name in ("mean", "worst")}
                row.append(intersecting({name: mean(each) for name, each in own.items()} if own["mean"] else None))
            rows.append(row)
    header = ("garment", "method", "iterations", "`valid` [J]", "`test` [J]", "flips [J]",
              *(("intersect, `test` [%]", "flips [%]") if crossed else ()))  # fmt: skip
    return table(header, rows, 2)


def _trained() -> list[dict[str, Any]]:
    """Return garment, method and iterations; those of a model that ships are where it was kept."""
    baselines = [each for each in result("table1")["trainings"] if each["method"] != "ssilk"]
    kept = [
        {"garment": IN_RESULTS[name], "method": "ssilk", "iterations": run["iterations"][kept_at(run)]}
        for name, run in result("shipped_training").items()
    ]
    return baselines + kept


def kept_at(run: dict[str, Any]) -> int:
    """Return the number of the validation with the lowest total."""
    totals: list[float] = run["total"]
    return totals.index(min(totals))


def trainings() -> str:
    """How the garments that ship were trained, and what their validations said."""
    rows = []
    for name, words in GARMENTS.items():
        run = result("shipped_training")[name]
        best = kept_at(run)
        rows.append([words, f"{run['iterations'][best]:,} of {run['iterations'][-1]:,}",
                     duration(run["seconds"][-1]), digits(run["total"][best]), digits(run["total"][-1]),
                     document("shipped_training")["hardware"][name]])  # fmt: skip
    header = ("garment", "kept at iteration", "time of its steps", "best [J]", "last [J]", "on")
    return table(header, rows)


def beside_solver() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield garment, split and figures of networks that the simulator went on from."""
    for name in GARMENTS:
        for row in measured(name):
            if row["figures"]["solver"]:
                yield name, row["split"], row["figures"]["solver"]


def own_start() -> str:
    """How far the network is from the simulator that starts from its own states."""
    rows: list[list[object]] = []
    named: set[str] = set()
    for name, split, at in beside_solver():
        away = (fixed(value, 0, 1e-3) for value in at["position_error"])
        speeds = (fixed(at[figure], 2) for figure in ("velocity_error", "lbs_velocity_error"))
        step = fixed(at["step_energy"], 0, 1e-3), fixed(at["step_distance"], 1, 1e-3)
        words = "" if name in named else GARMENTS[name]
        named.add(name)
        rows.append([words, split, at["windows"], *step, *away, *speeds])
    header = ("garment", "clips", "windows", "step [mJ]", "step [mm]", "after 5 [mm]", "10", "30", "60",
              "velocity [m/s]", "LBS")  # fmt: skip
    return table(header, rows, 2)


def rest() -> str:
    """Whether garments come to rest after stops, and repeat themselves in loops."""
    rows: list[list[object]] = []
    named: set[str] = set()
    for name in GARMENTS:
        for row in measured(name):
            stops, loop = row["figures"]["settling"], row["figures"]["loop_drift"]
            time = "" if stops["settling_time"] is None else fixed(stops["settling_time"], 1)
            away = (fixed(stops[figure], 0, 1e-3) for figure in ("static_distance", "max_static_distance"))
            words = "" if name in named else GARMENTS[name]
            named.add(name)
            rows.append([words, row["split"], stops["stops"], percent(stops["settled_share"], 0), time,
                         *away, fixed(loop["loop_distance"], 3, 1e-3)])  # fmt: skip
    header = ("garment", "clips", "stops", "settled [%]", "median time [s]", "distance to P [mm]", "largest",
              "between loops [mm]")  # fmt: skip
    return table(header, rows, 2)


def playing() -> str:
    """Times of a frame on one processor thread."""
    rows = []
    for name, words in GARMENTS.items():
        found = result("runtime")["models"][name]
        times = (fixed(found[way][FULL][0], 2, 1000)
                 for way in ("numpy", "PyTorch, in chunks", "NCS, in chunks"))  # fmt: skip
        rows.append([words, *times])
    return table(("garment", "SSILK, numpy [ms]", "SSILK, PyTorch [ms]", "NCS, PyTorch [ms]"), rows)


def extremes() -> str:
    """How many extremes of each kind work, fall back, are refused, and do not apply."""
    outcomes = document("stress_cape")["outcomes"]
    groups = dict.fromkeys(each["group"] for each in outcomes)
    rows = []
    for verdict in ("works", "falls back", "refuses", "does not apply"):
        counts = Counter(each["group"] for each in outcomes if each["verdict"] == verdict)
        rows.append([verdict, *(counts[group] or "" for group in groups), counts.total()])
    return table(("", *groups, "all"), rows)
