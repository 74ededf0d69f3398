# SPDX-License-Identifier: Apache-2.0
"""Test a trained garment under extremes of motion, wind, props, size, fabric, mesh and precision.

A table says for each case whether all values stay bounded, how far vertices go, how the energy grows, how large the
error is, and what happens: it works, falls back to rest, is refused with a sentence, or does not apply to this model.
The exit code is 3 where anything else happens. Simulators fall back where a frame misses their tolerance. --output
writes each case when it has run; the same command, given again, goes on from there. --stage given several times tests
each body of a family: cases then have the name of the body's stage in front.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import EXIT_OK, EXIT_VERIFICATION, fail
from ..events import Message, Progress, Reporter, Result, Started
from .options.bodies import BODIES, named_bodies
from .options.fabric import add_known_fabric, asked_known_fabric
from .options.files import check_output

if TYPE_CHECKING:
    from ..quality.kept_rows import KeptRows
    from ..quality.stress.outcome import CaseOutcome
    from ..quality.stress.subject import StressSubject


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("model", type=Path, help="model written by 'ssilk train'")
    verb.add_argument("--stage", type=Path, action="append", required=True, help=BODIES)
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument(
        "--motion",
        type=Path,
        metavar="SHOT[:/PRIM]",
        help="USD file with the motion that cases change (default: joints that sway)",
    )
    add_known_fabric(verb)
    verb.add_argument(
        "--quick", action="store_true", help="a tenth of the frames and smaller trials: minutes instead of an hour"
    )
    verb.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="run cases whose name has such a word, as 'rate:'"
    )
    verb.add_argument("-o", "--output", type=Path, help="JSON file for the figures")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Run the cases, each kept when it has run, and tabulate them."""
    from ..quality.stress.cases import CASES
    from ..quality.stress.outcome import markdown

    if options.output:
        check_output(options.output, options.model, *options.stage)
    subjects = {body: _subject(options, stage, report) for body, stage in named_bodies(options.stage).items()}
    cases = [replace(case, body=body) for body in subjects for case in CASES if case.matches(options.only)]
    if not cases:
        fail(
            "--only",
            f"no case contains {' or '.join(options.only)}",
            "'ssilk stress --help' names the option",
            f"groups are {', '.join(dict.fromkeys(case.group for case in CASES))}",
        )
    kept = _kept(options)
    known = (outcome for outcome in kept.known(report) if outcome.verdict != "breaks")  # that is tried again
    found = {outcome.label: outcome for outcome in known}
    missing = [case for case in cases if case.label not in found]
    report(Started("stress", len(missing)))
    began = time.monotonic()

    def tell_progress(done: int) -> None:
        """Tell the time left: cases take from nothing to minutes, so that what each is expected to take counts."""
        over, left = (sum(case.seconds for case in part) for part in (missing[:done], missing[done:]))
        seconds = (time.monotonic() - began) * left / over if over else None
        report(Progress(done, len(missing), seconds))

    def write(*, finished: bool) -> None:
        order = [replace(case, body=body).label for body in subjects for case in CASES]
        rows = [asdict(found[label]) for label in order if label in found]
        kept.write({"model": options.model.name}, rows, finished=finished)

    try:
        for number, case in enumerate(missing):
            tell_progress(number)
            outcome = found[case.label] = case.run(subjects[case.body])
            if not case.allows(outcome.verdict):
                report(Message(f"{case.label} {outcome.verdict}: {outcome.said}", "warning"))
            write(finished=False)
        tell_progress(len(missing))
    except KeyboardInterrupt:
        kept.tell_kept(len(found), report)
        raise
    write(finished=True)
    outcomes = [found[case.label] for case in cases]
    faults = [case.label for case, outcome in zip(cases, outcomes) if not case.allows(outcome.verdict)]
    report(Message(markdown(outcomes)))
    report(Result("stress", {"cases": len(outcomes), "faults": ", ".join(faults) or "none"}))
    return EXIT_VERIFICATION if faults else EXIT_OK


def _subject(options: argparse.Namespace, stage: Path, report: Reporter) -> StressSubject:
    """Load the model, the character of a stage and the motion, and say which body of a family that is."""
    from ssilk_usd.opening.stage import open_stage
    from ssilk_usd.reading.motion import read_motion

    from ..delivery.bake import in_fabric, worn
    from ..network.checkpoint import load_model
    from ..quality.evaluation.bodies import base_of
    from ..quality.stress.subject import FULL, QUICK, StressSubject
    from ..scene.family import has_bones, motion_on

    whole = load_model(options.model)
    on = worn(whole, open_stage(stage), options.root)
    if whole.bodies and on.body is None:
        report(Message(f"{on.scene.character.path}: the first body of the model's family"))
    file, in_words = in_fabric(on.file, str(options.model), options.fabric, options.material)
    for event in (*on.told, *in_words):
        report(event)
    skeleton, base = on.scene.character.skeleton, base_of(whole, on.member)
    clip = read_motion(str(options.motion), skeleton) if options.motion else None
    if clip and base and has_bones(clip, base[0]) and not has_bones(clip, skeleton):
        clip = motion_on(clip, base[0], skeleton, base[1])
        report(Message(f"{options.motion}: it has the bones of the model's first body, and is played on this one's"))
    return StressSubject(file, on.scene, clip, QUICK if options.quick else FULL)


def _kept(options: argparse.Namespace) -> KeptRows[CaseOutcome]:
    """Return where the outcomes are kept."""
    from ..quality.kept_rows import KeptRows
    from ..quality.stress.outcome import CaseOutcome
    from ._measured import measured_inputs

    inputs: dict[str, Any] = {}
    if options.output:
        clips = {"motion": options.motion} if options.motion else {}
        others = {"further bodies": options.stage[1:]} if options.stage[1:] else {}
        inputs = measured_inputs(
            models=[options.model], stage=options.stage[0], clips=clips, device="cpu", others=others
        )
        inputs |= {"root": options.root, "quick": options.quick, **asked_known_fabric(options)}
    return KeptRows(
        path=options.output,
        verb="stress",
        kind=CaseOutcome,
        names=("group", "name"),
        inputs=inputs,
        rows_at="outcomes",
    )
