# SPDX-License-Identifier: Apache-2.0
"""What rides on the garment of a bake: read from the character's stage, and compared with the cloth once written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ...errors import VerificationError, fail
from ...events import Message, Reporter, silent
from ...files import split_location
from ...scene.assets import Floats, Mesh
from ...scene.riders import Attachment, Rider, RiderJoints, triangle_beneath

if TYPE_CHECKING:
    from pxr import Usd


def riders_of(
    stage: Usd.Stage,
    garment: Mesh,
    root: str | None,
    report: Reporter = silent,
    laid: Callable[[], Mesh] | None = None,
) -> tuple[Rider, ...]:
    """Return what rides on a garment, at rest.

    Args:
        laid: returns the garment where the stage's riders lie on it, where that is on another body: they go along.

    Raises:
        SsilkError: as `read_riders` does, a rider lies far from the garment, or its vertices cannot carry it.
    """
    from ssilk_usd.reading.riders import read_riders

    file, prim = split_location(garment.path)
    told, found = read_riders(stage, prim or file or "", root=root, report=report), []
    start = laid() if laid and told else garment
    for said in told:
        points = np.concatenate([mesh.points for mesh in said.meshes])
        attachment: Attachment | None = None
        if said.soft:
            triangle_beneath(points, start, said.path)  # which it is near to
        elif said.vertices is None:
            attachment = Attachment.beneath(points, start, said.path)
        else:
            attachment = Attachment.to_vertices(said.vertices, start, said.path)
        meshes = said.meshes
        if start is not garment:
            meshes = tuple(_along(each, start, garment, attachment) for each in meshes)
        found.append(Rider(said.path, said.name, meshes, attachment))
    return tuple(found)


def _along(mesh: Mesh, start: Mesh, end: Mesh, attachment: Attachment | None) -> Mesh:
    """Return a rider's mesh moved as the cloth beneath it is; a soft one point by point."""
    if attachment is None:
        beneath = [Attachment.beneath(point[None], start, mesh.path) for point in mesh.points]
        moves = [each.shares @ (end.points - start.points)[each.vertices] for each in beneath]
        return replace(mesh, points=mesh.points + np.array(moves))
    rest, posed = (each.points[attachment.vertices] for each in (start, end))
    moved = attachment.transforms(rest, posed[None])[0]
    return replace(mesh, points=mesh.points @ moved[:3, :3].T + moved[:3, 3])


SOFT = 1e-3  # [m] by which soft riders may be off without a warning


def need_joints(riders: Sequence[Rider]) -> None:
    """Raise `SsilkError` where what rides on a garment is soft, of which only the points are to be written."""
    for rider in riders:
        if rider.attachment is None:
            found, allowed = (
                "it is soft, and rides on cloth that is written as points",
                "it has the joints of its cloth",
            )
            fail(rider.path, found, allowed, "use --refined-output joints, or take ssilk:rideSoft away")


class RiddenShot(Protocol):
    """A shot whose garment and riders can be posed, whatever its file format."""

    name: str

    def garment_points(self, time: float) -> Floats:
        """Return the garment's points in world space [m], y up, shape (V, 3)."""

    def rider_points(self, time: float) -> list[Floats]:
        """Return the points of each mesh that rides on it [m], shape (M, 3)."""


def verify_riders(shot: RiddenShot, times: Sequence[float], riders: RiderJoints, report: Reporter = silent) -> None:
    """Compare the riders of a shot with where its own cloth carries them, both posed by its format's rules alone.

    How far soft ones are off is reported.

    Raises:
        VerificationError: a rider is missing, or a rigid one is off its cloth by more than rounding.
    """
    from ssilk_usd.checking.shot import allowed_error

    soft: dict[str, tuple[float, float]] = {}
    for time in times if riders else ():
        garment = shot.garment_points(time)
        found = shot.rider_points(time)
        if [len(each) for each in found] != [body.mesh.vertex_count for body in riders.bodies]:
            text = f"it has {len(found)} meshes that ride on its garment; {len(riders.bodies)} are needed"
            raise VerificationError(f"{shot.name}: {text}, as they were baked.")
        for body, points, (expected, factor) in zip(riders.bodies, found, riders.rider_points(garment)):
            off, name = float(np.linalg.norm(points - expected, axis=1).max()), body.mesh.path
            bound = factor * allowed_error(garment)
            if not off <= bound:
                raise VerificationError(
                    f"{shot.name}: {name} is {1000 * off:.3g} mm off its cloth at time code {time:g}; at most "
                    f"{1000 * bound:.3g} mm is allowed."
                )
            if bound == np.inf:
                soft[name] = max(soft.get(name, (0.0, time)), (off, time))
    for name, (off, time) in soft.items():
        text = f"{name} is soft, and at most {1000 * off:.2g} mm off its cloth (time code {time:g})"
        report(Message(text, "info" if off <= SOFT else "warning"))
