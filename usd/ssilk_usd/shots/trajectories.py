# SPDX-License-Identifier: Apache-2.0
"""Read the trajectories of a mesh's vertices, whoever made them: the points of a cache at each of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import overload

import numpy as np
from pxr import Sdf, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats, Ints

from ..opening.stage import USD_SUFFIXES
from .play import Shot

OTHER_CACHES = {
    ".abc": "an Alembic cache, which this build of USD has no plug-in for",
    ".mdd": "an MDD cache, which tells no unit, axis or mesh",
    ".pc2": "a PC2 cache, which tells no unit, axis or mesh",
}
MOST_OTHER_EDGES = 0.5  # share of the edges: with all quads divided along their other diagonals a third is others


class MeshTrajectories(Sequence[Floats]):
    """The points of one mesh of a stage in the world [m], y up, shape (V, 3), at each of its frames.

    A frame is read when it is asked for, so any number of them take little memory.

    Attributes:
        fps: frames per second [1/s], those of the points' samples.
        times: time code of each frame.
        seconds: the same in seconds, shape (F,).
        mesh: path of the mesh.
        vertex_count: of the mesh.
    """

    def __init__(self, source: str, vertex_count: int | None = None, faces: Ints | None = None) -> None:
        """Open a cache.

        Args:
            source: "file[:/Prim/Path]". Where no prim is named, it is the mesh that is marked as a garment, or the
                one mesh that has `vertex_count` points.
            faces: triangles of the garment, which the mesh has to have as well, shape (F, 3).

        Raises:
            SsilkError: the file cannot be read, or holds no such mesh, or several, or another mesh.
        """
        file, prim = split_location(source)
        _need_readable(file)
        self._shot = Shot(file)
        self._index = _chosen(self._shot, prim, vertex_count)
        self.mesh = self._shot.meshes[self._index].path
        self.times, step = self._sampled()
        second = float(self._shot.stage.GetTimeCodesPerSecond())
        self.fps, self.seconds = second / step, np.array(self.times) / second
        self._second = second
        self.vertex_count = len(self[0])
        if vertex_count is not None and self.vertex_count != vertex_count:
            fail(
                f"{file}:{self.mesh}",
                f"{self.vertex_count} points",
                f"the garment has {vertex_count}",
                "cache the same mesh, its vertices in the same order",
            )
        if faces is not None and _other_edges(self._shot.meshes[self._index].faces, faces) > MOST_OTHER_EDGES:
            fail(
                f"{file}:{self.mesh}",
                "its edges join other vertices than the garment's",
                "point i of the cache is vertex i of the garment",
                "cache the same mesh, its vertices in the same order",
            )

    def _sampled(self) -> tuple[Sequence[float], float]:
        """Return the time codes of the frames, as the points are sampled or else all, and the step between them."""
        prim = self._shot.stage.GetPrimAtPath(self.mesh)
        samples = np.array(UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples())
        if len(samples) < 2:
            return self._shot.frame_times, 1.0
        step = float(np.median(np.diff(samples)))
        count = round((samples[-1] - samples[0]) / step) + 1
        return [float(samples[0] + number * step) for number in range(count)], step

    def __len__(self) -> int:
        return len(self.times)

    def at(self, code: float) -> Floats:
        """Return the points at a time code, also between frames."""
        return self._shot.mesh_points(self._index, code)

    def seconds_to_codes(self, seconds: float) -> float:
        """Return how many time codes so many seconds are."""
        return seconds * self._second

    @overload
    def __getitem__(self, frame: int) -> Floats: ...
    @overload
    def __getitem__(self, frame: slice) -> list[Floats]: ...
    def __getitem__(self, frame: int | slice) -> Floats | list[Floats]:
        if isinstance(frame, slice):
            return [self[each] for each in range(*frame.indices(len(self)))]
        return self._shot.mesh_points(self._index, self.times[frame])


def _other_edges(faces: Ints, own: Ints) -> float:
    """Return the share of the edges of triangles (F, 3) that `own` ones (G, 3) do not have."""
    one, other = ({(min(a, b), max(a, b)) for t in each.tolist() for a, b in zip(t, t[1:] + t[:1])}
                  for each in (faces, own))  # fmt: skip
    return len(one - other) / max(1, len(one))


def _need_readable(file: str) -> None:
    """Raise `SsilkError` for a file of points that is not USD, where it is known what it is."""
    suffix = Path(file).suffix
    if suffix not in OTHER_CACHES or not Path(file).is_file():
        return
    if Sdf.FileFormat.FindByExtension(suffix.removeprefix(".")) is None:
        fail(
            file,
            OTHER_CACHES[suffix],
            f"a cache is one of {', '.join(USD_SUFFIXES)}",
            "export the points as USD, or put the file on the garment in Blender and press To Bones",
        )


def _chosen(shot: Shot, prim: str | None, vertex_count: int | None) -> int:
    """Return the index of the mesh that is asked for, by itself or by a prim that holds it."""
    meshes, wanted = shot.meshes, f"meshes of {vertex_count} points"
    among = list(range(len(meshes)))
    found = [index for index, mesh in enumerate(meshes) if mesh.is_garment]
    if prim is not None:
        found = [index for index, mesh in enumerate(meshes) if prim in (mesh.path, mesh.name)]
        among = found = found or [index for index, mesh in enumerate(meshes) if _holds(prim, mesh.path)]
        wanted += f" in '{prim}'"
    if len(found) != 1:
        found = [index for index in among if shot.point_count(index) == vertex_count]
    if len(found) != 1:
        names = ", ".join(f"{mesh.path} ({shot.point_count(index)})" for index, mesh in enumerate(meshes[:6]))
        asked = f"{len(found)} {wanted}" if among else f"no visible mesh '{prim}'"
        fail(shot.name, asked, f"it has {names}", "name one: FILE:/PRIM")
    return found[0]


def _holds(prim: str, mesh: str) -> bool:
    """Return whether a prim, by its path or name, is above a mesh, as the Xforms are that many programs write."""
    above = mesh.rpartition("/")[0]
    return above == prim or above.startswith(f"{prim}/") or prim in above.split("/")
