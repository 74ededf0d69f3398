# SPDX-License-Identifier: Apache-2.0
"""Measure how small baked shots are, and how exact, against the garment's points at each frame in single precision.

    python benchmarks/compact.py cape.safetensors --stage cape.usdc --motion 01_walk.usdc 02_walk_1.usdc

The motions are played one after the other, with cuts between them. USD stores numbers of
arrays as they are, so that rounding them saves nothing in the file itself; what it would save in transport, where
files are deflated, and what it costs, is measured too.
"""

from __future__ import annotations

import argparse
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from helpers.reports import table, write_results
from pxr import Sdf
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.writing.files import write_motion

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, BakeTask, LayerFolder
from ssilk_core.delivery.bake.opened import open_shot
from ssilk_core.delivery.targets import TARGETS, cap_influences
from ssilk_core.scene.assets import Floats
from ssilk_core.scene.kinematics import deform

SAMPLED = ("blendShapeWeights", "rotations")
BITS = (16, 12, 10)
HEADER = ["what is stored", "bytes", "share of the point cache", "largest error [mm]", "mean error [mm]"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """A file, and how far [m] it is from what was computed."""

    name: str
    size: int
    errors: Floats


def measure() -> None:
    """Measure and write the table."""
    options = _options()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        motion = _motion(options, folder)
        request = BakeRequest(model=options.model, stage=options.stage, motion=str(motion))
        task = BakeTask(garment="garment", shot="shot", request=request, points=True)
        layers = LayerFolder(folder / "usd")
        layers.bake(task)
        LayerFolder(folder / "blender").bake(replace(task, request=replace(request, target="blender")))
        exact = np.stack(list(layers.garment(task).over(request.motion).vertices()))
        rows = [*_rows(task, folder, exact), *_targets(request, folder, exact), _heaviest(layers, task, exact)]
    cache = exact.size * 4
    cells = [
        [row.name, *_share(row.size, cache), f"{1e3 * row.errors.max():.2g}",
         f"{1e3 * row.errors.mean():.2g}"] for row in rows
    ]  # fmt: skip
    measured = [
        {"name": row.name, "bytes": row.size, "largest": row.errors.max(), "mean": row.errors.mean()} for row in rows
    ]
    title = f"{options.frames} frames of {exact.shape[1]:,} vertices; the point cache has {cache:,} bytes.\n\n"
    write_results(options, title + table(HEADER, cells), {"cache": cache, "rows": measured})


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="trained model")
    parser.add_argument("--stage", required=True, help="USD file with its character")
    parser.add_argument("--motion", nargs="+", required=True, help="USD files with motions")
    parser.add_argument("--frames", type=int, default=300, help="of the shot (default 300)")
    parser.add_argument("--name", default="compact", help="of the results (default compact)")
    parser.set_defaults(device="cpu", threads=torch.get_num_threads())
    return parser.parse_args()


def _motion(options: argparse.Namespace, folder: Path) -> Path:
    """Write the motions as one, of as many frames as are asked for."""
    skeleton, path = read_character(options.stage).skeleton, folder / "motion.usdc"
    motions = [read_motion(motion, skeleton) for motion in options.motion]
    rotations = np.concatenate([motion.rotations for motion in motions])[: options.frames]
    translations = np.concatenate([motion.translations for motion in motions])[: options.frames]
    if len(rotations) < options.frames:
        raise SystemExit(f"--motion: {len(rotations)} frames; {options.frames} are needed.")
    write_motion(path, replace(motions[0], rotations=rotations, translations=translations), skeleton)
    return path


def _rows(task: BakeTask, folder: Path, exact: Floats) -> Iterator[Row]:
    lean, full = (LayerFolder(folder / name).layout(task) for name in ("usd", "blender"))
    errors = _errors(lean.animation, exact)
    yield Row(name="points.usdc, the point cache", size=lean.points.stat().st_size, errors=_rounding(exact))
    yield Row(name="anim.usdc, the shot", size=lean.animation.stat().st_size, errors=errors)
    name = "anim.usdc of target blender: every joint, the root's path in its joint"
    yield Row(name=name, size=full.animation.stat().st_size, errors=_errors(full.animation, exact))
    asset = lean.asset.stat().st_size + lean.geometry.stat().st_size
    yield Row(name="the asset, once for all shots, body included", size=asset, errors=errors)
    yield Row(name="anim.usdc, deflated", size=_deflated(lean.animation), errors=errors)
    for bits in BITS:
        rounded = lean.animation.with_name(f"rounded_{bits}.usdc")
        _round(lean.animation, rounded, bits)
        name = f"anim.usdc, rounded to {bits} bits, deflated"
        yield Row(name=name, size=_deflated(rounded), errors=_errors(rounded, exact))


def _targets(request: BakeRequest, folder: Path, exact: Floats) -> Iterator[Row]:
    """Yield the shot as one file for each target, garment alone."""
    for name, target in TARGETS.items():
        path = folder / f"{name}{target.suffixes[0]}"
        main(["bake", request.model, "--stage", request.stage, "--motion", request.motion, "--target", name,
              "--no-body", "-o", str(path)])  # fmt: skip
        yield Row(name=f"one file for {name}, garment alone", size=path.stat().st_size, errors=_errors(path, exact))


def _share(size: int, cache: int) -> tuple[str, str]:
    return (f"{size:,}", f"1 / {cache / size:.1f}") if size else ("", "")


def _heaviest(layers: LayerFolder, task: BakeTask, exact: Floats) -> Row:
    """Return what capping influences alone would cost: the heaviest of each vertex, with nothing learned."""
    rollout = layers.garment(task).over(task.request.motion)
    deformer = cap_influences(rollout.deformer, TARGETS["game4"])
    points = np.concatenate([deform(deformer, rollout.motion, pose) for pose in rollout.poses()])
    errors = np.linalg.norm(points - exact, axis=-1)
    return Row(name="for comparison: the 4 heaviest influences, nothing learned", size=0, errors=errors)


def _errors(path: Path, exact: Floats) -> Floats:
    shot = open_shot(path)
    played = np.stack([shot.garment_points(time) for time in shot.frame_times])
    return np.linalg.norm(played - exact, axis=-1)


def _rounding(exact: Floats) -> Floats:
    return np.linalg.norm(exact.astype(np.float32) - exact, axis=-1)


def _deflated(path: Path) -> int:
    return len(zlib.compress(path.read_bytes(), 9))


def _round(source: Path, target: Path, bits: int) -> None:
    """Copy a layer with its samples rounded to steps of 2 ** (1 - bits), of numbers in [-1, 1]."""
    layer = Sdf.Layer.OpenAsAnonymous(str(source))
    paths: list[Sdf.Path] = []
    layer.Traverse("/", lambda path: paths.append(path) if path.name in SAMPLED else None)
    for path in paths:
        for time in layer.ListTimeSamplesForPath(path):
            value = layer.QueryTimeSample(path, time)
            steps = np.round(np.array(value) * 2 ** (bits - 1)) / 2 ** (bits - 1)
            layer.SetTimeSample(path, time, type(value).FromNumpy(steps.astype(np.float32)))
    layer.Export(str(target))


if __name__ == "__main__":
    measure()
