# SPDX-License-Identifier: Apache-2.0
"""What the paper's tables and figures need: trainings, simulations and records, as commands with predicted times."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ssilk_core.quality.evaluation.splits import read_index, splits_of

GARMENTS = ("cape", "hooded_dress", "fringe_skirt", "tshirt", "long_sleeve", "pants")
BASELINES = ("ncs", "ncs*", "snug")
TABLES = (
    "table1",
    "equal",
    "seeds",
    "table4",
    "table5",
    "figure11",
    "figure12",
    "table3",
)  # the most important first
STEP = {
    "cape": 4.2,
    "hooded_dress": 4.9,
    "fringe_skirt": 4.6,
    "tshirt": 3.2,
    "long_sleeve": 2.4,
    "pants": 2.1,
}  # [ms]
BASELINE_STEP = 8.5  # [ms]
START, VALIDATION, EVALUATION, FRAME = 25.0, 1.5, 3.0, 0.05  # [s]; the last: of the simulator, a frame of a shot
VALIDATIONS = 10
MOTION = ("recombinations=8", "perturbations=3")
USUAL = {"batch": 64, "window": 6, "static_batch": 512}
RECIPES = dict.fromkeys(("tshirt", "long_sleeve", "pants"), ("latent=256", "widths=512,512,512"))
SWEEPS: dict[str, dict[str, tuple[str, ...]]] = {
    "table4": {"latent_regularization": ("0.001", "0.01")},
    "table5": {"batch": ("32", "128", "256"), "window": ("4", "10", "18"), "latent": ("16", "64", "512")},
    "figure11": {"scheme": ("verlet", "direct", "direct_residual")},
    "figure12": {"shapes": ("0", "8", "16", "32", "64", "256", "512"), "proxies": ("0", "4", "8", "32", "64")},
}
"""Settings of the cape that are changed, one at a time; Figure 8 takes the zeros of Figure 12."""
REHEARSED = (
    "iterations=4",
    "validate_every=2",
    "valid_frames=4",
    "recombinations=0",
    "static_batch=2",
    "pretraining_batch=2",
)
PYTHON, SSILK = "python", ("python", "-m", "ssilk_core")


@dataclass(frozen=True)
class Job:
    """A process that writes one output.

    Attributes:
        outputs: what is there once it is done; a job whose outputs exist is not run.
        command: its words; the first one, "python", stands for the interpreter.
        seconds: predicted.
        needs: outputs of other jobs, which end before it begins.
    """

    name: str
    outputs: tuple[Path, ...]
    command: tuple[str, ...]
    seconds: float
    needs: tuple[Path, ...] = ()

    @property
    def is_done(self) -> bool:
        return all(path.is_file() for path in self.outputs)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is asked for.

    Attributes:
        folder: where everything goes.
        stages: folder of rigged stages called as `GARMENTS`, and "cape_proxies_8" and so on.
        motions, index: clips and their splits.
        seconds, sweep_seconds: of steps, for each training of Table 1 and of the sweeps.
        frames: of a simulated sequence; batch: of them together; iterations: of the solver in each.
        clips: only these of the held-out clips; all if none is named.
        rehearse: trainings of four small steps.
    """

    folder: Path
    stages: Path
    motions: Path
    index: Path
    device: str = "cuda"
    garments: Sequence[str] = GARMENTS
    tables: Sequence[str] = TABLES
    seconds: float = 60.0
    sweep_seconds: float = 45.0
    frames: int = 64
    batch: int = 96
    iterations: int = 50
    clips: Sequence[str] = ()
    rehearse: bool = False

    def model(self, name: str) -> Path:
        """Return where a model goes."""
        return self.folder / "models" / f"{name}.safetensors"

    def stage(self, name: str) -> Path:
        return self.stages / f"{name}.usdc"

    def files(self, split: str) -> list[str]:
        """Return the motion files of a split; "held" are all those that are evaluated."""
        index = read_index(self.index)
        chosen = dict.fromkeys(name for names in splits_of(index, self.clips).values() for name in names)
        of_split = [entry.clip for entry in index if entry.split == split]
        names = list(chosen) if split == "held" else [n for n in of_split if split == "train" or n in chosen]
        return [str(self.motions / f"{name}.usdc") for name in (names[:2] if self.rehearse else names)]

    def held_frames(self) -> int:
        """Return how many frames all clips that are evaluated have, 30 a second."""
        clips = {Path(file).stem for file in self.files("held")}
        index = json.loads(self.index.read_text())
        return sum(item["frames"] * 30 // item["fps"] for item in index if item["clip"] in clips)


@dataclass(frozen=True)
class Training:
    """One training: a garment and a method, and what differs from the garment's recipe."""

    name: str
    garment: str
    method: str = "ssilk"
    settings: tuple[str, ...] = ()
    stage: str = ""
    seed: int = 0

    def job(self, plan: Plan, seconds: float) -> Job:
        """Return the job: as many steps as take so many seconds for the garment's recipe (or the baseline) alone."""
        own = self.method == "ssilk"
        step = (STEP[self.garment] if own else BASELINE_STEP) / 1000
        steps = max(100, round(seconds / step))
        rates = (f"iterations={steps}", f"validate_every={max(1, steps // VALIDATIONS)}")
        recipe = RECIPES.get(self.garment, ()) if own else ()
        settings = [f"seed={self.seed}", *MOTION, *recipe, *rates, *self.settings]
        settings += [*REHEARSED, *(() if self._sets("batch") else ("batch=2",))] if plan.rehearse else []
        script = "train_baseline" if not own else "train_scheme" if self._sets("scheme") else ""
        begun = (PYTHON, f"benchmarks/{script}.py", *(() if own else (self.method,))) if script else (*SSILK, "train")
        command = (
            *begun, str(plan.stage(self.stage or self.garment)), "--motions", *plan.files("train"), "--valid",
            *plan.files("valid"), "-o", str(plan.model(self.name)), "--preset", "final", "--device", plan.device,
            *(word for setting in settings for word in ("--set", setting)),
        )  # fmt: skip
        taken = START + VALIDATIONS * VALIDATION + steps * step * (self._cost() if own else 1.0)
        return Job(self.name, (plan.model(self.name),), command, taken)

    def _sets(self, name: str) -> bool:
        return any(setting.startswith(f"{name}=") for setting in self.settings)

    def _cost(self) -> float:
        """Return the predicted time of a step over the usual one's: half of it goes with the frames decoded."""
        changed = {name: int(value) for name, _, value in (s.partition("=") for s in self.settings) if name in USUAL}
        frames, usual = (of["batch"] * (of["window"] - 2) + of["static_batch"] for of in (USUAL | changed, USUAL))
        return 0.5 + 0.5 * frames / usual


def trainings(plan: Plan) -> dict[str, list[Training]]:
    """Return the trainings of each table: those of the cape's sweeps begin with one that changes nothing."""
    methods = ("ssilk", *BASELINES)
    found = {"table1": [Training(f"{g}_{_stem(m)}", g, m) for g in plan.garments for m in methods]}
    found["equal"] = [Training(f"{g}_equal", g) for g in plan.garments]
    found["seeds"] = [Training(f"cape_{_stem(m)}_seed{n}", "cape", m, seed=n) for n in (1, 2) for m in methods]
    for table, sweep in SWEEPS.items():
        found[table] = [Training("sweep_usual", "cape"), *(_changed(n, v) for n, vs in sweep.items() for v in vs)]
    return {table: found[table] for table in plan.tables if table in found}


def _stem(method: str) -> str:
    return method.replace("*", "_star")


def _changed(name: str, value: str) -> Training:
    """Return a training of the cape with one setting changed; a number of proxies is the rig's, in its stage."""
    if name == "proxies":
        return Training(f"sweep_proxies_{value}", "cape", stage=f"cape_proxies_{value}")
    return Training(f"sweep_{name}_{value}", "cape", settings=(f"{name}={value}",))


def simulation(plan: Plan, garment: str) -> Job:
    """Return the simulation of all held-out clips, in sequences."""
    output = plan.folder / "shots" / garment
    clips = plan.files("held")
    command = (
        *SSILK, "simulate", str(plan.stage(garment)), "--motion", *clips, "-o", str(output), "--points", "--sequence",
        str(plan.frames), "--batch", str(plan.batch), "--iterations", str(plan.iterations), "--no-body",
        "--device", plan.device,
    )  # fmt: skip
    outputs = tuple(output / f"{Path(clip).stem}.usdc" for clip in clips)
    return Job(f"{garment}_simulated", outputs, command, START + FRAME * plan.held_frames())


def records(
    plan: Plan, name: str, garment: str, needs: Sequence[Job], simulated: Job | None = None, kind: str = "records"
) -> Iterator[Job]:
    """Yield what measures models: on whole clips, and in sequences beside the simulator where that has played.

    Those of another `kind` are kept apart: a changed setting is no other seed of Table 1.
    """
    clips, outputs = plan.files("held"), tuple(path for job in needs for path in job.outputs)
    asked = ("--stage", str(plan.stage(garment)), "--motions", str(plan.motions), "--index", str(plan.index))
    begun = (PYTHON, "benchmarks/tables.py", "record", *map(str, outputs), *asked)
    begun += ("--device", plan.device, *(("--clips", *(Path(c).stem for c in clips)) if plan.rehearse else ()))
    output = plan.folder / kind / f"{name}_whole.json"
    seconds = START + EVALUATION * len(needs)
    yield Job(f"{name}_whole", (output,), (*begun, "-o", str(output)), seconds, outputs)
    if simulated:
        beside = ("--exact", "--sequence", str(plan.frames), "--reference", str(simulated.outputs[0].parent))
        output = output.with_name(f"{name}_sequences.json")
        command = (*begun, *beside, "-o", str(output))
        yield Job(f"{name}_sequences", (output,), command, seconds, (*outputs, *simulated.outputs))


def jobs(plan: Plan) -> list[Job]:
    """Return all jobs, the most important first, after the simulations, which others wait for."""
    asked = trainings(plan)
    simulated = {name: simulation(plan, name) for name in plan.garments} if "table1" in asked else {}
    found: list[Job] = list(simulated.values())
    first = [training.job(plan, plan.seconds) for table in ("table1", "seeds") for training in asked.get(table, [])]
    swept = [t.job(plan, plan.sweep_seconds) for table in SWEEPS for t in asked.get(table, [])]
    swept = list({job.name: job for job in swept}.values())
    found += first
    for garment in plan.garments:
        own = [job for job in first if job.name.startswith(garment)]
        found += records(plan, garment, garment, own, simulated.get(garment)) if own else []
    # As many iterations as the baselines do in their time.
    equal = {t.garment: t.job(plan, plan.seconds * STEP[t.garment] / BASELINE_STEP) for t in asked.get("equal", [])}
    found += equal.values()
    for garment, job in equal.items():
        own = [other for other in first if other.name in {f"{garment}_{_stem(m)}" for m in BASELINES}]
        found += records(plan, f"{garment}_equal", garment, [job, *own], kind="equal")
    found += swept
    found += records(plan, "sweeps", "cape", swept, kind="sweeps") if swept else []
    if "table3" in plan.tables:
        found.append(_timings(plan, [job for job in first if job.name.startswith("cape") and "seed" not in job.name]))
    return found


def _timings(plan: Plan, models: Sequence[Job]) -> Job:
    output = Path(__file__).parents[1] / "results" / f"table3_{plan.device}.json"
    needs = tuple(path for job in models for path in job.outputs)
    command = (
        PYTHON, "benchmarks/tables.py", "table3", *map(str, needs), "--stage",
        str(plan.stage("cape")), "--motions", str(plan.motions), "--device", plan.device, "--name", output.stem,
        "--frames", "20" if plan.rehearse else "1000",
    )  # fmt: skip
    return Job("table3", (output,), command, START + 4 * len(models), needs)


def without_models(job: Job) -> Job:
    """Return a job of models with only those that are there: what is missing has failed or was not wanted."""
    gone = {str(path) for path in job.needs if path.suffix == ".safetensors" and not path.is_file()}
    return replace(job, command=tuple(word for word in job.command if word not in gone))
