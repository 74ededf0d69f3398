# SPDX-License-Identifier: Apache-2.0
"""Stop a moving character and see whether its garment comes to rest, where, and whether it hangs.

    python benchmarks/still.py cape.safetensors --stage character.usdc --motions FOLDER

A clip plays up to a moment, comes to a stop within a quarter of a second, and its pose is held for five seconds.
The reference is independent of the network: the simulator's Newton method on the vertices themselves, in float64, on
the same static energy (stretch, bending, gravity, collision) with the pinned vertices where the skeleton has them,
from where the garment came to rest, and again from the network's own quasi-static state P. What a garment floats is
its gravity above that minimum, as a share of m g L: its weight times its height at rest. A garment that floats is not
at a minimum, so the search pulls it down.
"""

from __future__ import annotations

from typing import Any

from reports import table, write_results
from subjects import Subject, arguments, clip_of, open_subject, parsed

from ssilk_core.evaluation.methods import Network, reel_of
from ssilk_core.evaluation.minimum import minima
from ssilk_core.evaluation.probes import held
from ssilk_core.evaluation.takes import Take, stopped
from ssilk_core.simulate import SimulationOptions, Simulator
from ssilk_core.simulate.newton import SolverOptions

STOPS = (("02_04", 1.7), ("02_04", 3.7), ("02_02", 1.1), ("05_12", 4.0))
HOLD = 5.0  # [s]
HEADER = ("garment", "stopped at", "kinetic energy at the stop [J]", "after 5 s", "calm after [s]", "off P [mm]",
          "over P [J]", "over the minimum [J]", "floats, of m g L", "P floats", "linear blend skinning floats",
          "RMS off the minimum [mm]", "inside the body", "at the minimum", "out of balance [g]")  # fmt: skip


def measure(subject: Subject, clip: str, stop: float, options: Any) -> dict[str, float]:
    """Return the figures of one stop."""
    dressed, weight = subject.dressed, subject.dressed.weight
    motion, first = stopped(clip_of(options, clip, subject), dressed.fps, stop, HOLD)
    take, last = Take(clip, 0, motion), range(motion.frame_count - 1, motion.frame_count)
    reel = reel_of([take], dressed, subject.model.joints)
    network = Network("ssilk", subject.model, reel)
    settings = SimulationOptions(fps=dressed.fps, quasi_static_solver=SolverOptions(iterations=options.iterations))
    simulator = Simulator(dressed.scene, dressed.fabric, settings, device=dressed.device)
    hold = held(dressed, reel, network, [first])[0]
    rest, still = (minima(simulator, [take], at(0, last)) for at in (network.vertices, network.still))
    return {
        "kinetic at the stop [J]": hold.begun,
        "kinetic after 5 s [J]": hold.kinetic,
        "calm after [s]": hold.settling,
        "off P [m]": hold.distance,
        "over P [J]": hold.above,
        "over the minimum [J]": float(rest.over()),
        "floats [m g L]": float(rest.floats(rest.start)) / weight,
        "P floats [m g L]": float(still.floats(still.start)) / weight,
        "plain floats [m g L]": float(rest.floats(rest.poses.lbs)) / weight,
        "distance [m]": float(rest.distance()),
        "inside": float(rest.inside(rest.start)),
        "inside at the minimum": float(rest.inside(rest.x)),
        "out of balance [g]": float(rest.residual),
    }


def row(garment: str, where: str, found: dict[str, float]) -> list[str]:
    """Return one line of the table."""
    start, end, calm, off, over_still, over, *floats, distance, inside, below, residual = found.values()
    calm_text = f"{calm:.2f}" if calm < HOLD else "never"
    return [garment, where, f"{start:.2e}", f"{end:.2e}", calm_text, f"{1000 * off:.0f}", f"{over_still:.4f}",
            f"{over:.4f}", *(f"{share:.2%}" for share in floats), f"{1000 * distance:.0f}", f"{inside:.2%}",
            f"{below:.2%}", f"{residual:.1e}"]  # fmt: skip


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--iterations", type=int, default=150, help="of Newton's method, at most (default 150)")
    options = parsed(parser)
    rows, measured = [], {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        for clip, stop in STOPS:
            where = f"{clip}, {stop:g} s"
            measured[f"{subject.name} {where}"] = found = measure(subject, clip, stop, options)
            rows.append(row(subject.name, where, found))
            print(table(HEADER, rows), flush=True)
    write_results(options, table(HEADER, rows), measured)


if __name__ == "__main__":
    main()
