# SPDX-License-Identifier: Apache-2.0
"""The cloth that a shot begins with, from a shot or a cache that ends there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import fail
from ...files import sha256, split_location
from ...scene.assets import Floats, Garment
from .request import AT, BakeRequest, split_start

SLACK = 1e-6  # of a time code


@dataclass(frozen=True, eq=False)
class StartCloth:
    """The cloth that a shot begins with.

    Attributes:
        points: one step of the model before the first frame, and in it, in world space [m], shape (2, V, 3).
        moves: whether the first was read: otherwise it is as the second.
        where: file, prim and time code, for messages.
        digest: SHA-256 of the file.
    """

    points: Floats
    moves: bool
    where: str
    digest: str


def read_start(text: str, garment: Garment, fps: float, begins: float) -> StartCloth:
    """Read the cloth of one frame of a shot or a cache, and of one step before that at a rate [1/s].

    Args:
        begins: time code of the frame that is to have this cloth.

    Raises:
        SsilkError: it cannot be read, has not that frame, is another mesh, or ends just before `begins`, or goes on
            past it, and no frame is named.
    """
    from ssilk_usd.shots.trajectories import MeshTrajectories

    place, code = split_start(text)
    _need_code(text)
    cache = MeshTrajectories(place, garment.mesh.vertex_count, garment.mesh.faces)
    first, last = float(cache.times[0]), float(cache.times[-1])
    if code is None:
        after = float(np.diff(cache.times[-2:]).sum()) or 1.0
        if first - SLACK <= begins < last - SLACK or last + SLACK < begins <= last + after + SLACK:
            fail(
                place,
                f"it lasts from {first:.9g} to {last:.9g}, and the shot begins at {begins:.9g}",
                "the shot's first frame is to be its last one",
                "begin the shot there, as with --range, or name the frame after '@' that is the shot's first",
            )
        code = last
    if not first - SLACK <= code <= last + SLACK:
        found = f"a start at time code {code:.9g}"
        fail(
            place,
            found,
            f"it lasts from {first:.9g} to {last:.9g}",
            "name a frame of it after '@', or none for its last",
        )
    earlier = code - cache.seconds_to_codes(1 / fps)
    moves = earlier >= first - SLACK
    now = cache.at(code)
    points = np.stack([cache.at(max(earlier, first)) if moves else now, now])
    if not np.isfinite(points).all():
        fail(place, "points that are not finite", "all must be finite", "write it again")
    return StartCloth(points, moves, f"{place} at {code:.9g}", sha256(Path(split_location(place)[0])))


def _need_code(text: str) -> None:
    """Raise `SsilkError` where "FILE[:/PRIM]@CODE" names a file that is there, and something else than a code."""
    place, at, code = text.rpartition(AT)
    there = [Path(split_location(each)[0]).is_file() for each in (place, text)]
    if at and there == [True, False] and split_start(text)[1] is None:
        found = f"'{code}' after '{AT}' is no time code"
        fail(f"--start-cloth {text}", found, "a number names a frame of it", f"such as {place}{AT}100")


def need_startable(request: BakeRequest, loops: bool) -> None:
    """Raise `SsilkError` where a start is asked for together with what it does not go with.

    Args:
        loops: whether the shot is a loop, as the request or its stage says.
    """
    at_end = request.start_cloth is not None and split_start(request.start_cloth)[1] is None
    for found, there, todo in (
        ("linear blend skinning", request.lbs, "leave --lbs out"),
        ("a run-up", request.pre_roll > 0, "leave --pre-roll out"),
        ("a loop", loops, "leave --loop out, and ssilk:loop of the garment in the shot"),
        ("a solver in latents, which starts by itself", request.latent_iterations > 0, "leave --quality latent out"),
        ("poses that are held", request.hold > 1, "leave --hold out"),
        ("handles, which come before it", at_end and request.handles > 0, "name the first handle's frame after '@'"),
    ):
        if there:
            fail("--start-cloth", f"a start and {found}", "one of both", todo)
