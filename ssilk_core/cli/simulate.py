# SPDX-License-Identifier: Apache-2.0
"""Simulate a garment, or an outfit, over motions without a network: slow and accurate, the reference.

Every frame minimises, over all vertices, the energy that networks are trained with. The result is a shot with the
garment on joints and blendshapes of the shot's own, within 1 mm (RMS) and 5 mm (any vertex) of the simulated points,
beside the moving body. --points writes the points themselves, as references are that models are compared with.
Several motions advance together, each into a file of its own in a folder: a GPU takes about as long for many as for
one. --range starts at rest in its first frame. Each file appears when its shot is finished. The same command, given
again after an interruption, simulates only what is missing; delete a file to simulate it again.

A list as 'ssilk wardrobe' takes it (.toml) in place of the stage is simulated as an outfit: its garments move
together, and push each other with equal forces. Outer garments start settled off those that 'over' names. Each
garment of each shot gets a file of its own, FOLDER/SHOT/GARMENT.usdc.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..delivery.bake import naming
from ..delivery.bake.request import parse_range
from ..delivery.bake.world import ShotSurroundings, asked_world
from ..errors import EXIT_OK, SsilkError, fail
from ..events import Countdown, Message, Reporter, Result, Started
from ..files import replacing, split_location
from ..scene.assets.reshaped import reshaped
from ..scene.fabrics import Fabric
from .options.fabric import add_fabric, asked_fabric
from .options.files import LIST, check_output
from .options.motions import add_range, tell_shapes, with_shapes
from .options.numbers import RATE, NumberRange
from .options.scene import STAGE, add_garment, garment_location, garment_under_riders
from .options.world import add_world

if TYPE_CHECKING:
    import torch
    from ssilk_usd.reading.world import AskedWorld
    from ssilk_usd.shots.points import PointCache

    from ..delivery.bake.counted import MetWorld
    from ..delivery.bake.result import BakeResult, ShotShapes
    from ..delivery.bake.stated import ShotCounts
    from ..physics.intersections.figures import SelfIntersections
    from ..physics.simulate import SimulationOptions
    from ..physics.simulate.simulator import SimulatedFrame
    from ..physics.skin.figures import ShownSkin
    from ..physics.world.sunk import SunkCloth
    from ..scene.assets import Floats, Motion, Scene, ShotWorld
    from ._simulated_outfit import SimulatedGarment


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("stage", type=Path, metavar="STAGE|LIST", help=STAGE + ", or a list of garments (.toml)")
    add_garment(verb)
    verb.add_argument(
        "--motion", type=Path, nargs="+", required=True, metavar="SHOT[:/PRIM]", help="USD files with motions"
    )
    verb.add_argument(
        "-o", "--output", type=Path, required=True,
        help="shot to write (.usdc, .usd or .usda), or a folder where there are several motions, or garments",
    )  # fmt: skip
    verb.add_argument("--shot-name", metavar="PATTERN",
                      help="name of each file in a folder, such as '{parent}_{stem}' (default: the motion file's, "
                           f"and the prim's where one is named); {naming.FIELDS}")  # fmt: skip
    add_range(verb, "frames to simulate", "all")
    add_fabric(verb)
    add_world(verb, "in the simulation")
    verb.add_argument("--fps", type=RATE, default=30.0, help="frames per second (default 30, as models are trained)")
    verb.add_argument("--tolerance", type=NumberRange(1e-9, 1e3), default=1e-2, metavar="G",
                      help="RMS acceleration that may be left in the cloth, in g (default 0.01)")  # fmt: skip
    verb.add_argument("--iterations", type=NumberRange(1, 10**6, int), default=100, metavar="N",
                      help="most iterations of the solver in each frame, or part of one (default 100)")  # fmt: skip
    verb.add_argument("--self-contact", action="store_true",
                      help="keep loose cloth from passing through its own garment; takes longer")  # fmt: skip
    verb.add_argument(
        "--batch",
        type=NumberRange(1, 10**6, int),
        default=64,
        help="motions that advance together (default 64)",
    )
    verb.add_argument("--sequence", type=NumberRange(1, 10**6, int), metavar="FRAMES",
                      help="restart from rest after so many frames (paper: 512; default: never)")  # fmt: skip
    verb.add_argument(
        "--points", action="store_true", help="write time-sampled points instead of joints and blendshapes"
    )
    verb.add_argument("--no-body", action="store_true", help="leave the body meshes out")
    verb.add_argument("--device", default="cpu", help="where it runs (default cpu)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Simulate and write."""
    from ssilk_usd.reading.frame_range import read_in_range
    from ssilk_usd.reading.motion import motion_files

    from ..devices import select_device
    from ..physics.simulate import SimulationOptions
    from ..physics.simulate.newton import SolverOptions
    from ._simulated_outfit import garments_of, outfit_options

    frames = parse_range(options.range or "all")
    asked = asked_world(options.collider, options.wind, options.gusts, options.gravity)
    is_list = options.stage.suffix == LIST
    every = outfit_options(options) if is_list else {"": options}
    outputs = {
        name: _outputs(options.output, list(map(str, options.motion)), options.shot_name, name) for name in every
    }
    stage, worn = next(iter(every.values())).stage, [garment_location(own)[0] for own in every.values()]
    for output in (output for each in outputs.values() for output in each):
        check_output(output, stage, *worn, *motion_files(options.motion))
    device = select_device(options.device)
    for own in every.values():
        asked_fabric(own)
    garments = garments_of(every, report)
    settings = SimulationOptions(
        fps=options.fps,
        batch=options.batch,
        sequence=options.sequence,
        self_contact=options.self_contact,
        solver=SolverOptions(tolerance=options.tolerance, iterations=options.iterations),
        quasi_static_solver=SolverOptions(tolerance=options.tolerance, iterations=150),
    )
    character, first = garments[0].worn.scene.character, garments[0].options
    read = [read_in_range(str(path), character.skeleton, frames) for path in options.motion]
    tell_shapes(first, read, report)
    motions = [with_shapes(first, each, path, character) for each, path in zip(read, options.motion)]
    for motion in motions:
        if moved := reshaped(character, motion):
            report(Message(f"{motion.path}: {'; '.join(map(str, moved))}; cloth meets it so, and it is written so"))
    together = _together(garments)
    shots = [
        [
            _Shot(output, motion, {**_provenance(each.options, path, each.worn.fabric), **together}, str(path), asked)
            for output, motion, path in zip(outputs[each.name], motions, options.motion)
        ]
        for each in garments
    ]
    named = not is_list and outputs[""] == [options.output]
    rows = [row for row in zip(*shots) if named or not all(shot.is_done for shot in row)]
    found = _written(garments, [list(each) for each in zip(*rows)], settings, device, report) if rows else {}
    left = {"current": len(motions) - len(rows)} if len(rows) < len(motions) else {}
    files = ", ".join(str(output) for each in outputs.values() for output in each)
    report(Result("simulate", {"shots": files, **left, **found}))
    return EXIT_OK


@dataclass(frozen=True, eq=False)
class _Shot:
    """A shot to simulate: its file, the character's motion, the provenance that the file states, where the motion
    was read, and what was asked for around the character."""

    output: Path
    motion: Motion
    provenance: dict[str, str | float]
    source: str
    asked: AskedWorld | None

    @property
    def is_done(self) -> bool:
        """Return whether the file is there and was simulated from the same."""
        from ssilk_usd.reading.facts import read_provenance

        if not self.output.is_file():
            return False
        found = read_provenance(self.output).get("simulated")
        if found == {**self.provenance, "points": True} and not self.provenance["points"]:
            fail(
                str(self.output),
                "it holds the points of this simulation",
                "joints and blendshapes would replace them",
                "give --points or another output; 'ssilk skin' makes joints and blendshapes of points",
            )
        return found == self.provenance


def _outputs(output: Path, motions: Sequence[str], pattern: str | None, garment: str = "") -> list[Path]:
    """Return the file that each motion's shot is written to.

    Args:
        garment: its name in an outfit; "" for a garment that is no part of a list.
    """
    from ssilk_usd.opening.stage import LAYER_SUFFIXES

    if output.suffix in LAYER_SUFFIXES and garment:
        fail(str(output), "one file for a list of garments", "each is a file of its own", "name a folder")
    if output.suffix in LAYER_SUFFIXES:
        if len(motions) != 1:
            fail(
                str(output), f"one file for {len(motions)} motions", "each shot is a file of its own", "name a folder"
            )
        return [output]
    for motion, count in Counter(motions).items():
        if count > 1:
            fail("--motion", f"'{motion}' is named twice", "a shot is simulated once")
    names = [_name(motion, pattern) for motion in motions]
    naming.need_unique(zip(names, motions, strict=True), "--motion", "shot", "--shot-name")
    return [output / name / f"{garment}.usdc" if garment else output / f"{name}.usdc" for name in names]


def _name(motion: str, pattern: str | None) -> str:
    given = naming.pattern_name(pattern, motion, "--shot-name") if pattern else naming.location_stem(motion)
    return naming.file_name(given)


def _written(
    garments: Sequence[SimulatedGarment],
    shots: Sequence[Sequence[_Shot]],
    settings: SimulationOptions,
    device: torch.device,
    report: Reporter,
) -> dict[str, object]:
    """Simulate the shots of each garment into open files, frame by frame; return figures for people."""
    from ..physics.simulate import Simulator, shots_of
    from ._simulated_outfit import OutfitCounter

    first, *others = (each.worn for each in garments)
    simulator = Simulator(first.scene, first.fabric, settings, over=others, device=device, report=report)
    motions = [shot.motion for shot in shots[0]]
    stage = str(garments[0].options.stage)
    around = [ShotSurroundings(shot.source, stage, first.scene, shot.motion, shot.asked) for shot in shots[0]]
    worlds = [each.read(report) for each in around]
    played = shots_of(motions, first.scene.character.skeleton, settings)
    total = sum(motion.frame_count for motion in played)
    report(Started("simulate", total, {"outputs": [str(shot.output) for own in shots for shot in own]}))
    figures = _Figures(settings.solver.tolerance)
    with ExitStack() as stack:
        caches = [
            _Caches(stack, each.options, own, each.worn.scene, played, worlds, report)
            for each, own in zip(garments, shots)
        ]
        counter = OutfitCounter(garments, [Path(split_location(shot.source)[0]).stem for shot in shots[0]])
        told = Countdown(total, report)
        for frame in simulator.frames(motions, worlds):
            figures.add(frame)
            rows = [rows for rows, _ in simulator.potential.garments]
            points = [frame.points[own] for own in rows]
            for cache, own in zip(caches, points):
                cache.write(frame.shot, frame.number, own)
            counter.add(frame.shot, frame.number, points)
            told()
    fits = {
        f"{each.name}: {what}" if each.name else what: value
        for each, cache in zip(garments, caches)
        for what, value in cache.figures().items()
    }
    return {**figures.of_all(total), **fits, **counter.figures()}


class _Caches:
    """The point caches of shots being simulated: the first frame opens one, and the last makes it a file.

    Where joints and blendshapes are asked for, the cache is a temporary file that becomes these.
    """

    def __init__(
        self,
        stack: ExitStack,
        options: argparse.Namespace,
        shots: Sequence[_Shot],
        scene: Scene,
        played: Sequence[Motion],
        worlds: Sequence[ShotWorld | None],
        report: Reporter,
    ) -> None:
        from ssilk_usd.opening.stage import open_stage
        from ssilk_usd.units import StageUnits

        from ..delivery.bake import riders_of

        self.stack, self.options, self.shots, self.scene, self.played = stack, options, shots, scene, played
        self.worlds = worlds
        stage, mesh = open_stage(options.stage), scene.garment.mesh
        self.units = StageUnits.of(stage)
        self.riders = riders_of(stage, mesh, options.root, report, garment_under_riders(options, mesh))
        if self.riders and options.points:
            report(
                Message(f"{options.stage}: --points writes the garment alone, without what rides on it", "warning")
            )
        self.folder = Path(stack.enter_context(TemporaryDirectory(prefix="ssilk_")))
        self.open: dict[int, tuple[ExitStack, PointCache]] = {}
        self.report = report
        self.fits: list[ShotShapes] = []
        self.shown: list[ShownSkin] = []
        self.crossed: list[SelfIntersections] = []
        self.sunk: list[SunkCloth] = []

    def write(self, shot: int, frame: int, points: Floats) -> None:
        """Write the garment's points (V, 3) [m] of one frame."""
        if shot not in self.open:
            self.open[shot] = self._opened(shot)
        own, cache = self.open[shot]
        cache.write(frame, points)
        if cache.written.all():
            del self.open[shot], cache
            own.close()
            if self.options.points:
                self._count(shot, self._path(shot))
            else:
                self._skin(shot)

    def figures(self) -> dict[str, object]:
        """Return how far joints and blendshapes are from the points, at most, and what the points would take.

        And how much covered skin shows, how many triangles intersect others, and how much cloth is in colliders, in
        the shots in which most is.
        """
        where = "" if len(self.shots) == 1 else "most in a shot: "
        told = {
            f"{where}{name}": value
            for found in (self.shown, self.crossed, self.sunk)
            for name, value in _most(found).items()
        }
        if not self.fits:
            return told
        return {
            "shapes of a shot, at most": max(fit.count for fit in self.fits),
            "joints lose, RMS [mm]": float(f"{max(fit.rms_mm for fit in self.fits):.4g}"),
            "joints lose, at most [mm]": float(f"{max(fit.largest_mm for fit in self.fits):.4g}"),
            "bytes": sum(shot.output.stat().st_size for shot in self.shots if shot.output.is_file()),
            "bytes of the points alone": sum(fit.point_bytes for fit in self.fits),
            **told,
        }

    def _path(self, shot: int) -> Path:
        """Return where the points of a shot are written."""
        output = self.shots[shot].output
        return output if self.options.points else self.folder / f"{shot}{output.suffix}"

    def _met(self, shot: int) -> MetWorld | None:
        """Return what surrounds the character of a shot; None where nothing does."""
        from ..delivery.bake.counted import MetWorld

        world, fps = self.worlds[shot], self.played[shot].fps
        return MetWorld(world, lambda frame: frame / fps) if world else None

    def _count(self, shot: int, path: Path) -> None:
        """Count in the file of a shot of points, and let it say what was found."""
        from ..delivery.bake.counted import state_counts

        name = Path(split_location(self.shots[shot].source)[0]).stem
        scene, motion, met = self.scene, self.played[shot], self._met(shot)
        self._keep(state_counts(path, scene, motion, name=name, device=self.options.device, met=met))

    def _keep(self, found: ShotCounts | BakeResult) -> None:
        self.shown += [found.shown_skin] if found.shown_skin else []
        self.crossed += [found.intersections] if found.intersections else []
        self.sunk += [found.sunk] if found.sunk else []

    def _skin(self, shot: int) -> None:
        """Turn the points of a shot into joints and blendshapes."""
        from ssilk_usd.shots.trajectories import MeshTrajectories

        from ..delivery.bake import rig_deformer, skin_trajectories

        asked, path = self.shots[shot], self._path(shot)
        try:
            points = MeshTrajectories(str(path), self.scene.garment.mesh.vertex_count)
            result = skin_trajectories(
                rig_deformer(self.scene),
                self.played[shot],
                points,
                asked.output,
                units=self.units,
                origin={},
                about={"simulated": asked.provenance},
                riders=self.riders,
                met=self._met(shot),
                include_body=not self.options.no_body,
                device=self.options.device,
                report=self.report,
            )
        except BaseException as error:  # what took hours is kept, whatever happens to the fit
            with replacing(asked.output) as temporary:
                shutil.copyfile(path, temporary)
            if not isinstance(error, SsilkError):
                raise
            self.report(Message(f"{error} They are written as points.", "warning"))
            self._count(shot, asked.output)
        else:
            assert result.shapes is not None
            self.fits.append(result.shapes)
            self._keep(result)
        path.unlink()

    def _opened(self, shot: int) -> tuple[ExitStack, PointCache]:
        from ssilk_usd.shots.points import point_cache

        from ..delivery.bake.origin import met_metadata

        asked, own = self.shots[shot], self.stack.enter_context(ExitStack())
        cache = own.enter_context(
            point_cache(
                self._path(shot),
                self.scene,
                self.played[shot],
                units=self.units,
                include_body=not self.options.no_body,
                provenance={"simulated": asked.provenance, **met_metadata(self.worlds[shot], asked.output)},
            )
        )
        return own, cache


def _most(found: Sequence[ShownSkin | SelfIntersections | SunkCloth]) -> Mapping[str, object]:
    """Return figures of the shot in which the mean is highest, for people; none of no shot."""
    most = max(found, key=lambda each: each.mean, default=None)
    return most.summary("time code") if most else {}


def _provenance(options: argparse.Namespace, motion: Path, fabric: Fabric) -> dict[str, str | float]:
    """Return everything that decides what a shot's file holds."""
    from ..delivery.bake.inputs import stage_contents

    garment, _ = garment_location(options)
    names = ("fps", "tolerance", "iterations", "points", "no_body")
    lists = ("material", "body")
    return {
        "stage": str(options.stage),
        "motion": str(motion),
        "garment": str(options.garment or ""),
        "root": options.root or "",
        "contents": " ".join(stage_contents(str(path)).digest for path in (options.stage, garment, motion)),
        "sequence": options.sequence or 0,
        "fabric": fabric.name,
        **({"range": options.range} if options.range not in (None, "all") else {}),
        **({"self_contact": "on"} if options.self_contact else {}),
        **{name: asked for name in ("wind", "gusts", "gravity") if (asked := getattr(options, name)) is not None},
        **({"collider": ", ".join(options.collider)} if options.collider else {}),
        **{name: getattr(options, name) for name in names},
        **{name: ", ".join(getattr(options, name)) for name in lists},
    }  # fmt: skip


def _together(garments: Sequence[SimulatedGarment]) -> dict[str, str | float]:
    """Return what decides how garments move together; nothing of one alone."""
    from ..delivery.bake.inputs import stage_contents

    if len(garments) == 1:
        return {}
    told = [
        f"{each.name} {stage_contents(str(garment_location(each.options)[0])).digest} {each.worn.fabric} "
        f"over {','.join(each.over)}"
        for each in garments
    ]
    return {"outfit": "; ".join(told)}


class _Figures:
    """Figures of a simulation."""

    def __init__(self, tolerance: float) -> None:
        self.tolerance, self.solved, self.iterations, self.fixed = tolerance, 0, 0, 0
        self.start, self.settled = time.monotonic(), 0.0

    def add(self, frame: SimulatedFrame) -> None:
        self.settled = self.settled or time.monotonic() - self.start  # before the first frame cloth comes to rest
        self.solved += frame.residual <= self.tolerance
        self.iterations += frame.iterations
        self.fixed += frame.fixed

    def of_all(self, frames: int) -> dict[str, object]:
        """Return figures to show."""
        seconds = time.monotonic() - self.start - self.settled
        return {
            "frames": frames,
            "within the tolerance": f"{self.solved / frames:.1%}",
            "Newton iterations per frame": round(self.iterations / frames, 1),
            "fixed vertices per frame": round(self.fixed / frames, 1),
            "seconds until the first frame": float(f"{self.settled:.3g}"),
            "seconds per frame": float(f"{seconds / frames:.3g}"),
        }
