# SPDX-License-Identifier: Apache-2.0
"""Read UsdSkel influences as skinning weights over a given joint order."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter, silent
from ssilk_core.scene.assets import Floats, Ints, SkinWeights

from ..names import GEOM_BIND, JOINTS, SKEL
from ..opening.stage import EARLIEST, inherited, location
from ..opening.times import change_times

METHOD = "primvars:skel:skinningMethod"
STILL = 1e-5  # of the largest value: rounding
WHOLE = 0.01  # how far weights of a vertex may sum from one: half floats and rounding tools stay within


@dataclass(frozen=True, eq=False)
class AuthoredInfluences:
    """Influences as authored: `indices` (V, I) into the names `joints`, and `weights` (V, I)."""

    path: str
    joints: tuple[str, ...]
    indices: Ints
    weights: Floats

    def onto(self, names: tuple[str, ...]) -> tuple[Ints, Floats]:
        """Return indices into `names` and weights, shape (V, I); weights of other joints are zero."""
        target = np.array([*match_joints(self.joints, names), -1])[self.indices]
        return np.where(target < 0, 0, target), np.where(target < 0, 0.0, self.weights)

    def used_joints(self) -> list[str]:
        """Return the names of all joints with any weight, in joint order."""
        return [self.joints[index] for index in np.unique(self.indices[self.weights != 0])]

    def tell_sums(self, report: Reporter) -> None:
        """Report vertices whose weights do not sum to one: UsdSkel plays them so, here they are made whole."""
        sums = self.weights.sum(axis=1)
        off = np.abs(sums - 1) > WHOLE
        if off.any():
            low, high = sums[off].min(), sums[off].max()
            said = f"to {low:.3g}" if high - low < WHOLE else f"from {low:.3g} to {high:.3g}"
            text = f"{self.path}: the weights of {np.count_nonzero(off)} of {len(off)} vertices sum {said}"
            text += ", and are made to sum to one; until they are normalised, USD shows these vertices elsewhere"
            report(Message(text, "warning"))


def tell_method(prim: Usd.Prim, report: Reporter) -> None:
    """Report a mesh that USD skins otherwise than by linear blend skinning."""
    method = inherited(prim, METHOD)
    chosen = None if method is None else method.Get(EARLIEST)
    if chosen not in (None, UsdSkel.Tokens.classicLinear):
        report(Message(f"{location(prim)}: its {chosen} skinning is evaluated as linear blend skinning", "warning"))


def match_joints(names: tuple[str, ...], among: tuple[str, ...]) -> list[int]:
    """Return the index of each joint in `among`, matched by path or else by a unique leaf name; -1 if missing."""
    full = {name: index for index, name in enumerate(among)}
    leaves: dict[str, list[int]] = {}
    for index, name in enumerate(among):
        leaves.setdefault(leaf(name), []).append(index)
    copies = Counter(map(leaf, names))

    def find(name: str) -> int:
        candidates = leaves.get(leaf(name), [])
        unique = len(candidates) == 1 and copies[leaf(name)] == 1
        return full.get(name, candidates[0] if unique else -1)

    return [find(name) for name in names]


def need_unique(joints: tuple[str, ...], where: str) -> None:
    """Raise `SsilkError` where a list names a joint twice: UsdSkel then takes either of both."""
    repeated = next((name for name, count in Counter(joints).items() if count > 1), None)
    if repeated is not None:
        fail(where, f"joint '{repeated}' is listed twice", "each joint needs its own path", "rename one")


def leaf(joint: str) -> str:
    """Return the last part of a joint path."""
    return joint.rpartition("/")[2]


def read_skin(
    prim: Usd.Prim, joints: tuple[str, ...], names: tuple[str, ...], report: Reporter = silent
) -> SkinWeights | None:
    """Read a mesh's weights over the joints `names`; return None if it has none.

    Args:
        prim: a mesh with its own or inherited influences, of any element size, per vertex or constant.
        joints: joint order of its skeleton; the mesh's own `skel:joints` takes precedence.
        names: joint order of the result.
        report: hears of weights that do not sum to one.

    Raises:
        SsilkError: counts do not match, an index has no joint, or a joint in use is not in `names`.
    """
    influences = read_influences(prim, joints)
    if influences is None:
        return None
    used = influences.used_joints()
    absent = [name for name, index in zip(used, match_joints(tuple(used), names)) if index < 0]
    if absent:
        fail(
            influences.path,
            f"it is weighted to joint '{absent[0]}', which the character's skeleton does not have",
            "weights belong to the character's joints",
            "bind the mesh to this skeleton again",
        )
    influences.tell_sums(report)
    return SkinWeights(influences.path, *influences.onto(names))


def read_influences(
    prim: Usd.Prim, joints: tuple[str, ...], properties: tuple[str, str, str] = SKEL
) -> AuthoredInfluences | None:
    """Read influences from the two primvars `properties`, over the mesh's own joint order or else `joints`."""
    where = location(prim)
    indices, weights = (inherited(prim, name) for name in properties[:2])
    if indices is None and weights is None:
        return None
    if indices is None or weights is None:
        fail(
            where,
            f"only one of {properties[0]} and {properties[1]} is authored",
            "both are needed",
            "bind the mesh again",
        )
    points = UsdGeom.Mesh(prim).GetPointsAttr()
    for attribute in (points, indices, weights, prim.GetAttribute(GEOM_BIND)):
        _need_still(attribute, where)
    count = len(points.Get(EARLIEST) or [])
    rows_of_indices = _rows(indices, count, where).astype(np.int64)
    rows_of_weights = _rows(weights, count, where).astype(np.float64)
    if rows_of_indices.shape != rows_of_weights.shape:
        fail(
            where,
            f"{rows_of_indices.shape[1]} joint indices but {rows_of_weights.shape[1]} weights for each point",
            "both need the same elementSize",
            "bind the mesh again",
        )
    own = inherited(prim, properties[2]) or inherited(prim, JOINTS)
    names = joints if own is None else tuple(own.Get(EARLIEST) or ())
    need_unique(names, where)
    return AuthoredInfluences(where, names, _checked(rows_of_indices, rows_of_weights, names, where), rows_of_weights)


def _need_still(attribute: Usd.Attribute, where: str) -> None:
    """Raise `SsilkError` where a value that skinning begins with changes; one time sample is as good as a default."""
    times = change_times([attribute]) if attribute else []
    if len(times) < 2:
        return
    first = np.array(attribute.Get(times[0]))
    bound = STILL * max(1.0, float(np.abs(first).max(initial=0)))
    for time in times[1:]:
        later = np.array(attribute.Get(time))
        if later.shape != first.shape or not np.allclose(later, first, rtol=0, atol=bound):
            fail(
                where,
                f"it is skinned, and its {attribute.GetName()} changes at time code {time:g}",
                "a skinned mesh has one value at all times, and joints and blendshapes move it",
                "author the value at rest alone, or make the mesh a point cache without influences",
            )


def _rows(attribute: Usd.Attribute, point_count: int, where: str) -> Floats:
    """Return a primvar as one row of `elementSize` values per point; a constant row is repeated."""
    primvar = UsdGeom.Primvar(attribute)
    values, size = np.array(primvar.ComputeFlattened(EARLIEST) or []), primvar.GetElementSize()
    constant = primvar.GetInterpolation() == UsdGeom.Tokens.constant
    rows = 1 if constant else point_count
    if len(values) != rows * size:
        fail(
            where,
            f"{attribute.GetName()} holds {len(values)} values for {rows} x {size}",
            f"elementSize values {'in all' if constant else 'for each point'} are needed",
            "bind the mesh again",
        )
    return np.broadcast_to(values.reshape(rows, size), (point_count, size))


def _checked(indices: Ints, weights: Floats, names: tuple[str, ...], where: str) -> Ints:
    """Return indices with -1 where the weight is zero; all others must name a joint."""
    used = weights != 0
    bad = int(np.count_nonzero(used & ((indices < 0) | (indices >= len(names)))))
    if bad:
        fail(
            where,
            f"{bad} joint indices lie outside 0 to {len(names) - 1}",
            "an index names a joint of the mesh's joint order",
            "bind the mesh again",
        )
    return np.where(used, indices, -1)
