# SPDX-License-Identifier: Apache-2.0
"""Check that the garment was modelled on the bind pose."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Character, Floats, Mesh, Skeleton
from ...scene.kinematics import invert_rigid, skin_points, skinning_matrices, world_transforms
from .finding import Finding, Findings, index_tuple
from .fit import signed_distance

MAX_ANGLE = 20.0  # [degrees] between bind and rest pose of a joint; above it one garment cannot fit both
DEEP_PENETRATION = 0.01  # [m] inside the body
MAX_DEEP_SHARE = 0.02  # share of deep vertices above which a garment does not fit a pose


def rest_pose(character: Character, mesh: Mesh) -> Findings:
    """Yield joints whose rest pose differs from the bind pose; an error if the garment fits the rest pose instead."""
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
        + (f"; {fits_bind:.0%} of the garment is inside the body at bind, {fits_rest:.0%} at rest" if wrong else ""),
        why="training assumes the bind pose; joints that a motion does not animate stay in the rest pose",
        fix="fit the garment to the bind pose, or bind the body in the pose that the garment was modelled on"
        if wrong
        else "",
        elements="joints",
        indices=index_tuple(far),
    )


def rest_angles(skeleton: Skeleton) -> Floats:
    """Return the angle between rest and bind pose of each joint with aligned roots [degrees], shape (J,)."""
    turn = _rest_matrices(skeleton)[:, :3, :3]
    return np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))


def _rest_matrices(skeleton: Skeleton) -> Floats:
    """Return the transform of each joint from bind to rest pose, the first root kept in place, shape (J, 4, 4)."""
    rest = world_transforms(skeleton.rest_transforms, skeleton.parents)
    return skinning_matrices(skeleton.bind_transforms[0] @ invert_rigid(rest[0]) @ rest, skeleton.bind_transforms)


def _at_rest(character: Character) -> Mesh:
    body = character.merged_body()
    points = skin_points(body.mesh.points, body.skin, _rest_matrices(character.skeleton)[None])[0]
    return Mesh(body.mesh.path, points, body.mesh.faces)


def _deep_share(mesh: Mesh, body: Mesh) -> float:
    return float(np.mean(signed_distance(mesh.points, body) < -DEEP_PENETRATION))
