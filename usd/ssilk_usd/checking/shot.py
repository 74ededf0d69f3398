# SPDX-License-Identifier: Apache-2.0
"""Check a written shot: USD's validators, our own rules, and the points that UsdSkel computes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Protocol

import numpy as np
from pxr import Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, UsdValidation

from ssilk_core.errors import VerificationError
from ssilk_core.scene.assets import Floats

from ..opening.stage import PRIMS, apply, open_stage, world_matrix
from ..shots.play import Shot, frame_times
from .rules import (
    ShotFinding,
    check_animation,
    check_blendshapes,
    check_mesh,
    check_skeleton,
    check_skin,
    error_unless,
)

TOLERANCE = 1e-5  # [m]
WORLD = 10_000.0  # [m] from the origin; what rounding is allowed does not grow beyond
EPSILON = float(np.finfo(np.float32).eps)
_SEVERITIES = {
    UsdValidation.ValidationErrorType.Error: "error",
    UsdValidation.ValidationErrorType.Warn: "warning",
}
# Shaders of MaterialX, MDL and renderers are known where their plugins are, which are not here.
_OF_PLUGINS = ("MissingShaderIdInRegistry", "MissingSourceTypeInRegistry")
# A texture, since a stage with a missing layer is not opened; subsets for materials, which may not say how they part.
_OF_LOOKS = ("UnresolvableDependency", "InvalidFamilyType")


def check_shot(path: str | Path) -> list[ShotFinding]:
    """Return the findings about a shot: those of UsdValidation, then those of our checks; empty if it is valid.

    Materials and subsets are copied from the character's stage, so what is wrong with these is a warning.

    Extents are compared with the skinned points only where nothing else is wrong.

    Raises:
        SsilkError: the file cannot be read as USD.
    """
    stage = open_stage(path)
    findings = [*_validate(stage), *_check_stage(stage), *_check_prims(stage)]
    if not any(finding.severity == "error" for finding in findings):
        findings += _check_extents(Shot(stage))
    return findings


def _validate(stage: Usd.Stage) -> Iterator[ShotFinding]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    quiet = UsdUtils.CoalescingDiagnosticDelegate()  # what follows says the same
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    del quiet
    for error in errors:
        places = [
            site.GetPrim() if site.IsPrim() else site.GetProperty()
            for site in error.GetSites()
            if site.IsPrim() or site.IsProperty()
        ]
        severity = _SEVERITIES.get(error.GetType())
        if not severity or error.GetName() in _OF_PLUGINS:
            continue
        is_of_look = error.GetName() in _OF_LOOKS or (places and all(map(_is_in_material, places)))
        paths = ", ".join(str(place.GetPath()) for place in places)
        yield ShotFinding("warning" if is_of_look else severity, paths, error.GetMessage())


def _is_in_material(place: Usd.Prim | Usd.Property) -> bool:
    paths = place.GetPath().GetPrimPath().GetPrefixes()
    return any(place.GetStage().GetPrimAtPath(path).IsA(UsdShade.Material) for path in paths)


def _check_stage(stage: Usd.Stage) -> Iterator[ShotFinding]:
    """Check the default prim, kind, rates, units and frame range, and that there is exactly one SkelRoot."""
    top, root = stage.GetPseudoRoot(), stage.GetDefaultPrim()
    yield from error_unless(root, top, "there is no default prim")
    if root:
        yield from error_unless(Usd.ModelAPI(root).GetKind(), root, "the default prim has no kind")
    for name in ("timeCodesPerSecond", "framesPerSecond", "startTimeCode", "endTimeCode", "metersPerUnit", "upAxis"):
        yield from error_unless(stage.HasAuthoredMetadata(name), top, f"{name} is not authored")
    same = stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond()
    yield from error_unless(same, top, "timeCodesPerSecond and framesPerSecond differ")
    roots = [prim for prim in Usd.PrimRange(top, PRIMS) if prim.IsA(UsdSkel.Root)]
    yield from error_unless(len(roots) == 1, top, f"there are {len(roots)} SkelRoots, where one is needed")


def _check_prims(stage: Usd.Stage) -> Iterator[ShotFinding]:
    frames = frame_times(stage)
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS):
        if prim.IsPseudoRoot():
            continue
        yield from error_unless(prim.GetTypeName(), prim, "it has no type, which cuts skinning off beneath it")
        yield from error_unless(not prim.IsInstanceable(), prim, "it is instanceable, which artists cannot edit")
        if prim.IsA(UsdSkel.Skeleton):
            yield from check_skeleton(prim)
            yield from _check_source(prim, frames)
        if prim.IsA(UsdGeom.Mesh):
            yield from check_mesh(prim)
            yield from _check_binding(prim)


def _check_source(prim: Usd.Prim, frames: tuple[float, ...]) -> Iterator[ShotFinding]:
    source = UsdSkel.BindingAPI(prim).GetInheritedAnimationSource()
    yield from error_unless(source, prim, "no animation is bound to it")
    if source:
        yield from check_animation(source, UsdSkel.Skeleton(prim).GetJointsAttr().Get() or [], frames)


def _check_binding(prim: Usd.Prim) -> Iterator[ShotFinding]:
    """Check influences and blendshapes of a mesh that is bound to a skeleton."""
    skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    if not prim.HasAPI(UsdSkel.BindingAPI):
        return
    yield from error_unless(skeleton, prim, "it is bound to no skeleton")
    if skeleton:
        source = UsdSkel.BindingAPI(skeleton.GetPrim()).GetInheritedAnimationSource()
        yield from check_skin(prim, skeleton.GetJointsAttr().Get() or [])
        animated = UsdSkel.Animation(source).GetBlendShapesAttr().Get() if source else None
        yield from check_blendshapes(prim, animated or [])


def _check_extents(shot: Shot) -> Iterator[ShotFinding]:
    """Check that the SkelRoot's extent contains everything skinned at each frame."""
    root = next(prim for prim in Usd.PrimRange(shot.stage.GetPseudoRoot(), PRIMS) if prim.IsA(UsdSkel.Root))
    within = [mesh.path.startswith(f"{root.GetPath()}/") for mesh in shot.meshes]
    extent = UsdGeom.Boundable(root).GetExtentAttr()
    missing = np.setdiff1d(shot.frame_times, extent.GetTimeSamples())
    if len(missing):
        text = f"extent has no sample at {len(missing)} of {len(shot.frame_times)} frames"
        yield ShotFinding("error", str(root.GetPath()), text)
        return
    for time in shot.frame_times:
        points = np.concatenate([each for each, inside in zip(shot.points(time), within) if inside])
        low, high = _world_box(shot, root, np.array(extent.Get(time), dtype=np.float64), time)
        slack = allowed_error(points)
        if (points < low - slack).any() or (points > high + slack).any():
            yield ShotFinding(
                "error", str(root.GetPath()), f"extent does not hold the skinned points at time {time:g}"
            )
            return


def _world_box(shot: Shot, root: Usd.Prim, extent: Floats, time: float) -> tuple[Floats, Floats]:
    """Return the bounds [m], y up, of the corners of an extent."""
    corners = np.stack(np.meshgrid(*extent.T), axis=-1).reshape(-1, 3)
    posed = apply(shot.units.matrix @ world_matrix(root, Usd.TimeCode(time)), corners)
    return posed.min(axis=0), posed.max(axis=0)


@dataclass(frozen=True)
class Comparison:
    """Distance of a shot from the computed points, at the vertex that is nearest to its bound or furthest past it.

    Attributes:
        worst: distance [m]; bound: what is allowed there [m].
        time: time code; vertex: index.
    """

    worst: float
    bound: float
    time: float
    vertex: int

    @property
    def passed(self) -> bool:
        return self.worst <= self.bound


def allowed_error(points: Floats, tolerance: float = TOLERANCE) -> float:
    """Return `tolerance` [m] plus what float32 rounds off: four units in the last place of the largest coordinate.

    Far from the origin float32 itself is coarser than any tolerance: 100 m away its spacing is 7.6e-6 m. A vertex
    is rounded when joints are stored, when each influence is added, and when it is stored. An allowance in proportion
    to the points alone would allow any error to points that are themselves wrong, so that it proves nothing. Game
    worlds reach some kilometres; therefore it ends at `WORLD`, at 4.8 mm; further out, a shot has to be as
    close as it is there.
    """
    return tolerance + 4 * EPSILON * min(float(np.abs(points[np.isfinite(points)]).max(initial=0.0)), WORLD)


class PosedGarment(Protocol):
    """A shot whose garment can be posed, whatever its file format."""

    name: str

    def sample_times(self, per_frame: int = 1) -> tuple[float, ...]:
        """Return the time codes of its frames, or of several samples per frame."""

    def garment_points(self, time: float) -> Floats:
        """Return the garment's points in world space [m], y up, shape (V, 3)."""


def compare_points(
    shot: PosedGarment, expected: Iterable[Floats], *, tolerance: float = TOLERANCE, samples_per_frame: int = 1
) -> Comparison:
    """Compare the garment of a shot, re-skinned from its file, with the decoder's vertices.

    Args:
        expected: for each sample of the shot in order, garment points in world space [m], y up, shape (V, 3).
        tolerance: largest distance [m] allowed, besides the rounding of float32 (see `allowed_error`).
        samples_per_frame: as the shot was written.

    Raises:
        VerificationError: frames or vertices are not as many as in the shot.
    """
    times = shot.sample_times(samples_per_frame)
    return max(_compare_frames(shot, times, expected, tolerance), key=lambda found: found.worst / found.bound)


def _compare_frames(
    shot: PosedGarment, times: Iterable[float], expected: Iterable[Floats], tolerance: float
) -> Iterator[Comparison]:
    for time, points in zip_longest(times, expected):
        if time is None or points is None:
            raise VerificationError(f"{shot.name}: the shot has another number of frames than what was computed.")
        yield _compare_frame(shot, time, points, tolerance)


def _compare_frame(shot: PosedGarment, time: float, expected: Floats, tolerance: float) -> Comparison:
    points = shot.garment_points(time)
    if points.shape != expected.shape:
        raise VerificationError(
            f"{shot.name}: the garment has {len(points)} vertices, but {len(expected)} were computed."
        )
    distance = np.nan_to_num(np.linalg.norm(points - expected, axis=-1), nan=np.inf)
    vertex = int(np.argmax(distance))
    return Comparison(float(distance[vertex]), allowed_error(expected, tolerance), time, vertex)
