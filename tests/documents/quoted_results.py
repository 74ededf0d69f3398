# SPDX-License-Identifier: Apache-2.0
"""What docs/results.md says of measurements: text with figures, made from the files that these come from."""

from __future__ import annotations

import re
from itertools import product
from statistics import mean, median

from ssilk_core.config import PRESETS
from ssilk_core.fabrics import Fabric
from ssilk_core.quality import QUALITIES

from .measured import (
    GARMENTS,
    METHODS,
    SPLITS,
    cells,
    default,
    digits,
    document,
    duration,
    evaluated,
    percent,
    result,
    row,
    series,
    shipped,
    spread,
)
from .shared import Text, cache_share, extremes, frame_time, model_size, two_gpus


def headline() -> Text:
    figures = cells("table1")
    models = result("runtime")["models"]["cape"]
    methods = ("ssilk", "plain", "ncs", "snug")
    lines = (
        ("Cape, excess [J]", "Cape", "valid", "excess"),
        ("Cape, excess on flips [J]", "Cape", "flips", "excess"),
        ("Cape, vertices inside the body [%]", "Cape", "valid", "inside"),
        ("T-shirt, excess [J]", "tshirt", "valid", "excess"),
        ("T-shirt, vertices inside the body [%]", "tshirt", "valid", "inside"),
    )
    for text, garment, split, figure in lines:
        shown = percent if figure == "inside" else spread
        yield row(text, *(shown(figures[garment, method, split][figure]) for method in methods))
    ours, ncs = (models[way]["full, poses included"][0] / 1000 for way in ("numpy", "NCS, in chunks"))
    yield row("Cape, from pose to vertices on one processor thread [ms a frame]", f"{ours:.2f}", "", f"{ncs:.2f}", "")


def opening() -> Text:
    yield from headline()
    figures, curves = cells("table1"), result("curves")
    times = [run["seconds"][-1] for run in curves.values()]
    yield f"{duration(min(times))} to {duration(max(times))} on one H200"
    yield f"{frame_time():.2f} ms a frame"
    yield f"1/{cache_share():.0f} of its point cache"
    yield f"The cape's model is {model_size()}"
    holds = evaluated("cape")["valid"]["holds"]
    yield f"{100 * holds['settled']:.0f} % of the stops within {document('evaluate_cape')['options']['hold']:g} s"
    yield f"stands {holds['distance'] * 1000:.1f} mm"
    lower = {other: lower_cells("ssilk", other, "excess") for other in ("ncs", "ncs*", "snug")}
    yield f"{lower['ncs']} of {len(figures) // len(METHODS)} cells"
    tight = [
        percent(figures[garment, "ssilk", "valid"]["inside"], 1) for garment in ("tshirt", "pants", "long_sleeve")
    ]
    yield f"{min(tight)} to {max(tight)} % of their vertices"
    yield f"in {equal_lower('ncs')} of {len(figures) // len(METHODS)} cells"


def lower_cells(method: str, other: str, figure: str, name: str = "table1") -> int:
    """Return in how many cells, of a garment and a split, one method's mean is lower than another's."""
    found = cells(name)
    pairs = product(GARMENTS, SPLITS)
    return sum(mean(found[g, method, s][figure]) < mean(found[g, other, s][figure]) for g, s in pairs)


def equal_lower(other: str) -> int:
    return lower_cells("ssilk", other, "total", "equal_iterations")


def conditions() -> Text:
    cape, frames = shipped("cape"), result("table2")["frames of a sequence"]
    (body,) = {line["vertices"] for line in document("trade_cape")["judging"] if line["body"] == "triangles"}
    yield f"{body:,} vertices and {len(cape['joint_names'])} joints"
    held_out = evaluated("cape")
    yield row("training", len(cape["provenance"]["motions"]), "")
    texts = {
        "valid": "held out; chooses the checkpoint that is kept",
        "inertia": "the clips of `valid` with strong accelerations",
        "flips": "a cartwheel and a flip; chooses nothing",
    }
    for split, text in texts.items():
        yield row(f"`{split}`", held_out[split]["clips"], text)
    times = [training["seconds"] for training in result("table1")["trainings"]]
    yield f"took {min(times):.0f} to {max(times):.0f} s"
    steps = {t["iterations"] for t in result("table1")["trainings"] if t["method"] != "ssilk"}
    (baseline,) = steps
    own = [t["iterations"] for t in result("table1")["trainings"] if t["method"] == "ssilk"]
    yield f"{min(own):,} to {max(own):,} iterations of SSILK and {baseline:,} of each baseline"
    decay = PRESETS["final"].train
    kept = getattr(decay, "ema_decay", None) or decay.average
    yield f"a decay of {kept:g}. After {baseline:,} steps it still holds {kept**baseline:.1%}".replace("%", " %")
    yield f"sequences of {frames} frames"
    seeds = len(cells("table1")["Cape", "ssilk", "valid"]["total"])
    assert seeds == 3, "the document says three seeds"


def table1() -> Text:
    found = cells("table1")
    for garment, method in product(GARMENTS, METHODS):
        lines = {split: found[garment, method, split] for split in SPLITS}
        yield row(
            GARMENTS[garment],
            f"**{METHODS[method]}**" if method == "ssilk" else METHODS[method],
            spread(lines["valid"]["total"]),
            *(spread(lines[split]["excess"]) for split in SPLITS),
            percent(lines["valid"]["inside"]),
            percent(lines["flips"]["inside"]),
            percent(lines["valid"]["excess_gravity"], 1),
        )


def findings() -> Text:
    found = cells("table1")
    names = {"valid": "`valid`", "inertia": "`inertia`", "flips": "flips"}
    for split in SPLITS:
        saved = [
            1 - mean(found[g, "ssilk", split]["total"]) / mean(found[g, "plain", split]["total"]) for g in GARMENTS
        ]
        yield f"{100 * min(saved):.0f} to {100 * max(saved):.0f} % on {names[split]}"
    count = len(found) // len(METHODS)
    lower = [lower_cells("ssilk", other, "excess") for other in ("ncs", "ncs*", "snug")]
    assert lower[1] == lower[2]
    yield f"lower than NCS's in {lower[0]} of {count} cells, and lower than that of NCS* and of SNUG in {lower[1]}"
    gravity = [mean(found[garment, "ssilk", split]["excess_gravity"]) for garment, split in product(GARMENTS, SPLITS)]
    yield f"at most 5 % of m g L above the simulator's in {sum(value <= 0.05 for value in gravity)} of {count} cells"
    skirts = [percent(found[garment, "ssilk", "flips"]["excess_gravity"], 0) for garment in ("Cape", "FringeSkirt")]
    yield f"{skirts[0]} and {skirts[1]} %"
    inside = [mean(found[garment, "ssilk", split]["inside"]) for garment, split in product(GARMENTS, SPLITS)]
    few = sum(value < 0.005 for value in inside)
    yield f"Under 0.5 % of the vertices are inside the body in {few} of {count} cells"
    lower = [equal_lower(other) for other in ("ncs", "ncs*", "snug")]
    yield f"lower than NCS's in {lower[0]} of {count} cells, than NCS*'s in {lower[1]} and than SNUG's in {lower[2]}"
    (steps,) = {t["iterations"] for t in result("table1")["trainings"] if t["method"] == "ncs"}
    yield f"With {steps:,} iterations"


def dynamics() -> Text:
    found = cells("table2")
    for garment in GARMENTS:
        errors = (
            digits(mean(found[garment, method, split]["velocity_error"]), 2)
            for split in SPLITS[1:]
            for method in METHODS
        )
        yield row(GARMENTS[garment], *errors)
    error = {key: mean(cell["velocity_error"]) for key, cell in found.items() if "velocity_error" in cell}
    others = [method for method in METHODS if method != "ssilk"]
    nearest = [g for g in GARMENTS if all(error[g, "ssilk", "inertia"] < error[g, m, "inertia"] for m in others)]
    yield f"nearest to the simulator in {len(nearest)} of {len(GARMENTS)} garments"
    *first, last = (GARMENTS[g] for g in GARMENTS if error[g, "ssilk", "flips"] > error[g, "plain", "flips"])
    yield f"On flips the {', the '.join(first)} and the {last} are further from it than with LBS"


def ablations() -> Text:
    rows = result("ablations")["total"]
    yield f"{result('ablations')['iterations']:,} iterations"
    names = {
        "decoder": "decoder (Figure 8)",
        "scheme": "integration (Figure 11)",
        "blendshapes": "blendshapes (Figure 12)",
        "proxies": "proxy joints",
        "regularity": "latent regularization λ (Table 4)",
        "batch": "batch (Table 5)",
        "window": "window (Table 5)",
        "latent": "latent size (Table 5)",
    }
    for setting, text in names.items():
        for line in (line for line in rows if line["setting"] == setting):
            value = str(line["value"]).replace("_", " ").removesuffix(".0")
            yield row(text, value, *(digits(mean(line[split])) for split in SPLITS))
            text = ""
    latents = {line["value"]: mean(line["valid"]) for line in rows if line["setting"] == "latent"}
    worst = max(latents, key=latents.__getitem__)
    yield f"but for a latent of {worst}, which is too small"
    deviation = spread(cells("table1")["Cape", "ssilk", "valid"]["total"]).partition("± ")[2]
    yield f"standard deviation of {deviation} J over three seeds"


def wardrobe() -> Text:
    for garment in GARMENTS.values():
        name = garment.replace("T-", "t").replace(" ", "_")
        run, figures = result("curves")[name], evaluated(name)
        best = run["iterations"][min(range(len(run["total"])), key=run["total"].__getitem__)]
        yield row(
            garment,
            f"{best:,} of {run['iterations'][-1]:,}",
            duration(run["seconds"][-1]),
            *(digits(figures[split]["total"], 2) for split in SPLITS),
            percent(figures["valid"]["collisions"], 1),
            percent(figures["flips"]["collisions"], 1),
        )
    yield f"{digits(evaluated('hooded_dress')['valid']['clip_totals'][1], 2)} J"
    cape = result("curves")["cape"]
    best = min(cape["total"])
    yield f"{digits(best, 2)} J at {cape['iterations'][cape['total'].index(best)]:,} iterations"
    yield f"{digits(cape['total'][-1], 2)} J at {cape['iterations'][-1]:,}"


def rest() -> Text:
    for split, found in evaluated("cape").items():
        holds, loops = found["holds"], found["loops"]
        yield row(
            f"`{split}`",
            holds["stops"],
            f"{holds['settled']:.0%}".rstrip("%"),
            f"{holds['settling']:.2f}",
            f"{1000 * holds['distance']:.1f}",
            f"{1000 * holds['furthest']:.1f}",
            digits(loops["second"], 4),
            digits(loops["last"], 4),
            f"{1000 * loops['apart']:.1f}",
        )
    options = document("evaluate_cape")["options"]
    yield f"held for {options['hold']:g} s"
    yield f"loops for {options['loop']:,} frames"
    drifts, firsts = [], []
    for clip in result("long_rollout").values():
        totals = [sum(terms) for terms in zip(*clip["J"].values(), strict=True)]
        drifts.append(abs(totals[-1] / totals[1] - 1))
        firsts.append(abs(totals[-1] / totals[0] - 1))
    yield f"Over 10,000 frames the totals of three clips change by at most {100 * max(drifts):.2f} %"
    yield f"differs from the last by {100 * min(firsts):.0f} to {100 * max(firsts):.0f} %"
    yield "a loop of 10,000 frames"
    yield "loops for 10,000 frames"
    for clip in result("long_rollout").values():
        assert abs(len(clip["J"]["stretch"]) * clip["frames of a loop"] - 10_000) <= clip["frames of a loop"]


def playing() -> Text:
    measured = result("runtime")
    cape, models = measured["cape"], measured["models"]["cape"]
    size = f"{cape['vertices']:,} vertices, {cape['blendshapes']} blendshapes, {cape['proxies']} proxy joints"
    yield f"({size}, {cape['joints']} joints)"
    ways = ("numpy", "PyTorch, in chunks", "NCS, in chunks", "PyTorch, frame by frame", "NCS, frame by frame")
    parts = {
        "network and kinematics": "+ kinematics",
        "with blendshapes and skinning": "+ blendshapes and skinning",
        "with descriptors of the poses": "full, poses included",
    }
    for text, part in parts.items():
        yield row(text, *(f"{models[way][part][0]:,.0f}" for way in ways))
    sizes = [
        measured["networks"][size]["numpy"]["+ kinematics"][0] for size in ("64: 256, 256", "128: 256, 512, 512")
    ]
    yield f"{sizes[0]:.0f} µs instead of {sizes[1]:.0f} µs"
    yield "64 latents and two layers of 256"
    floor = sum(time[0] for time in measured["models"]["cape, products alone"]["numpy"].values())
    yield f"matrix products alone take {floor:.0f} µs"
    cloth = measured["models"]["cape, Blender"]["Blender"]["cloth modifier"][0]
    load = measured["load of the machine"]
    yield f"{cloth / 1000:.0f} ms a frame for the same shot"
    yield f"on a machine with a load of {load['load']} on {load['cores']} cores"
    frame = result("table3_cuda")
    single = [1000 * frame[f"cape_{name}"]["full"][0] for name in ("ssilk", "ncs", "snug")]
    yield f"SSILK {single[0]:.1f} ms, NCS {single[1]:.1f} ms, SNUG {single[2]:.1f} ms"
    deviations = [1000 * frame[f"cape_{name}"]["full"][1] for name in ("ssilk", "ncs", "snug")]
    yield f"standard deviations of {min(deviations):.1f} to {max(deviations):.1f} ms"
    for count in (1, 8, 64, 512, 2048):
        rates = [result("batch")[f"{count} {what}"] for what in ("network alone", "with vertices")]
        yield row(f"{count:,}", *(f"{rate['median [us]']:.0f}" for rate in rates), *(
            f"{rate['frames per second']:,.0f}" for rate in rates
        ))  # fmt: skip


def sizes() -> Text:
    (shot,) = (line for line in result("compact")["rows"] if line["name"] == "anim.usdc, the shot")
    frame = 3 * 4 * result("runtime")["cape"]["vertices"]  # bytes of the same cape in single precision
    yield f"A shot of {result('compact')['cache'] // frame} frames takes {shot['bytes'] / 1e6:.2f} MB"
    yield f"1/{cache_share():.0f} of the vertices in single precision"
    yield f"{1e6 * shot['largest']:.1f} µm"


def levels() -> Text:
    yield "10 s shot [MB]"  # as `trade` scales them
    points = {point["variant"]: point for point in document("trade_cape")["points"]}
    times = result("runtime")["models"]
    for level in ("as trained", "film", "game", "crowd"):
        point = points[level]
        shown = "whole" if level == "as trained" else level
        rate = f"`{level}`, {point['fps']:.0f} frames/s" if level == "crowd" else f"`{level}`"
        yield row(
            "as trained" if level == "as trained" else rate,
            f"{point['shapes']} / {point['joints']} / {point['influences']}",
            digits(1000 * point["position"], 2) if point["position"] else "0",
            digits(point["excess"], 2) if point["excess"] else "0",
            f"{times[f'cape, {shown}']['numpy']['full, poses included'][0]:.0f}",
            f"{point['shot_bytes'] / 1e6:.2f}",
            f"{point['model_bytes'] / 1e6:.1f}",
        )
        if level != "as trained":
            kept = QUALITIES[level]
            assert (min(kept.shapes, 64), min(kept.influences, 8)) == (point["shapes"], point["influences"])


def refinement() -> Text:
    (clip,) = result("refine").values()
    frames = re.search(r"--frames (\d+)", document("refine")["command"])
    assert frames
    yield f"of {frames[1]} frames of one"
    for key, found in clip.items():
        count, _, base = key.partition(" ")
        yield row(
            "simulator" if key == "simulator" else count,
            {"network": "network", "refined": "refined frame"}.get(base, ""),
            digits(found["seconds"], 2) if found["seconds"] else "0",
            f"{found['energy']:.3f}".replace("-", "−"),
            percent(found["inside"], 3),
            f"{1000 * found['moved']:.1f}",
        )


def inside_the_body() -> Text:
    for garment in ("tshirt", "long_sleeve", "pants"):
        found = {
            (method, split): mean(cells("table2")[garment, method, split]["inside"])
            for method in ("simulator", "ssilk")
            for split in SPLITS[1:]
        }
        shares = [found["simulator", split] / found["ssilk", split] for split in SPLITS[1:]]
        yield row(
            GARMENTS[garment],
            *(percent(found[method, split], 2) for split in SPLITS[1:] for method in ("simulator", "ssilk")),
            *(f"{share:.0%}".rstrip("%") for share in shares),
            f"{1000 * result('collisions')[garment]['model']['depth'][0]:.1f}",
        )
    fabric = Fabric("default")
    yield f"{fabric.collision:g} N/m for each vertex"
    yield f"{1000 * fabric.margin:g} mm margin"


def stress() -> Text:
    found = document("stress_cape")["outcomes"]
    outcomes = {outcome["name"]: outcome for outcome in found if outcome["group"] != "simulator"}
    extents = [outcome["measured"]["extent"] for outcome in found if outcome["measured"].get("extent")]
    verdicts = [outcome["verdict"] for outcome in found]
    counts = {verdict: verdicts.count(verdict) for verdict in ("works", "falls back", "refuses")}
    yield extremes()
    yield f"{counts['works']} work, {counts['falls back']} fall back and {counts['refuses']} are refused"
    yield f"latent value exceeds {digits(max(extent['latent'] for extent in extents), 2)}"
    bound = getattr(PRESETS["final"].model, "latent_bound", None) or PRESETS["final"].model.bound
    yield f"under the bound of {bound:g}"
    growth = outcomes["100,000 frames"]["measured"]["extent"]["growth"]
    yield f"100,000 frames of a looped cartwheel the last loop has {growth:.2f} times the energy of the second"
    teleports = outcomes["a teleport of 30 m each second"]["measured"]["extent"]["growth"]
    yield f"A teleport of 30 m each second multiplies the mean energy by {teleports:.1f}"
    ride = outcomes["a ride at 50 m/s"]["measured"]["extent"]["growth"]
    assert abs(ride - outcomes["float32"]["measured"]["extent"]["growth"]) < 1e-3, "a ride changes nothing"
    yield "A ride at 50 m/s changes nothing"
    errors = {name: outcomes[name]["measured"]["error"] for name in ("float32", "float16", "bfloat16")}
    yield f"float32 by {1000 * errors['float32']:.2f} mm, float16 by {errors['float16']:.2f} m and"
    yield f"bfloat16 by {errors['bfloat16']:.2f} m"
    simulated = {
        "gravity: tenfold": "tenfold",
        "gravity: none": "none",
        "stretch stiffness 0.001 N/m": "0.001 N/m",
        "stretch stiffness 1 N/m": "1 N/m",
        "stretch stiffness 1,000 N/m": "1000 N/m",
        "stretch stiffness 1,000,000 N/m": "1e+06 N/m",
        "slivers 0.0001 as high as long": "slivers 0.0001 as high as long",
    }
    for text, name in simulated.items():
        groups = ("gravity", "simulator")
        (outcome,) = (o for o in found if o["name"] == name and o["group"] in groups)
        extent, residual = outcome["measured"]["extent"], outcome["measured"]["error"]
        yield row(text, f"{extent['frames'] - extent['recovered']} of {extent['frames']}", digits(residual, 2))
    works = {outcome["name"] for outcome in outcomes.values() if outcome["verdict"] == "works"}
    assert {"200,000", "100 m", "0.001 m"} <= works
    yield "200,000 vertices"
    yield "Characters of 1 mm and of 100 m"


def training_speed() -> Text:
    measured = result("training")
    cases, parts = measured["cases"], measured["parts of the base case"]
    size = cases["base"]["size"]
    yield (
        f"{size['vertices']:,} garment vertices, {size['body']} body vertices, {size['shapes']} blendshapes, "
        f"{size['proxies']} proxy joints, {size['batch']} windows of {size['window']}, {size['resting']} single poses"
    )
    steps = {
        "step on windows": ("base", "windows"),
        "step of pretraining, 1,024 poses": ("base", "warm"),
        "step on 256 windows of 6, the default": ("batch 256, window 6, resting 256", "windows"),
    }
    assert default("batch") == 256
    assert default("window") == 6
    for text, (case, phase) in steps.items():
        times = (cases[case][kind]["steps [ms]"][phase] for kind in ("reference", "kernels"))
        yield row(text, *(digits(time, 3) for time in times))
    shown = {
        "closest body point": "nearest body point",
        "stretch and bending, with gradient": "stretch and bending, with backward",
        "skinning, with gradient": "skinning, with backward",
        "stepper, 30 frames in a row": "stepper S frame by frame",
    }
    assert size["window"] - 2 == 30
    for text, part in shown.items():
        yield row(text, *(digits(parts[part][f"{kind} [ms]"], 2) for kind in ("reference", "kernels")))
    peak = cases["base"]["kernels"]["peak [bytes]"] / 1e9
    yield f"{peak:.1f} GB of GPU memory"
    sweeps = {
        "garment vertices": ("vertices 1250", "base", "vertices 5000", "vertices 10000"),
        "body vertices": ("base", "body 1229", "body 4000"),
        "window": ("window 16", "base", "window 64"),
        "batch": ("batch 16", "base", "batch 64"),
    }
    keys = {"garment vertices": "vertices", "body vertices": "body", "window": "window", "batch": "batch"}
    for text, names in sweeps.items():
        values = series(f"{cases[name]['size'][keys[text]]:g}" for name in names)
        yield row(text, values, series(f"{cases[name]['kernels']['steps [ms]']['windows']:.1f}" for name in names))
    for windows, case in ((32, "Windows of 32"), (6, "Windows of 6, the default")):
        batches = [int(key.rpartition(" ")[2]) for key in result("scaling")[case] if key.startswith("2 ")]
        yield row(windows, series(f"{b:g}" for b in batches), series(f"{two_gpus(case, b):.2f}" for b in batches))
    half = result("scaling")["Windows of 32"]
    times = [median(half[f"1 processes, batch {batch}"]["times"]["windows"]) for batch in ("64/2", "64")]
    yield f"Half of 64 windows takes {times[0] / times[1]:.0%} of the time".replace("%", " %")


def scenes() -> Text:
    found = result("scenes")
    pinned, tight, loose = (1000 * found[name]["train"] for name in ("all pinned", "all tight", "loose"))
    yield f"{pinned:.0f} ms where everything is pinned, {tight:.0f} ms where everything is tight"
    yield f"{loose:.0f} ms where all of it is loose"


def results() -> Text:
    for part in PARTS:
        yield from part()


PARTS = (
    opening,
    conditions,
    table1,
    findings,
    dynamics,
    ablations,
    wardrobe,
    rest,
    playing,
    sizes,
    levels,
    refinement,
    inside_the_body,
    stress,
    training_speed,
    scenes,
)
"""The parts of the document, in its order."""
