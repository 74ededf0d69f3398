# SPDX-License-Identifier: Apache-2.0
"""Methods of the evaluation as shots of the viewer, and simulations that are kept in a file."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from helpers.subjects import Subject
from ssilk_core.delivery.view.shots import Look, film_of_shots, sheet_of_shots
from ssilk_core.errors import fail
from ssilk_core.events import Reporter
from ssilk_core.files import replacing
from ssilk_core.physics.simulate import SimulationOptions, simulate
from ssilk_core.quality.evaluation.methods import EvaluationScene, Method, TakeSet
from ssilk_core.scene.assets import Floats, Ints, Motion, ShotWorld
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices

TRY = "simulate this motion again, into another file"


@dataclass(frozen=True)
class PlayedMesh:
    """A mesh of a shot, as the viewer asks for it."""

    name: str
    faces: Ints
    is_garment: bool
    colour: tuple[float, float, float] | None = None
    is_rider: bool = False


class PlayedShot:
    """A method over the only take of a set, as a shot of the viewer.

    Args:
        body: vertices of the character's body in each frame [m], shape (F, B, 3).

    Raises:
        SsilkError: the method is not finite.
    """

    def __init__(self, name: str, dressed: EvaluationScene, take_set: TakeSet, method: Method, body: Floats) -> None:
        motion = take_set.takes[0].motion
        x = method.vertices(0, range(motion.frame_count)).double().permute(2, 0, 1).cpu().numpy()
        self._show(name, dressed, x + take_set.origins[0], body, motion.fps)

    @classmethod
    def of(cls, name: str, dressed: EvaluationScene, points: Floats, body: Floats, fps: float) -> PlayedShot:
        """Return a shot of a garment's vertices (F, V, 3) in the world [m]; errors as above."""
        shot = cls.__new__(cls)
        shot._show(name, dressed, points, body, fps)
        return shot

    def _show(self, name: str, dressed: EvaluationScene, points: Floats, body: Floats, fps: float) -> None:
        if not np.isfinite(points).all():
            fail(name, "it is not finite", "a picture needs positions")
        self.garment, self.body, self.fps = points, body, fps
        self.frame_times = [float(frame) for frame in range(len(points))]
        faces, own = dressed.scene.character.merged_body().mesh.faces, dressed.scene.garment.mesh.faces
        self.meshes = [PlayedMesh("body", faces, False), PlayedMesh(dressed.name, own, True)]

    def points(self, time: float) -> Sequence[Floats]:
        """Return the vertices of body and garment in a frame [m]."""
        return [self.body[int(time)], self.garment[int(time)]]


def posed_body(dressed: EvaluationScene, motion: Motion) -> Floats:
    """Return the vertices of a character's whole body in each frame [m], shape (F, B, 3)."""
    skeleton, body = dressed.scene.character.skeleton, dressed.scene.character.merged_body()
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    return skin_points(body.mesh.points, body.skin, matrices)


def draw_rows(
    rows: Mapping[str, Floats], dressed: EvaluationScene, motion: Motion, options: Namespace, report: Reporter
) -> None:
    """Draw garments (F, V, 3) in the world [m], one row each, as options of `add_pictures` ask for it."""
    body = posed_body(dressed, motion)
    shots = [PlayedShot.of(name, dressed, points, body, motion.fps) for name, points in rows.items()]
    look = Look(options.size[0], options.size[1], options.azimuth, workers=2)
    if options.output:
        shown = {"columns": 6, "frames": options.shown, "look": look, "report": report}
        sheet_of_shots(options.output, shots, labels=list(rows), **shown)
    if options.film:
        film_of_shots(options.film, shots, labels=list(rows), look=look, report=report)


def add_pictures(parser: ArgumentParser) -> None:
    """Add the options that `draw_rows` takes."""
    parser.add_argument("-o", "--output", type=Path, metavar="PNG", help="sheet to write")
    parser.add_argument("--film", type=Path, metavar="MP4", help="film to write")
    parser.add_argument("--shown", type=int, nargs="+", metavar="FRAME", help="of the sheet (default: six, evenly)")
    parser.add_argument("--azimuth", type=float, default=150.0, help="of the camera [degrees] (default 150)")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(240, 300), metavar=("W", "H"), help="of a panel [pixels]"
    )


def simulated_worlds(
    path: Path, subject: Subject, motion: Motion, worlds: Sequence[ShotWorld | None], report: Reporter
) -> Floats:
    """Return the simulator's positions in each world, (W, F, V, 3) [m], from a file or into it.

    Raises:
        SsilkError: the file holds other positions.
    """
    if not path.is_file():
        options, count = SimulationOptions(fps=motion.fps), len(worlds)
        found = simulate(
            subject.scene, subject.file.fabric, [motion] * count, options, worlds=worlds, device=subject.device,
            report=report,
        )  # fmt: skip
        with replacing(path) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, points=np.stack(found).astype(np.float32))
    points = np.load(path, allow_pickle=False)["points"].astype(np.float64)
    wanted = len(worlds), motion.frame_count, subject.scene.garment.mesh.vertex_count, 3
    if points.shape != wanted:
        fail(str(path), f"positions of the shape {points.shape}", f"these worlds have {wanted}", TRY)
    return points


def kept_simulation(
    path: Path, dressed: EvaluationScene, motion: Motion, report: Reporter
) -> Callable[[str, range], Floats]:
    """Return a reader of the simulator's positions over a motion, for `methods.CachedPoints`.

    Where there is no file at `path` (.npz), the simulator plays the motion and writes one, which can be taken to any
    machine: "points" in the world [m], float32, shape (F, V, 3), and "fps".

    Raises:
        SsilkError: the file holds something else, or another rate, length or garment.
    """
    if path.suffix != ".npz":
        fail(str(path), "not a name for positions", "it ends in .npz")
    if not path.is_file():
        options = SimulationOptions(fps=motion.fps)
        found = simulate(dressed.scene, dressed.fabric, [motion], options, device=dressed.device, report=report)[0]
        with replacing(path) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, points=found.astype(np.float32), fps=motion.fps)
    points, fps = _read(path)
    wanted = motion.frame_count, dressed.scene.garment.mesh.vertex_count, 3
    if points.shape != wanted or not abs(fps - motion.fps) < 1e-6:
        fail(
            str(path), f"positions of the shape {points.shape} at {fps:g} frames per second",
            f"this motion and garment have {wanted} at {motion.fps:g}", TRY,
        )  # fmt: skip
    return lambda clip, frames: points[frames.start : frames.stop]


def _read(path: Path) -> tuple[Floats, float]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            return stored["points"].astype(np.float64), float(stored["fps"])
    except (ValueError, KeyError, OSError, EOFError) as error:
        fail(
            str(path), f"no positions ({type(error).__name__})", "a file of this script holds 'points' and 'fps'", TRY
        )
