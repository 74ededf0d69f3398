# SPDX-License-Identifier: Apache-2.0
"""Garments beneath the one that is certified or refined, as the files of their own pose them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ...errors import VerificationError, fail
from ...events import Message, Reporter
from ...files import sha256
from ...scene.assets import Floats, Ints, Mesh, Motion, Scene, SkinWeights
from ...scene.kinematics import motion_transforms, skin_points, skinning_matrices
from ..gltf.play import GlbShot
from ..targets import GLB
from .opened import open_shot, provenance_of

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot
    from ssilk_usd.shots.read import ShotPart

    from ...physics.collision.inner_cloth import InnerSurface

# What a shot says of the files of garments beneath, and of what they held, under these names.
OVER, OVER_HASHES = "over", "over_sha256"
THICKNESS = "thickness"  # [m] of the cloth of a glb that others lie over; stages of USD say it of each garment


class GarmentsBeneath:
    """Garments in files of their own, which stay where they are.

    Attributes:
        files: their paths, by their names.
        hashes: SHA-256 of each file before it was read; a glb is a part of the one that all are joined into.
        times: time codes of the frames.
        faces: triangles of all, of W vertices together, shape (G, 3).

    Args:
        samples: of each frame.
        hashes: SHA-256 of some of the files, by name, where they are known.

    Raises:
        SsilkError: a file cannot be read, or has other frames than the first.
    """

    def __init__(self, files: Mapping[str, Path], samples: int, hashes: Mapping[str, str] | None = None) -> None:
        self.files, known = dict(files), hashes or {}
        hashed = [name for name, path in self.files.items() if path.suffix != GLB]
        self.hashes = {name: known.get(name) or sha256(self.files[name]) for name in hashed}
        self._shots: list[Shot | GlbShot] = [open_shot(path) for path in self.files.values()]
        self.times = self._shots[0].sample_times(samples)
        faces, count = list[Ints](), 0
        for path, shot in zip(self.files.values(), self._shots):
            if shot.sample_times(samples) != self.times:
                fail(str(path), "other frames than the garments beside it", "all are of one range", "bake it again")
            own = len(shot.garment_points(self.times[0]))
            faces.append(next(mesh.faces for mesh in shot.meshes if mesh.is_garment) + count)
            count += own
        self.faces: Ints = np.concatenate(faces)

    def need_frames(self, count: int) -> None:
        """Raise `SsilkError` unless they have as many frames as the garment over them."""
        if len(self.times) != count:
            found, here = f"{len(self.times)} frames", f"the garment over it has {count}"
            fail(str(next(iter(self.files.values()))), found, here, "bake both over one range")

    @cached_property
    def surfaces(self) -> list[InnerSurface]:
        """Each as cloth that another one touches, in the bind pose.

        Raises:
            SsilkError: a file does not say how thick its cloth is.
        """
        return [_surface(path, shot) for path, shot in zip(self.files.values(), self._shots)]

    def each(self, frame: int) -> list[Floats]:
        """Return the vertices of each in a frame, in the world [m], shape (W, 3)."""
        return [shot.garment_points(self.times[frame]) for shot in self._shots]

    def points(self, frame: int) -> Floats:
        """Return the vertices of all in a frame, in the world [m], shape (W, 3)."""
        return np.concatenate(self.each(frame))

    def led_up_to(self, scene: Scene, motion: Motion) -> Iterator[list[Floats]]:
        """Yield each in the frames of a motion but for the last, which is the first frame: as if skin carried it.

        No file tells how it came there. It moves with the skin that is nearest to it in the bind pose.
        """
        skeleton, first = scene.character.skeleton, self.each(0)
        posed = motion_transforms(motion, skeleton.parents)
        matrices = skinning_matrices(posed[:-1], posed[-1])
        skins = [_skin_beneath(scene, surface.mesh) for surface in self.surfaces]
        for frame in matrices:
            yield [skin_points(points, skin, frame[None])[0] for points, skin in zip(first, skins)]

    def to_metadata(self, folder: Path) -> dict[str, object]:
        """Return what a shot in a folder says of them: their files from there, with forward slashes, and hashes."""
        named = {name: Path(os.path.relpath(path, folder)).as_posix() for name, path in self.files.items()}
        return {OVER: named, **({OVER_HASHES: self.hashes} if self.hashes else {})}


def beneath_said(
    said: Mapping[str, Any], path: Path, samples: int, made: str, report: Reporter
) -> GarmentsBeneath | None:
    """Return the garments that a file says it was made over, in their own files; None where it names none.

    It is warned of those that hold something else than then.

    Args:
        said: what `GarmentsBeneath.to_metadata` returned, among other facts.
        path: of the file.
        made: how it was made, such as "certified".

    Raises:
        VerificationError: one is not there.
    """
    files = _files_said(said, path)
    for name, file in files.items():
        if not file.is_file():
            raise VerificationError(f"{path}: it was {made} over '{name}', which is not at {file}; bake both again.")
    hashes = {name: sha256(files[name]) for name in said.get(OVER_HASHES) or {} if name in files}
    for text in changed_beneath(said, path, made, hashes):
        report(Message(text, "warning"))
    return GarmentsBeneath(files, samples, hashes) if files else None


def changed_beneath(
    said: Mapping[str, Any], path: Path, made: str, known: Mapping[str, str] | None = None
) -> list[str]:
    """Return in words which garments beneath are not what a file was made over; arguments as of `beneath_said`.

    Args:
        known: SHA-256 of some of their files, by name.
    """
    hashes, found, known = said.get(OVER_HASHES) or {}, [], known or {}
    for name, file in _files_said(said, path).items():
        if not file.is_file():
            found.append(f"{path}: it was {made} over '{name}', which is not at {file}; bake both again")
        elif name in hashes and (known.get(name) or sha256(file)) != hashes[name]:
            found.append(f"{path}: it was {made} over '{name}' as that was before; bake it again")
    return found


def _files_said(said: Mapping[str, Any], path: Path) -> dict[str, Path]:
    return {str(name): path.parent / str(place) for name, place in (said.get(OVER) or {}).items()}


def left_out(over: Mapping[str, str], beneath: Iterable[Path]) -> list[str]:
    """Return which models, whose SHA-256 are by name, are not those of files of garments beneath."""
    there = {_model_said(path) for path in beneath}
    return [name for name, digest in over.items() if digest not in there]


def _model_said(path: Path) -> str | None:
    """Return the SHA-256 of the model that a file's garment is played by; None where it says none."""
    if (said := provenance_of(path).get("model_sha256")) or path.suffix == GLB:
        return said
    record = _garment_part(path).record  # of what another program showed, such as Blender
    return record.model_hash if record else None


def _garment_part(path: Path, shot: Shot | None = None) -> ShotPart:
    from ssilk_usd.shots.read import read_parts

    shot = shot or cast("Shot", open_shot(path))
    return next(part for part, own in zip(read_parts(shot), shot.meshes) if own.is_garment)


def tell_left_out(where: str, missing: Sequence[str], made: str, report: Reporter) -> None:
    """Warn of a garment that is refined or certified without some of those that its model was trained over.

    Args:
        where: the garment, in words.
        missing: names of the models that it was trained over and does not meet.
        made: how it is made, such as "refined".
    """
    text = f"it was trained over {', '.join(missing)}, which is not baked beneath it here, and is {made} without"
    todo = "bake what lies beneath first, into the same folder or glb, or name it by --over"
    report(Message(f"{where}: {text}; {todo}", "warning"))


def _surface(path: Path, shot: Shot | GlbShot) -> InnerSurface:
    from ...physics.collision.inner_cloth import InnerSurface

    if isinstance(shot, GlbShot):
        rest, thickness = shot.garment_at_rest, provenance_of(path).get(THICKNESS)
    else:
        part = _garment_part(path, shot)
        rest, thickness = part.mesh, part.record and part.record.parameters.get(THICKNESS)
    if not isinstance(thickness, int | float):
        found, allowed = "it does not say how thick its cloth is", "a garment is refined over what 'ssilk bake' wrote"
        fail(str(path), found, allowed, "bake it again")
    return InnerSurface(rest, float(thickness))


def _skin_beneath(scene: Scene, mesh: Mesh) -> SkinWeights:
    """Return the weights of the skin that is nearest to each vertex of a garment in the bind pose."""
    from scipy.spatial import cKDTree

    body = scene.character.merged_body()
    _, nearest = cKDTree(body.mesh.points).query(mesh.points)
    return SkinWeights(mesh.path, body.skin.indices[nearest], body.skin.weights[nearest])
