# SPDX-License-Identifier: Apache-2.0
"""Measure what speed and size cost in accuracy, for all that can be changed without training again.

Blendshapes, proxies, influences, precision, frame rate, refinement, iterations of the solver in latents and quality
levels are varied one at a time, and the simulator goes on by itself from the network's first two states. Networks of
several sizes and garments can be compared: further models of a garment are measured whole and at their levels. Costs
are the times of playing and of the solver, memory, and the sizes of model and shot. Accuracy is energy, collisions,
skin that shows, and the distance of vertices and velocities from the whole model. All are measured on the same
frames, the first ones of each clip, because the simulator takes seconds for each on a processor. A shot of a solver
has the blendshapes that these frames need. Times are of this machine and of the first clip. --output writes each row
when it is measured, and says that it is unfinished until the last. The same command, given again, goes on from there.
A file of other models, motions or settings is begun anew. A variant that fails is told, the file stays unfinished,
and the exit code is 4 then.
"""

from __future__ import annotations

import argparse
import platform
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import EXIT_OK, EXIT_TASKS, fail
from ..events import Reporter, Result, Started
from ._measured import measured_inputs
from .options.fabric import add_known_fabric, asked_known_fabric
from .options.files import check_output
from .options.motions import need_motion_folder
from .options.numbers import NumberRange

if TYPE_CHECKING:
    from ..delivery.bake import BakeRollout
    from ..network.checkpoint import ModelFile
    from ..quality.cost import ShotBytes
    from ..quality.evaluation.methods import EvaluationScene
    from ..quality.trade.measure import StoredTake, VariantMeter, Weigh
    from ..scene.assets import Motion

CLIPS = 2  # are measured on where --clips names none
FRAMES = 60  # two seconds of each, for which the simulator of a cape takes a quarter of an hour on a processor


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="models on one skeleton")
    verb.add_argument("--stage", type=Path, required=True, help="USD file with the character")
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    add_known_fabric(verb)
    verb.add_argument("--motions", type=Path, required=True, metavar="FOLDER",
                      help="motion files; models are measured on --clips and reduced to fit the others")  # fmt: skip
    verb.add_argument(
        "--clips", nargs="+", default=[], metavar="NAME", help="measure on these (default: the first two)"
    )
    verb.add_argument("--frames", type=NumberRange(4, 10**6, int), default=FRAMES, metavar="N",
                      help="measure on the first N frames of each clip, at the models' rate (default "
                           f"{FRAMES})")  # fmt: skip
    verb.add_argument("--no-refine", action="store_true",
                      help="leave out all solvers, which take most of the time")  # fmt: skip
    verb.add_argument("-o", "--output", type=Path, help="figures to write (.json), and a plot beside them (.png)")
    verb.add_argument("--device", default="cpu", help="where PyTorch and the solver run (default cpu)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Sweep; return 0, or 4 where variants could not be measured."""
    from ..physics.intersections.pairs import need_predicates
    from ..quality.charts import write_chart
    from ..quality.trade.collision_cost import measure_collisions
    from ..quality.trade.plot import trade_panels
    from ..quality.trade.sweep import Results, sweep
    from ..quality.trade.table import caption, collision_table, table
    from ..quality.trade.variants import SIMULATOR, other_network, variants

    if options.output:
        if options.output.suffix != ".json":
            fail(str(options.output), "not a name for figures", "it ends in .json")
        check_output(options.output, *options.models)
    need_predicates()
    bench = Bench(options, report)
    results = Results(options.output, bench.asked)
    results.resume(report)
    report(Started("trade", 0, {"clips": list(bench.clips), "frames": bench.frames}))
    failed = 0
    try:
        for path, file in bench.files.items():
            meter = bench.meter(path, file)
            results.collision_costs = results.collision_costs or measure_collisions(
                meter.dressed, meter.take_set, meter.whole
            )
            size, fps = meter.reducer.whole, file.config.fps
            first = path in bench.first_of_garment
            tried = variants(size, fps, solved=not options.no_refine) if first else other_network(size, fps)
            failed += sweep(meter, tried, results, report)
        if not failed:
            results.finish()
    except KeyboardInterrupt:
        results.kept.tell_kept(len(results.points), report)
        raise
    finally:  # an interrupted sweep shows what it has
        if results.points and options.output:
            panels = trade_panels(results.points, bench.frames)
            write_chart(options.output.with_suffix(".png"), panels, size=(4.6, 3.6))
        if not options.json:
            tables = table(results.points), collision_table(results.collision_costs)
            simulated = any(point.swept == SIMULATOR for point in results.points)
            print(caption(bench.frames, simulated=simulated), *tables, sep="\n")
    report(Result("trade", {"points": [asdict(point) for point in results.points]} if options.json else {}))
    return EXIT_TASKS if failed else EXIT_OK


class Bench:
    """The scene and the motions that all models of a sweep are measured on.

    Attributes:
        clips: motions to measure on, by name.
        takes: what is measured of them.
        frames: how many frames that is of each clip.
        others, other_paths: motions that models are reduced for, and their files.
        first_of_garment: the first model of each garment, with the garment's name.
        asked: what distinguishes one sweep from another.
    """

    def __init__(self, options: argparse.Namespace, report: Reporter) -> None:
        from ssilk_usd.opening.stage import open_stage

        from ..delivery.bake import in_fabric, worn
        from ..devices import select_device
        from ..network.checkpoint import load_model
        from ..quality.evaluation.takes import takes_of, within

        self.options, self.device = options, select_device(options.device)
        self.files: dict[Path, ModelFile] = {path: load_model(path) for path in options.models}
        for path, file in self.files.items():
            if file.bodies:
                on = worn(file, open_stage(options.stage), options.root)
                self.files[path] = on.file
                for event in on.told:
                    report(event)
            own, in_words = in_fabric(self.files[path], str(path), options.fabric, options.material)
            self.files[path] = own
            for event in in_words:
                report(event)
        first = next(iter(self.files.values()))
        names = [path.stem for path in self.files]
        if len(set(names)) != len(names):
            fail(
                ", ".join(map(str, self.files)),
                "several models have one name",
                "points are identified by the model's file name",
                "rename a file",
            )
        self.first_of_garment: dict[Path, str] = {}
        for path, file in self.files.items():
            self._check(path, file, first)
        self.paths, self.other_paths = self._motions()
        self.others = [self._read(path, first) for path in self.other_paths]
        self.clips = {name: self._read(path, first) for name, path in self.paths.items()}
        skeleton = first.scene.character.skeleton
        fps = first.config.fps
        cut = [within(takes_of(name, clip, skeleton, fps), options.frames) for name, clip in self.clips.items()]
        self.takes = [take for own in cut for take in own]
        self.frames = {name: sum(take.frame_count for take in own) for name, own in zip(self.clips, cut)}
        self.asked = self._asked() if options.output else {}

    def _asked(self) -> dict[str, Any]:
        return {
            **measured_inputs(
                models=self.options.models,
                stage=self.options.stage,
                clips=self.paths,
                device=self.options.device,
                others={"motions that models are reduced for": self.other_paths},
            ),
            "clips": list(self.clips),
            "frames": self.frames,
            "processor": platform.processor() or platform.machine(),
            "root": self.options.root,
            **asked_known_fabric(self.options),
        }

    def _check(self, path: Path, file: ModelFile, first: ModelFile) -> None:
        """Check that a model can be compared with the first, and note it if it is the first of its garment."""
        if not (
            file.scene.character.skeleton.joint_names == first.scene.character.skeleton.joint_names
            and file.config.fps == first.config.fps
        ):
            fail(str(path), "a model of another skeleton, or rate", "one is allowed", "measure it by itself")
        mesh = file.scene.garment.mesh
        name = mesh.path.rpartition("/")[2]
        same = [other for other, known in self.first_of_garment.items() if known == name]
        if not same:
            self.first_of_garment[path] = name
        elif self.files[same[0]].scene.garment.mesh.points.tobytes() != mesh.points.tobytes():
            fail(
                str(path),
                f"its garment is called {name}, as is another one of {same[0]}",
                "names tell garments apart",
                "rename a prim",
            )

    def meter(self, path: Path, file: ModelFile) -> VariantMeter:
        """Return the meter of a model on all takes, reduced for other motions."""
        from ..quality.evaluation.methods import build_take_set
        from ..quality.reduction import Reducer
        from ..quality.trade.measure import VariantMeter

        dressed = self._dressed(file)
        take_set = build_take_set(self.takes, dressed, file.joints, file.config.descriptors)
        return VariantMeter(path.stem, Reducer(file, self.others), dressed, take_set, self._weigh(path))

    def _dressed(self, file: ModelFile) -> EvaluationScene:
        """Put a garment on the character of the stage."""
        from ssilk_usd.opening.stage import open_stage

        from ..delivery.bake import worn
        from ..quality.evaluation.methods import EvaluationScene

        scene = worn(file, open_stage(self.options.stage), self.options.root).scene
        return EvaluationScene(scene, file.fabric, file.config.fps, self.device)

    def _weigh(self, path: Path) -> Weigh:
        """Return a function that gives the size of a model's shots of the first clip, without the body."""
        from ..delivery.bake import BakeRequest, load_rollout, shot_bytes, stored_bytes, with_model

        motion, stage = str(next(iter(self.paths.values()))), str(self.options.stage)
        request = BakeRequest(
            model=str(path), stage=stage, motion=motion, range="all", root=self.options.root,
            fabric=self.options.fabric, material=tuple(self.options.material),
        )  # fmt: skip

        @lru_cache(4)
        def rollout(fps: float) -> BakeRollout:
            return load_rollout(replace(request, fps=fps))

        def weigh(file: ModelFile, fps: float, stored: StoredTake | None) -> ShotBytes:
            if stored is not None:
                return stored_bytes(rollout(fps), stored.motion, stored.shot)
            return shot_bytes(with_model(rollout(fps), file), ".usdc", include_body=False)

        return weigh

    def _motions(self) -> tuple[dict[str, Path], list[Path]]:
        """Return the files of the clips to measure on, and those to reduce models for: the others, if any."""
        from ssilk_usd.reading.motion import motion_files

        folder: Path = self.options.motions
        need_motion_folder(folder)
        files = {path.stem: path for path in motion_files([folder])}
        names = self.options.clips or list(files)[:CLIPS]
        missing = sorted(set(names) - files.keys())
        if missing:
            fail(
                str(folder),
                f"no clip is called {', '.join(missing)}",
                f"it holds {', '.join(list(files)[:3])} and so on",
            )
        others = [path for name, path in files.items() if name not in names] or list(files.values())
        return {name: files[name] for name in names}, others

    def _read(self, path: Path, file: ModelFile) -> Motion:
        from ssilk_usd.reading.motion import read_motion

        return read_motion(path, file.scene.character.skeleton)
