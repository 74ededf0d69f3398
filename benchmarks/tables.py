# SPDX-License-Identifier: Apache-2.0
"""Regenerate the paper's tables and figures on our data, each by one command, from trained models.

    python benchmarks/tables.py table1 MODELS --stage character.usdc --motions FOLDER --index FOLDER/index.json \\
        --reference SHOTS --device cuda

MODELS are files, or folders of them: those of 'ssilk train' and baselines, whose files say what they are. Models of
one garment and method count as seeds, shown as mean and standard deviation. SHOTS is what 'ssilk simulate'
made of the clips, one folder for each garment.

    record    figures of models into a file (--output), from which the tables are made where there are no models
    evaluate  all figures of 'ssilk evaluate'
    table1    every garment, split and method: total, collisions, excess over the simulator
    table2    the same of `inertia` and `flips`, beside the simulator
    table3    time of a single frame of one clip, in PyTorch
    ablations one setting changed at a time: decoder (Figure 8), integration scheme (Figure 11), blendshapes and
              proxies (Figure 12), latent regularisation (Table 4), batch, window and latent size (Table 5)

Records in place of models (`*.json`, or folders of them) need no stage and no motions. table1 takes totals from those
of whole clips and the errors to the simulator from those of sequences. `long_rollout.py` measures Figure 10 and
`curves.py` the curves of Figure 11. `paper.py` trains and measures all that the tables need.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from baselines.files import load_network
from helpers import paper_schemes
from helpers.records import with_reference, write_record
from helpers.reports import table, write_results
from helpers.seeds import Cell, cells, evaluated, measured
from helpers.single_frames import frame_times
from helpers.subjects import dressed_in
from helpers.sweeps import ablations
from ssilk_usd.reading.motion import read_motion

from ssilk_core.errors import SsilkError, fail
from ssilk_core.network.checkpoint import ModelFile
from ssilk_core.quality.evaluation.methods import build_take_set
from ssilk_core.quality.evaluation.run import SIMULATOR
from ssilk_core.quality.evaluation.splits import SPLITS
from ssilk_core.quality.evaluation.takes import takes_of
from ssilk_core.scene.assets import Motion

Columns = Mapping[str, tuple[tuple[str, ...], str]]
"""The path to a figure, and the form that it is shown in, by the heading."""

COLUMNS: Columns = {
    "L_tot [J]": (("total",), ".4g"),
    "vertices inside the body": (("collisions",), ".2%"),
    "L_tot excess [J]": (("reference", "total_excess"), ".4g"),
    "gravity excess [m g L]": (("reference", "gravity_excess"), "+.1%"),
}
WHOLE_CLIPS: Columns = {
    **COLUMNS,
    "triangles that intersect others": (("intersections", "mean"), ".2%"),
    "in the worst frame": (("intersections", "worst"), ".1%"),
}
DYNAMICS: Columns = {
    **COLUMNS,
    "RMS velocity error [m/s]": (("reference", "velocity_error"), ".3g"),
    "RMS acceleration error [m/s2]": (("reference", "acceleration_error"), ".3g"),
}


def methods_table(found: Mapping[tuple[str, str, str], Cell], shown: Columns = COLUMNS) -> str:
    """Return a line for each garment and method, with columns for each split that was measured."""
    splits = [split for split in SPLITS if any(split == own for _, _, own in found)]
    names = [name for name, (path, _) in shown.items() if any(cell.values(path) for cell in found.values())]
    columns = [(split, name) for split in splits for name in names]
    rows = []
    for key in dict.fromkeys((garment, method) for garment, method, _ in found):
        lines = {split: found.get((*key, split), Cell([])) for split in splits}
        rows.append([*key, *(lines[split].shown(*shown[name]) for split, name in columns)])
    return table(["garment", "method", *(f"{split}: {name}" for split, name in columns)], rows)


def figures_of(found: Mapping[tuple[str, str, str], Cell], shown: Columns = COLUMNS) -> list[dict[str, Any]]:
    """Return the figures of each cell: the values of all seeds under the names of a path, less "reference"."""
    names = ("garment", "method", "split")
    paths = {"_".join(name for name in path if name != "reference"): path for path, _ in shown.values()}
    values = {key: {name: cell.values(path) for name, path in paths.items()} for key, cell in found.items()}
    return [
        dict(zip(names, key)) | {name: seeds for name, seeds in of.items() if seeds} for key, of in values.items()
    ]


def verdicts(found: Mapping[tuple[str, str, str], Cell]) -> list[str]:
    """Return in how many cells each goal is met."""
    ours = {(garment, split): cell for (garment, method, split), cell in found.items() if method == "ssilk"}
    lines = []
    for baseline in ("ncs", "ncs*", "snug"):
        pairs = [(cell, found[g, baseline, s]) for (g, s), cell in ours.items() if (g, baseline, s) in found]
        lower = sum(mean(a.values(["total"])) < mean(b.values(["total"])) for a, b in pairs)
        lines += [f"ssilk's total is lower than {baseline}'s in {lower} of {len(pairs)} cells"] if pairs else []
    lines += _shares("the L_tot excess on flips is at most half of ncs's", [
        mean(own) <= 0.5 * mean(other.values(["reference", "total_excess"]))
        for (garment, split), cell in ours.items()
        if split == "flips"
        and (other := found.get((garment, "ncs", split)))
        and (own := cell.values(["reference", "total_excess"]))
    ])  # fmt: skip
    excesses = [mean(values) for cell in ours.values() if (values := cell.values(["reference", "gravity_excess"]))]
    lines += _shares("gravity excess over the simulator of at most 5 % of m g L", [v <= 0.05 for v in excesses])
    lines += _shares("collisions under 0.5 %", [mean(cell.values(["collisions"])) < 0.005 for cell in ours.values()])
    return lines


def _shares(text: str, met: Sequence[bool]) -> list[str]:
    return [f"ssilk: {text} in {sum(met)} of {len(met)} cells"] if met else []


def table1(options: argparse.Namespace) -> tuple[str, Any]:
    rows, models = measured(options)
    found = cells(with_reference(rows))
    notes = "".join(f"\n- {line}" for line in verdicts(found))
    trainings = [
        {"garment": settings["garment"], "method": method, **settings["trained"]}
        for name, settings in models.items()
        if (
            method := next(
                (row["method"].partition(" (")[0] for row in rows if Path(row["model"] or "").stem == name), None
            )
        )
    ]
    figures = {"figures": figures_of(found, WHOLE_CLIPS), "trainings": trainings}
    return methods_table(found, WHOLE_CLIPS) + notes + "\n", figures


def table2(options: argparse.Namespace) -> tuple[str, Any]:
    simulated = [row for row in measured(options)[0] if row["figures"]["reference"] or row["method"] == SIMULATOR]
    rows = [row for row in simulated if row["split"] != "valid"]
    if not rows:
        fail("table2", "no simulator among the figures", "its shots are needed", "give --reference, or records of it")
    found = cells(rows)
    return methods_table(found, DYNAMICS), {
        "frames of a sequence": rows[0]["sequence"],
        "figures": figures_of(found, DYNAMICS),
    }


def everything(options: argparse.Namespace) -> tuple[str, Any]:
    rows, text = evaluated(options, probes=True)
    return text, rows


def table3(options: argparse.Namespace) -> tuple[str, Any]:
    rows, found = [], {}
    for path in options.models:
        file, model = load_network(path)
        dressed = dressed_in(file, options.stage, options.device)
        skeleton = dressed.scene.character.skeleton
        takes = takes_of(options.clip, clip_of(options, file), skeleton, dressed.fps)
        times = frame_times(model.to(dressed.device), build_take_set(takes[:1], dressed, file.joints), options.frames)
        found[path.stem] = vars(times)
        spans = [f"{1000 * value:.2f} ± {1000 * spread:.2f}" for value, spread in (times.full, times.model)]
        rows.append([path.stem, *spans, f"{1000 * (times.full[0] - times.model[0]):.2f}"])
    return table(("model", "full pipeline [ms]", "model only [ms]", "blendshapes + skinning [ms]"), rows), found


def clip_of(options: argparse.Namespace, file: ModelFile) -> Motion:
    """Read the clip of table3."""
    return read_motion(options.motions / f"{options.clip}.usdc", file.scene.character.skeleton)


def record(options: argparse.Namespace) -> None:
    if not options.output:
        fail("record", "no --output", "a file to write is needed")
    write_record(options, evaluated(options)[0])


MADE: dict[str, Callable[[argparse.Namespace], tuple[str, Any]]] = {
    "evaluate": everything, "table1": table1, "table2": table2, "table3": table3, "ablations": ablations,
}  # fmt: skip


def parsed() -> argparse.Namespace:
    """Parse the command line, and find the models in folders."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=["record", *sorted(MADE)], help="what to make")
    parser.add_argument(
        "models", type=Path, nargs="+", metavar="MODELS", help="models or records, or folders of them"
    )
    parser.add_argument("--stage", type=Path, help="USD file with the character")
    parser.add_argument("--motions", type=Path, metavar="FOLDER", help="folder of motion files")
    parser.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="only these clips")
    parser.add_argument("--index", type=Path, help="JSON list of clips with their splits and tags")
    parser.add_argument("--reference", type=Path, metavar="SHOTS", help="folder of the simulator's shots")
    parser.add_argument("--exact", action="store_true", help="tight cloth collides as in the simulator")
    parser.add_argument("--loop", type=int, default=2000, help="of evaluate: frames to loop (default 2000)")
    parser.add_argument("--minimum", action="store_true", help="of evaluate: minimise the energy of held poses")
    parser.add_argument("--simulate-stops", action="store_true", help="of evaluate: simulate the stops too")
    parser.add_argument("--sequence", type=int, metavar="FRAMES", help="start clips anew after so many (paper: 512)")
    parser.add_argument("--clip", default="49_08a", help="clip of table3 (default 49_08a)")
    parser.add_argument("--frames", type=int, default=1000, help="that table3 times (default 1000)")
    parser.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    parser.add_argument("--name", help="of the result files (default: the table's)")
    parser.add_argument("-o", "--output", type=Path, metavar="JSON", help="of record: the file to write")
    options = parser.parse_args()
    options.name = options.name or options.table
    found = [sorted(path.iterdir()) if path.is_dir() else [path] for path in options.models]
    files = [path for paths in found for path in paths]
    options.records = [path for path in files if path.suffix == ".json" and not path.name.endswith(".curve.json")]
    options.models = [
        path for path in files if path.suffix == ".safetensors" and not path.name.endswith(".resume.safetensors")
    ]
    torch.set_num_threads(options.threads)
    return options


def main() -> None:
    options = parsed()
    paper_schemes.register()
    try:
        if not (options.models or options.records):
            fail("MODELS", "no model and no record", "'ssilk train' writes models")
        if options.table == "record":
            record(options)
        else:
            write_results(options, *MADE[options.table](options))
    except SsilkError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
