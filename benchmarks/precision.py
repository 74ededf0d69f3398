# SPDX-License-Identifier: Apache-2.0
"""Measure what 16 bits cost: bytes by part, and what moves, by part and over time, against single precision.

    python benchmarks/precision.py cape.safetensors --stage character.usdc --motions FOLDER --index FOLDER/index.json

Models are those that 'ssilk train' wrote. "Packed" is the file that ships, written and read again. Parts are rounded
one at a time on the hardest held-out clips, `inertia` and `flips`; the verdict is of the packed file on all of them.
"""

from __future__ import annotations

import tempfile
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from safetensors import safe_open
from torch import Tensor

from ssilk_core.errors import fail
from ssilk_core.network.checkpoint import ModelFile, network, save_model
from ssilk_core.network.packing import dequantize, quantize
from ssilk_core.physics.energy import TERMS
from ssilk_core.physics.energy.frames import FRAMES_PER_CHUNK
from ssilk_core.quality.evaluation.splits import chosen, read_index
from ssilk_core.quality.evaluation.takes import back_and_forth
from ssilk_core.scene.assets import Motion
from ssilk_core.training.motion_bank import roll_states

# Amid a cartwheel, or where a cape lies on the head of someone who gets up, a rollout makes millimetres of any
# rounding, for a few frames, at the same energy.
MOST_RMS = 2.5e-4  # [m] over all vertices, frames and clips
MOST_MOVED = 1e-2  # [m] any vertex in any frame
MOST_CHANGED = 1e-3  # of each energy, relative to the sizes of all of them
HELD_OUT, HARDEST = ("valid", "flips"), ("inertia", "flips")
LOOPED, FRAMES, STRETCHES = ("02_04", "02_02", "49_08a"), 1000, 4

Rounding = Callable[[np.ndarray], np.ndarray]
ROUNDINGS: dict[str, Rounding] = {
    "bfloat16": lambda values: torch.from_numpy(values.copy()).bfloat16().float().numpy(),
    "float16": lambda values: values.astype(np.float16).astype(np.float32),
    "packed": lambda values: dequantize(*quantize(values)) if values.ndim > 1 else values,
}
PARTS: dict[str, Callable[[str, np.ndarray], bool]] = {
    "matrices of P": lambda name, values: name.startswith("initialiser") and values.ndim > 1,
    "matrices of S": lambda name, values: name.startswith("stepper") and values.ndim > 1,
    "matrices of D": lambda name, values: name.startswith("output") and values.ndim > 1,
    "blendshapes": lambda name, values: name == "decoder.shapes",
    "skinning weights": lambda name, values: name == "decoder.skin_offset",
    "all matrices": lambda name, values: values.ndim > 1,
    "biases": lambda name, values: name.endswith("bias"),
    "beta, spring": lambda name, values: name.startswith("integrator"),
}
SIZES = {
    "model.initialiser": "P", "model.stepper": "S", "model.output": "D", "model.decoder.shapes": "blendshapes",
    "model.integrator": "beta, spring", "model.decoder.skin_offset": "skinning weights",
    "scene.plain": "skinning weights", "scene.rig": "skinning weights", "scene.mesh": "garment mesh",
}  # fmt: skip


@dataclass(frozen=True)
class Loss:
    """What a packed model does differently from the whole one.

    Attributes:
        largest, rms: distances between their vertices [m].
        changes: of the mean of each energy, relative to the sizes of all of them.
        energies, inside: means of the whole model [J], and the share of its vertices inside the body.
    """

    largest: float
    rms: float
    changes: dict[str, float]
    energies: dict[str, float]
    inside: float

    @property
    def bearable(self) -> bool:
        moved = self.largest <= MOST_MOVED and self.rms <= MOST_RMS
        return moved and max(map(abs, self.changes.values())) <= MOST_CHANGED


@torch.no_grad()
def positions(subject: Subject, motion: Motion) -> Tensor:
    """Return a rollout's vertices (V, 3, N) [m] over a motion."""
    validator, model = subject.validator(motion), subject.model
    found = []
    for clip in validator.clips:
        frames = torch.arange(clip.start, clip.stop, device=subject.device)
        states = roll_states(model, validator.bank, [clip], validator.down)[0]
        found += [
            model.vertices(z, validator.bank.character(at))
            for z, at in zip(states.split(FRAMES_PER_CHUNK), frames.split(FRAMES_PER_CHUNK))
        ]
    return torch.cat(found, dim=-1)


def moved(subject: Subject, other: Subject, motions: Sequence[Motion]) -> Tensor:
    """Return by how much each vertex is elsewhere (V, N) [m], over all frames of some motions."""
    return torch.cat([(positions(other, m) - positions(subject, m)).norm(dim=1) for m in motions], dim=1)


def rms(distances: Tensor) -> float:
    return float((distances**2).mean() ** 0.5)


def with_parameters(subject: Subject, parameters: dict[str, np.ndarray]) -> Subject:
    """Return a subject with other parameters in its network."""
    file = replace(subject.file, parameters=parameters)
    return replace(subject, file=file, model=network(file, subject.scene).to(subject.device))


def means(subject: Subject, motions: Sequence[Motion], *, lbs: bool = False) -> dict[str, float]:
    """Return the means over all frames of some motions of what `Validator.frame_terms` gives."""
    terms = [subject.frame_terms(motion, lbs=lbs) for motion in motions]
    return {name: float(torch.cat([each[name] for each in terms]).mean()) for name in terms[0]}


def loss(subject: Subject, other: Subject, motions: Sequence[Motion]) -> Loss:
    """Return what `other` does differently from `subject` over some motions."""
    mine, theirs, distances = means(subject, motions), means(other, motions), moved(subject, other, motions)
    scale = sum(abs(mine[name]) for name in TERMS)
    changes = {name: (theirs[name] - mine[name]) / scale for name in TERMS}
    energies = {name: mine[name] for name in TERMS}
    return Loss(float(distances.max()), rms(distances), changes, energies, mine["collisions"])


def written(file: ModelFile, folder: str, *, pack: bool) -> Path:
    """Write a model into a folder and return where it lies."""
    path = Path(folder) / f"{'packed' if pack else 'whole'}.safetensors"
    save_model(path, file, pack=pack)
    return path


def bytes_by_part(path: Path) -> Counter[str]:
    """Return how many bytes of a model file each part takes."""
    sizes: Counter[str] = Counter()
    with safe_open(path, "numpy") as stream:
        for name in stream.keys():  # noqa: SIM118
            owner = next(
                (SIZES[start] for start in SIZES if name.removeprefix("scale.").startswith(start)), "skeleton"
            )
            sizes[owner] += stream.get_tensor(name).nbytes
    sizes["header"] = path.stat().st_size - sizes.total()
    return sizes


def size_rows(name: str, file: ModelFile) -> tuple[list[list[str]], dict[str, Any]]:
    """Return a line for each part of a model file, and the bytes whole and packed."""
    with tempfile.TemporaryDirectory() as folder:
        whole, small = (bytes_by_part(written(file, folder, pack=pack)) for pack in (False, True))
    rows = [[name, part, f"{whole[part]:,}", f"{small[part]:,}"] for part, _ in whole.most_common()]
    rows.append([name, "all", f"{whole.total():,}", f"{small.total():,}"])
    return rows, {"whole": whole, "packed": small}


def part_rows(subject: Subject, motions: Sequence[Motion]) -> tuple[list[list[str]], dict[str, Any]]:
    """Return a line for each part with what each rounding of it moves, largest and RMS [mm]."""
    reference = [positions(subject, motion) for motion in motions]
    rows, measured = [], {}
    for part, belongs in PARTS.items():
        found = {how: _rounded(subject, belongs, rounding, motions, reference) for how, rounding in ROUNDINGS.items()}
        rows.append([subject.name, part, *(f"{1e3 * most:.3f} / {1e3 * mean:.4f}" for most, mean in found.values())])
        measured[part] = found
    return rows, measured


def _rounded(
    subject: Subject,
    belongs: Callable[[str, np.ndarray], bool],
    rounding: Rounding,
    motions: Sequence[Motion],
    reference: list[Tensor],
) -> tuple[float, float]:
    """Return how far vertices are moved, largest and RMS [m], by rounding one part of the parameters."""
    parameters = subject.file.parameters
    rounded = {name: rounding(value) if belongs(name, value) else value for name, value in parameters.items()}
    other = with_parameters(subject, rounded)
    distances = [(positions(other, motion) - there).norm(dim=1) for motion, there in zip(motions, reference)]
    return max(float(each.max()) for each in distances), rms(torch.cat(distances, dim=1))


def packed_subject(subject: Subject, options: Namespace) -> Subject:
    """Return a subject as it comes out of a packed file."""
    with tempfile.TemporaryDirectory() as folder:
        return open_subject(written(subject.file, folder, pack=True), options.stage, options.device)


def time_rows(subject: Subject, small: Subject, options: Namespace) -> tuple[list[list[str]], dict[str, Any]]:
    """Return a line for each looped clip with the largest and the RMS error of each stretch of it [mm]."""
    rows, measured = [], {}
    for clip in LOOPED:
        motion = back_and_forth(clip_of(options, clip, subject), subject.file.config.fps, FRAMES)[0].clip(0, FRAMES)
        stretches = moved(subject, small, [motion]).chunk(STRETCHES, dim=1)
        measured[clip] = [(float(part.max()), rms(part)) for part in stretches]
        rows.append([subject.name, clip, *(f"{1e3 * most:.3f} / {1e3 * mean:.4f}" for most, mean in measured[clip])])
    return rows, measured


def loss_row(name: str, found: Loss) -> list[str]:
    """Return a line with the verdict on a packed model."""
    changes = [f"{found.changes[term]:+.4%}" for term in TERMS]
    lossless = "yes" if found.bearable else "no"
    return [name, f"{1e3 * found.largest:.3f}", f"{1e3 * found.rms:.4f}", *changes, lossless]


LOSS_HEADER = ("garment", "largest [mm]", "RMS [mm]", *TERMS, "lossless")


def tables(rows: Mapping[str, list[list[str]]]) -> str:
    """Return all tables of the measurement."""
    span = FRAMES // STRETCHES
    stretches = [f"frames {i * span} to {(i + 1) * span - 1}" for i in range(STRETCHES)]
    return "\n".join(
        (
            "Bytes\n",
            table(("garment", "part", "whole", "packed"), rows["sizes"]),
            "Vertices moved by rounding one part, largest / RMS [mm]\n",
            table(("garment", "part", *ROUNDINGS), rows["parts"]),
            f"Vertices moved by packing, over {FRAMES} frames of a looped clip, largest / RMS [mm]\n",
            table(("garment", "clip", *stretches), rows["time"]),
            "Packed against whole on all held-out clips; lossless: no vertex moved by more than "
            f"{1e3 * MOST_MOVED:g} mm, all by {1e3 * MOST_RMS:g} mm RMS at most, no energy by more than "
            f"{MOST_CHANGED:.1%} of all\n",
            table(LOSS_HEADER, rows["loss"]),
        )
    )


def held_out(options: Namespace, subject: Subject, splits: Sequence[str]) -> list[Motion]:
    """Read the clips of some splits of the index."""
    index = read_index(options.index)
    names = dict.fromkeys(name for split in splits for name in chosen(index, split))
    if not names:
        fail(str(options.index), f"no clip of {' or '.join(splits)}", "these are the held-out clips")
    return [clip_of(options, name, subject) for name in names]


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips with their splits and tags")
    options = parsed(parser)
    rows: dict[str, list[list[str]]] = {"sizes": [], "parts": [], "time": [], "loss": []}
    measured: dict[str, Any] = {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        small = packed_subject(subject, options)
        found = loss(subject, small, held_out(options, subject, HELD_OUT))
        parts = {
            "sizes": size_rows(subject.name, subject.file),
            "parts": part_rows(subject, held_out(options, subject, HARDEST)),
            "time": time_rows(subject, small, options),
            "loss": ([loss_row(subject.name, found)], vars(found)),
        }
        for name, (lines, figures) in parts.items():
            rows[name] += lines
            measured.setdefault(subject.name, {})[name] = figures
        print(tables(rows), flush=True)
    write_results(options, tables(rows), measured)


if __name__ == "__main__":
    main()
