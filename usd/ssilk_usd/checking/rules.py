# SPDX-License-Identifier: Apache-2.0
"""Rules that USD's own validators do not check: meshes, influences, blendshapes, skeletons, animation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

SUM_TOLERANCE = 1e-5  # of a vertex's weights


@dataclass(frozen=True)
class ShotFinding:
    """`severity` is "error" (some reader will show something else) or "warning"; `prim` is a path, or empty."""

    severity: str
    prim: str
    text: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.prim or 'stage'}: {self.text}"


def error_unless(condition: object, prim: Usd.Prim, text: str) -> Iterator[ShotFinding]:
    """Yield an error about `prim` unless `condition` holds."""
    if not condition:
        yield ShotFinding("error", str(prim.GetPath()), text)


def check_mesh(prim: Usd.Prim) -> Iterator[ShotFinding]:
    """Check the polygons of a mesh and the lengths of its primvars."""
    mesh = UsdGeom.Mesh(prim)
    points = np.array(mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime()) or []).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], dtype=int)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], dtype=int)
    yield from error_unless(len(points) and np.isfinite(points).all(), prim, "it has no points, or not finite ones")
    yield from error_unless(counts.sum() == len(indices), prim, "faceVertexCounts do not add up to faceVertexIndices")
    inside = (indices >= 0) & (indices < len(points))
    yield from error_unless(inside.all(), prim, f"{np.count_nonzero(~inside)} faceVertexIndices name no point")
    lengths = {UsdGeom.Tokens.vertex: len(points), UsdGeom.Tokens.faceVarying: len(indices)}
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues():
        expected = lengths.get(primvar.GetInterpolation())
        values = primvar.ComputeFlattened()
        if expected is not None and values is not None:
            size, width = len(values), primvar.GetElementSize()
            text = f"{primvar.GetName()} holds {size} values, where {expected} times {width} are needed"
            yield from error_unless(size == expected * width, prim, text)


def check_skin(prim: Usd.Prim, joints: Sequence[str]) -> Iterator[ShotFinding]:
    """Check a mesh's influences against the joints of its skeleton."""
    binding = UsdSkel.BindingAPI(prim)
    own = binding.GetJointsAttr().Get() or joints
    indices = np.array(binding.GetJointIndicesPrimvar().Get() or [], dtype=int)
    weights = np.array(binding.GetJointWeightsPrimvar().Get() or [], dtype=float)
    width = max(1, binding.GetJointIndicesPrimvar().GetElementSize())
    yield from error_unless(
        len(indices) == len(weights) > 0 and len(indices) % width == 0,
        prim,
        f"{len(indices)} jointIndices and {len(weights)} jointWeights at {width} for each vertex",
    )
    bad = np.count_nonzero((indices < 0) | (indices >= len(own)))
    yield from error_unless(not bad, prim, f"{bad} jointIndices lie outside 0 to {len(own) - 1}")
    yield from error_unless(
        binding.GetGeomBindTransformAttr().HasAuthoredValue(), prim, "geomBindTransform is not authored"
    )
    yield from error_unless(
        UsdGeom.Mesh(prim).GetPointsAttr().GetNumTimeSamples() <= 1,
        prim,
        "it is bound to a skeleton and its points are animated, so that it deforms twice",
    )
    if len(indices) == len(weights) > 0 and len(indices) % width == 0:
        yield from _check_weights(prim, indices.reshape(-1, width), weights.reshape(-1, width))


def _check_weights(prim: Usd.Prim, indices: np.ndarray, weights: np.ndarray) -> Iterator[ShotFinding]:
    negative = np.count_nonzero(~(weights >= 0))
    yield from error_unless(not negative, prim, f"{negative} jointWeights are negative or not finite")
    off = np.count_nonzero(~(np.abs(weights.sum(axis=1) - 1) <= SUM_TOLERANCE))
    yield from error_unless(not off, prim, f"the jointWeights of {off} vertices do not add up to one")
    unsorted = np.count_nonzero((np.diff(weights, axis=1) > 0).any(axis=1))
    yield from error_unless(not unsorted, prim, f"the influences of {unsorted} vertices are not sorted by weight")
    used = np.where(weights > 0, indices, -1 - np.arange(indices.shape[1]))
    repeated = np.count_nonzero((np.diff(np.sort(used, axis=1), axis=1) == 0).any(axis=1))
    yield from error_unless(
        not repeated, prim, f"{repeated} vertices name a joint twice, of which some importers keep one"
    )


def check_blendshapes(prim: Usd.Prim, animated: Sequence[str]) -> Iterator[ShotFinding]:
    """Check a mesh's blendshapes against its targets, its points and the names in the animation."""
    binding = UsdSkel.BindingAPI(prim)
    names = list(binding.GetBlendShapesAttr().Get() or [])
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    text = f"{len(names)} blendShapes and {len(targets)} blendShapeTargets"
    yield from error_unless(len(names) == len(targets), prim, text)
    unknown = [name for name in names if name not in animated]
    yield from error_unless(
        not unknown, prim, f"no animation knows {len(unknown)} of its blendShapes ({unknown[:1]})"
    )
    point_count = len(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime()) or [])
    for path in targets:
        shape = prim.GetStage().GetPrimAtPath(path)
        found = shape and shape.IsA(UsdSkel.BlendShape)
        yield from error_unless(found, prim, f"the blendShapeTarget {path} is no BlendShape")
        if found:
            yield from _check_blendshape(shape, point_count)


def _check_blendshape(prim: Usd.Prim, point_count: int) -> Iterator[ShotFinding]:
    shape = UsdSkel.BlendShape(prim)
    offsets = np.array(shape.GetOffsetsAttr().Get() or []).reshape(-1, 3)
    sparse = shape.GetPointIndicesAttr().HasAuthoredValue()
    rows = np.array(shape.GetPointIndicesAttr().Get(), dtype=int) if sparse else np.arange(point_count)
    text = f"{len(offsets)} offsets for {len(rows)} points"
    yield from error_unless(len(offsets) == len(rows) > 0, prim, text)
    yield from error_unless(np.isfinite(offsets).all(), prim, "offsets are not finite")
    good = ((rows >= 0) & (rows < point_count)).all() and len(np.unique(rows)) == len(rows)
    yield from error_unless(good, prim, f"pointIndices repeat or lie outside 0 to {point_count - 1}")
    yield from error_unless(not shape.GetInbetweens(), prim, "in-between shapes, which some importers drop")


UNIT_TOLERANCE = 1e-3  # of quaternions


def check_skeleton(prim: Usd.Prim) -> Iterator[ShotFinding]:
    """Check the joints, bind transforms and rest transforms of a Skeleton."""
    skeleton = UsdSkel.Skeleton(prim)
    joints = list(skeleton.GetJointsAttr().Get() or [])
    yield from error_unless(joints, prim, "it has no joints")
    yield from error_unless(len(set(joints)) == len(joints), prim, "joint names repeat")
    valid, reason = UsdSkel.Topology(joints).Validate()
    yield from error_unless(valid, prim, f"parents must come before their children ({reason})")
    for attribute in (skeleton.GetBindTransformsAttr(), skeleton.GetRestTransformsAttr()):
        matrices = np.array(attribute.Get() or []).reshape(-1, 4, 4)
        text = f"{len(matrices)} {attribute.GetName()} for {len(joints)} joints"
        yield from error_unless(len(matrices) == len(joints), prim, text)
        regular = np.isfinite(matrices).all() and (np.abs(np.linalg.det(matrices)) > 0).all()
        yield from error_unless(regular, prim, f"{attribute.GetName()} are not finite or cannot be inverted")


def check_animation(prim: Usd.Prim, joints: Sequence[str], frames: Sequence[float]) -> Iterator[ShotFinding]:
    """Check a SkelAnimation against the joints of the skeleton that it moves and the stage's frames."""
    animation = UsdSkel.Animation(prim)
    names = list(animation.GetJointsAttr().Get() or [])
    kept = [name for name in joints if name in set(names)]
    yield from error_unless(names == kept, prim, "its joints differ from the Skeleton's, or in their order")
    channels = (animation.GetRotationsAttr(), animation.GetTranslationsAttr(), animation.GetScalesAttr())
    for attribute in channels:
        yield from check_samples(attribute, len(names), frames)
    yield from _check_rotations(animation.GetRotationsAttr())
    shapes = list(animation.GetBlendShapesAttr().Get() or [])
    yield from error_unless(len(set(shapes)) == len(shapes), prim, "blendshape names repeat")
    if shapes:
        yield from check_samples(animation.GetBlendShapeWeightsAttr(), len(shapes), frames)
        yield from _check_shape_weights(animation.GetBlendShapeWeightsAttr())


def check_samples(attribute: Usd.Attribute, length: int, frames: Sequence[float]) -> Iterator[ShotFinding]:
    """Check that an array has a value at each frame, or one for all, and the same length at all samples."""
    prim, name, times = attribute.GetPrim(), attribute.GetName(), attribute.GetTimeSamples()
    yield from error_unless(attribute.HasAuthoredValue(), prim, f"{name} has no value")
    missing = np.setdiff1d(frames, times) if len(times) > 1 else ()
    yield from error_unless(not len(missing), prim, f"{name} has no sample at {len(missing)} of {len(frames)} frames")
    wrong = [time for time, value in _samples(attribute) if len(value) != length]
    yield from error_unless(
        not wrong, prim, f"{name} has another length than {length} at {len(wrong)} samples (first: {wrong[:1]})"
    )


def _samples(attribute: Usd.Attribute) -> Iterator[tuple[float | str, Sequence]]:
    """Yield each time sample with its value, or the default value."""
    for time in attribute.GetTimeSamples():
        yield time, attribute.Get(time)
    if not attribute.GetTimeSamples() and attribute.HasAuthoredValue():
        yield "default", attribute.Get()


def _check_rotations(attribute: Usd.Attribute) -> Iterator[ShotFinding]:
    for time, value in _samples(attribute):
        off = np.abs(np.linalg.norm(np.array(value).reshape(-1, 4), axis=1) - 1)
        if not (off < UNIT_TOLERANCE).all():
            text = f"rotations are no unit quaternions at time {time}"
            yield ShotFinding("error", str(attribute.GetPrimPath()), text)
            return


def _check_shape_weights(attribute: Usd.Attribute) -> Iterator[ShotFinding]:
    for time, value in _samples(attribute):
        weights = np.array(value)
        if not ((weights >= 0) & (weights <= 1)).all():
            text = f"blendShapeWeights leave [0, 1] at time {time}, where importers clamp them"
            yield ShotFinding("error", str(attribute.GetPrimPath()), text)
            return
