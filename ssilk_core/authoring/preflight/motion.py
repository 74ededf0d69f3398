# SPDX-License-Identifier: Apache-2.0
"""Check motions for errors, and for joints that they do not animate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...events import format_count
from ...scene.assets import Floats, Ints, Motion, Scene, Skeleton
from ...scene.kinematics import (
    CUT_SPEED,
    MAX_JOINT_SPEED,
    hub_places,
    motion_transforms,
    skinning_matrices,
    split_at_cuts,
    world_transforms,
)
from .finding import Finding, Findings, format_joints, index_tuple

STILL_ANGLE = 0.5  # [degrees]
USUAL_RATES = (15.0, 240.0)  # [1/s] lowest and highest
CHECKED_RATE, MOST_CHECKED = 5.0, 500  # poses a second, and in all, in which limbs are looked for inside the body
MANY_BURIED = 0.02  # share of the frames
NAMED_LIMBS = 3
LYING, MOSTLY = 0.5, 0.9  # cosine between the hub's up axis and that at rest, and share of the frames
STRAIGHTER = 0.15  # by how much this cosine's mean is larger by the other axis, where that one is the right one
MAX_SAMPLE_GAP = 0.5  # [s] gap that is reported if it is also ten times the usual sampling interval


@dataclass(frozen=True, eq=False)
class MotionFile:
    """Facts about a motion's file: the joints that it animates and the times of its samples.

    Attributes:
        joints: indices of the skeleton's joints that it animates.
        times: times of the samples [s], shape (S,).
        upright: where posture alone told its up axis, how upright the character is on average by the axis taken and
            by the other, from 1 as at rest to -1 upside down.
        is_of_file: whether its file's axis was taken, and not that of the character's Xforms.
    """

    path: str
    joints: Ints
    times: Floats
    upright: tuple[float, float] | None = None
    is_of_file: bool = False


def unread_motion(path: str, reason: str) -> Finding:
    """Return the error of a motion that cannot be read, for a `reason` in one sentence."""
    return Finding(
        severity="error",
        code="motion-unread",
        prim=path,
        found=reason.removeprefix(f"{path}: ").removesuffix("."),
        why="training refuses it, too",
        fix="mend the file, or leave it out",
    )


def root_jumps(motion: Motion, skeleton: Skeleton) -> Findings:
    """Yield the frames at which the root is teleported rather than animated."""
    starts = np.cumsum([span.frame_count for span in split_at_cuts(motion, skeleton)])[:-1]
    if len(starts):
        root = hub_places(skeleton, motion.rotations, motion.translations)
        far = np.linalg.norm(root[starts] - root[starts - 1], axis=1).max()
        yield Finding(
            severity="warning",
            code="root-jumps",
            prim=motion.path,
            count=len(starts),
            found=f"the root jumps, by up to {far:.2g} m (first to frame {starts[0]} of {motion.frame_count})",
            why=f"a step {CUT_SPEED:g} m/s faster than those around it is not a movement; the cloth restarts there",
            fix="cut the clip there, or repair the root's curve",
            elements="frames",
            indices=index_tuple(starts),
        )


def lying(motion: Motion, skeleton: Skeleton) -> Findings:
    """Yield a warning if the character lies, or stands on its head, or stands straighter by the other up axis."""
    hub = motion_transforms(motion, skeleton.parents)[:, skeleton.hub, :3, :3]
    rest = world_transforms(skeleton.rest_transforms, skeleton.parents)[skeleton.hub, :3, :3]
    up = (hub @ rest.T)[:, :, 1]
    down, (_, own, other) = np.flatnonzero(up[:, 1] < LYING), up.mean(axis=0)
    if len(down) > MOSTLY * motion.frame_count:
        found = f"the character lies or stands on its head in {len(down)} of {motion.frame_count} frames"
    elif abs(other) > own + STRAIGHTER:  # between Y up and Z up is a quarter turn about x
        down = np.arange(motion.frame_count)
        leans, would = np.degrees(np.arccos(np.clip([own, abs(other)], -1, 1)))
        found = (
            f"the character leans by {leans:.0f} degrees on average, and by {would:.0f} if the up axis of its file "
            "were the other one"
        )
    else:
        return
    yield Finding(
        severity="warning",
        code="lying",
        prim=motion.path,
        count=len(down),
        found=found,
        why="gravity pulls the cloth along the world's y axis, not towards the character's feet",
        fix="if it should stand, correct upAxis of the motion's file, or export it together with its character",
        elements="frames",
        indices=index_tuple(down),
    )


def axis_by_posture(file: MotionFile) -> Findings:
    """Yield that posture alone told a clip's up axis: a character that lies in it was stood up, or the reverse."""
    if file.upright is None:
        return
    taken, other = ("its file", "the character's Xforms")[:: 1 if file.is_of_file else -1]
    leans, would = np.degrees(np.arccos(np.clip(file.upright, -1, 1)))
    yield Finding(
        severity="warning" if file.is_of_file else "info",  # bound to the character, USD shows it by the Xforms
        code="axis-by-posture",
        prim=file.path,
        found=f"it stands alone, and may be in the axes of {taken}, by which the character leans by {leans:.0f} "
        f"degrees on average, or in those of {other}, by which it leans by {would:.0f}; the former are taken",
        why="both have one unit of length, so posture alone tells them apart, and a character may lie",
        fix="if the other one is right, export it with its character, or bound to its Skeleton",
    )


def joint_jumps(motion: Motion, skeleton: Skeleton) -> Findings:
    """Yield the frames at which a joint leaps away from its parent."""
    steps = np.linalg.norm(np.diff(motion.translations, axis=0), axis=-1) * _within(skeleton)
    frames = np.flatnonzero((steps * motion.fps > CUT_SPEED).any(axis=1))
    if len(frames):
        joint = int(steps.max(axis=0).argmax())
        yield Finding(
            severity="warning",
            code="joint-jumps",
            prim=motion.path,
            count=len(frames),
            found=f"{format_joints(skeleton, [joint])} moves {steps.max():.2g} m from its parent in one frame "
            f"(first to frame {frames[0] + 1} of {motion.frame_count})",
            why=f"a step faster than {CUT_SPEED:g} m/s within a body is no movement, and the cloth does not restart",
            fix="repair the translation curves, or leave the clip out",
            elements="frames",
            indices=index_tuple(frames + 1),
        )


def _within(skeleton: Skeleton) -> NDArray[np.bool_]:
    """Flag the joints that move within the body: not roots, nor those above the hub or it, shape (J,)."""
    within = np.asarray(skeleton.parents) >= 0
    within[list(skeleton.hub_path)] = False
    return within


def joint_snaps(motion: Motion, skeleton: Skeleton) -> Findings:
    """Yield the frames at which a joint flips: training cuts the motion there."""
    angles = _angles(motion.rotations[1:], motion.rotations[:-1])
    frames = np.flatnonzero((np.radians(angles) * motion.fps > MAX_JOINT_SPEED).any(axis=1))
    if len(frames):
        joint = int(angles.max(axis=0).argmax())
        yield Finding(
            severity="warning",
            code="joint-snaps",
            prim=motion.path,
            count=len(frames),
            found=f"{format_joints(skeleton, [joint])} rotates by {angles.max():.0f} degrees in one frame "
            f"(first to frame {frames[0] + 1} of {motion.frame_count})",
            why=f"more than {MAX_JOINT_SPEED:g} rad/s is usually a flip in captured or Euler curves: training uses "
            "the spans between separately, and in a shot it whips the cloth around",
            fix="filter the rotation curves, or leave the clip out",
            elements="frames",
            indices=index_tuple(frames + 1),
        )


def short_motion(motion: Motion, skeleton: Skeleton, fps: float, window: int) -> Findings:
    """Yield a warning if no span of a motion is as long as a training window of `window` poses at `fps`."""
    spans = split_at_cuts(motion, skeleton, max_joint_speed=MAX_JOINT_SPEED)
    longest = max(int((span.frame_count - 1) * fps / motion.fps + 1e-6) + 1 for span in spans)
    if longest < window:
        yield Finding(
            severity="warning",
            code="short-motion",
            prim=motion.path,
            found=f"it has {longest} poses in a row at {fps:g} frames per second",
            why=f"a training window has {window} poses; this clip only provides single poses",
            fix="join it with other clips, or use a longer one",
        )


def unusual_rate(motion: Motion) -> Findings:
    """Yield a frame rate that is too low for cloth, or implausibly high."""
    if not USUAL_RATES[0] <= motion.fps <= USUAL_RATES[1] and motion.frame_count > 1:
        seconds = (motion.frame_count - 1) / motion.fps
        yield Finding(
            severity="warning",
            code="frame-rate",
            prim=motion.path,
            found=f"{motion.fps:g} frames per second: its {motion.frame_count} frames last {seconds:.3g} s",
            why="inertia depends on the true speed of a motion",
            fix="set timeCodesPerSecond and framesPerSecond to the rate at which it was animated",
        )


def sample_gaps(file: MotionFile) -> Findings:
    """Yield the gaps in the samples of an otherwise densely sampled motion."""
    steps = np.diff(file.times)
    if len(steps) > 2 and steps.max() > max(MAX_SAMPLE_GAP, 10 * np.median(steps)):
        at = int(steps.argmax())
        yield Finding(
            severity="warning",
            code="sample-gaps",
            prim=file.path,
            count=int(np.count_nonzero(steps > max(MAX_SAMPLE_GAP, 10 * np.median(steps)))),
            found=f"it has no samples for {steps.max():.2g} s from {file.times[at]:.3g} s on",
            why="the pose is interpolated across the gap",
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
            found=f"it does not animate {format_joints(skeleton, missing)}",
            why="they stay in the rest pose",
            elements="joints",
            indices=index_tuple(missing),
        )


def still_joints(motions: Sequence[Motion], skeleton: Skeleton) -> Findings:
    """Yield the joints that do not rotate in any of the motions."""
    first = motions[0].rotations[:1]
    turned = np.max([_angles(motion.rotations, first).max(axis=0) for motion in motions], axis=0)
    still = np.flatnonzero(turned < STILL_ANGLE)
    if len(still):
        yield Finding(
            severity="info",
            code="still-joints",
            prim=skeleton.path,
            count=len(still),
            found=f"{format_joints(skeleton, still)} never rotate in {format_count(len(motions), 'motions')}",
            why="the garment cannot learn the effect of these joints; they should not rotate in shots either",
            elements="joints",
            indices=index_tuple(still),
        )


def buried_limbs(scene: Scene, motions: Sequence[Motion]) -> Findings:
    """Yield the limbs whose tips lie in another part of the body, of those that loose cloth must not cross."""
    if not motions:
        return
    import torch

    from ...physics.collision import limb_axes
    from ...physics.collision.limb_axes import LimbPoser

    axes, skeleton = limb_axes(scene), scene.character.skeleton
    if axes is None:
        return
    poser, buried = LimbPoser(axes, scene.character.merged_body(), torch.device("cpu")), []
    seconds = sum(motion.frame_count / motion.fps for motion in motions)
    rate = min(CHECKED_RATE, MOST_CHECKED / seconds)
    for motion in motions:
        chosen = np.arange(0, motion.frame_count, max(1, round(motion.fps / rate)))
        world = motion_transforms(motion.picked(chosen), skeleton.parents)
        matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3].transpose(1, 2, 3, 0)
        buried.append(poser.buried(torch.as_tensor(matrices, dtype=torch.float32)).numpy())
    every, clips = np.concatenate(buried, axis=1), [found.any(axis=0).mean() for found in buried]
    share, shares, most = every.any(axis=0).mean(), every.mean(axis=1), int(np.argmax(clips))
    order = [limb for limb in np.argsort(-shares, kind="stable") if shares[limb]]
    if order:
        named = ", ".join(
            f"{format_joints(skeleton, axes.tips[[limb]])} {shares[limb]:.1%}" for limb in order[:NAMED_LIMBS]
        )
        yield Finding(
            severity="warning" if share >= MANY_BURIED else "info",
            code="buried-limbs",
            prim=skeleton.path,
            count=len(order),
            found=f"in {share:.1%} of the frames a limb ends inside another part of the body "
            f"({named}; most in {motions[most].path}, {clips[most]:.1%})",
            why="no cloth fits in between, and loose cloth passes through the limb there",
            fix="in shots, move the limb off the body",
            elements="joints",
            indices=index_tuple(axes.tips[order]),
        )


def _angles(after: Floats, before: Floats) -> Floats:
    """Return the angles between unit quaternions [degrees], shape (F, J)."""
    cosine = np.abs((after * before).sum(axis=-1))
    return np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))
