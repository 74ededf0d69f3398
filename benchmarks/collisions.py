# SPDX-License-Identifier: Apache-2.0
"""Find out which garment vertices are inside the body, how deep, and why.

    python benchmarks/collisions.py pants.safetensors --stage character.usdc --motions FOLDER --clips 02_04 49_08a

A sample of frames is measured. Besides the signed distance that trains and validates, the body's winding number
(libigl, exact) counts how many times a point is enclosed. "Buried surface" is a colliding vertex whose nearest
point of the body lies inside another part of the body, as in an armpit or a bent knee: no place on that surface
is free. "Clearance" is the signed distance at rest, and 4 mm is the margin that collision energies ask for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from helpers.reports import table, write_results
from helpers.subjects import Subject, arguments, clip_of, open_subject, parsed
from torch import Tensor

from ssilk_core.physics.collision import signed_distance
from ssilk_core.scene.assets import CLASS_NAMES, Floats, Ints, Motion
from ssilk_core.training.motion_bank import roll_states

ABOVE = 2e-3  # [m] over the surface, where a free surface is outside the body
HEADER = ("garment", "", *(f"inside: {name}" for name in CLASS_NAMES), "inside: all", "by winding number",
          "median depth [mm]", "95 % depth [mm]", "buried surface", "inside at rest too", "most at")  # fmt: skip


def winding(subject: Subject, body: Floats, points: Floats) -> Floats:
    """Return how many times a posed body (B, 3) encloses each point (N, 3)."""
    import igl

    return np.asarray(igl.winding_number(body, subject.scene.character.merged_body().mesh.faces, points))


def buried(subject: Subject, body: Floats, points: Floats) -> np.ndarray:
    """Return whether the nearest point of the body, lifted by `ABOVE`, is inside the body, for points (N, 3)."""
    import igl

    faces = subject.scene.character.merged_body().mesh.faces
    _, face, nearest = igl.point_mesh_squared_distance(points, body, faces)[:3]
    corners = body[faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return winding(subject, body, nearest + ABOVE * normal) > 0.5


def poses(subject: Subject, motion: Motion, step: int) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return skinning matrices and the positions of model and LBS for every `step`-th frame of a motion."""
    validator, found = subject.validator(motion), []
    for clip in validator.clips:
        frames = torch.arange(clip.start, clip.stop)
        states = roll_states(subject.model, validator.bank, [clip], validator.down)[0][::step]
        character = validator.bank.character(frames[::step])
        found.append((character, subject.model.vertices(states, character), validator.lbs_vertices(character)))
    return found


class Count:
    """Adds up colliding vertices over frames."""

    def __init__(self, subject: Subject, rest: Floats) -> None:
        self.subject, self.rest = subject, rest
        self.inside = np.zeros(len(rest))
        self.frames = self.enclosed = self.buried = 0
        self.depths: list[Floats] = []

    def add(self, x: Tensor, character: Tensor) -> None:
        """Count positions (V, 3, N) under skinning matrices (J, 3, 4, N)."""
        posed = self.subject.body.pose(character)
        distance = signed_distance(x, posed).double().numpy()
        for frame in range(x.shape[-1]):
            at, body = x[..., frame].double().numpy(), posed.points[..., frame].double().numpy()
            colliding = distance[:, frame] < 0
            self.inside += colliding
            self.frames += 1
            self.enclosed += np.count_nonzero(winding(self.subject, body, at) > 0.5)
            if colliding.any():
                self.depths.append(-distance[colliding, frame])
                self.buried += np.count_nonzero(buried(self.subject, body, at[colliding]))

    def figures(self) -> dict[str, Any]:
        """Return shares and depths."""
        share, classes = self.inside / self.frames, self.subject.scene.classes
        depth = np.concatenate([*self.depths, np.zeros(0)])
        hits = max(self.inside.sum(), 1)
        return {
            **{name: float(share[classes == i].mean()) for i, name in enumerate(CLASS_NAMES) if (classes == i).any()},
            "all": float(share.mean()),
            "winding": self.enclosed / self.frames / len(share),
            "depth": [float(np.quantile(depth, q)) if len(depth) else 0.0 for q in (0.5, 0.95)],
            "buried": self.buried / hits,
            "at rest too": float(self.inside[self.rest < 0].sum() / hits),
            "joints": self._joints(),
        }

    def _joints(self) -> dict[str, float]:
        """Return the three joints that most of the colliding vertices belong to, with their shares."""
        scene = self.subject.scene
        skin = scene.lbs_skin
        owner: Ints = skin.indices[np.arange(len(skin.indices)), skin.weights.argmax(axis=1)]
        hits = np.bincount(owner, self.inside, minlength=len(scene.joint_names)) / max(self.inside.sum(), 1)
        return {scene.joint_names[j].rpartition("/")[2]: float(hits[j]) for j in np.argsort(-hits)[:3]}


def rest_distances(subject: Subject) -> Floats:
    """Return the signed distance of each vertex to the body in the bind pose [m], shape (V,)."""
    bind = torch.eye(3, 4).expand(subject.scene.character.skeleton.joint_count, 3, 4)[..., None]
    rest = subject.model.decoder.rest[..., None]
    return signed_distance(rest, subject.body.pose(bind))[:, 0].double().numpy()


def row(garment: str, how: str, found: dict[str, Any]) -> list[str]:
    """Return one line of the table."""
    classes = [f"{found[name]:.2%}" if name in found else "" for name in CLASS_NAMES]
    joints = ", ".join(f"{name} {share:.0%}" for name, share in found["joints"].items())
    depth = [f"{1000 * value:.1f}" for value in found["depth"]]
    return [garment, how, *classes, f"{found['all']:.2%}", f"{found['winding']:.2%}", *depth,
            f"{found['buried']:.0%}", f"{found['at rest too']:.0%}", joints]  # fmt: skip


@torch.no_grad()
def measure(subject: Subject, options: Any) -> dict[str, Any]:
    """Return the figures at rest, under the model and under linear blend skinning."""
    rest = rest_distances(subject)
    counts = {how: Count(subject, rest) for how in ("at rest", "model", "LBS")}
    bind = torch.eye(3, 4).expand(subject.scene.character.skeleton.joint_count, 3, 4)[..., None]
    counts["at rest"].add(subject.model.decoder.rest[..., None], bind)
    for clip in options.clips:
        for character, x, lbs in poses(subject, clip_of(options, clip, subject), options.step):
            counts["model"].add(x, character)
            counts["LBS"].add(lbs, character)
    found = {how: count.figures() for how, count in counts.items()}
    quantiles = [float(np.quantile(rest, q)) for q in (0, 0.05, 0.5)]
    closer = float(np.mean(rest < subject.file.fabric.contact_distance))
    return {**found, "clearance": quantiles, "within the margin at rest": closer}


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--clips", nargs="+", required=True, help="clips to sample")
    parser.add_argument("--step", type=int, default=15, help="frames from one sample to the next (default 15)")
    options = parsed(parser)
    rows, notes, measured = [], "", {}
    for path in options.models:
        subject = open_subject(path, options.stage, options.device)
        measured[subject.name] = found = measure(subject, options)
        rows += [row(subject.name, how, found[how]) for how in ("at rest", "model", "LBS")]
        least, low, middle = (1000 * value for value in found["clearance"])
        notes += (
            f"\n- {subject.name} at rest: clearance {least:.1f} mm at least, {low:.1f} mm at 5 %, {middle:.1f} mm in "
            f"the middle; {found['within the margin at rest']:.0%} of the vertices stand within the margin."
        )
        print(table(HEADER, rows) + notes, flush=True)
    write_results(options, table(HEADER, rows) + notes + "\n", measured)


if __name__ == "__main__":
    main()
