# SPDX-License-Identifier: Apache-2.0
"""When values of a stage change: time samples, those of value clips, and splines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from pxr import Usd, UsdGeom

EARLIEST = Usd.TimeCode.EarliestTime()


def change_times(attributes: Iterable[Usd.Attribute]) -> list[float]:
    """Return the time codes at which values change: time samples, knots of splines, the ends of what goes on.

    A spline that is extrapolated by a slope or a loop changes from the first to the last time code of its stage.
    """
    return sorted({time for attribute in attributes for time in _changes(attribute)})


def samples_about(attribute: Usd.Attribute, code: float) -> list[float]:
    """Return the time samples that decide an attribute's value at a time code: two, one, or none at all."""
    return sorted(set(attribute.GetBracketingTimeSamples(code)))


def xform_attributes(prim: Usd.Prim) -> Iterator[Usd.Attribute]:
    """Yield the attributes that place a prim in the world, its own first, up to a reset of the transform stack."""
    while prim and not prim.IsPseudoRoot():
        xformable = UsdGeom.Xformable(prim)
        if xformable:
            yield from (operation.GetAttr() for operation in xformable.GetOrderedXformOps())
            if xformable.GetResetXformStack():
                return
        prim = prim.GetParent()


def visibility_attributes(prim: Usd.Prim) -> Iterator[Usd.Attribute]:
    """Yield the attributes that say whether a prim is visible, its own first."""
    while prim and not prim.IsPseudoRoot():
        if UsdGeom.Imageable(prim):
            yield UsdGeom.Imageable(prim).GetVisibilityAttr()
        prim = prim.GetParent()


def earliest(prim: Usd.Prim) -> Usd.TimeCode:
    """Return the earliest time at which a prim has a place: a spline may slope down to none in the infinite past."""
    splines = [attribute for attribute in xform_attributes(prim) if _has_spline(attribute)]
    times = change_times(splines)
    return Usd.TimeCode(times[0]) if times else EARLIEST


def _has_spline(attribute: Usd.Attribute) -> bool:
    # USD 24.5 (Blender 4.2) has no splines
    return hasattr(attribute, "HasSpline") and bool(attribute.HasSpline())


def _changes(attribute: Usd.Attribute) -> list[float]:
    if not _has_spline(attribute):
        return list(attribute.GetTimeSamples())
    from pxr import Ts

    spline, stage = attribute.GetSpline(), attribute.GetStage()
    times: list[float] = sorted(spline.GetKnots().keys())
    if times and stage.HasAuthoredTimeCodeRange():
        first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        if first < times[0] and spline.GetPreExtrapolation().mode != Ts.ExtrapHeld:
            times.append(first)
        if last > times[-1] and spline.GetPostExtrapolation().mode != Ts.ExtrapHeld:
            times.append(last)
    return times
