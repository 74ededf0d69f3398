# SPDX-License-Identifier: Apache-2.0
"""Train a baseline as 'ssilk train' trains a model: same scene, motions and energies, same validation.

    python benchmarks/train_baseline.py ncs STAGE --motions FOLDER --valid FOLDER -o ncs.safetensors --minutes 30

`ncs*` is NCS with the rotation augmentation that SSILK has in the tables. It takes all options of 'ssilk train';
`--set` changes the schedule below. A step computes energies of as many poses as a model's in the tables: it has 640
windows of 18 poses, of which the last two have energies and those before fill the memory (NCS: half a second and at
least 512 windows).
--resume continues from the last validation.
"""

from __future__ import annotations

import argparse
import math

from baselines.networks import BaselineConfig
from baselines.run import BaselineJob, train_baseline

from ssilk_core.cli import train
from ssilk_core.devices import select_device
from ssilk_core.errors import SsilkError
from ssilk_core.events import Failed, Result, TextReporter

METHODS = {
    "ncs": ("ncs", 0.0),
    "ncs*": ("ncs", 0.5),
    "snug": ("snug", 0.0),
}  # network, and share of windows that are rotated
SCHEDULE = (
    "static_fraction=0",
    "batch=640",
    "window=18",
    "state_reuse=0",
    "learning_rate=1e-3",
    "final_learning_rate=4e-5",
    "optimiser=adam",
    "weight_decay=0",
)


def parser() -> argparse.ArgumentParser:
    """Return a parser of the options of 'ssilk train', and of those that only baselines have."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("method", choices=METHODS)
    train.add_arguments(found)
    found.set_defaults(preset="final")
    found.add_argument("--iterations", type=int, help="steps to train for (default: those of the preset)")
    found.add_argument("--judged", type=int, default=2, help="last poses of a window with energies (default 2)")
    found.add_argument("--mixed", type=float, default=0.0, help="NCS: share of windows with mixed motion (default 0)")
    return found


def asked(options: argparse.Namespace, report: TextReporter) -> BaselineJob:
    """Read everything that the options name."""
    network, rotated = METHODS[options.method]
    iterations = [] if options.iterations is None else [f"iterations={options.iterations}"]
    options.settings = [*SCHEDULE, f"rotated_fraction={rotated}", *iterations, *options.settings]
    base = train.training_job(options, str(select_device(options.device)), report)
    return BaselineJob(
        base=base,
        config=BaselineConfig(method=network, fps=base.model.fps),
        judged=options.judged,
        mixed=options.mixed,
        seconds=math.inf if options.minutes is None else 60 * options.minutes,
    )


def main() -> int:
    options, report = parser().parse_args(), TextReporter()
    try:
        state = train_baseline(asked(options, report), report)
    except SsilkError as error:
        report(Failed(str(error)))
        return 2
    assert state.best is not None
    told = {"seconds": round(state.seconds, 1), "iterations": state.iteration, "kept": state.best.iteration}
    report(Result(options.method, {**told, "total [J]": round(state.best.score.total, 5)}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
