# SPDX-License-Identifier: Apache-2.0
"""Stop a moving character and measure whether its garment comes to rest, and where.

    python benchmarks/still.py cape.safetensors --stage character.usdc --motions FOLDER

A clip plays up to a moment, stops within a quarter of a second, and its pose is held for five seconds. The reference
is a minimum of the same static energy (stretch, bending, gravity, collision) that needs no network. The simulator's
Newton method finds it in float64, with the pinned vertices where the skeleton puts them. It starts from where the
garment came to rest, and again from the network's static state P. A gravity excess is the gravity energy above that
minimum as a share of m g L, the garment's weight times its height at rest.
"""

from __future__ import annotations

from typing import Any

from reports import table, write_results
from subjects import Subject, arguments, clip_of, open_subject, parsed

from ssilk_core.evaluation.methods import Network, build_take_set
from ssilk_core.evaluation.minimum import minima
from ssilk_core.evaluation.probes import settling
from ssilk_core.evaluation.takes import Take, stopped
from ssilk_core.simulate import SimulationOptions, Simulator
from ssilk_core.simulate.newton import SolverOptions

STOPS = (("02_04", 1.7), ("02_04", 3.7), ("02_02", 1.1), ("05_12", 4.0))
HOLD = 5.0  # [s]
HEADER = ("garment", "stop", "kinetic energy at stop [J]", "after 5 s [J]", "settling time [s]",
          "RMS distance to static state [mm]", "static energy excess over static state [J]", "over minimum [J]",
          "gravity excess over minimum [m g L]", "of static state", "of LBS", "RMS distance to minimum [mm]",
          "vertices inside the body", "at minimum", "static residual [g]")  # fmt: skip


def measure(subject: Subject, clip: str, stop: float, options: Any) -> dict[str, float]:
    """Return the figures of one stop."""
    dressed, weight = subject.dressed, subject.dressed.weight
    motion, first = stopped(clip_of(options, clip, subject), dressed.fps, stop, HOLD)
    take, last = Take(clip, 0, motion), range(motion.frame_count - 1, motion.frame_count)
    reel = build_take_set([take], dressed, subject.model.joints)
    network = Network(subject.model, reel)
    settings = SimulationOptions(fps=dressed.fps, rest=SolverOptions(iterations=options.iterations))
    simulator = Simulator(dressed.scene, dressed.fabric, settings, device=dressed.device)
    settled = settling(dressed, reel, network, [first])[0]
    rest, still = (minima(simulator, [take], at(0, last)) for at in (network.vertices, network.still))
    return {
        "initial kinetic energy [J]": settled.initial_kinetic_energy,
        "final kinetic energy [J]": settled.final_kinetic_energy,
        "settling time [s]": settled.settling_time,
        "static distance [m]": settled.static_distance,
        "static energy excess [J]": settled.static_energy_excess,
        "energy excess over minimum [J]": float(rest.energy_excess()),
        "gravity excess over minimum [m g L]": float(rest.gravity_excess(rest.start)) / weight,
        "static state's gravity excess over minimum [m g L]": float(still.gravity_excess(still.start)) / weight,
        "LBS gravity excess over minimum [m g L]": float(rest.gravity_excess(rest.poses.lbs)) / weight,
        "minimum distance [m]": float(rest.distance()),
        "inside": float(rest.inside(rest.start)),
        "inside at minimum": float(rest.inside(rest.x)),
        "static residual [g]": float(rest.residual),
    }


def row(garment: str, where: str, found: dict[str, float]) -> list[str]:
    """Return one line of the table."""
    start, end, time, static, above_static, above, *excesses, distance, inside, below, residual = found.values()
    settled = f"{time:.2f}" if time < HOLD else "never"
    return [garment, where, f"{start:.2e}", f"{end:.2e}", settled, f"{1000 * static:.0f}", f"{above_static:.4f}",
            f"{above:.4f}", *(f"{share:.2%}" for share in excesses), f"{1000 * distance:.0f}", f"{inside:.2%}",
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
