# SPDX-License-Identifier: Apache-2.0
"""The reference simulator beside the physics engine newton: the same garment, body and motions in one run.

    pip install newton
    python benchmarks/peers.py cape_stage.usdc --motions FOLDER --clips 01_14 dm_jump --device cuda

Every method starts each clip with the same cloth, at rest but for what few iterations leave, and with the velocity
of linear blend skinning. Clips run side by side, and methods in turn, `--runs` times over. What is timed is a frame,
all clips of it, without what compiles, captures or builds a method; on a processor, in processor time, which other
programs change less. The engine finds the bodies' vertices ready on its device, while the simulator's time includes
posing and skinning them. Figures are counted alike.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from helpers.clock import now
from helpers.reports import RESULTS, provenance, table, write_document
from helpers.subjects import parsed
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene

from ssilk_core.authoring.setup.prepare import prepare_scene
from ssilk_core.devices import select_device
from ssilk_core.errors import SsilkError, fail
from ssilk_core.events import TextReporter
from ssilk_core.physics.collision import Contacts
from ssilk_core.physics.energy import TERMS, GarmentEnergy
from ssilk_core.physics.energy.frames import energy_terms
from ssilk_core.physics.intersections.cloth import ClothIntersections
from ssilk_core.physics.simulate import SimulationOptions, Simulator
from ssilk_core.physics.simulate.characters import MotionSpan, PosedCharacters, split_into_spans
from ssilk_core.physics.simulate.newton import SolverOptions
from ssilk_core.physics.simulate.simulator import StepHistory
from ssilk_core.scene.assets import Floats, Motion, Scene
from ssilk_core.scene.fabrics import Fabric

if TYPE_CHECKING:
    from helpers.newton_cloth import PeerSettings, Shots

PASSES, APART = "passes", "is kept apart"
SHOWN = ("stretch", "gravity", "inertia", "collision")  # of the terms
HEADER = ("method", "cloth through cloth", "ms a frame, median", "quartiles", "medians of runs",
          "triangles that intersect others, mean [%]", "worst [%]", "vertices inside the body, mean [%]", "worst [%]",
          "L_tot [J]", *(f"{term} [J]" for term in SHOWN))  # fmt: skip
AT_REST, WARM_UP = 15, 3  # iterations in the first pose, and frames that are not timed
EVERY = 2  # frames, of which one is looked at for intersections
# Substeps of a frame and iterations of each: 600 steps a second as in the engine's examples of cloth (60 frames of
# ten), with the fewest iterations that these take; more of these; and few substeps.
VBD, STYLE3D = ((20, 4), (20, 10), (4, 50)), ((20, 10),)


def clock(device: torch.device) -> float:
    """Return a time [s]: of a GPU once its work is done, of a processor what this process has had of it."""
    return now(device) if device.type == "cuda" else time.process_time()


@dataclass(frozen=True, eq=False)
class Posed:
    """The character of all clips, as methods and figures need it, clip by clip.

    Attributes:
        bodies, skinned: in world space [m], shapes (F, B, 3) and (F, V, 3).
        roots: shape (F, 3).
        matrices: skinning matrices about the root of each clip's first frame, shape (J, 3, 4, F).
    """

    bodies: list[Floats]
    skinned: list[Floats]
    roots: list[Floats]
    matrices: list[torch.Tensor]

    @classmethod
    def of(cls, simulator: Simulator, spans: list[MotionSpan], frames: int) -> Posed:
        """Return the character in the first frames of spans."""
        found = cls([], [], [], [])
        for span in spans:
            poses = simulator.poser.pose(span.motion.rotations[:frames], span.motion.translations[:frames])
            roots, matrices = poses.root.T.cpu().numpy(), poses.matrices.clone()
            matrices[:, :, 3] += (poses.root - poses.root[:, :1]).to(matrices)
            found.roots.append(roots)
            found.matrices.append(matrices)
            for store, points in ((found.bodies, poses.body.points), (found.skinned, poses.lbs)):
                store.append(points.permute(2, 0, 1).double().cpu().numpy() + roots[:, None])
        return found


def spans_of(simulator: Simulator, clips: list[Motion], frames: int) -> list[MotionSpan]:
    """Return the clips at the simulator's rate.

    Raises:
        SsilkError: a clip has fewer frames before its first cut.
    """
    fps, found = simulator.options.fps, []
    for number, clip in enumerate(clips):
        span = split_into_spans(clip, simulator.poser.skeleton, number, fps, 1)[0]
        if span.frame_count < frames:
            fail(clip.path, f"{span.frame_count} frames before a cut", f"{frames} are needed", "give fewer --frames")
        found.append(span)
    return found


def started(simulator: Simulator, spans: list[MotionSpan]) -> StepHistory:
    """Return the states that all methods start with: at rest, or nearly so, in the first poses."""
    rotations, translations = (
        np.stack([getattr(s.motion, n)[0] for s in spans]) for n in ("rotations", "translations")
    )
    poses, solution = simulator.at_rest(rotations, translations)
    world = solution.x.double() + poses.root
    return StepHistory(world, None, poses.root, poses.lbs, matrices=poses.matrices)


class Ours:
    """The reference simulator."""

    def __init__(self, simulator: Simulator, spans: list[MotionSpan], start: StepHistory) -> None:
        self.simulator, self.spans, self.start = simulator, spans, start
        self.device = start.last.device
        self.run(WARM_UP)

    def run(self, frames: int) -> tuple[list[float], Floats]:
        """Return the seconds of all frames but the first, and positions [m], shape (F, N, V, 3)."""
        count, seconds = len(self.spans), []
        points = np.tile(self.start.last.permute(2, 0, 1).cpu().numpy(), (frames, 1, 1, 1))

        def poses_at(places: Sequence[tuple[int, int]]) -> PosedCharacters:
            return self.simulator.poser.poses_at([(self.spans[shot].motion, step) for shot, step in places])

        begun = clock(self.device)
        for each in self.simulator.carry_on(self.start.split(), [range(1, frames)] * count, poses_at):
            seconds.append(clock(self.device) - begun)
            points[each.step, each.shot] = each.state.last[..., 0].cpu().numpy()
            begun = clock(self.device)
        return np.reshape(seconds, (-1, count)).sum(axis=1).tolist(), points


class Peer:
    """The engine; it goes back to its first frame for each run."""

    def __init__(
        self, scene: Scene, fabric: Fabric, shots: Shots, settings: PeerSettings, device: torch.device
    ) -> None:
        from helpers.newton_cloth import NewtonCloth

        self.device = device
        self.cloth = NewtonCloth(scene, fabric, shots, settings, "cuda:0" if device.type == "cuda" else "cpu")
        self.cloth.warm_up()

    def run(self, frames: int) -> tuple[list[float], Floats]:
        """Return the seconds of all frames but the first, and positions [m], shape (F, N, V, 3)."""
        self.cloth.restart()
        seconds, points = [], [self.cloth.points()]
        for _ in range(frames - 1):
            begun = clock(self.device)
            self.cloth.advance()
            seconds.append(clock(self.device) - begun)
            points.append(self.cloth.points())
        return seconds, np.array(points)


class PeerFigures:
    """What all methods are counted by."""

    def __init__(self, scene: Scene, fabric: Fabric, simulator: Simulator, character: Posed) -> None:
        self.scene, self.simulator, self.character = scene, simulator, character
        device = simulator.potential.free.device
        self.energy = GarmentEnergy(scene.garment.rest_mesh, fabric, scene.classes, device=device)
        self.contacts = Contacts(scene, self.energy.cloth.samples, device=device)
        self.cloth = ClothIntersections.of(scene)

    def of(self, points: Floats) -> dict[str, Any]:
        """Return the figures of positions (F, N, V, 3); means are over all frames but the first two, which start."""
        terms = [self._terms(points[:, clip], clip) for clip in range(points.shape[1])]
        shares = np.array([[self.cloth.triangles(x).mean() for x in frame] for frame in points[1::EVERY]])
        joined = {name: torch.cat([part[name][2:] for part in terms]) for name in terms[0]}
        return {
            "shares": (100 * shares.reshape(-1)).tolist(),
            "inside": (100 * joined.pop("collisions")).tolist(),
            "terms": {name: float(values.mean()) for name, values in joined.items()},
        }

    def _terms(self, points: Floats, clip: int) -> dict[str, torch.Tensor]:
        """Return the terms of frames (F, V, 3) of a clip, about the root of its first frame."""
        body = self.simulator.poser.body.pose(self.character.matrices[clip].float(), exact=True, limbs=False)
        x, skinned = (self._local(world, clip) for world in (points, self.character.skinned[clip]))
        down, fps = x.new_tensor([0.0, -1.0, 0.0]), self.simulator.options.fps
        return energy_terms(self.energy, x, skinned, self.contacts, body, x, fps, down)

    def _local(self, world: Floats, clip: int) -> torch.Tensor:
        away = world - self.character.roots[clip][0]
        return torch.as_tensor(away.transpose(1, 2, 0).copy()).to(self.energy.mass)


def measure(scene: Scene, clips: list[Motion], options: argparse.Namespace, source: dict[str, str]) -> dict[str, Any]:
    """Return the figures of all methods, and write them as they come."""
    from helpers.newton_cloth import Shots

    device, fabric, frames = select_device(options.device), Fabric("default"), options.frames
    rest = SolverOptions(iterations=AT_REST)
    each = SimulationOptions(batch=len(clips), quasi_static_solver=rest)
    simulators = {
        held: Simulator(scene, fabric, replace(each, self_contact=held), device=device) for held in (False, True)
    }
    spans = spans_of(simulators[True], clips, frames)
    character, start = Posed.of(simulators[True], spans, frames), started(simulators[True], spans)
    bodies, skinned, roots = (np.array(each) for each in (character.bodies, character.skinned, character.roots))
    cloth = start.last.permute(2, 0, 1).cpu().numpy()
    shots = Shots(cloth, bodies, skinned, roots, simulators[True].options.fps)
    figures = PeerFigures(scene, fabric, simulators[True], character)
    made: dict[str, Ours | Peer] = {}
    measured: dict[str, Any] = {}
    begun = now(device)
    for run in range(options.runs):
        for name, kept, settings in methods():
            key = f"{name}, {kept}"
            if run and now(device) - begun + sum(measured[key]["milliseconds"][0]) / 1000 > options.seconds:
                continue
            if not run:
                simulator = simulators[kept == APART]
                made[key] = (
                    Peer(scene, fabric, shots, settings, device) if settings else Ours(simulator, spans, start)
                )
            seconds, points = made[key].run(frames)
            if not run:
                measured[key] = {"method": name, "cloth": kept, "milliseconds": [], **figures.of(points)}
            measured[key]["milliseconds"].append([1000 * each for each in seconds])
            print(f"{key}: {sum(seconds):.2f} s in run {run + 1}", file=sys.stderr, flush=True)
            write_document(RESULTS / f"{options.name}.json", source, measured)
    return measured


def methods() -> Iterator[tuple[str, str, PeerSettings | None]]:
    """Yield the name of each method, what becomes of cloth that meets cloth, and its settings; ours has none."""
    from helpers.newton_cloth import PeerSettings

    for kept in (APART, PASSES):
        yield "simulator", kept, None
        for steps in VBD if kept == PASSES else VBD[:-1]:  # few substeps are too long for its self-contact
            yield f"VBD, {steps[0]} x {steps[1]}", kept, PeerSettings("vbd", *steps, kept == APART)
    for steps in STYLE3D:
        yield f"Style3D, {steps[0]} x {steps[1]}", APART, PeerSettings("style3d", *steps, True)


def row(found: dict[str, Any]) -> list[str]:
    """Return the line of a method."""
    times, terms = np.array(found["milliseconds"]), found["terms"]
    low, middle, high = np.quantile(times, (0.25, 0.5, 0.75))
    runs = np.median(times, axis=1)
    shares, inside = np.array(found["shares"]), np.array(found["inside"])
    return [found["method"], found["cloth"], f"{middle:.1f}", f"{low:.1f} to {high:.1f}",
            f"{runs.min():.1f} to {runs.max():.1f}", f"{shares.mean():.2f}", f"{shares.max():.2f}",
            f"{inside.mean():.2f}", f"{inside.max():.2f}", f"{sum(terms[name] for name in TERMS):.4f}",
            *(f"{terms[name]:.4f}" for name in SHOWN)]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", type=Path, help="USD file with character and garment, as 'ssilk rig' writes it")
    parser.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
    parser.add_argument("--clips", nargs="+", default=["01_14"], help="their names (default 01_14)")
    parser.add_argument("--first", type=int, default=0, help="frame of each clip that it begins with (default 0)")
    parser.add_argument("--frames", type=int, default=60, help="of each clip (default 60)")
    parser.add_argument("--runs", type=int, default=3, help="of each method (default 3)")
    parser.add_argument("--seconds", type=float, default=60, help="of all runs, beyond the first ones (default 60)")
    parser.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    parser.add_argument("--name", help="of the result file (default: the script's)")
    options = parsed(parser)
    scene = prepare_scene(*read_scene(options.stage), report=TextReporter())
    skeleton = scene.character.skeleton
    found = [read_motion(options.motions / f"{clip}.usdc", skeleton) for clip in options.clips]
    clips = [clip.clip(round(options.first * clip.fps / SimulationOptions().fps), clip.frame_count) for clip in found]
    source = provenance(options)
    source["versions"] += "".join(f", {name} {version(name)}" for name in ("newton", "warp-lang"))
    measured = measure(scene, clips, options, source)
    print(table(HEADER, [row(found) for found in measured.values()]))


if __name__ == "__main__":
    try:
        if find_spec("newton") is None:
            fail("newton", "it is not installed", "it is the engine that is measured", "pip install newton")
        main()
    except SsilkError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
