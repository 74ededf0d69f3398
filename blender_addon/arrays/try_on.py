# SPDX-License-Identifier: GPL-3.0-or-later
"""Other bodies to try a garment on: how far towards one, and a member of the family from a stage."""

from __future__ import annotations

import numpy as np

from ssilk_core.events import format_count
from ssilk_core.scene.assets import Body, Character

from ..errors import SetupError
from .joints import identifiers

LEAST, MOST = -0.25, 1.25  # how far towards the other body a garment is shown: a little beyond both
KNOTS = (LEAST, 0.5, 1.0, MOST)  # shares at which it is carried; at 0 it is as it was fitted
LISTED = 3  # joints that are missing
TURNED = 5.0  # degrees between bodies up to which none is turned: their shapes differ
STANDS_ELSEWHERE = 0.05  # [m] likewise for their places
ADOPTED = "if they are proxies of an imported garment, Adopt Rig recognises them"
MEMBERS = (
    "Members have the same joints, and body meshes with the same points and faces; export it from the same base mesh "
    "and rig."
)


def knot_values(share: float) -> tuple[float, ...]:
    """Return how much each of `KNOTS` counts at a share: piecewise linear between neighbours, none at 0."""
    places = sorted((0.0, *KNOTS))
    return tuple(float(np.interp(share, places, [float(place == knot) for place in places])) for knot in KNOTS)


def member_points(base: Character, other: Character) -> list[np.ndarray]:
    """Return where another member of the family has the points of the base's bodies [m], shape (V, 3) for each.

    A member that is turned or stands elsewhere, as where the artist has moved the armature, is taken back.

    Raises:
        SetupError: joints of the base are missing, or a body mesh has other points or faces.
    """
    own, found = ([path.rpartition("/")[2] for path in each.skeleton.joint_names] for each in (base, other))
    missing = [name for name in own if name not in {*found, *identifiers(found)}]
    told = [f"{format_count(len(missing), 'joints')} missing ({', '.join(missing[:LISTED])})"] if missing else []
    matched = []
    for body in base.bodies:
        try:
            matched.append(_match(body, other).mesh.points)
        except SetupError as error:
            told.append(str(error))
    if told:
        todo = MEMBERS
        if len(told) == 1 and missing and not _moves_bodies(base, [own.index(name) for name in missing]):
            todo = f"They move no body: {ADOPTED}. {MEMBERS}"
        raise SetupError(f"'{other.path}' is no member of the family: {'; '.join(told)}. {todo}")
    placed = _placed(np.concatenate(matched), base.merged_body().mesh.points)
    return np.split(placed, np.cumsum([len(points) for points in matched])[:-1])


def _moves_bodies(character: Character, joints: list[int]) -> bool:
    return any(np.isin(each.skin.indices[each.skin.weights > 0], joints).any() for each in character.bodies)


def _match(body: Body, other: Character) -> Body:
    """Return the mesh of another character that has a body's points: of the same name, else the only one."""
    name, count, polygons = _leaf(body), body.mesh.vertex_count, _polygons(body)
    as_many = [each for each in (*other.bodies, *other.stand_ins) if each.mesh.vertex_count == count]
    if not as_many:
        there = ", ".join(f"'{_leaf(each)}' with {each.mesh.vertex_count}" for each in other.bodies) or "none"
        raise SetupError(f"no mesh has the {count} points of '{name}' (there is {there})")
    fitting = [each for each in as_many if _polygons(each) == polygons]
    if not fitting:
        raise SetupError(f"the faces of '{_leaf(as_many[0])}' join other points than those of '{name}'")
    named = [each for each in fitting if _leaf(each) == name]
    if not named and len(fitting) > 1:
        raise SetupError(f"{len(fitting)} meshes could be '{name}', and none is called so")
    return (named or fitting)[0]


def _polygons(body: Body) -> set[tuple[int, ...]]:
    """Return the points of each polygon, whichever comes first: programs begin faces and lists of them anywhere."""
    assert body.mesh.polygon_counts is not None and body.mesh.polygon_indices is not None
    corners = np.split(body.mesh.polygon_indices, np.cumsum(body.mesh.polygon_counts)[:-1])
    return {tuple(sorted(each.tolist())) for each in corners}


def _leaf(body: Body) -> str:
    return body.mesh.path.rpartition("/")[2]


def _placed(points: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return points (S, 3) turned and moved to where the base (S, 3) stands, y up, as a whole."""
    middle, own = points.mean(axis=0), base.mean(axis=0)
    left, _, right = np.linalg.svd((base - own).T @ (points - middle))  # the best rotation (Kabsch 1976)
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    if np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) > TURNED:
        points = points @ turn.T
    shift = own - points.mean(axis=0)
    shift[1] = base[:, 1].min() - points[:, 1].min()  # both stand on the same ground
    return points + np.where(np.abs(shift) > STANDS_ELSEWHERE, shift, 0.0)
