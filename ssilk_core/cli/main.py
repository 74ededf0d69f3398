# SPDX-License-Identifier: Apache-2.0
"""The command itself: its verbs, how its words are parsed, and what becomes of an error."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

from .. import __version__
from ..errors import EXIT_BAD_INPUT, EXIT_INTERRUPTED, SsilkError
from ..events import Failed, JsonReporter, Reporter, TextReporter
from .inputs import need_inputs
from .parsing import Parser

VERBS = {
    "inspect": "Check a character, a garment and motions before training (preflight).",
    "rig": "Give a garment weights, classes and proxy joints, written into a copy of the stage.",
    "train": "Train a garment on motions and write a model.",
    "wardrobe": "Train a list of garments as 'ssilk train' does, one at a time on each GPU.",
    "reduce": "Cut a trained model down to fewer blendshapes, proxy joints and influences, without training again.",
    "export": "Write a trained model's network as ONNX, for engines that play it themselves.",
    "bake": "Bake trained garments over motions as UsdSkel, and verify it by re-skinning the files.",
    "live": "Solve for a garment while a program plays its character: what live playback in Blender runs.",
    "remove": "Take garments out of the shots of a folder of layers, and write the stages of these shots again.",
    "simulate": "Simulate a garment, or an outfit, over motions without a network: slow and accurate, the reference.",
    "skin": "Turn a point cache into joints and blendshapes on the character's skeleton, and verify them.",
    "evaluate": "Measure trained garments on whole clips: energies, against the simulator, and what energies hide.",
    "trade": "Measure what speed and size cost in accuracy, for all that can be changed without training again.",
    "stress": "Test a trained garment under extremes of motion, wind, props, size, fabric, mesh and precision.",
    "report": "Write a page (.html) about a shot or a model: energies over time, worst frames, tables, provenance.",
    "verify": "Check a shot, and compare it, re-skinned by UsdSkel alone, with the decoder's vertices or its cache.",
    "view": "Film a shot (.mp4), lay out its moments on a sheet (.png), or write a page that plays it (.html).",
    "farm": "Bake many shots on a farm: write a bundle of Open Job Description, or run its tasks on a Ray cluster.",
    "task": "Bake tasks of a job that 'ssilk farm' wrote, or check that all are done: what a farm's workers run.",
    "demo": "Film a garment that ships beside linear blend skinning, then train a draft of it and film all three.",
    "completion": "Write the script that lets a shell complete verbs, options and names with the tab key.",
    "help": "Say what all verbs, or one of them, are for.",
}
"""What each verb does, the first line of its module's docstring: a list of verbs loads none of them."""

# The extra of the distribution that installs everything a verb needs; "all" for others.
EXTRAS = {
    "inspect": "train",
    "rig": "setup",
    "train": "train",
    "wardrobe": "train",
    "reduce": "usd",
    "export": "export",
    "bake": "bake",
    "live": "bake",
    "remove": "usd",
    "simulate": "train",
    "skin": "train",
    "evaluate": "train",
    "trade": "report",
    "stress": "train",
    "report": "report",
    "verify": "bake",
    "view": "view",
    "farm": "farm",
    "task": "bake",
}
OPTIONAL = ("torch", "pxr", "igl", "scipy", "trimesh", "embreex", "imageio_ffmpeg", "PIL", "matplotlib", "ray",
            "onnxscript")  # fmt: skip


BESIDE_OTHERS = ("train", "wardrobe", "demo", "live")  # verbs that train, or share their processor with a program


def module_of(verb: str) -> ModuleType:
    """Return the module of a verb."""
    return import_module(f".{verb}", __package__)


def parser(loaded: Collection[str] = tuple(VERBS)) -> Parser:
    """Return the parser of all verbs; only those that are `loaded` have options."""
    top = Parser(prog="ssilk", description="Neural loose garments, trained by physics alone, baked as UsdSkel.")
    top.add_argument("--version", action="version", version=f"ssilk {__version__}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, purpose in VERBS.items():
        verb = verbs.add_parser(name, help=purpose, formatter_class=argparse.RawDescriptionHelpFormatter)
        if name not in loaded:
            continue
        module = module_of(name)
        verb.description = module.__doc__
        verb.add_argument(
            "--json", action="store_true", help="events as JSON, one object per line, on standard output"
        )
        # A verb that runs or explains others gets both: importing them from here would be a circle.
        verb.set_defaults(run=module.run, main=main, parser=top)
        module.add_arguments(verb)
    return top


def _asked(words: Sequence[str]) -> Collection[str]:
    """Return the verbs whose options a command may need."""
    if words[:1] == ["completion"]:
        return tuple(VERBS)
    if words[:1] == ["wardrobe"]:  # a list is a list of trainings
        return ("wardrobe", "train")
    return words[:2] if words[:1] == ["help"] else words[:1]


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM, by which farms and systems end a process, stop as Ctrl-C does: no file is left half written."""
    ours = (
        threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    )
    if ours:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code: 0, 2 bad input, 3 not verified, 4 tasks failed, 130 interrupted."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    report: Reporter = JsonReporter() if "--json" in words else TextReporter()
    if words[:1] and words[0] in BESIDE_OTHERS:
        # PyTorch's threads otherwise keep cores busy while they wait. Those of `physics.loops` then lack them, and
        # beside other programs a step takes several times as long. This is read when PyTorch is imported.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        with _terminated_as_interrupted():
            options = parser(_asked(words)).parse_args(words)
            need_inputs(options)
            return int(options.run(options, report))
    except SsilkError as error:
        report(Failed(str(error)))
        return error.exit_code
    except KeyboardInterrupt:
        report(Failed("interrupted; nothing half written was left behind."))
        return EXIT_INTERRUPTED
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in OPTIONAL:
            raise
        extra = EXTRAS.get(options.verb, "all")
        report(
            Failed(f"'{options.verb}' needs {error.name}, which is not installed; install the extra ssilk[{extra}].")
        )
        return EXIT_BAD_INPUT
    except OSError as error:
        report(Failed(f"{error.filename or options.verb}: {error.strerror or error}; check the path and its disk."))
        return EXIT_BAD_INPUT
