# SPDX-License-Identifier: Apache-2.0
"""Rules of UsdSkel that USD's own validators do not check: skeletons and their animation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pxr import Usd, UsdSkel

from .finding import ShotFinding, error_unless

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
        yield from _check_weights(animation.GetBlendShapeWeightsAttr())


def check_samples(attribute: Usd.Attribute, length: int, frames: Sequence[float]) -> Iterator[ShotFinding]:
    """Check that an array has a value at each frame, or one default value, and the same length at all samples."""
    prim, name, times = attribute.GetPrim(), attribute.GetName(), attribute.GetTimeSamples()
    yield from error_unless(attribute.HasAuthoredValue(), prim, f"{name} has no value")
    missing = np.setdiff1d(frames, times) if times else ()
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


def _check_weights(attribute: Usd.Attribute) -> Iterator[ShotFinding]:
    for time, value in _samples(attribute):
        weights = np.array(value)
        if not ((weights >= 0) & (weights <= 1)).all():
            text = f"blendShapeWeights leave [0, 1] at time {time}, where importers clamp them"
            yield ShotFinding("error", str(attribute.GetPrimPath()), text)
            return
