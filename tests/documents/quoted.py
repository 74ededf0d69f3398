# SPDX-License-Identifier: Apache-2.0
"""What documents say of measurements: every line or phrase with a figure, made from the file that it comes from.

A function for each document yields its text, piece by piece; `test_figures.py` finds each piece in the document, and
no figure outside of them. After a new measurement the failing test shows the line as it ought to be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ssilk_usd import memory, trial

from ssilk_core.delivery.farm.openjd import CHUNK, CHUNK_SECONDS
from ssilk_core.network import checkpoint
from ssilk_core.physics.collision.distance import MAX_DEPTH, MAX_QUERY_DISTANCE, TIGHT_REACH
from ssilk_core.physics.refine import clearing
from ssilk_core.physics.skin import hidden_faces
from ssilk_core.scene.decomposition import FitTolerance
from ssilk_core.scene.fabrics import FABRICS, Fabric
from ssilk_core.scene.mesh.stitches import TOUCH
from ssilk_core.training.settings import PRESETS
from tools.settings_page import settings

from .measured import default, digits, duration, fixed, micro, milli, percent, result, row, series
from .quoted_results import results
from .shared import (
    Text,
    cache_share,
    compact_row,
    large_step,
    large_step_size,
    preset_minutes,
    shot_row,
    two_gpus,
)

# README.md


def readme() -> Text:
    preview, final = (preset_minutes(PRESETS[name]) for name in ("preview", "final"))
    yield f"about {preview:.0f} minutes on a shared H200 and `--preset final` about {final:.0f} minutes"
    yield f"{two_gpus(32, 1024):.1f} times as fast with 1,024 windows of 32 poses in a batch"
    yield f"{two_gpus(32, 64):.2f} times as fast with 64 windows"


# docs/training.md

PAPER = {
    "latent_bound": "none",
    "max_latent_step": "none",
    "velocity_allowance": "none",
    "window": 32,
    "batch": 32,
    "state_reuse": 0,
    "rotated_fraction": 1,
    "recombinations": 0,
    "perturbations": 0,
    "tumbling": 0,
    "outlier_energy": 0,
    "newton_weight": 0,
    "clearance": 0,
    "noise": 0.1,
    "noise_correlation": 0,
    "noise_probability": "not stated",
    "static_fraction": 0,
    "static_batch": 0,
    "static_learning_rate": "not stated",
    "learning_rate": "not stated",
    "integrator_learning_rate_scale": "not stated",
    "shape_learning_rate_scale": "not stated",
    "shape_smoothing": 0,
    "ema_decay": "none",
    "latent_regularization": 0,
}
"""What the paper has for our settings (Sections 3.5 to 3.7, Tables 4 and 5)."""


def training() -> Text:
    yield f"Further than {milli(MAX_QUERY_DISTANCE)} mm\nfrom every vertex it touches nothing"
    yield f"at most {milli(MAX_DEPTH)} mm deep"
    yield f"further than {milli(TIGHT_REACH)} mm from it they touch nothing"
    sizes = {
        "draft": "a first look, on a CPU",
        "preview": "a look on a GPU",
        "light": "many characters",
        "final": "shots",
    }
    for name, purpose in sizes.items():
        preset = PRESETS[name]
        model, train = preset.model, preset.train
        yield row(
            f"`{name}`", model.latent, model.shapes, series(model.widths), f"{train.iterations:,}",
            f"{train.batch} of {train.window}", purpose,
        )  # fmt: skip
    for setting, paper in PAPER.items():
        unit = " [m]" if setting == "clearance" else ""
        yield f"| `{setting}`{unit} | {default(setting):g} | {paper} |"
    cloth, papers = Fabric("default"), FABRICS["paper"]
    yield f"| `drag` (material) [kg/(m² s)] | {cloth.drag:g} |"
    yield f"| `contact_model` (material) | {cloth.contact_model} | {papers.contact_model} |"
    yield f"| `contact` (material) [N/m³] | {cloth.contact:g} | none |"
    yield f"| `loose_contact` (material) [N/m³] | {cloth.loose_contact:g} | none |"
    yield f"| `tether` (material) [N/m³] | {cloth.tether:g} | {papers.tether:g} |"
    yield f"| `stitch` (material) [N/m³] | {cloth.stitch:g} | {papers.stitch:g} |"
    yield f"A vertex within {1000 * TOUCH:g} mm of a face of another island"
    yield f"| `margin` (material) [mm] | {1000 * cloth.margin:g} | {1000 * papers.margin:g} |"
    yield f"| `thickness` (material) [mm] | {1000 * cloth.thickness:g} | none |"
    yield f"{default('fps'):g} times a second"
    yield from shape_smoothing()
    yield from optimiser()
    yield f"`final` takes {PRESETS['final'].train.ema_decay:g}"
    yield large_step()
    yield f"With `weight_decay={final_decay():g}` and half the static rate"
    decayed = result("long_decay_training")
    last = min(decayed[name]["iterations"][-1] for name in ("cape_decay", "cape_half_rate_decay"))
    yield f"they did not in {last:,} iterations and more"
    preview, final = (preset_minutes(PRESETS[name]) for name in ("preview", "final"))
    yield f"`preview` takes {preview:.0f} minutes and `final` {final:.0f}"
    yield "(`recombinations={0.recombinations}`, `perturbations={0.perturbations}`)".format(PRESETS["final"].train)
    tight = result("bind_pose_training")["tshirt"]
    yield f"(`--set iterations={tight['iterations'][-1]}`), {duration(tight['seconds'][-1])} for the T-shirt"
    yield from side_by_side()


def final_decay() -> float:
    return PRESETS["final"].train.weight_decay


def side_by_side() -> Text:
    """Yield the time of an iteration of any of several trainings on one GPU, under MPS."""
    run, count = result("final_training")["fringe_skirt"], 3
    time = 1000 * run["seconds"][-1] / run["iterations"][-1] / count
    yield f"took {time:.1f} ms for an iteration of one\nof them"


def optimiser() -> Text:
    yield f"| `optimiser` | {default('optimiser')} | not stated |"
    yield f"| `weight_decay` | {default('weight_decay'):g} | not stated | `final` takes {final_decay():g}, so that"
    yield f"with {large_step_size()['batch']} windows in a batch"
    allowed = default("velocity_allowance"), checkpoint.OLDER_LIMITS["velocity_allowance"]
    yield "{:g} is `velocity_allowance`; older models have {:g}".format(*allowed)
    runs = result("optimiser_training")
    muon, adam = result("muon_training"), result("tight_training")
    for garment in ("cape", "fringe_skirt", "hooded_dress"):
        least = (f"{min(runs[f'{garment}_{name}']['total']):.3f}" for name in ("muon", "adam"))
        yield row(garment.replace("_", " "), *least, *(least_at(each[garment]) for each in (muon, adam)))
    others = {name: muon[f"{name}_seed_1"] for name in ("cape", "hooded_dress")}
    least = (fixed(min(other["total"]), 4) for other in others.values())
    yield "{} J for the cape and {} J for the dress".format(*least)
    longer = (percent(other["seconds"][-1] / muon[name]["seconds"][-1] - 1) for name, other in others.items())
    yield "with {} % and {} % more time".format(*longer)
    cape, skirt, dress = (muon[name]["total"][-1] for name in ("cape", "fringe_skirt", "hooded_dress"))
    yield f"to {cape:.4f} J for the cape, {skirt:.4f} J for the fringe skirt and {dress:.4f} J for the dress"


def least_at(run: dict[str, Any]) -> str:
    """Return the lowest total of a training [J] and its iteration, of how many."""
    at = run["total"].index(min(run["total"]))
    return f"{run['total'][at]:.4f} at {run['iterations'][at]:,} of {run['iterations'][-1]:,}"


def shape_smoothing() -> Text:
    runs = [result("shape_smoothing")[name] for name in ("smoothed", "unsmoothed")]
    best = [run["total"].index(min(run["total"])) for run in runs]
    yield f"sharing an H200 for {duration(runs[0]['seconds'][-1])}"
    smooth, rough = (run["total"][at] for run, at in zip(runs, best))
    yield f"reach {smooth:.2f} J with it and {rough:.2f} J without"
    smooth, rough = (1000 * run["bending"][at] for run, at in zip(runs, best))
    yield f"is {smooth:.1f} and {rough:.1f} mJ"


# docs/farm.md


def farm() -> Text:
    start = result("farm")["start"]
    python, model = (
        start[f"seconds to {what}"] for what in ("start Python and its modules", "load the model and its character")
    )
    chunk = CHUNK_SECONDS
    yield f"{python:.1f} s to start and {model:.2f} s to load model and character"
    yield f"{percent((python + model) / chunk, 1)} % of a chunk of {chunk} s"
    cluster = {
        "shots": "shots", "workers killed": "workers killed", "shots lost": "shots lost",
        "shots baked twice": "shots ended twice", "files half written": "half-written files",
        "shots compared with an undisturbed bake": "shots compared",
        "of these, shots that differ": "shots that differ from an undisturbed bake",
    }  # fmt: skip
    for text, key in cluster.items():
        yield row(text, result("farm")["cluster"][key])
    for what, value in result("disturbed_farm").items():
        yield row(what, value)
    for count, cores in {1: "1 core", 2: "2 cores", 4: "4 cores"}.items():
        rate = result("farm_cores")["cores"][f"shots per second, cores: {count}"]
        yield row(f"shots of 60 frames a second on {cores}", fixed(rate, 1))
    soak = result("farm_soak")["soak"]
    for count in ("1,000", "3,000", "10,000"):
        yield row(
            f"memory after {count} bakes in one process [MiB]", fixed(soak[f"memory after {count} bakes [MiB]"])
        )
    yield f"file handles stay at {soak['file handles, least and most'].partition(',')[0]}"
    yield from shared_disk()
    fuzzed = result("fuzz_stages")
    readers = fuzzed["readers"].values()
    yield f"In {fuzzed['minutes']:.0f} minutes `benchmarks/fuzz_stages.py` damaged and read"
    yield f"{sum(reader['all'] for reader in readers):,} stages, motions and models"
    yield f"at most {fuzzed['memory added at most [MiB]']:,.0f} MiB of memory"
    yield f"The longest took {max(reader['longest [s]'] for reader in readers):.0f} s"
    yield f"Reading may take {trial.USUAL:g} s of computing, or of waiting without any, and {memory.USUAL:g} GiB more"
    yield row(
        "`SSILK_READ_GIB`",
        f"the most memory that reading a file may take [GiB], {memory.USUAL:g} where it is not set",
    )
    yield row(
        "`SSILK_READ_SECONDS`",
        f"the longest that reading a file may compute [s], {trial.USUAL:g} where it is not set",
    )


CORES = 2  # of the machine that shared_disk.json is from


def shared_disk() -> Text:
    """What a job of 10,000 shots of five garments asks of one disk, from what one garment in some shots asks."""
    found = result("shared_disk")
    shots, runs, sizes = found["shots"], found["runs"], found["bytes"]
    own = {count: runs[f"bake, workers: {count}"]["operations in the folder"] for count in (1, 2, 4)}
    chunk = own[2] - own[1]
    task = (own[1] - chunk) / shots
    yield row("operations of a chunk", fixed(chunk))
    yield row("operations of each of its tasks", fixed(task))
    yield row(
        "operations of a task that is done already", fixed(runs["bake again"]["operations in the folder"] / shots)
    )
    yield row("operations of the last step, for each task", fixed(runs["check"]["operations in the folder"] / shots))
    yield f"{fixed(own[1] + 3 * chunk)} operations for 4 workers, and {fixed(own[4])} were counted"
    delay = found["delay of a file operation [s]"]
    yield f"waits {1000 * delay:g} ms"
    for count in (1, 2, 4):
        run = runs[f"bake, workers: {count}"]
        waited = delay * run["operations of the busiest worker"]
        computed = run["seconds of computing, start included"] / min(count, CORES)
        yield row(count, own[count], fixed(waited), fixed(waited + computed), fixed(run["seconds"]))
    tasks = found["large job"]["tasks"]
    chunks = tasks / CHUNK
    yield f"{tasks:,} tasks in {chunks:,.0f} chunks of {CHUNK}"
    operations = chunks * chunk + tasks * task
    yield row("operations of all bakes, millions", fixed(operations, 1, 1e6))
    yield row("of these by each of 1,000 workers", f"{operations / 1000:,.0f}")
    yield row("minutes that each worker waits, at 1 ms", fixed(operations / 1000 / 1000 / 60, 1))
    yield row("minutes that each worker waits, at 10 ms", fixed(operations / 1000 / 100 / 60, 1))
    shared = sizes["model"] + sizes["stage"] + sizes["asset"] + found["large job"]["bytes"]
    yield row("read by a chunk: model, stage, asset and job [MB]", fixed(shared, 0, 1e6))
    yield row("read by all chunks, where no host keeps any of it [GB]", fixed(chunks * shared, 0, 1e9))
    yield row("the file of the job [MB]", fixed(found["large job"]["bytes"], 0, 1e6))
    yield row("reading it for one chunk [s]", fixed(found["large job"]["seconds to read ten"], 2))
    last = tasks * runs["check"]["operations in the folder"] / shots
    yield row("operations of the last step, millions", fixed(last, 1, 1e6))
    yield row("minutes that the last step waits, at 1 ms, at most", fixed(last / 1000 / 60, 0))


# docs/pipeline.md


def pipeline() -> Text:
    targets = {
        "usd": ("all", "the stage's", "layers or a file"),
        "blender": ("all", "z up, metres", "layers or a file"),
        "game8": ("8", "y up, metres (as glTF)", "layers or a file"),
        "game4": ("4", "y up, metres", "layers or a file"),
        "arkit": ("4", "y up, metres", "one `.usdz`"),
        "glb": ("all", "y up, metres", "one `.glb`"),
        "glb4": ("4", "y up, metres", "one `.glb`"),
    }
    for name, texts in targets.items():
        line = compact_row(f"one file for {name}, garment alone")
        yield row(f"`{name}`", *texts, *(digits(1000 * line[error], 2) for error in ("largest", "mean")))
    yield f"lies more than {milli(clearing.DEEPEST)} mm beneath"
    yield f"no vertex is lifted by more than {milli(clearing.FARTHEST)} mm"
    heaviest = compact_row("for comparison: the 4 heaviest influences, nothing learned")
    yield f"The 4 heaviest influences alone would be up to {milli(heaviest['largest'])} mm off"
    yield f"takes {cache_share()} of the point cache"
    yield f"{micro(shot_row()['largest'], 1)} µm"
    yield fitted(" over all vertices and frames", " in any frame")
    yield from hidden_skin()


def hidden_skin() -> Text:
    (low, few), (high, many) = hidden_faces.FAN
    names = ("COVER_REACH", "SHOW_DEPTH", "TOUCHING", "APART", "SPACING", "SHALLOW")
    lengths = (getattr(hidden_faces, name) for name in names)
    reach, depth, touching, apart, spacing, shallow = (f"{1000 * length:.0f} mm" for length in lengths)
    yield f"points at most {spacing} apart"
    yield f"cloth within {reach} above the skin"
    yield f"cloth within {depth} beneath it counts, unless"
    yield f"{few} steep rays, tilted by {low:.0f} degrees"
    yield f"{many} flat rays, tilted by {high:.0f} degrees, but for {hidden_faces.FLAT_FREE} at most"
    yield f"less than {shallow} beneath"
    yield f"cloth at most {reach} above the skin"
    yield f"less than {touching} above the skin, or beneath it, cloth within {depth} beneath it blocks"
    yield f"a distance of {apart} and one face"
    yield f"flatter than {90 - high:.0f} degrees"


# docs/artist_guide.md


def fitted(over: str = "", where: str = "") -> str:
    """Return how near joints and blendshapes come to points."""
    tolerance = FitTolerance()
    return f"within {1000 * tolerance.rms:g} mm (RMS{over}) and {1000 * tolerance.largest:g} mm (any vertex{where})"


# docs/settings.md


def settings_page() -> Text:
    for name, (usual, presets) in settings().items():
        yield f"| `{name}` | {usual} | {presets} |" if presets else f"| `{name}` | {usual} |"
    steps = [preset.train.iterations for preset in PRESETS.values()]
    yield f"{min(steps)} to {max(steps):,}."
    for name, unit in {"density": "kg/m²", "bending": "N m", "margin": "m"}.items():
        values = [getattr(fabric, name) for fabric in FABRICS.values()]
        yield f"{power(min(values))} to {power(max(values))} {unit}."
    yield f"0 to {FABRICS['default'].drag:g} kg/(m² s)."


def power(value: float) -> str:
    """Return a number as the page writes it."""
    return f"{value:g}" if value >= 1e-3 else f"{value:.0e}".replace("e-0", "e-")


QUOTED: dict[str, Callable[[], Text]] = {
    "README.md": readme,
    "CHANGELOG.md": lambda: iter(()),
    "docs/results.md": results,
    "docs/settings.md": settings_page,
    "docs/training.md": training,
    "docs/farm.md": farm,
    "docs/pipeline.md": pipeline,
    "docs/architecture.md": lambda: iter(()),
    "docs/index.md": lambda: iter(()),
    "docs/reference.md": lambda: iter(()),
    "docs/artist_guide.md": lambda: iter((fitted(),)),
}
"""Text with figures, by document."""
