# SPDX-License-Identifier: Apache-2.0
"""What docs/results.md says of measurements: text with figures, made from the files that these come from."""

from __future__ import annotations

import re
from functools import partial
from itertools import product
from statistics import mean

from ssilk_core.demo.shipped import shipped_path
from ssilk_core.files import sha256
from ssilk_core.network.settings import ModelConfig
from ssilk_core.quality.evaluation.solver_errors import AFTER
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.training.settings import PRESETS

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
    fields,
    fixed,
    means,
    micro,
    milli,
    percent,
    result,
    row,
    series,
    shipped,
    spread,
)
from .shared import (
    LARGE_STEP,
    SCALING,
    Text,
    cache_share,
    extremes,
    frame_time,
    large_step_size,
    shot_row,
    step_time,
    two_gpus,
)

CELLS = list(product(GARMENTS, SPLITS))
TIGHT = ("tshirt", "long_sleeve", "pants")
HELD_OUT = ("valid", "test", "flips")
FULL = "full, poses included"
SKINNING = "linear blend skinning"
one_digit, two_digits, four_digits = (partial(digits, count=count) for count in (1, 2, 4))
share, share_1, share_2, share_3 = (partial(percent, places=places) for places in range(4))
milli_1 = partial(milli, places=1)


def lower(figure: str, comparison: str = "table1") -> dict[str, int]:
    """Return in how many cells, of a garment and a split, the mean of SSILK is lower, by the other method."""
    found = means(comparison, figure)
    return {
        other: sum(found[g, "ssilk", s] < found[g, other, s] for g, s in CELLS) for other in ("ncs", "ncs*", "snug")
    }


def opening() -> Text:
    figures, runtime = cells("table1"), result("runtime")["models"]["cape"]
    lines = {
        "Cape, excess [J]": ("Cape", "valid", "total_excess", spread),
        "Cape, excess on flips [J]": ("Cape", "flips", "total_excess", spread),
        "Cape, vertices inside the body [%]": ("Cape", "valid", "collisions", share_2),
        "T-shirt, excess [J]": ("tshirt", "valid", "total_excess", spread),
        "T-shirt, vertices inside the body [%]": ("tshirt", "valid", "collisions", share_2),
    }
    for text, (garment, split, figure, form) in lines.items():
        yield row(text, *(form(figures[garment, m, split][figure]) for m in ("ssilk", "LBS", "ncs", "snug")))
    ours, ncs = (fixed(runtime[way][FULL][0], 2, 1000) for way in ("numpy", "NCS, in chunks"))
    yield row("Cape, from pose to vertices on one processor thread [ms a frame]", ours, "", ncs, "")

    times = [run["seconds"][-1] for run in result("curves").values()]
    yield f"{duration(min(times))} to {duration(max(times))} on one H200"
    yield f"{frame_time():.2f} ms a frame"
    yield f"{cache_share()} of its point cache"
    yield f"The cape that ships is {shipped_path('cape').stat().st_size / 1e6:.1f} MB"
    yield f"An earlier cape takes {frame_time():.2f} ms"
    settling, hold = shipped_rest()["settling"], document("evaluate_cape_shipped")["options"]["hold"]
    assert settling["settled_share"] == 1, "the document says so"
    yield f"after all of {settling['stops']} stops within {hold:g} s"
    yield f"within\n  {settling['settling_time']:.2f} s. It then stands {milli_1(settling['static_distance'])} mm"
    yield f"{lower('total_excess')['ncs']} of {len(CELLS)} cells"
    found = {**result("shown_skin_hands"), **result("shown_skin_shipped")}
    tests = [share_1(found[name]["test"]["network"]["pierced"]) for name in ("cape", "fringe_skirt", "hooded_dress")]
    yield (
        f"In {tests[0]} % of the frames of `test` a limb is through the cape that ships, in {tests[1]} % through the "
        f"skirt and in {tests[2]} % through the dress"
    )
    inside = [share_1(figures[garment, "ssilk", "valid"]["collisions"]) for garment in TIGHT]
    yield f"{min(inside)} to {max(inside)} % of their vertices"
    yield f"in {lower('total', 'equal_iterations')['ncs']} of {len(CELLS)} cells"


def refined_skin(tight: dict) -> Text:
    yield "Four solver iterations in every frame (`--refine 4`)"
    for name, own in tight.items():
        pairs = [own[split][method] for split in HELD_OUT for method in ("network", "refine 4")]
        yield row(GARMENTS.get(name) or name.replace("_", " "),
                  *(f"{share_3(at['mean'])}, {share_2(at['worst'])}" for at in pairs))  # fmt: skip
    cells_of = [own[split]["refine 4"] for own in tight.values() for split in ("valid", "test")]
    reached = [sum(at[figure] <= goal for at in cells_of) for figure, goal in (("mean", 1e-4), ("worst", 1e-3))]
    yield f"are 0.01 % and 0.1 %, on `valid` and `test`. The mean is reached in {reached[0]} of {len(cells_of)} cells"
    yield f"worst frame in {reached[1]}.\n"
    cells_of = product(tight, HELD_OUT, ("mean", "worst"))
    more = {(n, s, f) for n, s, f in cells_of if tight[n][s]["refine 4"][f] > tight[n][s]["network"][f]}
    told = {("pants", "valid", "mean"), ("pants", "test", "mean"), ("pants", "test", "worst")}
    assert more == told, "the document names them"
    yield from refined_loose()


def refined_loose() -> Text:
    found = result("shown_skin_refined")
    methods = ("network", "refine 4")
    for name, own in found.items():
        pairs = [own[split][method] for split in HELD_OUT for method in methods]
        words = name.replace("_before", ", before").replace("_", " ")
        yield row(words, *(f"{share_3(at['mean'])}, {share_2(at['worst'])}" for at in pairs))
    cells_of = [own[split]["refine 4"] for own in found.values() for split in ("valid", "test")]
    reached = [sum(at[figure] <= goal for at in cells_of) for figure, goal in (("mean", 1e-4), ("worst", 1e-3))]
    yield f"in {reached[0]} of {len(cells_of)} cells, and the worst frame in {reached[1]}."
    pairs = [[own[split][method]["worst"] for method in methods] for own in found.values() for split in HELD_OUT]
    yield f"In {sum(now < then / 2 for then, now in pairs)} of {len(pairs)} cells the worst frame"
    cape = found["cape"]["test"]
    assert cape["refine 4"]["mean"] > cape["network"]["mean"], "the document says so"
    assert {cape[method]["in"] for method in methods} == {"01_14"}, "the document names it"


def shown() -> Text:
    tight = {name: result(f"shown_skin_{name}")[name] for name in TIGHT}
    skirt, dress = result("shown_skin_limits")["fringe_skirt"], result("shown_skin_shipped")["hooded_dress"]
    cape = result("shown_skin_decay")["cape"]
    found = {**tight, "cape": cape, "fringe_skirt": skirt, "hooded_dress": dress}
    yield f"those settings with {result('bind_pose_training')['tshirt']['iterations'][-1]:,} iterations"
    for garment in GARMENTS.values():
        own = found[garment.lower().replace("-", "").replace(" ", "_")]
        pairs = [own[split]["network"] for split in HELD_OUT]
        pairs += [own[split][SKINNING] for split in ("test", "flips")]
        bare = (share_1(own["test"][method]["bare"]) for method in ("network", SKINNING))
        yield row(garment, *(f"{share_3(at['mean'])}, {share_1(at['worst'])}" for at in pairs), *bare)
    yield from refined_skin(tight)
    goals = {"valid": (0.0005, 0.005), "test": (0.0005, 0.005), "flips": (0.003, 0.02)}
    yield f"{share_2(goals['test'][0])} % on `valid` and `test`, and {share_1(goals['flips'][0])} % on flips"
    yield f"{share_1(goals['test'][1])} %, and {share(goals['flips'][1])} % on flips"
    for figure, most in (("mean", 0), ("worst", 1)):
        valid, test, flips = (
            sum(own[split]["network"][figure] <= goal[most] for own in found.values())
            for split, goal in goals.items()
        )
        yield f"{valid} of {len(found)} reach it on `valid`, {test} on `test` and {flips} on flips"
    missing = [name for name, own in found.items() if own["test"]["network"]["mean"] > goals["test"][0]]
    assert missing == ["long_sleeve"], "the document names it"
    hardest, clips = "01_14", found["long_sleeve"]["test"]["network"]["clips"]
    yield f"One clip ({hardest}) makes most"
    others = mean(share for clip, share in clips.items() if clip != hardest)
    yield f"its mean over the other six clips is\n  {share_3(others)} %"
    (shapes,) = {shipped(name)["config"]["shapes"] for name in LOOSE}
    yield f"All have {shapes} blendshapes"
    clips = [len(found["cape"][split]["network"]["clips"]) for split in goals]
    training = len(shipped("cape")["provenance"]["motions"])
    yield f"has {clips[0]} clips, `test` {clips[1]} and flips {clips[2]}, and training had {training} motions"
    solved = skirt["first 12 frames"]
    yield f"the first {solved['network']['frames']} frames of a handspring"
    yield f"{solved['network']['stretch'] / solved['simulator']['stretch']:.1f} times the simulator's"
    bare = result("shown_skin")["tshirt"]["first 12 frames"]["simulator"]["bare"]
    yield f"bares {share_1(bare)} % of the skin"
    splits = product(found.values(), ("test", "flips"))
    assert all(own[split]["network"]["worst"] < own[split][SKINNING]["worst"] for own, split in splits)


LOOSE = ("cape", "fringe_skirt", "hooded_dress")


def limbs() -> Text:
    hands = result("shown_skin_hands")
    shipping = {**{name: hands[name] for name in LOOSE}, **result("shown_skin_shipped")}
    for garment in ("cape", "hooded dress", "fringe skirt"):
        own = shipping[garment.replace(" ", "_")]
        cells_of = [own[split]["network"] for split in HELD_OUT] + [
            own[split][SKINNING] for split in ("test", "flips")
        ]
        yield row(garment, *(share_1(at["pierced"]) for at in cells_of))
    more = [
        name
        for name, own in shipping.items()
        if own["flips"]["network"]["pierced"] > own["flips"][SKINNING]["pierced"]
    ]
    assert not more, "the document says so"
    counts = ("4 iterations", "16 iterations")
    yield "of the network / after 4 / after 16 iterations"
    yield f"| network | {' | '.join(counts)} | stretch |"
    for name, clips in result("limbs").items():
        for clip, at in clips.items():
            found = [at["network"], *(at[count] for count in counts)]
            yield row(
                f"{name.replace('_', ' ')}, {clip}", *(str(one["through"]) for one in found),
                " / ".join(fixed(one["stretch"], 3) for one in found),
            )  # fmt: skip
            yield f"the {at['frames']} frames are refined"
    cape = result("limbs")["cape"]["01_14"]
    assert all(cape[count]["stretch"] > cape["network"]["stretch"] for count in counts), "the document says so"
    trained, less, known = result("shown_skin_decay"), 0, {**hands, "cape": hands["cape_before"]}
    for garment in LOOSE:
        cells_of = []
        for split in HELD_OUT:
            now, then = (found[garment][split]["network"]["pierced"] for found in (trained, known))
            cells_of += [then, now]
            less += now < then
        yield row(garment.replace("_", " "), *map(share_1, cells_of))
    yield f"It is less in {less} of {len(LOOSE) * len(HELD_OUT)} cells"


def worst_frames() -> Text:
    found = {name: at["01_14"] for name, at in result("worst_frames").items()}
    methods = ("network", "4 iterations", "200 iterations")
    yield "In the worst frame of 01_14"
    yield "for 4 iterations and for 200"
    yield row("garment", "frame", *methods)
    for name, at in found.items():
        shares = (f"{share_2(at[key]['shows'])} ({share_2(at[key]['inside'])})" for key in methods)
        yield row(GARMENTS.get(name) or name.replace("_", " "), at["frame"], *shares)
    first, few, last = ({name: at[key]["shows"] for name, at in found.items()} for key in methods)
    goal = 0.005
    assert sum(share <= goal < first[name] for name, share in few.items()) == 4, "the document says so"
    yield f"under the goal of {share_1(goal)} % in this frame."
    yield f"show more, {share_2(few['pants'])} % in place of {share_2(first['pants'])} %"
    yield f"and the cape shows {share_2(few['cape'])} %. After 200 iterations all"
    assert max(last.values()) <= goal, "the document says so"
    inside = {name: at["4 iterations"]["inside"] for name, at in found.items()}
    assert {name for name, share in few.items() if share and inside[name] > share / 2} == {"cape", "pants"}, "named"


def clearance() -> Text:
    found, runs = result("shown_skin_clearance"), result("clearance_training")
    for name in ("cape", "fringe_skirt", "tshirt", "hooded_dress"):
        garment = GARMENTS.get(name) or GARMENTS[name.title().replace("_", "")]
        for far, run in ((0, name), (default("clearance"), f"{name}_clearance")):
            own = [found[run][split]["network"] for split in HELD_OUT]
            last = (runs.get(run) or result("dress_training")[run])["iterations"][-1]
            pairs = (f"{share_3(at['mean'])}, {share_1(at['worst'])}" for at in own)
            yield row("" if far else garment, fixed(1000 * far), f"{last:,}", *pairs, f"{own[0]['stretch']:.3f}")
    cells_of = list(product(("cape", "fringe_skirt", "tshirt", "hooded_dress"), HELD_OUT))
    for figure, words in (("mean", "The mean"), ("worst", "the worst frame")):
        less = sum(
            found[f"{name}_clearance"][split]["network"][figure] < found[name][split]["network"][figure]
            for name, split in cells_of
        )
        yield f"{words} is lower in {less} of {len(cells_of)} cells"
    more = [
        found[f"{name}_clearance"]["valid"]["network"]["stretch"] / found[name]["valid"]["network"]["stretch"] - 1
        for name in ("cape", "fringe_skirt", "tshirt", "hooded_dress")
    ]
    yield f"by {share(min(more))} to {share(max(more))} % on `valid`"
    for name, form in {"cape": ".4f", "fringe_skirt": ".4f", "tshirt": ".3f"}.items():
        ends = [f"{min(runs[run]['total']):{form}}" for run in (name, f"{name}_clearance")]
        garment = GARMENTS.get(name) or name.replace("_", " ")
        yield f"{ends[0]} to {ends[1]} J for the {garment}"


def kept_at(run: dict) -> tuple[int, str]:
    """Return the best validation of a training, and at which of its iterations that was."""
    best = run["total"].index(min(run["total"]))
    return best, f"{run['iterations'][best]:,} of {run['iterations'][-1]:,}"


def beside_solver(name: str, split: str) -> dict:
    """Return the figures of a network that ships, measured beside the solver on the clips of a split."""
    rows = document(f"evaluate_solver_{name}")["figures"]
    (found,) = (line["figures"] for line in rows if (line["method"], line["split"]) == ("ssilk", split))
    return found


def from_solver(name: str, split: str) -> dict:
    """Return how far the network is from the solver that starts from its own states, on the clips of a split."""
    return beside_solver(name, split)["solver"]


def from_own_start() -> Text:
    goals, reached = (0.01, 0.06, 0.2), {}
    shots = ("after 5 [mm]", *AFTER[1:])
    yield row("garment", "clips", "windows", "step [mJ]", "step [mm]", *shots, "velocity [m/s]", "LBS")
    yield f"for {AFTER[-1]} frames. *Step*"
    for garment, split in product(LOOSE, ("test", "flips")):
        at = from_solver(garment, split)
        step = milli(at["step_energy"]), f"{1000 * at['step_distance']:.1f}"
        away = [milli(value) for value in at["position_error"]]
        speeds = (f"{at[name]:.2f}" for name in ("velocity_error", "lbs_velocity_error"))
        name = garment.replace("_", " ") if split == "test" else ""
        yield row(name, "flips" if split == "flips" else "`test`", at["windows"], *step, *away, *speeds)
        if split == "test":
            found = at["position_error"][0], at["position_error"][2], at["velocity_error"]
            reached[garment] = [value <= goal for value, goal in zip(found, goals)]
    yield f"10 mm after {AFTER[0]} frames, {milli(goals[1])} mm after {AFTER[2]}, and {goals[2]:g} m/s"
    at = from_solver("cape", "test")
    yield f"the cape that ships is {milli(at['position_error'][0])} mm (RMS) from the simulator's after five frames"
    at = from_solver("cape", "flips")
    speeds = "its velocity is {:.2f} m/s from the simulator's, that of LBS {:.2f} m/s"
    yield speeds.format(at["velocity_error"], at["lbs_velocity_error"])
    assert at["velocity_error"] > at["lbs_velocity_error"], "the document says so"
    rows = document("evaluate_solver_cape_jump")["figures"]
    (now,) = (line["figures"]["solver"]["position_error"] for line in rows if line["method"] == "ssilk")
    yield "{}, {} and {} mm away after 5, 10 and\n  30 frames".format(*(milli(value) for value in now[:3]))
    (held,) = (line["figures"] for line in document("evaluate_solver_cape_held")["figures"])
    yield f"were held for {held['frames'] // held['clips']} frames"
    yield f"stays where it is, {milli_1(held['static_distance'])} mm from its own"
    away = [milli(value) for value in held["solver"]["position_error"][:3]]
    yield "it is {}, {} and {} mm away after 5, 10 and 30 frames".format(*away)
    yield f"its velocities are\n  {held['solver']['velocity_error']:.2f} m/s off"
    assert held["solver"]["position_error"][0] > goals[0], "the document says so"
    before = [result("moving_states")["cape"][f"network, after {count} [mm]"] for count in AFTER[:3]]
    yield "{:.1f}, {:.1f} and {:.1f} mm away there".format(*before)
    assert sum(map(sum, reached.values())) == reached["fringe_skirt"][1] == 1, "the document says so"


def moving_states() -> Text:
    at = result("moving_states")["cape"]
    for words, *names in (
        ("step: energy above the next better way [mJ]", "lost by the network [mJ]", "lost by the decoder [mJ]"),
        ("step: distance from the solver [mm]", "network from solver [mm]", "best outputs from solver [mm]"),
        ("from the solver after 5 frames [mm]", "network, after 5 [mm]", "best outputs, after 5 [mm]"),
        ("after 10", "network, after 10 [mm]", "best outputs, after 10 [mm]"),
        ("after 30", "network, after 30 [mm]", "best outputs, after 30 [mm]"),
    ):
        yield row(words, *(f"{at[name]:.1f}" for name in names))
    yield f"These are {at['steps']} steps and {at['shots']} shots."
    assert at["best outputs, after 5 [mm]"] > 10 and at["best outputs, after 30 [mm]"] > 60, "the document says so"
    assert at["lost by the network [mJ]"] > 0.8 * sum(at[f"lost by the {who} [mJ]"] for who in ("network", "decoder"))


def missed_steps() -> Text:
    earlier, now = result("step_errors"), result("step_errors_rate")["cape"]
    shown = {"cape": now, **{name: earlier[name] for name in ("fringe_skirt", "hooded_dress")}}
    for garment, splits in shown.items():
        for number, (split, at) in enumerate(splits.items()):
            energies = (fixed(at[name], 1, 0.001) for name in ("mean", "median", "p95"))
            name = split if split == "flips" else f"`{split}`"
            yield row("" if number else garment.replace("_", " "), name, *energies, milli_1(at["distance"]))
    yield "95 % below [mJ]"
    best, last = (earlier[name] for name in ("cape", "cape_last"))
    pairs = (("test", "mean"), ("flips", "mean"), ("flips", "median"))
    found = [fixed(run[split][name], 1, 0.001) for split, name in pairs for run in (best, last)]
    yield "{} and {} mJ on `test` and {} and {} mJ on flips in the mean, and {} and {} mJ on flips".format(*found)
    before = result("step_errors_before")["cape"]
    yield "{} and {} mJ on `test` and flips".format(
        *(fixed(before[at]["mean"], 1, 0.001) for at in ("test", "flips"))
    )
    dress = earlier["hooded_dress"]
    yield f"that of the dress is by {percent(dress['test']['median'] / dress['train']['median'] - 1)} %"
    (steps,) = {at["steps"] for splits in [*earlier.values(), now] for at in splits.values()}
    yield f"{steps} steps of each split"


def static_states() -> Text:
    for garment, states in result("static_states").items():
        for number, (state, at) in enumerate(states.items()):
            energies = (fixed(at[name], 3) for name in ("energy", "stretch", "gravity", "collision"))
            yield row("" if number else garment.replace("_", " "), state, *energies, milli(at["distance"]))


def conditions() -> Text:
    cape, held_out = shipped("cape"), evaluated("cape")
    (body,) = {line["vertices"] for line in document("trade_simulator")["judging"] if line["body"] == "triangles"}
    yield f"{body:,} vertices and {len(cape['joint_names'])} joints"
    uses = {
        "valid": "held out; chooses the checkpoint that is kept",
        "inertia": "the clips of `valid` with strong accelerations",
        "flips": "a cartwheel and a flip; chooses nothing",
    }
    for split, use in uses.items():
        yield row(f"`{split}`", held_out[split]["clips"], use)
    trainings = result("table1")["trainings"]
    times = [training["seconds"] for training in trainings]
    yield f"took {min(times):.0f} to {max(times):.0f} s"
    own = [training["iterations"] for training in trainings if training["method"] == "ssilk"]
    (baseline,) = {training["iterations"] for training in trainings if training["method"] != "ssilk"}
    yield f"{min(own):,} to {max(own):,} iterations of SSILK and {baseline:,} of each baseline"
    decay = PRESETS["final"].train.ema_decay
    yield f"a decay of {decay:g}. After {baseline:,} steps it still holds {share_1(decay**baseline)} %"
    yield f"sequences of {result('table2')['frames of a sequence']} frames"
    assert len(cells("table1")["Cape", "ssilk", "valid"]["total"]) == 3, "the document says three seeds"


def table1() -> Text:
    columns = {
        "valid/total": spread,
        **{f"{split}/total_excess": spread for split in SPLITS},
        "valid/collisions": share_2,
        "flips/collisions": share_2,
        "valid/gravity_excess": share_1,
    }
    for garment, (method, name) in product(GARMENTS, METHODS.items()):
        found = {split: cells("table1")[garment, method, split] for split in SPLITS}
        yield row(GARMENTS[garment], f"**{name}**" if method == "ssilk" else name, *fields(found, columns))


def findings() -> Text:
    count, total = len(CELLS), means("table1", "total")
    for split, name in {"valid": "`valid`", "inertia": "`inertia`", "flips": "flips"}.items():
        saved = [1 - total[g, "ssilk", split] / total[g, "LBS", split] for g in GARMENTS]
        yield f"{share(min(saved))} to {share(max(saved))} % on {name}"
    less = lower("total_excess")
    assert less["ncs*"] == less["snug"]
    yield (
        f"lower than NCS's in {less['ncs']} of {count} cells, "
        f"and lower than that of NCS* and of SNUG in {less['snug']}"
    )
    gravity, inside = (
        {(g, s): means("table1", figure)[g, "ssilk", s] for g, s in CELLS}
        for figure in ("gravity_excess", "collisions")
    )
    near, few = sum(value <= 0.05 for value in gravity.values()), sum(value < 0.005 for value in inside.values())
    yield f"at most 5 % of m g L above the simulator's in {near} of {count} cells"
    yield f"{share(gravity['Cape', 'flips'])} and {share(gravity['FringeSkirt', 'flips'])} %"
    yield f"Under 0.5 % of the vertices are inside the body in {few} of {count} cells"
    less = lower("total", "equal_iterations")
    yield (
        f"lower than NCS's in {less['ncs']} of {count} cells, "
        f"than NCS*'s in {less['ncs*']} and than SNUG's in {less['snug']}"
    )
    (steps,) = {training["iterations"] for training in result("table1")["trainings"] if training["method"] == "ncs"}
    yield f"With {steps:,} iterations"


def dynamics() -> Text:
    error = means("table2", "velocity_error")
    for garment, name in GARMENTS.items():
        yield row(name, *(two_digits(error[garment, m, split]) for split in SPLITS[1:] for m in METHODS))
    nearest = [g for g in GARMENTS if min(METHODS, key=lambda method: error[g, method, "inertia"]) == "ssilk"]
    yield f"nearest to the simulator in {len(nearest)} of {len(GARMENTS)} garments"
    *first, last = (GARMENTS[g] for g in GARMENTS if error[g, "ssilk", "flips"] > error[g, "LBS", "flips"])
    yield f"On flips the {', the '.join(first)} and the {last} are further from it than with LBS"


def ablations() -> Text:
    found = result("ablations")
    yield f"{found['iterations']:,} iterations"
    names = {
        "decoder": "decoder (Figure 8)",
        "scheme": "integration (Figure 11)",
        "blendshapes": "blendshapes (Figure 12)",
        "proxies": "proxy joints",
        "latent_regularization": "latent regularization λ (Table 4)",
        "batch": "batch (Table 5)",
        "window": "window (Table 5)",
        "latent": "latent size (Table 5)",
    }
    for setting, name in names.items():
        for number, line in enumerate(line for line in found["total"] if line["setting"] == setting):
            value = line["value"].replace("_", " ").removesuffix(".0")
            yield row("" if number else name, value, *(digits(mean(line[split])) for split in SPLITS))
    latents = {line["value"]: mean(line["valid"]) for line in found["total"] if line["setting"] == "latent"}
    yield f"but for a latent of {max(latents, key=latents.__getitem__)}, which is too small"
    deviation = spread(cells("table1")["Cape", "ssilk", "valid"]["total"]).partition("± ")[2]
    yield f"standard deviation of {deviation} J over three seeds"


def wardrobe() -> Text:
    columns = {
        **{f"{split}/total": two_digits for split in SPLITS},
        "valid/collisions": share_1,
        "flips/collisions": share_1,
    }
    for garment in GARMENTS.values():
        name = garment.replace("T-", "t").replace(" ", "_")
        run = result("curves")[name]
        _, kept = kept_at(run)
        yield row(garment, kept, duration(run["seconds"][-1]), *fields(evaluated(name), columns))
    yield f"{two_digits(evaluated('hooded_dress')['valid']['clip_totals'][1])} J"


def long_training() -> Text:
    runs, norms, stopped = result("long_training"), result("matrix_norms"), result("norm_training")
    for name, run in runs.items():
        yield training_row(run, name.replace("_seed_", ", seed ").replace("_", " "))
    within = [name for name, run in runs.items() if "cape" not in name and relative_rise(run) <= 0.1]
    assert len(within) == 5 and "fringe_skirt_seed_1" not in within, "the document says so"
    yield f"The skirt of seed 1 rises by {share(relative_rise(runs['fringe_skirt_seed_1']))} % of it"
    capes = [runs[name] for name in ("cape", "cape_seed_1", "cape_seed_2")]
    assert min(capes[0]["total"]) == capes[0]["total"][-1], "still falling"
    best = (f"{min(run['total']):.4f}".replace("-", "−") for run in capes[1:])
    yield "were at {} and {} J, and\n  are at {:.2f} and {:.2f} J".format(
        *best, *(run["total"][-1] for run in capes[1:])
    )
    last = runs["cape"]["iterations"].index(28_800)
    totals = [run["total"][last] for run in capes]
    yield "After 28,800 iterations the totals of the capes are {:.2f}, {:.2f} and {:.2f} J".format(*totals)
    assert all(run["stretch"][last] + run["inertia"][last] > run["total"][last] / 2 for run in capes)
    after = runs["cape"]["iterations"].index(38_400)
    yield f"back to {max(run['total'][after] for run in capes):.4f} J and\n  less by iteration 38,400"
    long, ships = norms["cape_long"], norms["cape"]
    yield f"matrix of P is {max(long['P']):.1f} in the cape of seed 1, of D {max(long['D']):.1f}, and"
    yield f"{max(ships['P']):.1f} and\n  {max(ships['D']):.1f} in the cape that shipped before"
    yield f"kept after {ships['iteration']:,} iterations"
    yield f"Those of S stay: {max(long['S']):.1f} and {max(ships['S']):.1f}"
    for name in ("fringe_skirt", "hooded_dress"):
        assert all(max(norms[f"{name}_long"][part]) > 1.4 * max(norms[name][part]) for part in "PD")
    (count,) = {at["iteration"] for at in stopped.values()}
    inertia = {name: f"{at['inertia']:.3f}" for name, at in stopped.items()}
    none = [inertia[f"none, seed {seed}"] for seed in range(3)]
    yield f"after {count:,} static iterations, when the three above had an inertia of {none[0]}, {none[1]} and"
    yield f"{none[2]} J. With"
    bound = [inertia[name] for name in ("norm 2, seed 0", "norm 2, seed 2", "norm 1.5, seed 0")]
    words = "it is {} and {} J (seeds 0 and 2), with 1.5 times that root {} J (seed 0)"
    yield words.format(*bound)
    yield f"with `weight_decay=1` {inertia['weight_decay=1, seed 2']} J (seed 2)"
    least = [min(min(run["total"]) for name, run in runs.items() if garment in name) for garment in LOOSE[1:]]
    yield "with {:.4f} and {:.4f} J".format(*least)
    shipped_totals = (
        min(result(f"{kind}_training")[name]["total"]) for kind, name in zip(("limits", "tight"), LOOSE[1:])
    )
    assert all(now < then for now, then in zip(least, shipped_totals)), "the document says so"


def training_row(run: dict, *cells: str) -> str:
    """Return the line of a training: where its best was kept, then totals, distances from P and step errors."""
    best, kept = kept_at(run)
    ends = (f"{run['total'][at]:.4f}".replace("-", "−") for at in (best, -1))
    away, missed = ([fixed(1000 * run[key][at]) for at in (best, -1)] for key in ("dynamics", "step energy"))
    return row(*cells, kept, *ends, *away, *missed)


def training_rows(runs: dict, names: dict[str, str]) -> Text:
    """Yield the lines of trainings, some of which have names of their own."""
    assert set(names) < set(runs)
    for name, run in runs.items():
        yield training_row(run, names.get(name, name.replace("_", " ")))


def relative_rise(run: dict) -> float:
    """Return how far the last total of a training lies over its best, relative to that."""
    return run["total"][-1] / min(run["total"]) - 1


def limits_training() -> Text:
    names = {
        "tshirt": "T-shirt",
        "cape_no_bound": "cape, `latent_bound=0`",
        "cape_outliers": "cape, `outlier_energy=1`",
    }
    runs = result("limits_training")
    yield from training_rows(runs, names)
    times = [run["seconds"][-1] / 60 for run in runs.values()]
    yield f"for {min(times):.0f} to {max(times):.0f} minutes of steps"
    counts = [len(run["iterations"]) for run in runs.values()]
    yield f"has {min(counts)} to {max(counts)} validations"
    muon = result("muon_training")
    yield f"(−{-min(muon['cape_seed_1']['total']):.4f} J for another seed"
    yield f"{min(muon['hooded_dress']['total']):.4f} J for the dress"
    yield f"whose best is\n  {min(result('tight_training')['hooded_dress']['total']):.4f} J"
    rises = (share(relative_rise(runs[name])) for name in ("fringe_skirt", "hooded_dress"))
    yield f"skirt and dress rise by {' and '.join(rises)} % of it"
    assert all(run["step energy"][-1] > run["step energy"][kept_at(run)[0]] for n, run in runs.items() if "cape" in n)
    ends = [result("step_errors")[name]["train"] for name in ("cape", "cape_last")]
    mean_step, median, most = ([fixed(at[name], 1, 0.001) for at in ends] for name in ("mean", "median", "p95"))
    yield f"the mean step misses {mean_step[0]} mJ at the best and {mean_step[1]} mJ at the end"
    yield f"the median {' and '.join(median)} mJ"
    yield f"the 95th percentile {' and '.join(most)} mJ"


def long_decay_training() -> Text:
    names = {
        "cape_half_rate": ("cape", "half", "0"),
        "cape_half_rates": ("cape", "half, and half of the other", "0"),
        "cape_decay": ("cape", "full", "1"),
        "cape_half_rate_decay": ("cape", "half", "0.5"),
        "fringe_skirt_half_rate_decay": ("fringe skirt", "half", "0.5"),
        "hooded_dress_half_rate_decay": ("hooded dress", "half", "0.5"),
    }
    runs, norms, before = result("long_decay_training"), result("matrix_norms"), result("long_training")
    assert set(runs) == set(names)
    yield f"of seed {shipped('cape')['provenance']['train']['seed']}, but for half of that rate"
    for name, run in runs.items():
        yield training_row(run, *names[name])
    at = runs["cape_half_rate"]["iterations"].index(28_800)
    (total,) = {runs[name]["total"][at] for name in ("cape_half_rate", "cape_half_rates")}
    yield f"after 28,800 iterations their total is {total:.2f} J"
    static = [runs[name]["inertia"][: at + 1] for name in ("cape_decay", "cape_half_rate_decay")]
    yield f"is {min(map(min, static)):.4f} to {max(map(max, static)):.4f} J throughout"
    best = runs["cape_half_rate_decay"]["total"]
    yield f"with both is −{-min(best):.4f} J, lower than"
    assert min(best) < min(min(run["total"]) for name, run in before.items() if "cape" in name)
    yield f"has risen by\n  {milli_1(best[-1] - min(best))} mJ"
    skirt, dress = (runs[f"{name}_half_rate_decay"] for name in LOOSE[1:])
    yield f"rises by {share(relative_rise(skirt))} % of its best and the dress by {share(relative_rise(dress))} %"
    largest = {part: [f"{max(norms[f'{name}_decay'][part]):.1f}" for name in LOOSE] for part in "PD"}
    yield "of P is {} in the cape with both, {} in the skirt and {} in\n  the dress".format(*largest["P"])
    yield "those of D are {}, {} and {}".format(*largest["D"])
    for name, run, words in (
        ("fringe_skirt", skirt, "of the skirt is {:.4f} J, without decay {:.4f} to {:.4f} J"),
        ("hooded_dress", dress, "of the dress {:.4f} J,\n  without {:.4f} to {:.4f} J"),
    ):
        without = [min(other["total"]) for training, other in before.items() if name in training]
        yield words.format(min(run["total"]), min(without), max(without))
    train, ships = PRESETS["final"].train, shipped("cape")["provenance"]["train"]
    assert train.recombinations > shipped("cape")["provenance"]["train"]["recombinations"], "but for more motion"
    for setting in ("iterations", "static_fraction", "static_learning_rate", "learning_rate", "weight_decay"):
        assert ships[setting] == getattr(train, setting), "final has the settings of the cape that ships"


def bind_pose_training() -> Text:
    runs, before = result("bind_pose_training"), result("final_training")
    names = {name: name.replace("_seed_", ", seed ").replace("_", " ") for name in runs if "seed" in name}
    yield f"and {runs['tshirt']['iterations'][-1]:,} iterations. Three to"
    yield from training_rows(runs, {**names, "tshirt": "T-shirt"})
    cape, skirt = runs["cape_seed_2"], runs["fringe_skirt_seed_2"]
    static = [value for at, value in zip(cape["iterations"], cape["inertia"]) if at < cape["iterations"][-1] // 2]
    yield f"stays within {min(static):.4f} and {max(static):.4f} J\n  in the cape"
    best = min(cape["total"])
    yield f"The best of the cape, −{-best:.4f} J, is the lowest of all. At the end it has"
    others = [run for name in ("long_training", "long_decay_training") for run in result(name).values()]
    assert best < min(min(run["total"]) for run in others)
    yield f"risen by {milli_1(cape['total'][-1] - best)} mJ"
    yield f"is reached by the skirt ({share(relative_rise(skirt))} %) and not by the cape"
    assert relative_rise(skirt) < 0.1 < (cape["total"][-1] - best) / -best
    ends = [[min(trainings[name]["total"]) for trainings in (runs, before)] for name in TIGHT]
    pairs = [f"{now:.4f} J, not {then:.4f} J" for now, then in ends]
    yield "T-shirt is {}, of the long sleeve {}, and of the pants {}".format(*pairs)
    counts = {found[name]["iterations"][-1] for found in (runs, before) for name in TIGHT}
    yield "in {:,} iterations, not {:,}".format(*sorted(counts))
    train = PRESETS["final"].train
    assert train.iterations == cape["iterations"][-1] == skirt["iterations"][-1]


def tumbling_training() -> Text:
    runs, skin = result("tumbling_training"), result("shown_skin_tumbling")
    times = [run["seconds"][-1] / 60 for run in runs.values()]
    yield f"for {min(times):.0f} to {max(times):.0f} minutes of steps"
    for name, run in runs.items():
        yield training_row(run, tumbling_name(name))
    before = result("long_decay_training")["cape_half_rate_decay"], result("bind_pose_training")["cape_seed_2"]
    was_one, was_two = (fixed(min(run["total"]), 4) for run in before)
    one, two = (fixed(min(runs[f"cape_seed_{seed}"]["total"]), 4) for seed in (1, 2))
    yield f"The best of seed 2 is {two} J, and without such motions it was {was_two} J, in"
    yield f"{before[1]['iterations'][-1]:,} iterations; that of seed 1 is {one} J, not {was_one} J"
    last = {name: run["total"][-1] - min(run["total"]) for name, run in runs.items()}
    capes = [milli_1(rise) for name, rise in last.items() if "cape" in name]
    yield "After their best the capes rise by {}, {} and {} mJ".format(*capes)
    assert all(relative_rise(run) < 0.2 for name, run in runs.items() if "cape" not in name)
    most = max(relative_rise(run) for name, run in runs.items() if "cape" not in name)
    yield f"skirts and dresses rise by {share(most)} % at most"
    yield f"that turn over: {default('tumbling'):g}, not the half"
    for name, found in skin.items():
        if name.startswith(TIGHT):
            cells_of = [found[split]["network"] for split in HELD_OUT]
            pairs = (f"{share_3(at['mean'])}, {share_1(at['worst'])}" for at in cells_of)
            yield row(TUMBLING[name], *pairs, *(f"{at['stretch']:.2f}" for at in cells_of[:2]))
    shirts = [skin[name]["test"]["network"] for name in ("tshirt", "tshirt_more_motions")]
    yield "{} to {} % on `test`".format(*(share_3(at["mean"]) for at in shirts))
    yield "worst frame from {} to {} %".format(*(share_1(at["worst"]) for at in shirts))
    tight = {"tshirt_more_motions", "long_sleeve", "pants"}
    for split, goal in (("valid", 0.0005), ("test", 0.0005), ("flips", 0.003)):
        assert all(skin[name][split]["network"]["mean"] <= goal for name in tight), "the document says so"
    capes = [skin[f"cape_{each}"]["test"]["network"]["mean"] for each in ("more_motions", "seed_1")]
    yield "shows {} % on `test`, that of seed 1 shows {} %".format(*map(share_3, capes))
    now, then = result("shown_skin_shipped")["hooded_dress"], result("shown_skin_refined")["hooded_dress_before"]
    flips = (share_3(dress["flips"]["network"]["mean"]) for dress in (now, then))
    yield "on flips it shows {} % of the skin, the one that shipped before {} %".format(*flips)
    worst = (share_1(dress["test"]["network"]["worst"]) for dress in (now, then))
    yield "in its worst frame of `test` {} %, not {} %".format(*worst)
    ratio = now["valid"]["network"]["stretch"] / then["valid"]["network"]["stretch"]
    yield f"is stretched {ratio:.1f} times as much"
    usual, contact = (skin[name] for name in ("tshirt", "tshirt_tournament"))
    assert all(usual[split]["network"]["worst"] < contact[split]["network"]["worst"] for split in HELD_OUT)
    stretch = [[skin[each][split]["network"]["stretch"] for each in ("tshirt_tether", "tshirt_more_motions")]
               for split in ("valid", "test")]  # fmt: skip
    yield "by {} and {} %".format(*(share(firm / usual - 1) for firm, usual in stretch))
    yield from tumbling_flips()


TUMBLING = {
    "tshirt": "T-shirt",
    "tshirt_outlier_energy": "T-shirt, `outlier_energy=1`",
    "tshirt_tournament": "T-shirt, poses with contact",
    "tshirt_more_motions": "T-shirt, more motions",
    "tshirt_all": "T-shirt, all three",
    "tshirt_tether": "T-shirt, more motions, firm tether",
    "long_sleeve": "long sleeve, more motions, poses with contact",
    "pants": "pants, more motions, poses with contact",
}


def tumbling_name(name: str) -> str:
    """Return what the document calls a training."""
    words = {"_seed_": ", seed ", "_more_motions": ", more motions", "_tether": ", more motions, firm tether"}
    for part, text in words.items():
        name = name.replace(part, text)
    return name.replace("_", " ")


def tumbling_flips() -> Text:
    found = {(at["model"], at["split"]): at for at in result("evaluate_solver_tumbling")}
    shots = ("after 5 [mm]", *AFTER[1:])
    yield row("training", "energy [J]", "inertia [J]", "jerk", *shots, "velocity [m/s]", "LBS")
    for name in result("tumbling_training"):
        yield flips_row(tumbling_name(name), found[name, "flips"])
    for garment in ("cape", "fringe_skirt"):
        own = beside_solver(garment, "flips")
        yield flips_row(f"{garment.replace('_', ' ')} that ships", {**own, "inertia": own["terms"]["inertia"]})
    test, ships = found["cape_more_motions", "test"]["solver"], from_solver("cape", "test")
    yield "is {}, {}, {} and {} mm away".format(*(milli(value) for value in test["position_error"]))
    yield f"{test['velocity_error']:.2f} m/s off"
    assert all(now > then for now, then in zip(test["position_error"], ships["position_error"])), "it is nearer"
    capes = [at["solver"] for (name, split), at in found.items() if split == "flips" and name.startswith("cape")]
    assert all(at["velocity_error"] > at["lbs_velocity_error"] for at in capes), "none is nearer than LBS"
    second, ships = found["cape_seed_2", "flips"]["solver"], from_solver("cape", "flips")
    assert all(now > then for now, then in zip(second["position_error"], ships["position_error"])), "it is further"


def flips_row(name: str, at: dict) -> str:
    """Return the line of a model on flips."""
    solver = at["solver"]
    away = [milli(value) for value in solver["position_error"]]
    speeds = (f"{solver[key]:.2f}" for key in ("velocity_error", "lbs_velocity_error"))
    return row(name, fixed(at["total"], 3), fixed(at["inertia"], 3), f"{at['jerk_ratio']:.2f}", *away, *speeds)


def final_training() -> Text:
    names = {f"{name}_seed_1": f"{name.replace('_', ' ')}, seed 1" for name in LOOSE}
    runs = result("final_training")
    yield from training_rows(runs, {**names, "tshirt": "T-shirt"})
    twice = runs["fringe_skirt"]["iterations"][-1]
    yield f"without decay and with {twice // 2:,} iterations, for twice as many"
    yield f"(`--set iterations={twice}`)"
    yield "The dress of seed 1 has less energy"
    before = result("shown_skin_refined")["hooded_dress_before"]
    new, old = result("shown_skin_final"), {**result("shown_skin_limits"), "hooded_dress": before}
    for name, split, figure, words in (
        ("hooded_dress", "valid", "mean", "{:.3f} % of the skin in the mean, against {:.3f} %"),
        ("hooded_dress", "test", "worst", "shows {:.1f} %, against {:.1f} %"),
        ("fringe_skirt", "valid", "worst", "level, in the worst frame with {:.2f} and {:.2f} %"),
        ("fringe_skirt", "test", "worst", "shows {:.1f} %, against {:.1f} %"),
    ):
        yield words.format(*(100 * found[name][split]["network"][figure] for found in (new, old)))
    assert all(shipped(name)["provenance"]["train"]["iterations"] != twice for name in LOOSE), "none of these ships"
    yield "The skirt of seed 1 has less energy"
    loose = [name for name in runs if name.startswith(LOOSE)]
    assert {runs[name]["iterations"][-1] for name in loose} == {twice}, "the document says so"
    rises = {name: relative_rise(run) for name, run in runs.items()}
    skirts, dresses = ([rises[name], rises[f"{name}_seed_1"]] for name in ("fringe_skirt", "hooded_dress"))
    assert max(skirts + dresses) < 0.1, "the document says so"
    yield f"the skirts rise by {share(skirts[0])} and {share(skirts[1])} % of it"
    yield f"the dresses by {share(dresses[0])} and {share(dresses[1])} %"
    earlier = {name[:-2]: at for name, at in result("sizes").items() if name.endswith("_l")}
    for name in ("fringe_skirt", "hooded_dress"):
        assert min(runs[f"{name}_seed_1"]["total"]) < min(earlier[name]["total"])
    cape = runs["cape_seed_1"]["total"]
    yield f"The cape rises by {milli_1(cape[-1] - min(cape))} mJ"
    pants = runs["pants"]
    yield f"{kept_at(pants)[1].split()[0]} iterations, and rises by {share(rises['pants'])} %"
    assert kept_at(pants)[0] == 0 and max(rises["tshirt"], rises["long_sleeve"]) < 0.001, "the document says so"


def network_sizes() -> Text:
    found = result("sizes")
    for name, at in found.items():
        garment, _, size = name.rpartition("_")
        counts = f"{at['proxies']} / {at['shapes']} / {at['latent']}"
        times = (fixed(at[key]) for key in ("network", "frame"))
        totals = (fixed(value, 4) for value in at["total"])
        steps = milli(at["step energy"]), milli_1(at["step distance"])
        words = garment.replace("_", " ") if size == "s" else ""
        yield row(words, size.upper(), counts, f"{at['bytes'] / 1e6:.1f}", *times, *totals, *steps)
    yield f"trained alike in {found['cape_s']['iterations'][1]:,} iterations"
    yield f"was cut at {found['hooded_dress_x']['iterations'][1]:,}"
    yield f"hidden layers of {found['cape_s']['widths'][0]}, is a network for 50 µs and less"
    least = {name: at["total"][0] for name, at in found.items()}
    assert max(at["network"] for name, at in found.items() if name.endswith("_s")) < 50
    yield f"it has {milli(least['cape_s'] - least['cape_l'])} mJ more than L"
    assert round(least["hooded_dress_s"] / least["hooded_dress_l"]) == 2, "the document says so"
    yield f"whose {ModelConfig.shapes} blendshapes are the default, is within 5 mJ of L"
    assert all(abs(least[f"{name}_m"] - least[f"{name}_l"]) < 0.005 for name in ("cape", "fringe_skirt"))
    yield f"{share(least['hooded_dress_m'] / least['hooded_dress_l'] - 1)} % above it in the dress"
    ratios = [mean(found[f"{name}_x"][key] / found[f"{name}_l"][key] for name in LOOSE) for key in ("frame", "bytes")]
    yield "for {:.1f} times the time of a frame of L and {:.1f} times its size".format(*ratios)
    assert all(least[f"{name}_x"] == min(least[f"{name}_{size}"] for size in "smlx") for name in LOOSE)
    steps = {name: at["step distance"] for name, at in found.items()}
    yield f"cape are {milli_1(steps['cape_l'] - steps['cape_x'])} mm nearer to the minimum"
    assert all(steps[f"{name}_x"] >= steps[f"{name}_l"] for name in ("fringe_skirt", "hooded_dress"))


AS_HERO = "4 iterations"  # what the level was when the table was measured, without feedback


def levels_on_gpu() -> Text:
    for at in document("trade_cuda")["points"]:
        if at["variant"] in ("as trained", "1 iterations", "2 iterations", "hero"):
            level = AS_HERO if at["variant"] == "hero" else at["variant"]
            skin, solver = at["shown_skin"], fixed(at["solving"]) if at["solving"] else ""
            figures = fixed(at["total"], 3), share_3(skin["mean"]), share_2(skin["worst"])
            yield row(at["model"].replace("_", " "), level, solver, *figures, two_digits(1000 * at["position"]))


def levels_and_simulator() -> Text:
    found = document("trade_simulator")
    (count,) = set(found["asked"]["frames"].values())
    yield f"the first {count} frames of each"
    ratios = []
    for at in found["points"]:
        skin, variant = at["shown_skin"], "light" if at["model"].endswith("_light") else at["variant"]
        yield row(
            GARMENTS[at["garment"]],
            f"`{variant}`" if variant in {"light", *QUALITIES} else variant,
            two_digits(at["solving"]) if at["solving"] else "",
            fixed(at["total"], 3),
            share_3(skin["mean"]),
            share_2(skin["worst"]),
            "" if variant == "light" else two_digits(1000 * at["position"]),
            fixed(at["shot_bytes"], 2, 1e6),
        )
    energies = {}
    for name in LOOSE:
        of = {at["variant"]: at for at in found["points"] if at["model"] == name}
        energies[name] = {variant: at["total"] for variant, at in of.items()}
        ratios.append(of["simulator"]["solving"] / of["hero"]["solving"])
        far = (milli(of[variant]["position"]) for variant in ("simulator", "hero"))
        yield "by {} and {} mm".format(*far)
        assert sha256(shipped_path(name)) in found["asked"]["models"].values(), "the document says that it ships"
        assert of["hero"]["refine"] == QUALITIES["hero"].refine
    yield f"{min(ratios):.1f} to {max(ratios):.1f} times as long"
    light = {at["garment"]: at["total"] for at in found["points"] if at["model"].endswith("_light")}
    assert light["Cape"] > energies["cape"]["as trained"], "the document says so"
    assert round(light["FringeSkirt"] / energies["fringe_skirt"]["as trained"]) == 10, "the document says so"
    cape, skirt, dress = (energies[name] for name in LOOSE)
    assert dress["hero"] < min(dress["as trained"], dress["simulator"]), "the document says so"
    times = result("runtime_networks")["models"]
    whole, crowd = (times[f"cape, {level}"]["numpy"][FULL][0] for level in ("whole", "crowd"))
    yield f"takes {fixed(whole)} µs on one processor thread, and {fixed(crowd)} µs in `crowd`"
    yield f"`crowd` multiplies the cape's energy by {cape['crowd'] / cape['as trained']:.1f}"
    assert cape["hero"] < cape["simulator"] < cape["as trained"], "the document says so"
    assert skirt["simulator"] < skirt["as trained"] < skirt["hero"], "the document says so"


def shipped_rest() -> dict:
    """Return the figures of the cape that ships, at stops and in loops of `test`."""
    (found,) = (line["figures"] for line in document("evaluate_cape_shipped")["figures"] if line["method"] == "ssilk")
    return found


def rest() -> Text:
    columns = {
        "settling/stops": fixed,
        "settling/settled_share": share,
        "settling/settling_time": partial(fixed, places=2),
        "settling/static_distance": milli_1,
        "settling/max_static_distance": milli_1,
        "loop_drift/second_loop_total": four_digits,
        "loop_drift/last_loop_total": four_digits,
        "loop_drift/loop_distance": milli_1,
    }
    for split, found in evaluated("cape").items():
        yield row(f"`{split}`", *fields(found, columns))
    options = document("evaluate_cape")["options"]
    yield f"held for {options['hold']:g} s"
    yield f"loops for {options['loop']:,} frames"
    yield f"are {fixed(shipped_rest()['loop_drift']['loop_distance'], 1, 1e-6)} µm apart"
    clips, frames = result("long_rollout").values(), 10_000
    assert all(
        0 <= len(clip["J"]["stretch"]) * clip["frames of a loop"] - frames < clip["frames of a loop"]
        for clip in clips
    )
    totals = [[sum(terms) for terms in zip(*clip["J"].values(), strict=True)] for clip in clips]
    first, second = ([abs(loops[-1] / loops[number] - 1) for loops in totals] for number in (0, 1))
    yield f"Over {frames:,} frames the totals of three clips change by at most {share_2(max(second))} %"
    yield f"differs from the last by {share(min(first))} to {share(max(first))} %"
    yield f"a loop of {frames:,} frames"
    yield f"loops for {frames:,} frames"


def playing() -> Text:
    models, cape = result("runtime")["models"], shipped("cape")
    yield (
        f"({cape['vertices']:,} vertices, {len(cape['proxy_names'])} proxy joints, {len(cape['joint_names'])} joints)"
    )
    ways = ("numpy", "PyTorch, in chunks", "NCS, in chunks", "PyTorch, frame by frame", "NCS, frame by frame")
    parts = {
        "network and kinematics": "+ kinematics",
        "with blendshapes and skinning": "+ blendshapes and skinning",
        "with descriptors of the poses": FULL,
    }
    for text, part in parts.items():
        yield row(text, *(fixed(models["cape"][way][part][0]) for way in ways))
    networks = result("runtime")["networks"]
    small, large = (networks[size]["numpy"]["+ kinematics"][0] for size in ("64: 256, 256", "128: 256, 512, 512"))
    yield f"{small:.0f} µs instead of {large:.0f} µs"
    yield "64 latents and two layers of 256"
    products = models["cape, products alone"]["numpy"].values()
    yield f"matrix products alone take {fixed(sum(time for time, _ in products))} µs"
    cloth, _ = models["cape, Blender"]["Blender"]["cloth modifier"]
    yield f"{fixed(cloth, unit=1000)} ms a frame for the same shot"
    machine = re.search(r"(\d+) cores, load ([\d.]+)", document("runtime")["hardware"])
    assert machine
    yield f"on a machine with a load of {machine[2]} on {machine[1]} cores"
    times, deviations = zip(
        *(result("table3_cuda")[f"cape_{name}"]["full"] for name in ("ssilk", "ncs", "snug")), strict=True
    )
    yield "SSILK {} ms, NCS {} ms, SNUG {} ms".format(*map(milli_1, times))
    yield f"standard deviations of {milli_1(min(deviations))} to {milli_1(max(deviations))} ms"
    columns = {
        f"{what}/{figure}": fixed
        for figure in ("median [us]", "frames per second")
        for what in ("network alone", "with vertices")
    }
    for count in (1, 8, 64, 512, 2048):
        rates = {what: result("batch")[f"{count} {what}"] for what in ("network alone", "with vertices")}
        yield row(f"{count:,}", *fields(rates, columns))


def sizes() -> Text:
    frame = 3 * 4 * shipped("cape")["vertices"]  # bytes in single precision
    yield f"A shot of {result('compact')['cache'] // frame} frames takes {shot_row()['bytes'] / 1e6:.2f} MB"
    yield f"{cache_share()} of the vertices in single precision"
    yield f"{micro(shot_row()['largest'], 1)} µm"


def refinement() -> Text:
    ((name, clip),) = result("refine").items()
    assert name == "cape 02_04", "the document says so"
    frames = re.search(r"--frames (\d+)", document("refine")["command"])
    assert frames
    yield f"the first {frames[1]} frames of a jump"
    columns = {"seconds": two_digits, "energy": partial(fixed, places=3), "shows": share_2, "limbs": share,
               "moved": milli, "apart": milli, "jitter": milli_1}  # fmt: skip
    previous = {"network": "network", "refined": "refined"}
    for key, found in clip.items():
        count, _, past = key.partition(" ")
        yield row(count, previous.get(past, ""), *fields(found, columns))
    network, few, alone, hero, simulator = (
        clip[key] for key in ("0", "4 refined", "8 network", "8 refined", "simulator")
    )
    yield f"from {milli(network['apart'])} to {milli(hero['apart'])} mm"
    assert QUALITIES["hero"].refine == 8, "the document says so"
    assert all(abs(clip[key]["apart"] / network["apart"] - 1) < 0.05 for key in ("4 network", "8 network"))
    assert hero["energy"] < min(at["energy"] for at in clip.values() if at is not hero), "the document says so"
    assert max(alone["jitter"], hero["jitter"]) < network["jitter"] < simulator["jitter"] < few["jitter"]
    yield f"{hero['shapes']} blendshapes of their own, and {alone['shapes']} without feedback"
    yield f"take {two_digits(hero['seconds'])} s, those of the simulator {two_digits(simulator['seconds'])} s"


def inside_the_body() -> Text:
    found = means("table2", "collisions")
    for garment in TIGHT:
        pairs = [(found[garment, "simulator", split], found[garment, "ssilk", split]) for split in SPLITS[1:]]
        yield row(
            GARMENTS[garment],
            *(share_2(value) for pair in pairs for value in pair),
            *(share(simulator / ours) for simulator, ours in pairs),
            milli_1(result("collisions")[garment]["model"]["depth"][0]),
        )
    fabric = FABRICS["paper"]
    yield f"{fabric.collision:g} N/m for each vertex"
    yield f"{milli(fabric.margin)} mm margin"


def stress() -> Text:
    found = document("stress_cape")["outcomes"]
    verdicts = [outcome["verdict"] for outcome in found]
    measured = {(outcome["group"] == "simulator", outcome["name"]): outcome["measured"] for outcome in found}
    played = {name: what for (simulated, name), what in measured.items() if not simulated}
    counts = [verdicts.count(verdict) for verdict in ("works", "falls back", "refuses")]
    yield extremes()
    yield "{} work, {} fall back and {} are refused".format(*counts)
    largest = max(what["extent"]["latent"] for what in measured.values() if what["extent"])
    yield f"latent value exceeds {two_digits(largest)}, under the bound of {PRESETS['final'].model.latent_bound:g}"
    growth = {name: what["extent"]["growth"] for name, what in played.items() if what["extent"]}
    loop, teleport = growth["100,000 frames"], growth["a teleport of 30 m each second"]
    yield f"100,000 frames of a looped cartwheel the last loop has {loop:.2f} times the energy of the second"
    yield f"A teleport of 30 m each second multiplies the mean energy by {teleport:.1f}"
    assert abs(growth["a ride at 50 m/s"] - growth["float32"]) < 1e-3, "a ride changes nothing"
    yield "A ride at 50 m/s changes nothing"
    yield f"float32 by {milli(played['float32']['error'], 2)} mm"
    yield f"float16 by {played['float16']['error']:.2f} m and bfloat16 by {played['bfloat16']['error']:.2f} m"
    simulated = {
        "gravity: tenfold": (False, "tenfold"),
        "gravity: none": (False, "none"),
        "stretch stiffness 0.001 N/m": (True, "0.001 N/m"),
        "stretch stiffness 1 N/m": (True, "1 N/m"),
        "stretch stiffness 1,000 N/m": (True, "1000 N/m"),
        "stretch stiffness 1,000,000 N/m": (True, "1e+06 N/m"),
        "slivers 0.0001 as high as long": (True, "slivers 0.0001 as high as long"),
    }
    for text, key in simulated.items():
        extent = measured[key]["extent"]
        within = f"{extent['frames'] - extent['recovered']} of {extent['frames']}"
        yield row(text, within, two_digits(measured[key]["error"]))
    works = {outcome["name"] for outcome in found if outcome["verdict"] == "works"}
    assert {"200,000", "100 m", "0.001 m"} <= works
    yield "200,000 vertices"
    yield "Characters of 1 mm and of 100 m"


def training_speed() -> Text:
    cases, parts = (result("training")[name] for name in ("cases", "parts of the base case"))
    base = cases["base"]
    size = base["size"]
    yield (
        "{vertices:,} garment vertices, {body} body vertices, {shapes} blendshapes, {proxies} proxy joints, "
        "{batch} windows of {window}, {static_batch} single poses"
    ).format_map(size)
    poses = size["batch"] * (size["window"] - 2) + size["static_batch"]
    steps = {
        "step on windows": ("base", "windows"),
        f"step of pretraining, {poses:,} poses": ("base", "warm"),
        "step on {batch} windows of {window}".format_map(large_step_size()): (LARGE_STEP, "windows"),
    }
    for text, (case, phase) in steps.items():
        columns = {f"{kind}/steps [ms]/{phase}": digits for kind in ("reference", "kernels")}
        yield row(text, *fields(cases[case], columns))
    shown = {
        "closest body point": "nearest body point",
        "stretch and bending, with gradient": "stretch and bending, with backward",
        "skinning, with gradient": "skinning, with backward",
        f"stepper, {size['window'] - 2} frames in a row": "stepper S frame by frame",
    }
    for text, part in shown.items():
        yield row(text, *(two_digits(parts[part][f"{kind} [ms]"]) for kind in ("reference", "kernels")))
    yield f"{base['kernels']['peak [bytes]'] / 1e9:.1f} GB of GPU memory"
    sweeps = {
        "garment vertices": ("vertices", (1250, 2500, 5000, 10000)),
        "body vertices": ("body", (587, 1229, 4000)),
        "window": ("window", (16, 32, 64)),
        "batch": ("batch", (16, 32, 64)),
    }
    for text, (name, values) in sweeps.items():
        swept = [base if value == size[name] else cases[f"{name} {value}"] for value in values]
        yield row(text, series(values), series(fixed(case["kernels"]["steps [ms]"]["windows"], 1) for case in swept))
    for window, name in SCALING.items():
        batches = {int(case["batch"]): None for case in result(name)["cases"] if case["processes"] == 2}
        yield row(window, series(batches), series(f"{two_gpus(window, batch):.2f}" for batch in batches))
    half = step_time(32, 1, "64/2") / step_time(32, 1, "64")
    yield f"Half of 64 windows takes {share(half)} % of the time"


def scenes() -> Text:
    times = [milli(result("scenes")[name]["train"]) for name in ("all pinned", "all tight", "loose")]
    yield "{} ms where everything is pinned, {} ms where everything is tight".format(*times)
    yield f"{times[2]} ms where all of it is loose"


PARTS = (
    opening, conditions, shown, limbs, worst_frames, clearance, from_own_start, missed_steps,
    moving_states,
    static_states, table1,
    findings, dynamics,
    ablations,
    wardrobe, long_training, long_decay_training, bind_pose_training, tumbling_training,
    limits_training, final_training, rest, playing, sizes, levels_and_simulator, levels_on_gpu,
    network_sizes, refinement,
    inside_the_body, stress,
    training_speed, scenes,
)  # fmt: skip
"""The parts of the document, in its order."""


def results() -> Text:
    for part in PARTS:
        yield from part()
