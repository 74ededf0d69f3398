# SPDX-License-Identifier: Apache-2.0
"""Train a list of garments as 'ssilk train' does, one at a time on each GPU.

LIST is a TOML file with a table for each garment, and [defaults] for all; its paths are relative to its folder:

    [defaults]
    stage = "hero.usda"
    motions = ["walks/", "runs/"]
    preset = "final"

    [cape]
    garment = "cape.usdc"
    set = { iterations = 100000 }

    [skirt]
    garment = "skirt.usdc"
    over = ["tights"]

    [tights]
    garment = "tights.usdc"

Other keys are valid, fabric, material, fabrics, family and graded. Garments named by 'over' are trained first, and
worn beneath; a name that ends in .safetensors is a model file. 'ssilk inspect LIST' tells where garments start inside
each other. FOLDER gets NAME.safetensors and NAME.log for each garment, and a copy of LIST, which 'ssilk bake' takes
for all of them. The same command, given again, skips what is finished and resumes what was interrupted; a garment
whose entry or inputs have changed is trained again. Ctrl-C stops all trainings after their current step, a second
Ctrl-C at once. A garment that fails does not stop the others.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from ..devices import default_preset
from ..errors import EXIT_OK, EXIT_WORSE, SsilkError, fail
from ..events import Failed, GarmentEvent, Message, Reporter, Result, Started, TaskEvent, silent
from ..files import need_writable, sha256, split_body
from ..scene.shape_weights import is_shapes, need_weights
from ..training.wardrobe.listing import WardrobeEntry, read_list, write_list
from ..training.wardrobe.panel import ProgressTable, table
from ..training.wardrobe.queue import CommandTask, End, Queue, Slot
from ..training.wardrobe.training import GarmentTraining
from ..work_record import request_key
from . import train
from .options.bodies import bodies_in_list, members
from .options.numbers import NumberRange
from .options.scene import garment_location


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("list", type=Path, metavar="LIST", help="TOML file with a table for each garment")
    verb.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder for models, states and logs"
    )
    verb.add_argument(
        "--jobs",
        type=NumberRange(1, 1000, int),
        help="trainings at a time (default: one for each GPU; one without GPUs)",
    )
    verb.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train (default auto)"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Train all; return 0, 130 when interrupted, the code of one that failed, or 5 where one is worse than none."""
    device, slots = _slots(options.device, options.jobs)
    need_writable(options.output / "log")
    entries = read_list(options.list)
    entries = [_with_bodies(entry, entries, options.list.parent, report) for entry in entries]
    requests, known = dict[str, str](), dict[str, GarmentTraining]()
    for entry in entries:
        requests[entry.name] = _request(options.parser, entry, options.list, device, requests)
    for entry in entries:
        known[entry.name] = GarmentTraining(entry, options.output, requests[entry.name], known)
    trainings = [*known.values()]
    options.output.mkdir(parents=True, exist_ok=True)
    _keep_list(entries, options.list, options.output)
    show = report if options.json else ProgressTable([entry.name for entry in entries])
    show(Started("wardrobe", len(trainings), {"device": device, "at a time": len(slots)}))
    _train(trainings, options.list.absolute().parent, device, slots, show)
    rows = [training.row() for training in trainings]
    if options.json:
        report(Result("wardrobe", {"garments": rows}))
    else:
        print(table(rows), *(f"{t.entry.name}: {t.error}" for t in trainings if t.state == "failed"), sep="\n")
    return max((training.code for training in trainings), key=lambda code: (code not in (EXIT_OK, EXIT_WORSE), code))


def _with_bodies(
    entry: WardrobeEntry, entries: Sequence[WardrobeEntry], folder: Path, report: Reporter
) -> WardrobeEntry:
    """Return an entry whose training leaves out of its bodies what its stage has of the list's other garments."""
    bodies = bodies_in_list(entry, entries, folder, report)
    return replace(entry, words=(*entry.words, *(word for body in bodies for word in ("--body", body))))


def _keep_list(entries: Sequence[WardrobeEntry], path: Path, folder: Path) -> None:
    """Copy a list beside the models that it stands for, unless it lies there.

    Raises:
        SsilkError: a list of that name lies there, in which are other garments.
    """
    if folder.samefile(path.absolute().parent):
        return
    kept, own = folder / path.name, {entry.name for entry in entries}
    before = {entry.name for entry in read_list(kept)} if kept.exists() else own
    if not (before <= own or own <= before):
        found = f"another list, of {', '.join(sorted(before))}"
        fail(str(kept), found, "a list lies beside its models under its name", "rename one, or name another folder")
    write_list(kept, {entry.name: entry.located(path.parent) for entry in entries})


def _train(
    trainings: Sequence[GarmentTraining], source: Path, device: str, slots: Sequence[Slot], show: Reporter
) -> None:
    """Train all garments that wait; paths of the list are relative to `source`."""
    from ..training.signals import stop_on_signals

    named = {training.entry.name: training for training in trainings}

    def tell(name: str, event: TaskEvent) -> None:
        if isinstance(event, Failed):
            named[name].error = event.error
        show(GarmentEvent(name, event))

    def ended(name: str, end: End) -> None:
        named[name].end(end)
        if named[name].state != "failed":  # then there is an error to be seen
            tell(name, Message(named[name].state))

    for name, training in named.items():
        if training.plan:
            tell(name, Message(training.plan))
    with stop_on_signals(show) as stop:
        left = [training for training in trainings if training.state == "waiting"]

        def take() -> CommandTask | None:
            """Return the next training of which the inner garments are there."""
            for training in [*left]:
                failed = [inner.entry.name for inner in training.inner if inner.state == "failed"]
                if failed:
                    left.remove(training)
                    training.skip(failed[0])
                    show(GarmentEvent(training.entry.name, Failed(training.error)))
                elif all(inner.state == "finished" for inner in training.inner):
                    left.remove(training)
                    return training.begin(source, device)
            return None

        Queue(slots, tell, ended).run(take, stop)


def _slots(device: str, jobs: int | None) -> tuple[str, list[Slot]]:
    """Return the device that all train on, and the environment of each training at a time."""
    gpus = [] if device == "cpu" else _visible_gpus()
    if not (gpus or device != "cuda"):
        fail("--device cuda", "no GPU is visible", "'auto' and 'cpu' are allowed")
    if gpus:
        return "cuda", [{"CUDA_VISIBLE_DEVICES": gpus[index % len(gpus)]} for index in range(jobs or len(gpus))]
    jobs = jobs or 1
    threads = str(max(1, (os.cpu_count() or 1) // jobs))
    return "cpu", [{"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", threads)}] * jobs


def _visible_gpus() -> list[str]:
    """Return the GPUs as CUDA_VISIBLE_DEVICES names them."""
    import torch

    count, visible = torch.cuda.device_count(), os.environ.get("CUDA_VISIBLE_DEVICES")
    return [name.strip() for name in visible.split(",")][:count] if visible else [str(n) for n in range(count)]


def _request(
    parser: argparse.ArgumentParser, entry: WardrobeEntry, path: Path, device: str, inner: Mapping[str, str]
) -> str:
    """Return a hash of what is asked for a garment of the list at `path`, with the preset that a device stands for.

    Args:
        inner: the hashes of the garments that it may be worn over, by name.

    Raises:
        SsilkError: there is no such file, or 'ssilk train' would not take it.
    """
    where = f"{path}: table '{entry.name}'"
    try:
        options = parser.parse_args(["train", *entry.words, "-o", f"{entry.name}.safetensors"])
        train.configured(options)
        files = _inputs(options, path.parent)
        for file in files:
            need_weights(str(file))
            if not file.is_file():
                fail(str(file), "there is no file", "paths are relative to the folder of the list")
        _need_shapes(options, path.parent)
    except SsilkError as error:
        raise SsilkError(f"{where}: {error}") from error
    words = entry.words if options.preset else [*entry.words, "--preset", default_preset(device)]
    over = [(f"over {name}", inner[name]) for name in entry.over]
    return request_key(words, [*((file.name, sha256(file)) for file in files), *over])


def _need_shapes(options: argparse.Namespace, folder: Path) -> None:
    """Raise `SsilkError` where a stage has not the shapes that make a body of a training, or marks none."""
    from ssilk_usd.opening.stage import open_stage

    stage, named = folder / options.stage, options.family
    family = named and [each if is_shapes(str(each)) else folder / each for each in named]
    others = members(argparse.Namespace(stage=stage, family=family), silent)
    for body in (str(stage), *(others if named else ())):  # unnamed ones are within the ranges that the stage marks
        if split_body(body)[1]:
            open_stage(body)


def _inputs(options: argparse.Namespace, folder: Path) -> list[Path]:
    """Return the files that a training reads, and after them the layers that stages and motions consist of.

    Where these are single files, a training has the key that it had before layers counted, and is not done again.
    """
    from ssilk_usd.opening.stage import used_files
    from ssilk_usd.reading.motion import motion_files

    motions = motion_files(folder / motion for motion in [*options.motions, *options.valid])
    bodies = [options.stage, garment_location(options)[0], *(options.family or ())]
    named = [folder / file for body in bodies if (file := split_body(str(body))[0]) and not is_shapes(file)]
    own = {path.resolve() for path in (*named, *motions)}
    layers: set[Path] = set()
    for path in filter(Path.is_file, own):
        with suppress(SsilkError):  # a file that cannot be read is told by the training that reads it
            layers |= {Path(file).resolve() for file in used_files(str(path))}
    ordered = sorted(layers - own, key=lambda path: (path.name, path))
    return [*named, *(folder / file for file in options.over), *motions, *ordered]
