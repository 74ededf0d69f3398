# SPDX-License-Identifier: Apache-2.0
"""Whether the frames of a file are as free as its certificate says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ....errors import VerificationError
from ....events import Reporter, silent
from ..beneath import beneath_said
from ..opened import open_shot, provenance_of
from ..result import certified_frames
from ..rollout import BakeRollout
from .requirements import need_certifier
from .summary import CERTIFICATE
from .written import faults_in


@dataclass(frozen=True)
class CheckedCertificate:
    """A certificate that a file says of itself, and what was counted in it again.

    Attributes:
        moved: frames that it says were moved.
        said, counted: what the file says, and what was found in it now, in the same words.
    """

    moved: frozenset[int]
    said: str
    counted: str


def verify_certificate(rollout: BakeRollout, path: Path, report: Reporter = silent) -> CheckedCertificate:
    """Check that the frames of a file are as free as it says; return what it says and what was counted.

    Raises:
        VerificationError: it does not say how free it is, or another frame is not.
    """
    from ....physics.certify.certifier import Certifier

    need_certifier()
    said = provenance_of(path).get(CERTIFICATE)
    if not isinstance(said, Mapping):
        raise VerificationError(f"{path}: it was baked with --certify, but has no certificate; bake it again.")
    moved, left = (frames_said(said.get(name, ())) for name in ("moved frames", "frames left"))
    shot, samples = open_shot(path), rollout.request.samples_per_frame
    beneath = beneath_said(said, path, samples, "certified", report)
    certifier = Certifier(rollout.deformer.scene, beneath.faces if beneath else None)
    times, intersecting, showing = shot.sample_times(samples), 0, 0
    for frame, faults in faults_in(shot, certifier, rollout, beneath, report):
        intersecting, showing = intersecting + (len(faults.pairs) > 0), showing + (len(faults.skin) > 0)
        if frame not in left:
            raise VerificationError(
                f"{path}: {len(faults.pairs)} pairs of triangles intersect and {len(faults.skin)} points of covered "
                f"skin show at time code {times[frame]:g}, where its certificate says that none does."
            )
    counted = certified_frames(len(times), intersecting, showing, tuple(beneath.files) if beneath else ())
    return CheckedCertificate(frozenset(moved), str(said.get("found", "nothing")), counted)


def frames_said(said: object) -> set[int]:
    """Return the frames of spans such as "3 to 5" that a file lists."""
    spans = [str(each).split(" to ") for each in said] if isinstance(said, Iterable) else []
    return {frame for first, last in spans for frame in range(int(first), int(last) + 1)}
