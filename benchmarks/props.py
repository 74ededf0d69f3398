# SPDX-License-Identifier: Apache-2.0
"""How the network meets boxes: those that its cloth does not touch, and those that it swings into.

    python benchmarks/props.py --stage character.usdc --motions FOLDER --index FOLDER/index.json

First a box stands still beside the first pose of a clip, which is held: on four sides, away from the cloth by each of
--gaps. Told is how far it moves the cloth, which does not touch it (RMS). Then boxes are drawn that the body does not
come near, and that cloth which does not see them enters, up to --boxes in the first --frames of each clip. Told are
the shares of vertices more than 5 mm inside in these frames, in the mean and in the worst, seen and not.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from floor import clip_of, played, seeing
from helpers.reports import table
from helpers.subjects import Subject, open_subject
from scipy.spatial.transform import Rotation
from ssilk_usd.stages import demo_body_path

from ssilk_core.demo.shipped import shipped_path
from ssilk_core.network.runtime import Player
from ssilk_core.scene.assets import Collider, Floats, Motion, Scene, ShotWorld
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices

INSIDE = 5e-3  # [m]
HELD = 90  # frames
HALF = np.array([0.25, 0.5, 0.25])  # [m] half extents of boxes beside a held pose
SMALLEST, LARGEST = np.array([0.1, 0.2, 0.1]), np.array([0.4, 0.6, 0.4])  # [m] half extents of the others
AROUND = 0.25  # [m] that their centres are away from a vertex
ROOM = 0.01  # [m] between them and the body
BEFORE, AFTER = 15, 30  # frames, about that for which a box is drawn, in which cloth must enter it
ENTERS = 0.005  # share of the cloth, at least
TRIES = 600  # for each clip
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


@dataclass(frozen=True, eq=False)
class Box:
    """A box with its centre and half extents [m], turned about the vertical [rad]."""

    centre: Floats
    half: Floats
    turn: float = 0.0

    @property
    def axes(self) -> Floats:
        return Rotation.from_euler("y", self.turn).as_matrix()

    def world(self, fps: float) -> ShotWorld:
        """Return a world that holds it alone."""
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * self.half
        faces = np.array([half for a, b, c, d in QUADS for half in ((a, b, c), (a, c, d))])
        whole = np.ones(1, dtype=bool)
        points = corners @ self.axes.T + self.centre
        return ShotWorld(fps, (Collider("a box", faces, points[None], np.eye(4)[None], whole),))

    def depth(self, points: Floats) -> Floats:
        """Return how deep points (..., 3) are inside [m], negative outside."""
        return (self.half - np.abs((points - self.centre) @ self.axes)).min(axis=-1)


def beside(cloth: Floats, axis: int, side: int, gap: float) -> Box:
    """Return a box on one side of the bounds of cloth (V, 3), away by a gap [m]."""
    low, high = cloth.min(axis=0), cloth.max(axis=0)
    centre = (low + high) / 2
    centre[axis] = (high if side > 0 else low)[axis] + side * (gap + HALF[axis])
    return Box(centre, HALF)


def moved_by_untouched(options: argparse.Namespace, subject: Subject, player: Player) -> list[list[str]]:
    """Return rows of gaps and distances."""
    motion = clip_of(options, subject, options.held)
    held = motion.picked(np.zeros(HELD, dtype=int))
    free = played(player, held)[-1]
    rows = []
    for gap in options.gaps:
        found = []
        for axis, side in ((0, 1), (0, -1), (2, 1), (2, -1)):
            seen = seeing(player, held, beside(free, axis, side, gap).world(held.fps))
            away = played(player, seen)[-1] - free
            found.append(1e3 * np.sqrt((away**2).sum(axis=1).mean()))
        rows.append([f"{1e3 * gap:.0f}", *(f"{each:.1f}" for each in found)])
    return rows


def swung_into(options: argparse.Namespace, subject: Subject, player: Player) -> tuple[int, Floats, Floats]:
    """Return the number of boxes, and the share inside in each frame, seen and not."""
    dice, seen, unseen = np.random.default_rng(options.seed), [], []
    for entry in json.loads(options.index.read_text()):
        if entry["split"] != options.split:
            continue
        motion = clip_of(options, subject, entry["clip"])
        free, body, found = played(player, motion), posed_body(subject.scene, motion), 0
        for _ in range(TRIES):
            frame, vertex = dice.integers(BEFORE, motion.frame_count), dice.integers(free.shape[1])
            centre = free[frame, vertex] + AROUND * dice.normal(size=3)
            box = Box(centre, dice.uniform(SMALLEST, LARGEST), dice.uniform(0, np.pi))
            entered = box.depth(free[frame - BEFORE : frame + AFTER]) > INSIDE
            if entered.mean() < ENTERS or box.depth(body).max() > -ROOM:
                continue
            met = played(player, seeing(player, motion, box.world(motion.fps)))
            seen.append((box.depth(met) > INSIDE).mean(axis=1))
            unseen.append((box.depth(free) > INSIDE).mean(axis=1))
            found += 1
            if found == options.boxes:
                break
    if not seen:
        raise SystemExit(f"no box was found that the cloth enters in {options.split}")
    return len(seen), np.concatenate(seen), np.concatenate(unseen)


def posed_body(scene: Scene, motion: Motion) -> Floats:
    """Return every eighth vertex of the body in each frame [m], shape (F, N, 3)."""
    body, skeleton = scene.character.merged_body(), scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    skin = replace(body.skin, indices=body.skin.indices[::8], weights=body.skin.weights[::8])
    return skin_points(body.mesh.points[::8], skin, matrices)


def main() -> None:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--model", type=Path, default=shipped_path("cape"), metavar="FILE")
    found.add_argument("--stage", type=Path, default=demo_body_path(), help="USD file with the character")
    found.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="of motion files CLIP.usdc")
    found.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    found.add_argument("--split", default="test", help="of the clips (default test)")
    found.add_argument("--held", default="02_01", help="clip whose first pose is held (default 02_01)")
    found.add_argument("--gaps", type=float, nargs="+", default=[0.02, 0.06, 0.2, 0.4], help="[m]")
    found.add_argument("--boxes", type=int, default=4, help="in each clip (default 4)")
    found.add_argument("--frames", type=int, default=240, help="of each clip, at the model's rate (default 240)")
    found.add_argument("--seed", type=int, default=1)
    options = found.parse_args()
    subject = open_subject(options.model, options.stage, "cpu")
    player = Player(subject.file)
    sides = ["right [mm]", "left [mm]", "front [mm]", "back [mm]"]
    print(table(["away by [mm]", *sides], moved_by_untouched(options, subject, player)))
    count, *shares = swung_into(options, subject, player)
    rows = [
        [name, f"{100 * share.mean():.2f}", f"{100 * share.max():.1f}"]
        for name, share in zip(("seen", "not seen"), shares)
    ]
    print(table([f"{count} boxes", "inside, mean [%]", "worst frame [%]"], rows))


if __name__ == "__main__":
    main()
