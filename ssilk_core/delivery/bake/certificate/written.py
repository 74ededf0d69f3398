# SPDX-License-Identifier: Apache-2.0
"""What is wrong in the frames of a written file, as its own joints and blendshapes pose it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ....errors import fail
from ....events import Countdown, Reporter
from ....scene.assets import Floats
from ....scene.kinematics import body_at_rest, motion_transforms, skin_points, skinning_matrices
from ..beneath import GarmentsBeneath
from ..posed import body_in
from ..rollout import BakeRollout

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot

    from ....physics.certify.certifier import Certifier
    from ....physics.certify.faults import FrameFaults
    from ...gltf.play import GlbShot
    from ...view.player import ShotPlayer


def faults_in(
    shot: Shot | GlbShot,
    certifier: Certifier,
    rollout: BakeRollout,
    beneath: GarmentsBeneath | None,
    report: Reporter,
) -> Iterator[tuple[int, FrameFaults]]:
    """Yield the frames of a file in which something is wrong, as its own joints and blendshapes pose it.

    Raises:
        SsilkError: garments beneath have other frames.
    """
    scene, motion = rollout.deformer.scene, rollout.motion
    skeleton = scene.character.skeleton
    player: ShotPlayer = shot
    garment = next(number for number, mesh in enumerate(player.meshes) if mesh.is_garment)
    bodies = body_in(shot, scene) if scene.character.bodies else None
    merged = scene.character.merged_body() if scene.character.bodies else None
    joints = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    times = shot.sample_times(rollout.request.samples_per_frame)
    if beneath and beneath.times != times:
        fail(
            str(next(iter(beneath.files.values()))),
            f"{len(beneath.times)} frames from {beneath.times[0]:g}",
            f"the garment over it has {len(times)} from {times[0]:g}, and is certified over the same ones",
            "bake both over one range",
        )
    told = Countdown(len(times), report)
    for frame, time in enumerate(times):
        posed = shot.points(time)
        body: Floats | None = None
        if bodies is not None:
            body = np.concatenate([posed[number] for number in bodies])
        elif merged is not None:
            rest = body_at_rest(scene.character, motion, slice(frame, frame + 1))
            body = skin_points(rest, merged.skin, joints[frame : frame + 1])[0]
        below = beneath.points(frame) if beneath else None
        faults = certifier.finder.find(posed[garment], certifier.finder.place(body, below))
        if faults.count:
            yield frame, faults
        told()
