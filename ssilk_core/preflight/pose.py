# SPDX-License-Identifier: Apache-2.0
"""Whether the garment was modelled on the bind pose or on another one."""

from __future__ import annotations

import numpy as np

from ..assets import Character, Floats, Mesh, Skeleton
from ..kinematics import invert_rigid, skin_points, skinning_matrices, world_transforms
from .finding import Finding, Findings, listing
from .fit import signed_distance

MAX_ANGLE = 20.0  # [degrees] between bind and rest pose of a joint; cloth for one then does not fit the other
DEEP_PENETRATION = 0.01  # [m] inside the body
MAX_DEEP_SHARE = 0.02  # share of deep vertices above which a garment does not fit a pose


def rest_pose(character: Character, mesh: Mesh) -> Findings:
    """Yield joints whose rest pose is far from the bind pose: an error if the garment fits the former instead."""
    angles = rest_angles(character.skeleton)
    far = np.flatnonzero(angles > MAX_ANGLE)
    if not len(far):
        return
    worst = int(angles.argmax())
    fits_bind, fits_rest = (_deep_share(mesh, body) for body in (character.merged_body().mesh, _at_rest(character)))
    wrong = fits_bind > MAX_DEEP_SHARE and fits_rest < 0.5 * fits_bind
    yield Finding(
        severity="error" if wrong else "info",
        code="rest-pose",
        prim=mesh.path if wrong else character.skeleton.path,
        count=len(far),
        found=f"rest and bind pose of {len(far)} joints differ by more than {MAX_ANGLE:.0f} degrees, most at "
        f"'{character.skeleton.joint_names[worst]}' ({angles[worst]:.0f})"
        + (f"; {fits_bind:.0%} of the garment is inside the body as bound, {fits_rest:.0%} at rest" if wrong else ""),
        why="the garment is fitted to the bind pose; joints that a motion lacks stay in the rest pose",
        fix="fit the garment to the bind pose, or bind the body in the pose that the garment was modelled on"
        if wrong
        else "",
        elements="joints",
        indices=listing(far),
    )


def rest_angles(skeleton: Skeleton) -> Floats:
    """Return the angle between the rest and the bind pose of each joint, the roots aligned [degrees], shape (J,)."""
    turn = _rest_matrices(skeleton)[:, :3, :3]
    return np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))


def _rest_matrices(skeleton: Skeleton) -> Floats:
    """Return bind pose to rest pose for each joint, placed where the first root is bound, shape (J, 4, 4)."""
    rest = world_transforms(skeleton.rest_transforms, skeleton.parents)
    return skinning_matrices(skeleton.bind_transforms[0] @ invert_rigid(rest[0]) @ rest, skeleton.bind_transforms)


def _at_rest(character: Character) -> Mesh:
    body = character.merged_body()
    points = skin_points(body.mesh.points, body.skin, _rest_matrices(character.skeleton)[None])[0]
    return Mesh(body.mesh.path, points, body.mesh.faces)


def _deep_share(mesh: Mesh, body: Mesh) -> float:
    return float(np.mean(signed_distance(mesh.points, body) < -DEEP_PENETRATION))
