# SPDX-License-Identifier: Apache-2.0
"""What a certificate says: how many frames are free, which were moved, which have no free position, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..result import CertificateSummary, FrameSpan
from .work import CertificateWork

if TYPE_CHECKING:
    from ....physics.certify.faults import FrameFaults

CERTIFICATE = "certificate"  # what a shot says of it, under this name


def summary_of(work: CertificateWork, found: Mapping[int, FrameFaults], times: Sequence[float]) -> CertificateSummary:
    """Return what the certificate says."""
    from ....physics.certify.certifier import runs

    away = {
        frame: np.linalg.norm(points - work.frames.points(frame), axis=1) for frame, points in work.points.items()
    }
    moved = np.concatenate([each[each > 0] for each in away.values()]) if away else np.zeros(0)
    spans = tuple(FrameSpan(*each) for each in runs(found))
    reasons = tuple(_reason(work, [found[frame] for frame in range(span.first, span.last + 1)]) for span in spans)
    return CertificateSummary(
        frames=work.frames.count,
        faulty=len(work.faulty),
        moved=tuple(FrameSpan(*each) for each in runs(work.points)),
        intersecting=sum(len(faults.pairs) > 0 for faults in found.values()),
        showing=sum(len(faults.skin) > 0 for faults in found.values()),
        left=spans,
        codes=tuple((float(times[span.first]), float(times[span.last])) for span in spans),
        reasons=reasons,
        mean_mm=1000 * float(moved.mean()) if len(moved) else 0.0,
        largest_mm=1000 * float(moved.max()) if len(moved) else 0.0,
        over=tuple(work.beneath.files) if work.beneath else (),
    )


def _reason(work: CertificateWork, faults: Sequence[FrameFaults]) -> str:
    """Return what is wrong in consecutive frames, and where."""
    scene = work.base.deformer.scene
    cloth, names = work.certifier.finder.cloth, scene.character.skeleton.joint_names
    regions: Counter[int] = Counter()
    pairs, points = max(len(each.pairs) for each in faults), max(len(each.skin) for each in faults)
    for each in faults:
        if cloth.regions is not None:
            own = each.pairs[each.pairs < len(cloth.mesh.faces)]
            regions.update(cloth.regions[own].tolist())
        regions.update(work.certifier.finder.joints[each.skin.index].tolist())
    where = names[regions.most_common(1)[0][0]].rpartition("/")[2]
    first = next((int(each.pairs[0, 0]) for each in faults if len(each.pairs)), None)
    said = [f"up to {pairs} pairs of triangles, such as with triangle {first}"] if first is not None else []
    said += [f"up to {points} points of skin"] if points else []
    return f"{' and '.join(said)} beside {where}"
