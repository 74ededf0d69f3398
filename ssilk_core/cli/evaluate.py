# SPDX-License-Identifier: Apache-2.0
"""Measure trained garments on whole clips: energies, against the simulator, and what energies hide.

Models of one garment share their tables with linear blend skinning, on the character that they were trained with.
--stage given several times measures each body of a family: garments then have the name of the body's stage in front,
and the body on which least is won over linear blend skinning is told. Clips with the bones of the model's first body
are played between the bones of the others.
Gravity is relative to linear blend skinning. --reference compares with the reference simulator. It names a folder of
shots of the same clips, written by 'ssilk simulate --points' and named after the clips, or one with such a folder
for each garment, under its name. Of several bodies each has its own folder there, under its stage's name. Three
probes follow. Poses are held after stops: a garment should come to rest at its own static state. The first seconds
of clips are looped: a garment should repeat itself. Steps are linearised about states of rollouts: a disturbance of
the two states before a step should not grow, so the spectral radius of the map from these to the next two should stay
under one. --no-probes leaves them out.
--solver continues the first two states of each clip, and of its most violent second, with the reference simulator. It
tells how far the garment is from that after 5, 10, 30 and 60 frames, and what single steps from its own past miss.
--output writes each row when it is measured, and says that it is unfinished until the last. What is measured of the
next rows is kept beside it, in a file that ends in .parts, every five seconds. The same command, given again, goes on
from there, to the same figures. Files of other models, motions or settings are begun anew.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..delivery.bake.fabrics import need_fabric
from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result, Started
from .options.bodies import BODIES, named_bodies
from .options.fabric import add_known_fabric
from .options.files import check_output
from .options.motions import need_motion_folder

if TYPE_CHECKING:
    import torch

    from ..network.checkpoint import ModelFile
    from ..quality.evaluation.asked import EvaluationClips, EvaluationOptions
    from ..quality.evaluation.methods import EvaluatedMethod, EvaluationScene, Method, TakeSet
    from ..quality.evaluation.results import EvaluationResults
    from ..scene.assets import Skeleton

COLUMNS = 118  # of a terminal, which tables fit


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="files written by 'ssilk train'")
    verb.add_argument("--stage", type=Path, action="append", required=True, help=BODIES)
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
    verb.add_argument("--index", type=Path, metavar="JSON",
                      help='list of {"clip", "split", "tags"}, with "train" as poses that are known (default: '
                           "all clips in one split)")  # fmt: skip
    verb.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="only these clips")
    verb.add_argument("--reference", type=Path, metavar="FOLDER",
                      help="shots of 'ssilk simulate --points' to compare with")  # fmt: skip
    add_known_fabric(verb)
    verb.add_argument("--no-probes", action="store_true", help="measure clips alone, without probes")
    verb.add_argument("--solver", action="store_true",
                      help="simulate from the garment's own states, and single steps (long on a CPU)")  # fmt: skip
    verb.add_argument("-o", "--output", type=Path, help="figures to write (.json), in SI units")
    verb.add_argument("--device", default="cpu", help="where it runs (default cpu)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Evaluate; return 0."""
    from ..quality.evaluation.asked import EvaluationOptions
    from ..quality.evaluation.bodies import worst_bodies
    from ..quality.evaluation.tables import tables

    if options.output:
        if options.output.suffix != ".json":
            fail(str(options.output), "not a name for figures", "it ends in .json")
        check_output(options.output, *options.models, *options.stage, options.index)
    need_fabric(options.fabric, options.material)
    asked = EvaluationOptions(stops=0, loop=0, linearised=0) if options.no_probes else EvaluationOptions()
    asked = replace(asked, solver=options.solver)
    results = evaluated(options, asked, partial(open_model, options, report), report)
    rows = [row for _, row in results.rows]
    worst = worst_bodies(rows)
    if not options.json:
        print(tables(rows, COLUMNS))
    told: dict[str, object] = {f"worst body, {one.place}": one.words for one in worst}
    if options.json:
        told = {"figures": results.figures, **({"worst bodies": [asdict(one) for one in worst]} if worst else {})}
    report(Result("evaluate", told))
    return EXIT_OK


@dataclass(frozen=True, eq=False)
class OpenedModel:
    """A model to evaluate, on one body.

    Attributes:
        file: as a model for that body.
        name: of its method; `on` returns that over takes.
        base: the skeleton of the first body of its family, and this one's ratio of heights; None for one body.
    """

    path: Path
    file: ModelFile
    name: str
    on: Callable[[TakeSet], Method]
    base: tuple[Skeleton, float] | None = None

    @property
    def garment(self) -> tuple[object, ...]:
        """What models must share to be measured on the same takes: mesh, rest shape, fabric and rate."""
        garment = self.file.scene.garment
        shape = garment.mesh.points.tobytes(), garment.rest_mesh.points.tobytes()
        return self.prim, *shape, self.file.fabric, self.file.config.fps

    @property
    def prim(self) -> str:
        """Name of the garment's prim."""
        return self.file.scene.garment.mesh.path.rpartition("/")[2]


Opener = Callable[[Path, Path, "torch.device"], OpenedModel]
"""Opens a file for the body of a stage, on a device."""


def open_model(
    options: argparse.Namespace, report: Reporter, path: Path, stage: Path, device: torch.device
) -> OpenedModel:
    """Open a model of 'ssilk train' for the body of a stage.

    Raises:
        SsilkError: the model cannot be read, or does not dress the character.
    """
    from ssilk_usd.opening.stage import open_stage

    from ..delivery.bake import in_fabric, worn
    from ..network.checkpoint import load_model, network
    from ..quality.evaluation.bodies import base_of
    from ..quality.evaluation.methods import Network

    whole = load_model(path)
    on = worn(whole, open_stage(stage), options.root)
    file, told = in_fabric(on.file, str(path), options.fabric, options.material)
    for event in (*on.told, *told):
        report(event)
    build = partial(Network, network(file).to(device))
    return OpenedModel(path, file, "ssilk", build, base_of(whole, on.member))


def evaluated(
    options: argparse.Namespace, asked: EvaluationOptions, opener: Opener, report: Reporter, *, exact: bool = False
) -> EvaluationResults:
    """Evaluate the models that options name, and write their output where they name one.

    Args:
        exact: see `evaluation.methods.EvaluationScene`.
    """
    from ..devices import select_device
    from ..physics.intersections.pairs import need_predicates
    from ..quality.evaluation.run import evaluate

    need_predicates()
    device = select_device(options.device)
    bodies, listed = named_bodies(options.stage), _listed(options)
    opened = {body: [opener(path, stage, device) for path in options.models] for body, stage in bodies.items()}
    results = _results(options, asked, [one for each in opened.values() for one in each], listed)
    known = results.known(report)
    groups = [(body, models, each) for body, each in opened.items() for models in _by_garment(each)]
    for number, (body, models, each) in enumerate(groups):
        dressed, methods = (
            _dressed(models[0].file, bodies[body], body, options, device, exact),
            _methods(models, each),
        )
        playlist = _playlist(options, dressed, listed, models[0].base, report)
        report(Started("evaluate", len(playlist.clips), {"garment": dressed.name, "clips": list(playlist.clips)}))
        paths = {method.name: str(one.path) for method, one in zip(methods, models)}
        try:
            before, kept = known[len(results.rows) :], results.parts(number)
            for row in evaluate(dressed, methods, playlist, asked, report, before, kept):
                results.add(paths.get(row.method), row)
        except KeyboardInterrupt:
            results.interrupted(report)
            raise
    results.finish()
    return results


def _by_garment(opened: Iterable[OpenedModel]) -> list[list[OpenedModel]]:
    """Return the models of each garment, in the order of the first of each."""
    groups: dict[tuple[object, ...], list[OpenedModel]] = {}
    for one in opened:
        groups.setdefault(one.garment, []).append(one)
    return list(groups.values())


def _methods(models: Sequence[OpenedModel], opened: Sequence[OpenedModel]) -> list[EvaluatedMethod]:
    """Return the methods of one garment, named after their files where several have one name.

    Args:
        opened: all on that body: garments of one name may be of other fabrics or rest shapes.
    """
    from ..quality.evaluation.methods import EvaluatedMethod

    alike = [one for one in opened if one.prim == models[0].prim]
    every = [one.name for one in alike]
    for told in (lambda path: path.stem, lambda path: path.with_suffix("")):
        count = Counter(every)
        every = [name if count[name] == 1 else f"{one.name} ({told(one.path)})" for name, one in zip(every, alike)]
    names = [name for name, one in zip(every, alike) if one in models]
    return [
        EvaluatedMethod(name, one.file.joints, one.on, one.file.config.descriptors)
        for name, one in zip(names, models)
    ]


def _dressed(
    file: ModelFile, stage: Path, body: str, options: argparse.Namespace, device: torch.device, exact: bool
) -> EvaluationScene:
    """Put the garment of a model on the character of a stage."""
    from ssilk_usd.opening.stage import open_stage

    from ..delivery.bake import worn
    from ..quality.evaluation.methods import EvaluationScene

    scene = worn(file, open_stage(stage), options.root).scene
    return EvaluationScene(scene, file.fabric, file.config.fps, device, exact=exact, character=body)


@dataclass(frozen=True)
class ListedClips:
    """Names of clips by split, the files of the clips by name, and the motions of the training."""

    splits: dict[str, list[str]]
    files: dict[str, Path]
    seen: list[Path]


def _playlist(
    options: argparse.Namespace,
    dressed: EvaluationScene,
    listed: ListedClips,
    base: tuple[Skeleton, float] | None,
    report: Reporter,
) -> EvaluationClips:
    """Read the clips that options name, and find the simulator's shots of them.

    Args:
        base: as `OpenedModel` has it.
    """
    from ssilk_usd.reading.motion import read_motion, read_motions

    from ..quality.evaluation.asked import EvaluationClips
    from ..scene.family import has_bones, motion_on
    from ._reference import References

    skeleton = dressed.scene.character.skeleton
    reference = None
    if options.reference:
        vertices, folder = dressed.scene.garment.mesh.vertex_count, options.reference / dressed.character
        reference = References(folder, dressed.prim, vertices, dressed.fps)
    clips = {name: read_motion(path, skeleton) for name, path in listed.files.items()}
    if base and (moved := [name for name, motion in clips.items() if has_bones(motion, base[0])]):
        clips |= {name: motion_on(clips[name], base[0], skeleton, base[1]) for name in moved}
        text = (
            f"{len(moved)} of {len(clips)} clips have the bones of the model's first body, and are played on its own"
        )
        report(Message(f"{dressed.scene.character.path}: {text}"))
    return EvaluationClips(
        clips=clips,
        splits=listed.splits,
        simulated=reference.clips & listed.files.keys() if reference else frozenset(),
        read=reference.read if reference else None,
        seen=read_motions(listed.seen, skeleton),
    )


def _listed(options: argparse.Namespace) -> ListedClips:
    """Find the clips that options name."""
    from ssilk_usd.reading.motion import motion_files

    from ..quality.evaluation.splits import SPLITS, chosen, read_index, splits_of

    folder: Path = options.motions
    need_motion_folder(folder)
    files = {path.stem: path for path in motion_files([folder])}
    index = read_index(options.index) if options.index else []
    splits = splits_of(index, options.clips) if options.index else {"all": options.clips or list(files)}
    if not splits:
        fail(str(options.index), f"no clip of {', '.join(SPLITS)} is chosen", "one at least is needed")
    names = dict.fromkeys(name for split in splits.values() for name in split)
    missing = sorted(names.keys() - files.keys())
    if missing:
        fail(
            str(folder),
            f"{len(missing)} clips are missing ({', '.join(missing[:3])})",
            f"it holds {', '.join(list(files)[:3])} and so on",
        )
    seen = [files[name] for name in chosen(index, "train") if name in files]
    return ListedClips(splits, {name: files[name] for name in names}, seen)


def _results(
    options: argparse.Namespace, asked: EvaluationOptions, opened: Sequence[OpenedModel], listed: ListedClips
) -> EvaluationResults:
    """Return the results to write, with their provenance; their inputs are told by content, wherever they lie."""
    from ..files import sha256, split_body
    from ..quality.evaluation.results import EvaluationResults
    from ._measured import contents, measured_inputs
    from ._reference import shots

    if not options.output:
        return EvaluationResults(None, {}, {})
    inputs = measured_inputs(
        models=options.models,
        stage=options.stage[0],
        clips=listed.files,
        device=options.device,
        others={
            "motions of the training": listed.seen,
            **({"further bodies": options.stage[1:]} if options.stage[1:] else {}),
        },
    )
    garments = dict.fromkeys(one.prim for one in opened) if options.reference else ()
    simulated = {
        f"{body}/{name}" if body else name: shots(options.reference / body, name)
        for body in named_bodies(options.stage)
        for name in garments
    }
    settings = {**asdict(asked), "clips": options.clips, "root": options.root}
    if options.fabric or options.material:
        settings |= {"fabric": options.fabric, "material": options.material}
    return EvaluationResults(
        options.output,
        {
            "units": "SI",
            "models": {str(path): digest for path, (_, digest) in zip(options.models, inputs["models"])},
            "stage": {str(stage): sha256(split_body(str(stage))[0]) for stage in options.stage},
            "reference": options.reference and str(options.reference),
            "options": settings,
            "hardware": inputs["hardware"],
            "versions": inputs["versions"],
        },
        {
            **inputs,
            "splits": listed.splits,
            "simulated shots": {
                name: dict(zip(used, contents(files[clip] for clip in used)))
                for name, files in simulated.items()
                if (used := [clip for clip in files if clip in listed.files])
            },
            "options": settings,
        },
    )
