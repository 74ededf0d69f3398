# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with motions, and what they do not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..assets import Floats, Ints, Motion, Skeleton
from ..kinematics import CUT_SPEED, split_at_cuts
from .finding import Finding, Findings, amount, joint_leaves, listing

MAX_FRAME_ROTATION = 120.0  # [degrees] in one frame; the fastest human joints turn by about 7,000 degrees a second
STILL_ANGLE = 0.5  # [degrees]
RATES = (15.0, 240.0)  # [1/s]
MAX_SAMPLE_GAP = 0.5  # [s] without a sample, in a motion that otherwise has ten times as many


@dataclass(frozen=True, eq=False)
class MotionFile:
    """What a motion's file holds beside the motion: which joints it animates and when it was sampled.

    Attributes:
        joints: indices of the skeleton's joints that it animates.
        times: when it has samples [s], shape (S,).
    """

    path: str
    joints: Ints
    times: Floats


def root_jumps(motion: Motion) -> Findings:
    """Yield the frames at which the root has been moved rather than animated."""
    starts = np.cumsum([span.frame_count for span in split_at_cuts(motion)])[:-1]
    if len(starts):
        root = motion.translations[:, 0]
        far = np.linalg.norm(root[starts] - root[starts - 1], axis=1).max()
        yield Finding(
            severity="warning",
            code="root-jumps",
            prim=motion.path,
            count=len(starts),
            found=f"the root jumps, by up to {far:.2g} m (first to frame {starts[0]} of {motion.frame_count})",
            why=f"a step so much faster ({CUT_SPEED:g} m/s) than those beside it is no movement; cloth starts anew",
            fix="cut the clip there, or repair the root's curve",
            elements="frames",
            indices=listing(starts),
        )


def joint_snaps(motion: Motion, skeleton: Skeleton) -> Findings:
    """Yield the frames at which a joint flips over within one frame."""
    angles = _angles(motion.rotations[1:], motion.rotations[:-1])
    frames = np.flatnonzero((angles > MAX_FRAME_ROTATION).any(axis=1))
    if len(frames):
        joint = int(angles.max(axis=0).argmax())
        yield Finding(
            severity="warning",
            code="joint-snaps",
            prim=motion.path,
            count=len(frames),
            found=f"{joint_leaves(skeleton, [joint])} turns by {angles.max():.0f} degrees in one frame",
            why="the cloth on it is whipped around; a flip in captured or Euler curves mostly, not a movement",
            fix="filter the rotation curves, or leave the clip out",
            elements="frames",
            indices=listing(frames + 1),
        )


def short_motion(motion: Motion, fps: float, window: int) -> Findings:
    """Yield that a motion has no span as long as a training window of `window` poses at `fps`."""
    longest = max(int((span.frame_count - 1) * fps / motion.fps + 1e-6) + 1 for span in split_at_cuts(motion))
    if longest < window:
        yield Finding(
            severity="warning",
            code="short-motion",
            prim=motion.path,
            found=f"it holds {longest} poses in a row at {fps:g} frames per second",
            why=f"a training window has {window} poses; this clip is used for single poses at most",
            fix="join it with others, or give a longer clip",
        )


def unusual_rate(motion: Motion) -> Findings:
    """Yield a rate of frames at which cloth cannot be followed, or that nobody animates at."""
    if not RATES[0] <= motion.fps <= RATES[1] and motion.frame_count > 1:
        seconds = (motion.frame_count - 1) / motion.fps
        yield Finding(
            severity="warning",
            code="frame-rate",
            prim=motion.path,
            found=f"{motion.fps:g} frames per second, so that its {motion.frame_count} frames last {seconds:.3g} s",
            why="inertia depends on the true speed of a motion",
            fix="set timeCodesPerSecond and framesPerSecond to what it was made at",
        )


def sample_gaps(file: MotionFile) -> Findings:
    """Yield stretches of a densely sampled motion that hold no samples."""
    steps = np.diff(file.times)
    if len(steps) > 2 and steps.max() > max(MAX_SAMPLE_GAP, 10 * np.median(steps)):
        at = int(steps.argmax())
        yield Finding(
            severity="warning",
            code="sample-gaps",
            prim=file.path,
            count=int(np.count_nonzero(steps > max(MAX_SAMPLE_GAP, 10 * np.median(steps)))),
            found=f"it has no samples for {steps.max():.2g} s from {file.times[at]:.3g} s on",
            why="the pose is interpolated straight across the gap",
            fix="export the motion again, or cut it there",
        )


def missing_joints(file: MotionFile, skeleton: Skeleton) -> Findings:
    """Yield the joints of the character that a motion does not animate."""
    missing = np.setdiff1d(np.arange(skeleton.joint_count), file.joints)
    if len(missing):
        yield Finding(
            severity="info",
            code="missing-joints",
            prim=file.path,
            count=len(missing),
            found=f"it does not animate {joint_leaves(skeleton, missing)}",
            why="they stay in the rest pose",
            elements="joints",
            indices=listing(missing),
        )


def still_joints(motions: Sequence[Motion], skeleton: Skeleton) -> Findings:
    """Yield the joints that turn in none of the motions."""
    first = motions[0].rotations[:1]
    turned = np.max([_angles(motion.rotations, first).max(axis=0) for motion in motions], axis=0)
    still = np.flatnonzero(turned < STILL_ANGLE)
    if len(still):
        yield Finding(
            severity="info",
            code="still-joints",
            prim=skeleton.path,
            count=len(still),
            found=f"{joint_leaves(skeleton, still)} never turn in {amount(len(motions), 'motions')}",
            why="the garment cannot learn to follow what it never sees; in the shot these joints should be still too",
            elements="joints",
            indices=listing(still),
        )


def _angles(after: Floats, before: Floats) -> Floats:
    """Return the angles between unit quaternions [degrees], shape (F, J)."""
    cosine = np.abs((after * before).sum(axis=-1))
    return np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))
