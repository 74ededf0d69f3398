# SPDX-License-Identifier: Apache-2.0
"""How much cloth lies below the floor: the network that sees it, and the same one where it does not.

    python benchmarks/floor.py sunk --stage character.usdc --motions FOLDER --index FOLDER/index.json --split test
    python benchmarks/floor.py look --motions FOLDER --clip dm_cartwheel --simulation floor.npz -o sheet.png

The floor of each clip is level and touches the lowest point that the body reaches in it. Told are the share of the
garment's vertices that lie more than 5 mm below it in the first --frames of each clip, the worst frame, and how many
frames have a vertex there; and how deep the deepest lies. `look` draws simulator, network and plain skinning in one
clip over its floor; --simulation is read, or written where there is no such file.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from helpers.pictures import add_pictures, draw_rows, simulated_worlds
from helpers.reports import table
from helpers.subjects import Subject, open_subject
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.stages import demo_body_path

from ssilk_core.demo.shipped import shipped_path
from ssilk_core.events import TextReporter
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.sight import seen_proximity
from ssilk_core.scene.assets import Collider, Floats, Motion, Scene, ShotWorld
from ssilk_core.scene.kinematics import motion_transforms, resample, skin_points, skinning_matrices

BELOW = 5e-3  # [m]
SIZE = 100.0  # [m] of the floor
PLACES = 1000  # vertices of the body that find its lowest point


@dataclass(frozen=True)
class Sunk:
    """Cloth below a floor: mean and worst share of the vertices, share of the frames, and greatest depth [m]."""

    mean: float
    worst: float
    frames: float
    depth: float

    @classmethod
    def of(cls, heights: Floats) -> Sunk:
        """Return that of vertices (F, V) above the floor [m]."""
        below = heights < -BELOW
        share = below.mean(axis=1)
        return cls(share.mean(), share.max(), below.any(axis=1).mean(), max(0.0, -heights.min()))


def floor_of(scene: Scene, motion: Motion) -> float:
    """Return the height of the lowest point that a body reaches in a motion [m]."""
    body, skeleton = scene.character.merged_body(), scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    rows = np.linspace(0, body.mesh.vertex_count - 1, min(PLACES, body.mesh.vertex_count)).astype(int)
    skin = replace(body.skin, indices=body.skin.indices[rows], weights=body.skin.weights[rows])
    return float(skin_points(body.mesh.points[rows], skin, matrices)[..., 1].min())


def floor_world(motion: Motion, height: float) -> ShotWorld:
    """Return a world with a floor at a height [m]."""
    corners = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]) * SIZE + [0, height, 0]
    faces, whole = np.array([[0, 1, 2], [0, 2, 3]]), np.ones(1, dtype=bool)
    return ShotWorld(motion.fps, (Collider("the floor", faces, corners[None], np.eye(4)[None], whole),))


def seeing(player: Player, motion: Motion, world: ShotWorld) -> Motion:
    """Return a motion whose garment sees the colliders of a world."""
    return replace(motion, proximity=seen_proximity(world, motion, player))


def played(player: Player, motion: Motion) -> Floats:
    """Return the network's positions over a motion [m], shape (F, V, 3)."""
    playback = player.play(motion)
    return np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])


def sunk(options: argparse.Namespace, subject: Subject) -> None:
    """Print how much of the garment lies below the floor in each clip of a split."""
    player, rows = Player(subject.file), []
    every: dict[str, list[Floats]] = {"sees it": [], "does not": []}
    for entry in json.loads(options.index.read_text()):
        if entry["split"] != options.split:
            continue
        motion = clip_of(options, subject, entry["clip"])
        floor = floor_of(subject.scene, motion)
        for name, seen in ("sees it", seeing(player, motion, floor_world(motion, floor))), ("does not", motion):
            heights = played(player, seen)[..., 1] - floor
            every[name].append(heights)
            rows.append([entry["clip"], name, *_cells(Sunk.of(heights))])
    rows += [["all", name, *_cells(Sunk.of(np.concatenate(heights)))] for name, heights in every.items()]
    print(table(["clip", "network", "mean [%]", "worst [%]", "frames [%]", "deepest [mm]"], rows))


def look(options: argparse.Namespace, subject: Subject) -> None:
    """Draw simulator, network and linear blend skinning in one clip over its floor."""
    motion, report, player = clip_of(options, subject, options.clip), TextReporter(), Player(subject.file)
    world, skeleton = floor_world(motion, floor_of(subject.scene, motion)), subject.scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    rows = {
        "simulator": simulated_worlds(options.simulation, subject, motion, [world], report)[0],
        "SSILK": played(player, seeing(player, motion, world)),
        "plain skinning": skin_points(subject.scene.garment.mesh.points, subject.scene.lbs_skin, matrices),
    }
    draw_rows(rows, subject.dressed, motion, options, report)


def clip_of(options: argparse.Namespace, subject: Subject, name: str) -> Motion:
    """Return the first frames of a clip at the model's rate."""
    motion = read_motion(options.motions / f"{name}.usdc", subject.scene.character.skeleton)
    return resample(subject.on_body(motion), subject.file.config.fps).clip(0, options.frames)


def main() -> None:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("what", choices=["sunk", "look"])
    found.add_argument("--model", type=Path, default=shipped_path("cape"), metavar="FILE")
    found.add_argument("--stage", type=Path, default=demo_body_path(), help="USD file with the character")
    found.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="of motion files CLIP.usdc")
    found.add_argument("--index", type=Path, help="JSON list of clips and their splits, for 'sunk'")
    found.add_argument("--split", default="test", help="of the clips (default test)")
    found.add_argument("--clip", default="dm_cartwheel", help="that 'look' draws (default dm_cartwheel)")
    found.add_argument("--frames", type=int, default=300, help="of each clip, at the model's rate (default 300)")
    found.add_argument("--simulation", type=Path, metavar="NPZ", help="positions, read or written")
    found.add_argument("--device", default="cpu", help="where the simulator runs (default cpu)")
    add_pictures(found)
    options = found.parse_args()
    needed = "index" if options.what == "sunk" else "simulation"
    if getattr(options, needed) is None:
        found.error(f"'{options.what}' needs --{needed}")
    subject = open_subject(options.model, options.stage, options.device)
    (sunk if options.what == "sunk" else look)(options, subject)


def _cells(sunk: Sunk) -> list[str]:
    return [
        f"{100 * sunk.mean:.3f}",
        f"{100 * sunk.worst:.2f}",
        f"{100 * sunk.frames:.1f}",
        f"{1e3 * sunk.depth:.0f}",
    ]


if __name__ == "__main__":
    main()
