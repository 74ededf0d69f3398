# SPDX-License-Identifier: Apache-2.0
"""Energies of a shot's garment in each frame, from its points alone."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from ...physics.collision import PosedBody, signed_distance
from ...physics.constants import GRAVITY
from ...physics.energy import TERMS, GarmentEnergy
from ...physics.energy.stretch import deformation_gradient_operator
from ...physics.intersections.cloth import ClothIntersections, IntersectionCounts
from ...physics.intersections.figures import EVERY, SelfIntersections
from ...physics.skin.covered_points import CoveredPoints
from ...physics.skin.covered_skin import ShownCounts, shown_skin
from ...physics.skin.figures import ShownSkin
from ...quality.evaluation.metrics import principal_stretches
from ...scene.assets import Floats, Mesh
from ...scene.fabrics import Fabric
from ...scene.mesh.topology import vertex_normals

SHOT_TERMS = tuple(term for term in TERMS if term != "tether")
SHARE, SHOWN, BARE = "inside the body", "covered skin that shows", "covered skin that is bare"
STRETCH = "stretch of the cloth"
CROSSED = "triangles that intersect others"
UNITS = {**dict.fromkeys((SHOWN, BARE, CROSSED, STRETCH, SHARE), "%"), "total": "J", **dict.fromkeys(SHOT_TERMS, "J")}
STRETCHED_SHARE = 0.99  # of the triangles, which stretch no more


@dataclass(eq=False)
class TermsMeter:
    """Measures the energies of a shot's frames, given in order.

    The energy of gravity counts heights above the middle of the body, relative to the garment at rest. A shot does
    not say which cloth is tight: all cloth collides with the whole body here, as stiffly as tight cloth, and none is
    tethered. In training tight cloth collides only with the patch under it.

    Attributes:
        garment: the mesh where it lies at rest.
        body: all body meshes at rest as one, or None.
        fps: frames per second.
        sewn: the mesh in the rest shape of its energies; where it lies by default.
        values: by name, one for each frame: energies [J], the shares of the covered skin that shows and that is
            bare, the share of triangles that intersect others, as it was in the last of every `EVERY` frames, the
            larger principal stretch that 99 triangles in 100 do not exceed, less one, and the share of
            vertices inside the body [%].
        finite: whether the garment of each frame is.
    """

    garment: Mesh
    body: Mesh | None
    fabric: Fabric
    fps: float
    sewn: Mesh | None = None
    values: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in UNITS})

    def __post_init__(self) -> None:
        rest = self.sewn or self.garment
        self.energy = GarmentEnergy(rest, self.fabric)
        self.columns = deformation_gradient_operator(rest, self.energy.mass.device, self.energy.mass.dtype)
        self.finite: list[bool] = []
        self.counts: list[ShownCounts] = []
        self.cloth = ClothIntersections(self.garment)
        self.crossed: list[IntersectionCounts] = []
        self.past: deque = deque(maxlen=2)
        import torch

        self.faces, self.covered = None, None
        if self.body:
            covered = CoveredPoints(self.body, self.garment, device=torch.device("cpu"))
            self.covered = covered if len(covered) else None
            self.faces = torch.as_tensor(np.array(self.body.faces))
        self.rest = self._height(self.garment.points, None if self.body is None else self.body.points)

    def add(self, points: Floats, body: Floats | None, time: float) -> None:
        """Take the frame of a time code: points of the garment (V, 3) and of the body (B, 3) [m].

        Where the garment is not finite, all covered skin shows and the energies are not finite.
        """
        import torch

        self.finite.append(bool(np.isfinite(points).all()))
        origin = points.mean(axis=0) if self.finite[-1] else np.zeros(3)
        x = torch.as_tensor(points - origin, dtype=torch.float32)[:, :, None]
        stretch, bending = self.energy.elastic(x)
        largest = principal_stretches(self.columns(x))[0].quantile(STRETCHED_SHARE)
        found = {
            "stretch": float(stretch),
            "bending": float(bending),
            "gravity": self._height(points, body) - self.rest,
            "stitch": float(self.energy.stitch(x)),
            "inertia": self._inertia(points),
            CROSSED: self._crossed(points, time),
            STRETCH: 100 * (float(largest) - 1),
            **self._collision(x, None if body is None else body - origin, time),
        }
        total = sum(value for name, value in found.items() if UNITS[name] == "J")
        for name, value in {"total": total, **found}.items():
            self.values[name].append(value)

    def shown_skin(self, name: str) -> ShownSkin | None:
        """Return the share of the covered skin that shows in the shot `name`; None where nothing is covered."""
        return shown_skin([(name, ShownCounts.joined(self.counts))]) if self.covered else None

    def intersections(self, name: str) -> SelfIntersections:
        """Return the share of the triangles that intersect others in the shot `name`."""
        return self.cloth.figures([(name, IntersectionCounts.joined(self.crossed))])

    def _crossed(self, points: Floats, time: float) -> float:
        """Return the share of triangles that intersect others [%], in this frame or in the last that was counted."""
        if len(self.values[CROSSED]) % EVERY == 0:
            self.crossed.append(self.cloth.counts([points], [time]))
        return 100 * float(self.crossed[-1].shares[0])

    def _height(self, points: Floats, body: Floats | None) -> float:
        """Return the garment's weight times its height above the middle of the body, or above y = 0 [J]."""
        ground = 0.0 if body is None else float(body[:, 1].mean())
        return GRAVITY * float(self.energy.mass.numpy() @ (points[:, 1] - ground))

    def _inertia(self, points: Floats) -> float:
        """Return sum m/(2 dt^2) |x - 2 x_{t-1} + x_{t-2}|^2; zero for the first two frames."""
        enough = len(self.past) == 2
        squared = ((points - 2 * self.past[1] + self.past[0]) ** 2).sum(1) if enough else np.zeros(len(points))
        self.past.append(points)
        return float(self.energy.mass.numpy() @ squared) * self.fps**2 / 2

    def _collision(self, x, body: Floats | None, time: float) -> dict[str, float]:  # type: ignore[no-untyped-def]  # torch is heavy
        import torch

        if body is None or self.body is None:
            return {"collision": 0.0, SHARE: 0.0, SHOWN: 0.0, BARE: 0.0}
        normals = vertex_normals(body, self.body.faces)
        at, towards = (torch.as_tensor(values, dtype=torch.float32)[:, :, None] for values in (body, normals))
        distance = signed_distance(self.energy.cloth.positions(x), PosedBody(at, towards, faces=self.faces))
        inside = 100 * float((distance[: len(x)] < 0).double().mean())
        found = {"collision": float(self.energy.collision_at(distance)), SHARE: inside, SHOWN: 0.0, BARE: 0.0}
        if self.covered:
            states = self.covered.states(x, at[self.covered.vertices])
            self.counts.append(ShownCounts.of(states, [time]))
            found |= {SHOWN: 100 * float(self.counts[-1].shares), BARE: 100 * float(self.counts[-1].bare)}
        return found


def worst_frames(values: Floats, count: int, apart: int) -> list[int]:
    """Return up to `count` frames with the largest finite values, the worst first, at least `apart` frames apart."""
    found: list[int] = []
    for frame in np.argsort(-np.asarray(values), kind="stable").tolist():
        if len(found) == count or not np.isfinite(values[frame]):
            break
        if all(abs(frame - other) >= apart for other in found):
            found.append(frame)
    return found
