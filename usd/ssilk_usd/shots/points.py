# SPDX-License-Identifier: Apache-2.0
"""Write a simulated garment as a point cache: a shot whose garment has its points at each frame, beside its body."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.errors import fail
from ssilk_core.files import replacing
from ssilk_core.scene.assets import Deformer, Floats, GarmentPose, Motion, Scene
from ssilk_core.scene.kinematics import lbs_deformer, lbs_poses

from ..opening.garment_api import GarmentRecord
from ..opening.stage import PRIMS
from ..reading.mesh import is_garment
from ..units import StageUnits
from ..writing.asset_info import AssetInfo
from ..writing.author import extent_array
from ..writing.body_faces import HiddenPolygons
from ..writing.export import need_layer_suffix, save
from .shot import ShotSummary, write_shot
from .velocities import cut_frames, with_velocities

if TYPE_CHECKING:
    from ssilk_core.scene.riders import RiderJoints

FRAMES_PER_SAVE = 128  # 5 MB of points in memory for a garment of 3,000 vertices


class PointCache:
    """A point cache that is being written; frames may come in any order.

    Attributes:
        shot: what the file holds.
    """

    def __init__(
        self, path: Path, shot: ShotSummary, vertex_count: int, units: StageUnits, samples_per_frame: int
    ) -> None:
        self.path, self.shot, self.frame_count, self.vertex_count = path, shot, shot.frame_count, vertex_count
        self.units, self.step, self.unsaved_count = units, 1 / samples_per_frame, 0
        self.written = np.zeros(self.frame_count, dtype=bool)
        self.layer = Sdf.Layer.FindOrOpen(str(path))
        stage = Usd.Stage.Open(self.layer, None)
        self.garment, self.root = _unbind(stage), stage.GetDefaultPrim().GetPath()
        UsdGeom.Mesh(stage.GetPrimAtPath(self.garment)).CreateVelocitiesAttr()

    def write(self, frame: int, points: Floats) -> None:
        """Write the garment's points [m], y up, shape (V, 3), of one frame of the shot.

        Raises:
            SsilkError: no such frame, points of another garment, or points that are not finite.
        """
        where = f"{self.path}: frame {frame}"
        if not 0 <= frame < self.frame_count:
            fail(where, "no such frame", f"frames run from 0 to {self.frame_count - 1}")
        if points.shape != (self.vertex_count, 3):
            fail(where, f"points of shape {points.shape}", f"({self.vertex_count}, 3) is needed")
        if not np.isfinite(points).all():
            fail(where, "NaN or infinity among the points", "all must be finite")
        placed = np.ascontiguousarray(self.units.points_from_core(points), dtype=np.float32)
        low, high = placed.min(axis=0), placed.max(axis=0)
        time = self.shot.start + self.step * frame
        self._set("points", time, Vt.Vec3fArray.FromNumpy(placed))
        self._set("extent", time, extent_array(low, high))
        around = np.array(self.layer.QueryTimeSample(self.root.AppendProperty("extent"), time))
        box = extent_array(np.minimum(low, around[0]), np.maximum(high, around[1]))
        self.layer.SetTimeSample(self.root.AppendProperty("extent"), time, box)
        self.written[frame] = True
        self.unsaved_count += 1
        if self.unsaved_count >= FRAMES_PER_SAVE:
            self.save()

    def _set(self, name: str, time: float, value: object) -> None:
        self.layer.SetTimeSample(self.garment.AppendProperty(name), time, value)

    def add_velocities(self, cuts: Container[int]) -> None:
        """Write the velocities of the points once all frames are there; none leads across `cuts`.

        See `velocities`: frames may have come in any order.
        """
        points = self.garment.AppendProperty("points")
        times = self.shot.start + self.step * np.arange(self.frame_count)
        read = (np.array(self.layer.QueryTimeSample(points, float(time)), dtype=np.float64) for time in times)
        for time, (_, moving) in zip(times, with_velocities(read, self.shot.fps / self.step, cuts)):
            self._set("velocities", float(time), Vt.Vec3fArray.FromNumpy(moving.astype(np.float32)))
            self.unsaved_count += 1
            if self.unsaved_count >= FRAMES_PER_SAVE:
                self.save()

    def save(self) -> None:
        """Write pending changes to the file."""
        save(self.layer, self.path)
        self.unsaved_count = 0


@contextmanager
def point_cache(
    path: str | Path,
    scene: Scene,
    motion: Motion,
    *,
    units: StageUnits,
    start: float | None = None,
    samples_per_frame: int = 1,
    include_body: bool = True,
    riders: RiderJoints | None = None,
    skinned: tuple[Deformer, Iterable[GarmentPose]] | None = None,
    hidden: Sequence[tuple[int, bool]] = (),
    hidden_polygons: HiddenPolygons | None = None,
    provenance: Mapping[str, object] | None = None,
    record: GarmentRecord | None = None,
    info: AssetInfo | None = None,
) -> Iterator[PointCache]:
    """Yield a cache that takes the garment's points frame by frame; the file appears once all are in it.

    Their velocities are added then, for motion blur.

    Character, body and time codes are those of a shot by `write_shot`; the garment is bound to nothing.

    Args:
        path: the file to write: .usdc, .usd, or .usda for people.
        motion: the character's motion at the samples of the shot, whose rate becomes the shot's.
        start: time code of the first frame, by default the motion's own.
        skinned: the garment and its poses with the joints of `riders`, which stay; linear blend skinning by default.
        units, samples_per_frame, include_body, riders, hidden, hidden_polygons, provenance, record, info: as
            `write_shot` takes them.

    Raises:
        SsilkError: frames are missing at the end, or the file cannot be written.
    """
    need_layer_suffix(path)
    deformer, poses = skinned or (lbs_deformer(scene), lbs_poses(motion.frame_count))
    with replacing(path) as temporary:
        shot = write_shot(
            temporary,
            deformer,
            motion,
            poses,
            units=units,
            start=motion.start if start is None else start,
            samples_per_frame=samples_per_frame,
            include_body=include_body,
            riders=riders,
            hidden=hidden,
            hidden_polygons=hidden_polygons,
            provenance=provenance,
            record=record,
            info=info,
        )
        cache = PointCache(temporary, shot, scene.garment.mesh.vertex_count, units, samples_per_frame)
        yield cache
        missing = int((~cache.written).sum())
        if missing:
            fail(str(path), f"{missing} of {motion.frame_count} frames have no points", "every frame needs points")
        cache.add_velocities(cut_frames(motion, scene.character.skeleton))
        cache.save()
        del cache  # the file is closed before it is renamed


def _unbind(stage: Usd.Stage) -> Sdf.Path:
    """Unbind the garment of a shot from its skeleton, and return its path."""
    prim = next(p for p in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS) if p.IsA(UsdGeom.Mesh) and is_garment(p))
    prim.RemoveAPI(UsdSkel.BindingAPI)
    for name in prim.GetAuthoredPropertyNames():
        if name.startswith(("skel:", "primvars:skel:")):
            prim.RemoveProperty(name)
    return prim.GetPath()
