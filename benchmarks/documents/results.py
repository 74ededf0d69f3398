# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/results.md, all of the garments that ship."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from statistics import mean
from typing import Any

from .forms import GARMENTS, digits, document, duration, fixed, percent, result, table

SPLITS = ("valid", "test", "flips")
METHODS = {"LBS": "LBS", "ncs": "NCS", "ncs*": "NCS*", "snug": "SNUG", "ssilk": "**SSILK**"}
IN_RESULTS = {"cape": "Cape", "fringe_skirt": "FringeSkirt", "hooded_dress": "HoodedDress"}
LBS, REFINED = "linear blend skinning", "refine 4"
FULL = "full, poses included"


def cells(name: str) -> dict[tuple[str, str, str], dict[str, Any]]:
    """Return the figures of `tables.py`, by garment, method and split."""
    return {(row["garment"], row["method"], row["split"]): row for row in result(name)["figures"]}


def overview() -> str:
    """Energy, skin that shows and limbs through the cloth, beside linear blend skinning."""
    energies, rows = cells("table1"), []
    for name, words in GARMENTS.items():
        for split in SPLITS:
            skin = result("shown_skin")[name][split]
            pairs = (energies[IN_RESULTS[name], method, split]["total"] for method in ("ssilk", "LBS"))
            row = [words if split == "valid" else "", split, *(digits(mean(each)) for each in pairs)]
            for figure, places in (("mean", 3), ("worst", 1), ("pierced", 1)):
                row += [percent(skin[method][figure], places) for method in ("network", LBS)]
            rows.append(row)
    header = ("garment", "clips", "energy [J]", "LBS", "shows, mean [%]", "LBS", "shows, worst [%]", "LBS",
              "limbs [%]", "LBS")  # fmt: skip
    return table(header, rows, 2)


def other_methods() -> str:
    """Energies of all methods, and their excess and velocities beside the simulator."""
    energies, dynamics, rows = cells("table1"), cells("table2"), []
    for name, words in GARMENTS.items():
        for number, (method, shown) in enumerate(METHODS.items()):
            keys = [(IN_RESULTS[name], method, split) for split in SPLITS]
            row = ["" if number else words, shown, *(digits(mean(energies[key]["total"])) for key in keys)]
            for key in keys[1:]:
                row.append(digits(mean(energies[key]["total_excess"])) if "total_excess" in energies[key] else "")
            for key in keys[1:]:
                found = dynamics.get(key, {}).get("velocity_error")
                row.append(fixed(mean(found), 2) if found else "")
            rows.append(row)
    header = ("garment", "method", "`valid` [J]", "`test` [J]", "flips [J]", "excess, `test` [J]", "flips [J]",
              "velocity, `test` [m/s]", "flips [m/s]")  # fmt: skip
    return table(header, rows, 2)


def trainings() -> str:
    """What the methods of the table above were trained for."""
    found = {(each["garment"], each["method"]): each for each in result("table1")["trainings"]}
    rows = []
    for name, words in GARMENTS.items():
        counts = (f"{found[IN_RESULTS[name], method]['iterations']:,}" for method in ("ncs", "ncs*", "snug"))
        run = result("shipped_training")[name]
        best = run["total"].index(min(run["total"]))
        rows.append([words, *counts, f"{run['iterations'][best]:,} of {run['iterations'][-1]:,}",
                     duration(run["seconds"][-1]), digits(run["total"][best]), digits(run["total"][-1])])  # fmt: skip
    header = ("garment", "NCS", "NCS*", "SNUG", "SSILK, kept at", "time of its steps", "best [J]", "last [J]")
    return table(header, rows)


def refined_skin() -> str:
    """Skin that shows, bare skin and limbs, as trained and refined."""
    rows = []
    for name, words in GARMENTS.items():
        for split in SPLITS:
            own = [result("shown_skin")[name][split][method] for method in ("network", REFINED)]
            pairs = (f"{percent(at['mean'], 3)}, {percent(at['worst'])}" for at in own)
            limbs, bare = ([percent(at[figure]) for at in own] for figure in ("pierced", "bare"))
            rows.append([words if split == "valid" else "", split, *pairs, *limbs, *bare])
    header = ("garment", "clips", "shows: network", "refined", "limbs: network", "refined", "bare: network",
              "refined")  # fmt: skip
    return table(header, rows, 2)


def worst_frames() -> str:
    """Whether the solver can cover what shows in the worst frame of the hardest clip."""
    rows = []
    for name, words in GARMENTS.items():
        at = result("worst_frames")[name]["01_14"]
        shares = (f"{percent(at[key]['shows'], 2)} ({percent(at[key]['inside'], 2)})"
                  for key in ("network", "4 iterations", "200 iterations"))  # fmt: skip
        rows.append([words, at["frame"], *shares])
    return table(("garment", "frame", "network", "4 iterations", "200 iterations"), rows)


def beside_solver() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield garment, split and figures of networks that the simulator went on from."""
    for name in ("cape", "hooded_dress"):
        source = "evaluate_cape" if name == "cape" else "evaluate_solver_hooded_dress"
        for row in document(source)["figures"]:
            if row["method"] == "ssilk" and row["split"] in SPLITS:
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
    """Whether the cape comes to rest after stops, and repeats itself in loops."""
    rows = []
    for row in document("evaluate_cape")["figures"]:
        if row["method"] == "ssilk":
            stops, loop = row["figures"]["settling"], row["figures"]["loop_drift"]
            time = "" if stops["settling_time"] is None else fixed(stops["settling_time"], 1)
            rows.append([row["split"], stops["stops"], percent(stops["settled_share"], 0), time,
                         fixed(stops["static_distance"], 0, 1e-3), fixed(stops["max_static_distance"], 0, 1e-3),
                         fixed(loop["loop_distance"], 3, 1e-3)])  # fmt: skip
    header = ("clips", "stops", "settled [%]", "median time [s]", "distance to P [mm]", "largest",
              "between loops [mm]")  # fmt: skip
    return table(header, rows)


def refinement() -> str:
    """What iterations of the solver buy in a jump."""
    rows = []
    ways = {"0": ("network", ""), "4 network": ("4", "network"), "4 refined": ("4", "refined"),
            "8 network": ("8", "network"), "8 refined": ("8, *hero*", "refined"),
            "simulator": ("simulator", "simulated")}  # fmt: skip
    for clip, found in result("refine").items():
        for key, (count, past) in ways.items():
            at = found[key]
            seconds = digits(at["seconds"], 2) if at["seconds"] else ""
            words = GARMENTS[clip.split()[0]] if key == "0" else ""
            rows.append([words, count, past, seconds, digits(at["energy"]), percent(at["shows"], 2),
                         percent(at["limbs"], 0), fixed(at["apart"], 0, 1e-3), fixed(at["jitter"], 1, 1e-3)])  # fmt: skip
    header = ("garment", "iterations", "inertia from", "s a frame", "energy [J]", "shows, worst [%]", "limbs [%]",
              "apart [mm]", "jitter [mm]")  # fmt: skip
    return table(header, rows, 3)


def levels() -> str:
    """What each quality level costs and loses."""
    on_cpu = {(at["model"], at["variant"]): at["solving"] for at in document("trade_cpu")["points"]}
    rows = []
    for at in document("trade_cuda")["points"]:
        variant, skin = at["variant"], at["shown_skin"]
        cpu = on_cpu.get((at["model"], variant))
        solver = ("", "") if at["solving"] is None else (digits(at["solving"], 2), digits(cpu, 2) if cpu else "")
        name = f"`{variant}`" if at["swept"] == "level" else variant.replace("1 iterations", "1 iteration")
        rows.append([GARMENTS[at["model"]] if variant == "as trained" else "", name,
                     fixed(at["milliseconds"], 2), *solver, fixed(at["total"], 3), percent(skin["mean"], 3),
                     digits(1000 * at["position"], 2), fixed(at["model_bytes"], 1, 1e6),
                     fixed(at["shot_bytes"], 1, 1e6)])  # fmt: skip
    header = ("garment", "variant", "play [ms]", "solver, GPU [ms]", "one thread [ms]", "energy [J]", "shows [%]",
              "off [mm]", "model, 32 bits [MB]", "shot [MB]")  # fmt: skip
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


def crowds() -> str:
    """Many shots at once on a GPU."""
    rows = []
    for count in (1, 8, 64, 512, 2048):
        at = [result("batch")[f"{count} {what}"] for what in ("network alone", "with vertices")]
        rows.append([f"{count:,}", *(fixed(each["median [us]"]) for each in at),
                     *(digits(each["frames per second"], 3) for each in at)])  # fmt: skip
    header = ("shots", "network [µs]", "with vertices [µs]", "network [frames/s]", "with vertices [frames/s]")
    return table(header, rows)


def extremes() -> str:
    """How many extremes work, fall back and are refused, by group."""
    outcomes = document("stress_cape")["outcomes"]
    verdicts = ("works", "falls back", "refuses")
    groups = {each["group"]: Counter[str]() for each in outcomes}
    for each in outcomes:
        groups[each["group"]][each["verdict"]] += 1
    rows = [[group, *(counts[verdict] or "" for verdict in verdicts)] for group, counts in groups.items()]
    total = Counter(each["verdict"] for each in outcomes)
    return table(("extremes of", *verdicts), [*rows, ["all", *(total[verdict] or "" for verdict in verdicts)]])
