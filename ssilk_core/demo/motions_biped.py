# SPDX-License-Identifier: Apache-2.0
"""A two-legged figure: tracks of what it does, solved to joint rotations of any rig with the usual joint names.

Rotations are meant in world axes relative to the bind pose, so that it does not matter how a rig turns its joint
frames. Legs and arms are two bones solved from their ends (law of cosines), so that feet stay where they stand.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..errors import fail
from ..scene.assets import Floats, Motion, Skeleton
from ..scene.kinematics import invert_rigid, quaternion_from_matrix
from .motions_curves import FPS, about, apply, ease, euler_rotations

SIDE_NAMES = ("Left", "Right")
OUTWARD = np.array([1.0, -1.0])  # the left points to +x
NEEDED = (
    "Hips",
    "Neck",
    *(s + j for s in SIDE_NAMES for j in ("UpLeg", "Leg", "Foot", "ToeBase", "Arm", "ForeArm", "Hand")),
)


@dataclass(frozen=True, eq=False)
class Track:
    """What a figure does in F frames; pairs are left, then right; angles in radians.

    Attributes:
        hips: position of the pelvis joint [m], shape (F, 3).
        pelvis: rotation of the pelvis, shape (F, 3, 3).
        spine, head: pitch forward, yaw to the left, roll to the left of chest against pelvis and of head
            against chest, shape (F, 3).
        arms: forward swing, lift to the side, inward twist, elbow bend, from hanging straight, shape (F, 2, 4).
        wrists, grip: where the wrists are held [m], (F, 2, 3), and how much, 0 to 1, (F, 2).
        ankles, feet, toes: ankle positions [m] (F, 2, 3), foot rotations (F, 2, 3, 3), toes bent up (F, 2).
    """

    hips: Floats
    pelvis: Floats
    spine: Floats
    head: Floats
    arms: Floats
    wrists: Floats
    grip: Floats
    ankles: Floats
    feet: Floats
    toes: Floats


class Biped:
    """Measures of a skeleton, and the solver of tracks on it."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.skeleton = skeleton
        self.points = skeleton.bind_transforms[:, :3, 3]
        names = [name.rsplit("/", 1)[-1].rsplit(":", 1)[-1] for name in skeleton.joint_names]
        self.index = {name: joint for joint, name in enumerate(names)}
        missing = [name for name in NEEDED if name not in self.index]
        if missing:
            fail(
                skeleton.path,
                f"no joint named {', '.join(missing)}",
                "the motions made in code need a two-legged rig with the joint names of the CMU mocap skeletons",
                "rename the joints, or use motions of your own",
            )
        self.above: set[int] = set()  # joints that the hips hang from
        joint = self.index["Hips"]
        while (joint := int(skeleton.parents[joint])) >= 0:
            self.above.add(joint)
        legs = [
            np.linalg.norm(self.at(a) - self.at(b)) for a, b in (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot"))
        ]
        self.leg = float(sum(legs))
        self.scale = self.leg / 0.7945  # the measures of the motions are those of an adult of 1.62 m
        self.ground = float(self.at("LeftFoot")[1] - 0.069 * self.scale)

    def at(self, name: str) -> Floats:
        """Return a joint's position at the bind pose [m]."""
        return self.points[self.index[name]]

    def stand(self, frames: int) -> Track:
        """Return a track of standing still at the origin, arms hanging, knees a little soft."""
        hips = self.at("Hips") + (0, -0.006 * self.scale, 0)
        identity = np.broadcast_to(np.eye(3), (frames, 3, 3))
        foot = np.broadcast_to(np.eye(3), (frames, 2, 3, 3))
        still = np.zeros((frames, 3))
        arms = np.broadcast_to(np.radians([2.0, 11.0, 8.0, 16.0]), (frames, 2, 4))
        ankles = np.broadcast_to(self.ankle(foot, self.stance()), (frames, 2, 3))
        return Track(
            np.broadcast_to(hips, (frames, 3)), identity, still, still, arms, np.zeros((frames, 2, 3)),
            np.zeros((frames, 2)), ankles, foot, np.zeros((frames, 2)),
        )  # fmt: skip

    def stance(self, width: float = 0.095) -> Floats:
        """Return where the two feet stand, `width` [m] from the middle, as ground points under the ankles, (2, 3)."""
        ankle = self.at("LeftFoot")
        return np.stack([[side * width * self.scale, self.ground, ankle[2]] for side in OUTWARD])

    def ankle(self, feet: Floats, ground: Floats, *, heel: Floats | float = 0.0) -> Floats:
        """Return ankle positions of feet rolled over the ball of the foot, or over the heel as `heel` goes to 1.

        Args:
            feet: foot rotations (F, 2, 3, 3). Its heading turns about the ankle, its pitch about the pivot.
            ground: points on the ground where the flat foot has its ankle, (2, 3) or (F, 2, 3).
        """
        forward = feet @ np.array([1.0, 0, 0])
        yaw = np.arctan2(-forward[..., 2], forward[..., 0])
        heading = about(1, yaw)
        ankle = np.array([0.0, self.at("LeftFoot")[1] - self.ground, 0.0])
        ball = self.at("LeftToeBase") - self.at("LeftFoot") + ankle
        back = np.array([0.0, 0.0, -0.05 * self.scale])
        pivot = np.array([0.0, ball[1], ball[2]]) + np.asarray(heel)[..., None] * (back - (0.0, ball[1], ball[2]))
        return ground + apply(heading, pivot) + apply(feet, ankle - pivot)

    def solve(self, name: str, track: Track) -> Motion:
        """Return the motion of a track."""
        turns = self.torso(track)
        _, points = self.place(track.hips, turns)
        for side in range(2):
            turns |= self.leg_turns(track, side, points)
            turns |= self.arm_turns(track, side, points, turns)
        return self.motion(name, *self.place(track.hips, turns))

    def torso(self, track: Track) -> dict[str, Floats]:
        """Return rotations from pelvis to head, the bend shared evenly by the joints between."""
        turns = {"Hips": track.pelvis}
        for names, angles, base in (
            (("LowerBack", "Spine", "Spine1", "Spine2"), track.spine, "Hips"),
            (("Neck", "Neck1", "Head"), track.head, "chest"),
        ):
            chain = [name for name in names if name in self.index]
            for step, name in enumerate(chain, 1):
                turns[name] = turns[base] @ euler_rotations(angles * step / len(chain))
            turns.setdefault("chest", turns[chain[-1]] if chain else turns[base])
        for side, name in enumerate(SIDE_NAMES):
            lifted = np.radians(32) * ease((track.arms[:, side, 1] - np.radians(35)) / np.radians(130))
            turns[name + "Shoulder"] = turns["chest"] @ about(2, OUTWARD[side] * lifted)
        return turns

    def place(self, hips: Floats, turns: dict[str, Floats]) -> tuple[Floats, Floats]:
        """Return rotations (F, J, 3, 3) and positions (F, J, 3); joints without a turn follow their parents.

        Joints above the hips stand still, and other roots follow the hips.
        """
        count, carrier = self.skeleton.joint_count, self.index["Hips"]
        rotations, points = np.zeros((len(hips), count, 3, 3)), np.zeros((len(hips), count, 3))
        given = {self.index[name]: turn for name, turn in turns.items() if name in self.index}
        for joint, parent in enumerate(self.skeleton.parents):
            if joint in self.above:
                rotations[:, joint], points[:, joint] = np.eye(3), self.points[joint]
                continue
            if joint == carrier or parent < 0:
                rotations[:, joint] = given.get(joint, turns["Hips"])
                points[:, joint] = hips + apply(turns["Hips"], self.points[joint] - self.points[carrier])
                continue
            rotations[:, joint] = given.get(joint, rotations[:, parent])
            points[:, joint] = points[:, parent] + apply(
                rotations[:, parent], self.points[joint] - self.points[parent]
            )
        return rotations, points

    def leg_turns(self, track: Track, side: int, points: Floats) -> dict[str, Floats]:
        """Return rotations of thigh, shin, foot and toes that bring the ankle to its place, knee forward."""
        names = [SIDE_NAMES[side] + part for part in ("UpLeg", "Leg", "Foot", "ToeBase")]
        hinge = apply(track.pelvis, np.array([1.0, 0.0, -0.12 * OUTWARD[side]]))  # knees point a little outward
        upper, lower = self.two_bones(points[:, self.index[names[0]]], track.ankles[:, side], hinge, names[:3], -1.0)
        foot = track.feet[:, side]
        return dict(zip(names, (upper, lower, foot, foot @ about(0, -track.toes[:, side]))))

    def arm_turns(self, track: Track, side: int, points: Floats, turns: dict[str, Floats]) -> dict[str, Floats]:
        """Return rotations of upper arm and forearm from their angles, or from where the wrist is held."""
        names = [SIDE_NAMES[side] + part for part in ("Arm", "ForeArm", "Hand")]
        swing, lift, twist, bend = np.moveaxis(track.arms[:, side], -1, 0)
        frame = about(2, OUTWARD[side] * lift) @ about(0, -swing) @ about(1, -OUTWARD[side] * twist)
        frame = turns["chest"] @ frame
        down = np.array([0.0, -1.0, 0.0])
        first, second = (np.linalg.norm(self.at(b) - self.at(a)) for a, b in pairwise(names))
        shoulder = points[:, self.index[names[0]]]
        wrist = shoulder + first * apply(frame, down) + second * apply(frame @ about(0, -bend), down)
        wrist = wrist + track.grip[:, side, None] * (track.wrists[:, side] - wrist)
        upper, lower = self.two_bones(shoulder, wrist, apply(frame, np.array([-1.0, 0, 0])), names, 1.0)
        return {names[0]: upper, names[1]: lower}

    def two_bones(
        self, root: Floats, end: Floats, hinge: Floats, names: list[str], bends: float
    ) -> tuple[Floats, Floats]:
        """Return rotations (F, 3, 3) of two bones from `root` towards `end` that bend about `hinge`, all (F, 3)."""
        first, second = self.at(names[1]) - self.at(names[0]), self.at(names[2]) - self.at(names[1])
        a, b = float(np.linalg.norm(first)), float(np.linalg.norm(second))
        reach = end - root
        length = np.linalg.norm(reach, axis=-1, keepdims=True)
        reach = reach / length
        length = within_reach(length, a + b)
        hinge = hinge - (hinge * reach).sum(axis=-1, keepdims=True) * reach
        hinge = hinge / np.linalg.norm(hinge, axis=-1, keepdims=True)
        cosine = np.clip((a * a + length**2 - b * b) / (2 * a * length), -1.0, 1.0)
        upper = cosine * reach + np.sqrt(1 - cosine**2) * np.cross(reach, hinge)
        lower = (length * reach - a * upper) / b
        rest = np.cross(first, second)
        if np.linalg.norm(rest) < 0.02 * a * b:  # straight at the bind pose: elbows bend forward, knees back
            rest = np.cross(first, [0.0, 0.0, bends])
        return (
            frame_of(upper, hinge) @ np.swapaxes(frame_of(first, rest), -1, -2),
            frame_of(lower, hinge) @ np.swapaxes(frame_of(second, rest), -1, -2),
        )

    def motion(self, name: str, rotations: Floats, points: Floats) -> Motion:
        """Return local rotations and translations of rotations from the bind pose and places, as `place` has them.

        Joints but roots and the hips keep their places in their parents.
        """
        bind = self.skeleton.bind_transforms
        world = rotations @ bind[:, :3, :3]
        parents = np.asarray(self.skeleton.parents)
        children = np.flatnonzero(parents >= 0)
        local = world.copy()
        local[:, children] = np.swapaxes(world[:, parents[children]], -1, -2) @ world[:, children]
        offsets = bind[:, :3, 3].copy()
        offsets[children] = (invert_rigid(bind[parents[children]]) @ bind[children])[:, :3, 3]
        translations = np.repeat(offsets[None], len(points), axis=0)
        translations[:, parents < 0] = points[:, parents < 0]
        carrier = self.index["Hips"]
        if self.above:
            above = parents[carrier]
            back = np.swapaxes(world[:, above], -1, -2)
            translations[:, carrier] = apply(back, points[:, carrier] - points[:, above])
        return Motion(name, FPS, one_sign(quaternion_from_matrix(local)), translations)


def within_reach(length: Floats, full: float) -> Floats:
    """Return lengths that approach, and never reach, the length of the straight limb; C2."""
    soft, stretched = 0.98 * full, 0.999 * full
    return np.where(length < soft, length, soft + (stretched - soft) * np.tanh((length - soft) / (stretched - soft)))


def frame_of(bone: Floats, hinge: Floats) -> Floats:
    """Return the frame (..., 3, 3) of a bone and the axis it bends about, made orthonormal."""
    bone = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
    hinge = hinge - (hinge * bone).sum(axis=-1, keepdims=True) * bone
    hinge = hinge / np.linalg.norm(hinge, axis=-1, keepdims=True)
    return np.stack([bone, hinge, np.cross(bone, hinge)], axis=-1)


def one_sign(quaternions: Floats) -> Floats:
    """Return quaternions (F, J, 4) with each on the same side as the one before it in time."""
    flips = np.sign(np.sum(quaternions[1:] * quaternions[:-1], axis=-1))
    signs = np.concatenate([np.ones((1, quaternions.shape[1])), np.cumprod(np.where(flips < 0, -1.0, 1.0), axis=0)])
    return quaternions * signs[..., None]
