# SPDX-License-Identifier: Apache-2.0
"""Read proxy rigs: joints appended to the skeleton, listed in the garment's `ssilk:proxyJoints`.

A rig may be edited by hand. The skeleton decides: a joint listed is a proxy wherever it moved
in the hierarchy (it is found by a leaf name that is unique), a joint removed is gone with its weights, and a joint
that descends from a proxy is a proxy.
"""

import numpy as np
from pxr import Usd

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter, silent
from ssilk_core.scene.assets import Floats, Ints, ProxyRig, Skeleton, SkinWeights

from ..names import PROXIES
from ..opening.stage import StageLike, has_value, location, needs_whole_files, open_stage, value
from .garment import find_garment, fitted_skeleton, lbs_skin
from .rebinding import joint_moves
from .skin import match_joints, read_influences
from .spaces import SkelSource


@needs_whole_files
def read_proxy_rig(
    source: StageLike,
    skeleton: Skeleton,
    *,
    garment: str | None = None,
    root: str | None = None,
    report: Reporter = silent,
) -> ProxyRig | None:
    """Read a garment's proxy rig, as it was written or as it was edited by hand; None where it has none.

    Args:
        source: the stage with the garment and the skeleton that its proxies hang from.
        skeleton: the character's; combined joint indices run over its joints, then over the proxies.
        garment, root: as in `read_garment`.
        report: hears of proxies that are gone, and of vertices that fall back to LBS because of that.

    Raises:
        SsilkError: a proxy hangs from another garment's, or vertices have no weights left and no LBS weights.
    """
    stage = open_stage(source)
    prim = find_garment(stage, garment, root)
    if not has_value(prim, PROXIES):
        return None
    where, skel = location(prim), fitted_skeleton(prim, root)
    if skel is None:
        fail(where, "it lists proxy joints but its stage has no skeleton", "proxies are joints", "rig it again")
    mine = np.flatnonzero([owner == str(prim.GetPath()) for owner in skel.owners])
    names = tuple(skel.joints[index] for index in mine)
    gone = [name for name, index in zip(value(prim, PROXIES), _find(prim, skel)) if index < 0]
    if gone:
        report(Message(f"{where}: {len(gone)} of its proxy joints are gone ({gone[0]}, ...)", "warning"))
    binds, moves = skel.binds_to_core(skel.bind[mine]), joint_moves(skel, skeleton)
    return ProxyRig(
        where,
        names,
        _proxy_parents(skel, mine, skeleton, where),
        binds if moves is None else moves[mine] @ binds,
        _rig_skin(prim, skel, skeleton, names, report),
    )


def _find(prim: Usd.Prim, skel: SkelSource) -> list[int]:
    return match_joints(tuple(value(prim, PROXIES) or ()), skel.joints)


def _proxy_parents(skel: SkelSource, mine: Ints, skeleton: Skeleton, where: str) -> Ints:
    """Return the combined joint index of each proxy's parent."""
    own = {int(index): skeleton.joint_count + proxy for proxy, index in enumerate(mine)}
    parents = []
    for index in mine:
        above = int(skel.parents[index])
        if above < 0:
            fail(where, f"proxy '{skel.joints[index]}' has no parent", "its parent must be a joint", "reparent it")
        combined = own.get(above, -1)
        if combined < 0 and not skel.owners[above]:
            combined = match_joints((skel.joints[above],), skeleton.joint_names)[0]
        if combined < 0:
            fail(
                where,
                f"proxy '{skel.joints[index]}' hangs from '{skel.joints[above]}'",
                "a proxy hangs from a joint of the character or from a proxy of the same garment",
                "reparent it",
            )
        parents.append(combined)
    return np.array(parents, dtype=np.int64)


def _rig_skin(
    prim: Usd.Prim, skel: SkelSource, skeleton: Skeleton, names: tuple[str, ...], report: Reporter
) -> SkinWeights:
    """Return the garment's weights over the combined joints; rows without remaining joints take LBS weights."""
    influences = read_influences(prim, skel.joints)
    if influences is None:
        fail(
            location(prim), "the garment has proxies but no weights", "weights are needed", "bind it, or rig it again"
        )
    influences.tell_sums(report)
    indices, weights = influences.onto((*skeleton.joint_names, *names))
    lost = (weights.sum(axis=1) <= 0) & (influences.weights.sum(axis=1) > 0)
    if not lost.any():
        return SkinWeights(influences.path, indices, weights)
    lbs = lbs_skin(prim, skel.joints, skeleton)
    if lbs is None:
        fail(
            influences.path,
            f"{np.count_nonzero(lost)} vertices are weighted to joints that are gone, and to no others",
            "each vertex needs a weight",
            "paint them, or rig the garment again",
        )
    report(Message(f"{influences.path}: {np.count_nonzero(lost)} vertices lost all proxies and follow the body"))
    width = max(indices.shape[1], lbs.indices.shape[1])
    mixed = [
        np.where(lost[:, None], _padded(body, width), _padded(own, width))
        for body, own in ((lbs.indices, indices), (lbs.weights, weights))
    ]
    return SkinWeights(influences.path, *mixed)


def _padded(array: Floats | Ints, width: int) -> Floats | Ints:
    return np.pad(array, ((0, 0), (0, width - array.shape[1])))
