# SPDX-License-Identifier: Apache-2.0
"""Draw frames of a motion, a row for each method, from one camera: the simulator, trained models, skinning.

    python benchmarks/sheet.py --motion cartwheel --frames 30 36 42 --simulation cartwheel.npz -o sheet.png

The rows are the reference simulator, where --simulation names a file of its positions or one to write; each model's
network; the solver in its latents, for each number of --iterations; and linear blend skinning. A motion is one of the
demo, or a file. Without --frames, the sheet shows moments spread over the motion. --film shows the same side by side.
On a processor the simulator takes seconds for a frame: with neither -o nor --film the script only writes
--simulation, on a GPU, say, and the file can be taken elsewhere. Frames are counted from zero, at the model's rate.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch
from helpers.methods import SKINNING, methods_of
from helpers.pictures import PlayedShot, kept_simulation, posed_body
from helpers.subjects import Subject, open_subjects
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.stages import demo_body_path

from ssilk_core.delivery.view.output import FILM, PICTURE, check_suffix
from ssilk_core.delivery.view.shots import Look, film_of_shots, sheet_of_shots
from ssilk_core.demo.motions import MOTIONS, build_motion
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import fail
from ssilk_core.events import Reporter, TextReporter
from ssilk_core.quality.evaluation.methods import CachedPoints, LinearBlendSkinning, Method, TakeSet, build_take_set
from ssilk_core.quality.evaluation.takes import Take, takes_of


def opened_take(options: argparse.Namespace, subject: Subject) -> Take:
    """Return the motion that options name, at the model's rate.

    Raises:
        SsilkError: it is no motion, too short, or has a cut.
    """
    skeleton, name = subject.scene.character.skeleton, options.motion
    motion = build_motion(name, skeleton) if name in MOTIONS else read_motion(Path(name), skeleton)
    takes = takes_of(Path(name).stem, motion, skeleton, subject.file.config.fps)
    if len(takes) != 1:
        fail(str(name), f"{len(takes)} parts between cuts", "a motion of four frames or more without a cut is drawn")
    outside = [frame for frame in options.frames if not 0 <= frame < takes[0].frame_count]
    if outside:
        fail(str(name), f"there is no frame {outside[0]}", f"it has the frames 0 to {takes[0].frame_count - 1}")
    return takes[0]


def played(
    options: argparse.Namespace, subjects: list[Subject], take: Take, report: Reporter
) -> Iterator[tuple[str, Subject, TakeSet, Method]]:
    """Yield the methods in the order of rows, each with its label."""
    first = subjects[0]
    plain = build_take_set([take], first.dressed, first.model.joints)
    if options.simulation:
        read = kept_simulation(options.simulation, first.dressed, take.motion, report)
        yield "simulator", first, plain, CachedPoints(read, first.dressed, plain)
    for subject in subjects:
        take_set = build_take_set([take], subject.dressed, subject.model.joints, subject.model.config.descriptors)
        for name, method in methods_of(subject, take_set, options.iterations, report):
            yield f"{subject.name}, {name}" if len(subjects) > 1 else name, subject, take_set, method
    yield SKINNING, first, plain, LinearBlendSkinning(first.dressed, plain)


def draw(options: argparse.Namespace, subjects: list[Subject], take: Take, report: Reporter) -> None:
    """Write the picture, the film, or both."""
    body = posed_body(subjects[0].dressed, take.motion)
    shots = {
        label: PlayedShot(label, subject.dressed, take_set, method, body)
        for label, subject, take_set, method in played(options, subjects, take, report)
    }
    look = Look(options.size[0], options.size[1], options.azimuth, workers=options.threads)
    if options.output:
        sheet_of_shots(options.output, list(shots.values()), labels=list(shots), columns=options.columns,
                       frames=options.frames or None, look=look, report=report)  # fmt: skip
    if options.film:
        film_of_shots(options.film, list(shots.values()), labels=list(shots), look=look, report=report)


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--model", type=Path, nargs="+", default=[shipped_path("cape")], metavar="FILE",
                       help="of one garment, written by 'ssilk train' (default: the cape that ships)")  # fmt: skip
    found.add_argument("--stage", type=Path, default=demo_body_path(),
                       help="USD file with the character (default: the demo's body)")  # fmt: skip
    found.add_argument("--motion", required=True, help=f"a motion file, or of the demo: {', '.join(MOTIONS)}")
    found.add_argument("--frames", type=int, nargs="+", default=[], help="that the sheet shows, from zero")
    found.add_argument("--columns", type=int, default=6, help="moments of a sheet without --frames (default 6)")
    found.add_argument("--iterations", type=int, nargs="*", default=[2],
                       help="of the solver in latents, a row for each; none for no such row (default 2)")  # fmt: skip
    found.add_argument("--simulation", type=Path, metavar="NPZ", help="the simulator's positions, read or written")
    found.add_argument("-o", "--output", type=Path, metavar="PNG", help="sheet to write")
    found.add_argument("--film", type=Path, metavar="MP4", help="film to write")
    found.add_argument("--azimuth", type=float, default=150.0, help="of the camera [degrees] (default 150)")
    found.add_argument(
        "--size", type=int, nargs=2, default=(240, 300), metavar=("W", "H"), help="of a panel [pixels]"
    )
    found.add_argument("--device", default="cpu", help="where methods run (default cpu)")
    found.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    return found


def main() -> None:
    options = parser().parse_args()
    torch.set_num_threads(options.threads)
    if not (options.output or options.film or options.simulation):
        fail("sheet", "nothing to write", "-o, --film or --simulation is needed")
    for path, suffix in ((options.output, PICTURE), (options.film, FILM)):
        if path:
            check_suffix(path, (suffix,))
    subjects, report = open_subjects(options.model, options.stage, options.device), TextReporter()
    take = opened_take(options, subjects[0])
    if options.output or options.film:
        draw(options, subjects, take, report)
    else:
        kept_simulation(options.simulation, subjects[0].dressed, take.motion, report)


if __name__ == "__main__":
    main()
