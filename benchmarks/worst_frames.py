# SPDX-License-Identifier: Apache-2.0
"""Whether the solver shows less skin than the network in a clip's worst frame.

    python benchmarks/worst_frames.py cape.safetensors --stage character.usdc --motions FOLDER --clips 01_14

Solver iterations start from the network's state in that frame, and inertia holds the cloth there: a few, as
`bake --refine` makes them, and as many as the solver needs to its tolerance. Then cloth is lifted off skin that still
shows. The share of the skin that shows and lies inside another part of the body is told too: no one sees it.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from helpers.subjects import Subject, arguments, clip_of, measure_each, parsed
from refine import NetworkTake
from shown_skin import refined_points, seen

from ssilk_core.authoring.setup.surface import is_enclosed
from ssilk_core.physics.skin.covered_skin import CoveredSkin
from ssilk_core.scene.assets import Floats
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices
from ssilk_core.scene.mesh.topology import vertex_normals

ITERATIONS = (4, 200)
BEFORE = 1  # frames before the worst one, for its drag
ABOVE = 1.5e-3  # [m] over the skin, where it is asked what is inside: skin is not inside itself
METHODS = ("network", *(f"{count} iterations" for count in ITERATIONS))
HEADER = ("garment", "clip", "frame", *(f"{method} [%]" for method in METHODS), "of these inside another part [%]")


def last_frame(subject: Subject, skin: CoveredSkin, take: NetworkTake, points: Floats) -> dict[str, float]:
    """Return the share of covered points that show in the last frame, and that do so inside another part."""
    x, character = list(take.blocks(points))[-1]
    shows = skin.states(x[..., -1:], character[..., -1:]).shows[:, 0].cpu().numpy()
    scene = subject.dressed.scene
    merged, skeleton = scene.character.merged_body(), scene.character.skeleton
    world = motion_transforms(take.motion, skeleton.parents)[-1:]
    (posed,) = skin_points(merged.mesh.points, merged.skin, skinning_matrices(world, skeleton.bind_transforms))
    body = replace(merged.mesh, points=posed)
    corners, weights = body.faces[skin.points.faces[shows]], skin.points.weights[shows][..., None]
    normals = (vertex_normals(posed, body.faces)[corners] * weights).sum(axis=1)
    places = (posed[corners] * weights).sum(axis=1) + ABOVE * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return {"shows": float(shows.mean()), "inside": float(is_enclosed(places, body).sum() / len(shows))}


@torch.no_grad()
def measure(subject: Subject, options: Namespace) -> dict[str, Any]:
    """Return, by clip, the worst frame and the shares of covered skin that show there."""
    skin = CoveredSkin(subject.scene, device=subject.device)

    found: dict[str, Any] = {}
    for clip in options.clips:
        whole = NetworkTake.of(subject, clip_of(options, clip, subject))
        shown = np.asarray(seen(subject, skin, whole.blocks(whole.points))[0].shares)
        worst = max(int(shown.argmax()), BEFORE)
        take = whole.clip(worst - BEFORE, worst + 1)
        points = [take.points, *(refined_points(take, count) for count in ITERATIONS)]
        methods = {name: last_frame(subject, skin, take, each) for name, each in zip(METHODS, points, strict=True)}
        found[clip] = {"frame": worst, **methods}
    return found


def rows(garment: str, found: dict[str, Any]) -> list[list[str]]:
    """Return the lines of a garment."""
    return [
        [garment, clip, str(at["frame"]), *(f"{at[method]['shows']:.2%}" for method in METHODS),
         " / ".join(f"{at[method]['inside']:.2%}" for method in METHODS)]
        for clip, at in found.items()
    ]  # fmt: skip


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", required=True, metavar="NAME", help="clips of the motions' folder")
    measure_each(parsed(parser), HEADER, measure, rows)


if __name__ == "__main__":
    main()
