# SPDX-License-Identifier: Apache-2.0
"""Play any shot back: meshes deformed by UsdSkel's own functions, or by samples of their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Ints

from ..opening.stage import EARLIEST, PRIMS, StageLike, apply, open_stage, stage_name
from ..opening.times import change_times
from ..reading.mesh import display_colour, is_drawn, is_garment, is_rider, read_mesh, rendered
from ..reading.posed import PlainMesh, SkinnedMesh, posed_mesh, skinning_of
from ..units import StageUnits


@dataclass(frozen=True, eq=False)
class ShotMesh:
    """A mesh of a shot.

    Attributes:
        name: its prim's name.
        path: its prim's path.
        faces: triangles, shape (F, 3).
        is_garment: it is marked as a garment (see `read_mesh.is_garment`); what is not counts as body.
        colour: the mean of its displayColor in sRGB, each from 0 to 1; None where it has none.
        is_rider: it rides on a garment, and is no body either.
    """

    name: str
    path: str
    faces: Ints
    is_garment: bool
    colour: tuple[float, float, float] | None = None
    is_rider: bool = False


class Shot:
    """Meshes over time, in metres and y up.

    Attributes:
        stage, units: the opened stage and its units.
        fps: frames per second, and time codes too.
        frame_times: time code of each frame.
        meshes: every visible mesh of the stage that a render shows, in its order; stand-ins where none does.
    """

    def __init__(self, source: StageLike) -> None:
        """Open a shot.

        Raises:
            SsilkError: not a readable stage, or one without visible meshes.
        """
        self.stage = open_stage(source)
        self.name = stage_name(self.stage)
        self.units = StageUnits.of(self.stage)
        self.fps = float(self.stage.GetTimeCodesPerSecond())
        skinned = skinning_of(self.stage)
        everything = Usd.PrimRange(self.stage.GetPseudoRoot(), PRIMS)
        prims = [prim for prim in everything if prim.IsA(UsdGeom.Mesh) and is_drawn(prim)]
        sides = [rendered([prim for prim in prims if is_garment(prim) == side]) for side in (False, True)]
        prims = [prim for prim in prims if any(prim in side for side in sides)]
        if not prims:
            fail(self.name, "no visible mesh", "a shot has at least one", "check that this is the right file")
        self._players = [posed_mesh(prim, skinned) for prim in prims]
        self.meshes = tuple(_describe(prim) for prim in prims)
        self.frame_times = frame_times(self.stage)

    def sample_times(self, per_frame: int = 1) -> tuple[float, ...]:
        """Return the time codes of the frames, or of several samples per frame."""
        return frame_times(self.stage, per_frame)

    def points(self, time: float) -> list[Floats]:
        """Return the points of each mesh in world space [m], y up, float64, shape (V, 3), at a time code."""
        code = Usd.TimeCode(float(time))
        xforms = UsdGeom.XformCache(code)
        return [apply(self.units.matrix, player.points(code, xforms)) for player in self._players]

    def mesh_points(self, index: int, time: float) -> Floats:
        """Return the points of one of `meshes` in world space [m], y up, float64, shape (V, 3), at a time code."""
        code = Usd.TimeCode(float(time))
        return apply(self.units.matrix, self._players[index].points(code, UsdGeom.XformCache(code)))

    def point_count(self, index: int) -> int:
        """Return how many points one of `meshes` has."""
        return len(UsdGeom.Mesh(self.stage.GetPrimAtPath(self.meshes[index].path)).GetPointsAttr().Get(EARLIEST))

    @property
    def is_skinned(self) -> bool:
        """Return whether joints move the garment; otherwise its points are stored."""
        garment = self._garment()
        return isinstance(garment, SkinnedMesh) and bool(garment.skinning.HasJointInfluences())

    def garment_points(self, time: float) -> Floats:
        """Return the points of the one garment [m], shape (V, 3).

        Raises:
            SsilkError: the shot has no garment, or several.
        """
        code = Usd.TimeCode(float(time))
        return apply(self.units.matrix, self._garment().points(code, UsdGeom.XformCache(code)))

    def rider_points(self, time: float) -> list[Floats]:
        """Return the points of each mesh that rides on a garment [m], shape (V, 3), in the stage's order."""
        return [self.mesh_points(index, time) for index, mesh in enumerate(self.meshes) if mesh.is_rider]

    def _garment(self) -> SkinnedMesh | PlainMesh:
        garments = [player for player, mesh in zip(self._players, self.meshes) if mesh.is_garment]
        if len(garments) != 1:
            fail(self.name, f"{len(garments)} meshes are marked as garments", "one is needed")
        return garments[0]


def _describe(prim: Usd.Prim) -> ShotMesh:
    faces = read_mesh(prim, np.eye(4)).faces
    return ShotMesh(prim.GetName(), str(prim.GetPath()), faces, is_garment(prim), _colour(prim), is_rider(prim))


def _colour(prim: Usd.Prim) -> tuple[float, float, float] | None:
    """Return a mesh's colour in sRGB (IEC 61966-2-1); None without one."""
    found = display_colour(prim)
    if found is None:
        return None
    linear = np.array(found)
    red, green, blue = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).tolist()
    return red, green, blue


def frame_times(stage: Usd.Stage, per_frame: int = 1) -> tuple[float, ...]:
    """Return the time codes of a stage's frames, or of several samples per frame."""
    start, end = _time_range(stage)
    return tuple(start + index / per_frame for index in range(int(np.floor((end - start) * per_frame + 1e-6)) + 1))


def _time_range(stage: Usd.Stage) -> tuple[float, float]:
    """Return the first and last time code: as authored, or else of all animated attributes."""
    if stage.HasAuthoredTimeCodeRange():
        return stage.GetStartTimeCode(), stage.GetEndTimeCode()
    prims = Usd.PrimRange(stage.GetPseudoRoot(), PRIMS)
    times = [change_times([attribute]) for prim in prims for attribute in prim.GetAuthoredAttributes()]
    spans = [(samples[0], samples[-1]) for samples in times if samples]
    return (min(low for low, _ in spans), max(high for _, high in spans)) if spans else (0.0, 0.0)
