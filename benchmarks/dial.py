# SPDX-License-Identifier: Apache-2.0
"""The dial between fast and near to the simulator: errors of each place on it beside its time, of one garment.

    python benchmarks/dial.py errors --garment cape --stage character.usdc --motions FOLDER --device cuda
    python benchmarks/dial.py times --garment cape --stage character.usdc --motions FOLDER --device cuda
    OMP_NUM_THREADS=1 python benchmarks/dial.py times --garment cape ... --device cpu --threads 1
    python benchmarks/dial.py picture

Places are the network, as trained and reduced to quality levels, the solver in latents on few elements and on all,
refinement, *Hero* and the simulator (`helpers/dial_places.py`). Windows are spread over each clip of the splits. All
places play the frames of a window and --lead frames before it, from rest. The simulator goes on from the place's own
first two states in the window, so that nobody is blamed for a state that it did not choose. Its own row goes on from
the network's, and is right by definition. What it is worth is told by "1 mm off": the loose cloth of these two states
is moved sideways by a millimetre, and that simulation is compared with the first.

All figures are of a window's frames after its first two: RMS distances over mass after some frames [m], RMS errors of
velocity over mass and frames [m/s], total energies [J] (gravity relative to skinning), shares of the covered skin
that show, of frames in which a limb is through the cloth, and of triangles that intersect others in the frames whose
distances are told, and RMS third differences of positions [m].

Times are those of a frame of one shot: on one processor core of a shot alone, on a GPU of --shots at once, but of
refinement, whose frames are solved at once instead. Both write the garment's file, which grows by the row of a place
as soon as the simulator has gone on from all its windows; the same command goes on where it was cut off.
`picture` draws what the files of the garments that ship hold.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from documents.dial import draw
from helpers.dial_bench import OFF, DialBench, DialErrors, DialTime
from helpers.dial_places import ALONE, HELD, NETWORK, PLACES, SIMULATOR, DialPlace
from helpers.own_windows import STATES
from helpers.reports import provenance, rounded
from ssilk_usd.stages import demo_body_path
from torch import Tensor

from ssilk_core.devices import device_name
from ssilk_core.errors import SsilkError, fail
from ssilk_core.events import Countdown, Message, Reporter, TextReporter
from ssilk_core.physics.energy import TERMS
from ssilk_core.physics.intersections.pairs import need_predicates
from ssilk_core.physics.skin.covered_skin import ShownCounts
from ssilk_core.quality.evaluation.metrics import mean_square
from ssilk_core.quality.evaluation.own_starts import MethodWindow, Window, continuations
from ssilk_core.quality.evaluation.record import frame_energies
from ssilk_core.scene.assets import Motion

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "dial.png"
LOOKS = ("total", "shown", "limbs", "intersecting", "jitter")
OFF_BY = 1e-3  # [m]
ON_GPU = 64  # shots that are timed at once
SHOT = 1 + HELD.batch  # frames of shots that are timed; the first stands alone


@dataclass(frozen=True, eq=False)
class Played:
    """A place in the windows of a split.

    Attributes:
        windows: those in which it is finite.
        own: the same, with what it does there.
    """

    split: str
    place: str
    windows: list[Window]
    own: list[MethodWindow]
    lost: int


def errors(options: argparse.Namespace, report: Reporter) -> None:
    """Measure the places that the garment's file lacks; the simulator goes on from several at once."""
    need_predicates()
    bench = DialBench(options, report)
    measured = {(row.split, row.place) for row in bench.rows}
    names = {place for _, place in bench.names}
    known = {name for name in names if all((split, name) in measured for split in bench.splits)}
    missing = [place for place in PLACES if place.name not in known and place.name in options.places]
    if {SIMULATOR, OFF} - known:
        missing = [NETWORK, *(place for place in missing if place != NETWORK)]
        known -= {NETWORK.name, SIMULATOR, OFF}  # the three are measured together
    bench.rows = [row for row in bench.rows if row.place in known]
    count = sum(map(len, bench.windows.windows.values()))
    frames = max(take.frame_count for take in bench.windows.takes)
    report(Message(f"{bench.subject.name}: {count} windows, of takes of {frames} frames at most"))
    group: list[Played] = []
    for place in missing:
        one_by_one = place.refine is not None and not place.refine.feedback
        told = Countdown(sum(take.frame_count for take in bench.windows.takes) if one_by_one else frames, report)
        report(Message(f"{bench.subject.name}: {place.name}"))
        group += played(bench, place, told)
    simulated(bench, group)


def played(bench: DialBench, place: DialPlace, told: Countdown) -> list[Played]:
    """Play a place in all takes, and return its windows; the network's, moved by a millimetre, beside it."""
    dressed, take_set = bench.subject.dressed, bench.take_set
    method = bench.dial.method(place, take_set, told)
    found = []
    for split, windows in bench.windows.windows.items():
        own = [(window, MethodWindow(dressed, take_set, method, window)) for window in windows]
        finite = [(window, one) for window, one in own if one.is_finite]
        lost = len(own) - len(finite)
        found.append(Played(split, place.name, [at for at, _ in finite], [one for _, one in finite], lost))
        if place == NETWORK:
            offset = torch.zeros_like(found[-1].own[0].x[0])
            offset[dressed.simulator.potential.free, 0] = OFF_BY
            found.append(replace(found[-1], place=OFF, own=[one.moved(offset) for one in found[-1].own]))
    return found


def simulated(bench: DialBench, group: Sequence[Played]) -> None:
    """Let the simulator go on from all windows, and write what that tells of each place as soon as it is known."""
    every = [window for one in group for window in one.own]
    report = bench.report
    report(Message(f"{bench.subject.name}: the simulator goes on from {len(every)} windows"))
    told = Countdown(sum(len(window.x) - STATES for window in every), report)
    ends = np.cumsum([len(one.own) for one in group])
    network = {
        one.split: range(end - len(one.own), end) for one, end in zip(group, ends) if one.place == NETWORK.name
    }
    simulator = bench.subject.dressed.simulator
    simulator.options = replace(simulator.options, batch=len(every))  # those that take longest begin with the others
    reached: dict[int, Tensor] = {}
    waiting = dict(zip(ends.tolist(), group))
    for number, x in continuations(simulator, every, told):
        reached[number] = x
        for end, one in list(waiting.items()):
            # The simulation from the network's own states is what that from a millimetre beside is compared with.
            own = range(end - len(one.own), end)
            compared = network[one.split] if one.place == OFF else own
            if not reached.keys() >= {*own, *compared}:
                continue
            del waiting[end]
            reference = [reached[at] for at in compared]
            shown = [reached[at] for at in own] if one.place == OFF else [window.x for window in one.own]
            bench.rows.append(figures(bench, one, shown, reference))
            if one.place == NETWORK.name:
                bench.rows.append(figures(bench, replace(one, place=SIMULATOR), reference, reference))
            bench.write(**provenance(bench.options))


def figures(bench: DialBench, one: Played, own: Sequence[Tensor], reference: Sequence[Tensor]) -> DialErrors:
    """Return what positions (L, V, 3) in windows tell, beside those of the simulator."""
    dressed, mass = bench.subject.dressed, bench.subject.energy.mass.double()
    after: dict[str, list[float]] = {str(count): [] for count in bench.options.after}
    values: dict[str, list[float]] = {"velocity": [], **{name: [] for name in LOOKS}}
    for (take, frames), x, y in zip(one.windows, own, reference):
        away = (x - y).permute(1, 2, 0)
        square = mean_square(away, mass)
        for count, found in after.items():
            found.append(float(square[int(count) + STATES - 1].sqrt()))
        moved = mean_square(away.diff(dim=-1)[..., STATES - 1 :], mass).mean().sqrt()
        values["velocity"].append(float(moved) * dressed.fps)
        local = bench.take_set.local(take, x.cpu().numpy())
        for name, value in appearance(bench, take, frames, local, x).items():
            values[name].append(value)
    distance = {count: tuple(found) for count, found in after.items()}
    told = {name: tuple(found) for name, found in values.items()}
    return DialErrors(split=one.split, place=one.place, lost=one.lost, distance=distance, **told)


@torch.no_grad()
def appearance(bench: DialBench, take: int, frames: range, local: Tensor, x: Tensor) -> dict[str, float]:
    """Return `LOOKS` of a window's frames after its first two, as `DialErrors` has them.

    Args:
        local: positions about the take's first root [m], shape (V, 3, L).
        x: the same in the world, shape (L, V, 3).
    """
    dressed, later = bench.subject.dressed, frames[STATES:]
    terms = frame_energies(dressed, bench.take_set, take, later, local)
    states = dressed.covered.states(local[..., STATES:], bench.take_set.character(take, later))
    counts = ShownCounts.of(states)
    chosen = x[[count + STATES - 1 for count in bench.options.after]].cpu().numpy()
    crossed = [dressed.intersections.triangles(points).mean() for points in chosen]
    return {
        "total": float(sum(terms[name].double().mean() for name in TERMS)),
        "shown": float(counts.shares.mean()),
        "limbs": np.nan if counts.pierced_share is None else counts.pierced_share,
        "intersecting": float(np.mean(crossed)),
        "jitter": float(mean_square(local.diff(n=3), bench.subject.energy.mass).mean().sqrt()),
    }


def times(options: argparse.Namespace, report: Reporter) -> None:
    """Time the places that the garment's file lacks on this device."""
    bench = DialBench(options, report)
    device = bench.subject.device
    known = bench.document.get("times", [])
    at_once = options.shots or (ON_GPU if device.type == "cuda" else 1)
    shots = timed_shots(bench, max(at_once, ALONE))
    for place in (*PLACES, None):
        name = place.name if place else SIMULATOR
        if any((time["place"], time["device"]) == (name, device.type) for time in known):
            continue
        count, milliseconds = bench.dial.milliseconds(place, shots, at_once=at_once > 1)
        report(Message(f"{bench.subject.name}, {name}: {milliseconds:.3g} ms a frame and shot, {count} at once"))
        own = DialTime(place=name, device=device.type, hardware=device_name(device), shots=count,
                       milliseconds=milliseconds)  # fmt: skip
        known = [*known, rounded(asdict(own))]
        bench.write(times=known)


def timed_shots(bench: DialBench, count: int) -> list[Motion]:
    """Return shots from the windows' starts on, of each split in turn; they begin a frame later in each round."""
    order = [at for each in zip(*bench.windows.windows.values()) for at in each]
    found = []
    for number in range(count):
        take, frames = order[number % len(order)]
        motion = bench.windows.takes[take].motion
        start = frames.start + number // len(order) % max(1, len(frames) - SHOT + 1)
        found.append(motion.clip(start, start + SHOT))
    return found


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("what", choices=("errors", "times", "picture"), help="to do")
    found.add_argument("--garment", default="cape", help="garment that ships (default cape)")
    found.add_argument("--model", type=Path, metavar="FILE", help="another model, written by 'ssilk train'")
    found.add_argument("--stage", type=Path, default=demo_body_path(),
                       help="USD file with the character (default: the demo's body)")  # fmt: skip
    found.add_argument("--motions", type=Path, metavar="FOLDER", help="folder of motion files")
    found.add_argument("--index", type=Path, metavar="JSON",
                       help="list of clips with their splits (default: index.json of that folder)")  # fmt: skip
    found.add_argument("--splits", nargs="+", default=["test", "flips"], help="(default test flips)")
    found.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="only these clips of the splits")
    every = [place.name for place in PLACES]
    found.add_argument("--places", nargs="+", default=every, choices=every, metavar="PLACE",
                       help=f"whose errors are measured: {', '.join(every)} (default: all)")  # fmt: skip
    found.add_argument("--windows", type=int, default=1, help="of each clip (default 1)")
    found.add_argument("--lead", type=int, default=30, help="frames played before a window (default 30)")
    found.add_argument("--after", type=int, nargs="+", default=[10, 30],
                       help="frames to tell distances after; the last ends a window (default 10 30)")  # fmt: skip
    found.add_argument("--shots", type=int, help="that are timed at once (default: 64 on a GPU, 1 on a processor)")
    found.add_argument("--output", type=Path, metavar="FILE",
                       help="figures, or picture (default: in results/, and docs/images/dial.png)")  # fmt: skip
    found.add_argument("--device", default="cpu", help="where everything runs (default cpu)")
    found.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    return found


def main() -> None:
    options = parser().parse_args()
    torch.set_num_threads(options.threads)
    try:
        if options.what == "picture":
            draw(options.output or PICTURE)
            return
        if options.motions is None:
            fail("--motions", "no folder", "figures are measured on motions")
        if options.windows < 1 or min(options.after) < 1:
            found = f"{options.windows} windows, after {options.after} frames"
            fail("windows", found, "at least 1 is needed of each")
        {"errors": errors, "times": times}[options.what](options, TextReporter())
    except SsilkError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
