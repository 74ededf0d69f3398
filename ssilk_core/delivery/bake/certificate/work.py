# SPDX-License-Identifier: Apache-2.0
"""What a certificate is made with, kept from one attempt to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ....scene.assets import Floats, GarmentPose
from ....scene.kinematics import body_at_rest, motion_transforms, skin_points, skinning_matrices, split_at_cuts
from ..beneath import GarmentsBeneath
from ..rollout import BakeRollout

if TYPE_CHECKING:
    from ....physics.certify.certifier import Certifier, Frames


@dataclass(eq=False)
class CertificateWork:
    """What a certificate is made with, kept from one attempt to the next."""

    base: BakeRollout
    certifier: Certifier
    frames: Frames
    beneath: GarmentsBeneath | None = None
    attempts: int = 0  # how often the file has been looked at
    exact: set[int] = field(default_factory=set)  # frames with a shape each
    caught: set[int] = field(default_factory=set)  # frames in which nothing free was found
    points: dict[int, Floats] = field(default_factory=dict)  # of frames that are moved
    faulty: tuple[int, ...] = ()


def frames_of(
    rollout: BakeRollout,
    poses: Sequence[GarmentPose],
    points: Sequence[Floats],
    beneath: GarmentsBeneath | None = None,
) -> Frames:
    """Return the frames of a rollout, of which its bodies and turns are computed when they are asked for."""
    from ....physics.certify.certifier import Frames
    from ....scene.decomposition.rest import turns

    scene, motion = rollout.deformer.scene, rollout.motion
    skeleton = scene.character.skeleton
    joints = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    body = scene.character.merged_body() if scene.character.bodies else None
    starts = np.array([pose.start for pose in poses])

    def body_at(frame: int) -> Floats | None:
        if body is None:
            return None
        rest = body_at_rest(scene.character, motion, slice(frame, frame + 1))
        return skin_points(rest, body.skin, joints[frame : frame + 1])[0]

    def turns_at(frame: int) -> Floats:
        pose = poses[int(np.searchsorted(starts, frame, side="right")) - 1]
        return turns(rollout.deformer, motion, pose.part(slice(frame - pose.start, frame - pose.start + 1)))[0]

    spans = split_at_cuts(motion, skeleton)
    cuts = np.cumsum([span.frame_count for span in spans])[:-1]
    apart, below = frozenset(cuts.tolist()), beneath.points if beneath else None
    return Frames(motion.frame_count, motion.fps, points.__getitem__, body_at, turns_at, apart, below)
