# SPDX-License-Identifier: Apache-2.0
"""Whether characters are a family, one skeleton and one topology, and what differs where they are none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...errors import SsilkError, fail
from ...events import format_count
from ...files import split_body, split_location
from ...scene.assets import Body, Character
from ...scene.family import BodyFamily, turned_joint
from ..preflight.finding import Finding, Findings

LISTED = 3  # names of those that are missing
OTHER_WEIGHTS = 0.05  # from which on a body's skinning weights are told to be others


def differences(base: Character, other: Character) -> list[str]:
    """Say what keeps a character from being one of the base's family, by name; nothing where it is one."""
    own, found = base.skeleton, other.skeleton
    told = []
    if missing := [name for name in own.joint_names if name not in found.joint_names]:
        told.append(f"{format_count(len(missing), 'joints')} missing ({_some(missing)})")
    if more := [name for name in found.joint_names if name not in own.joint_names]:
        told.append(f"{format_count(len(more), 'joints')} more ({_some(more)})")
    if not told and own.joint_names != found.joint_names:
        first = next(name for name, its in zip(own.joint_names, found.joint_names) if name != its)
        told.append(f"its joints are in another order, from '{first}' on")
    if not told:
        told += [
            f"joint '{name}' has another parent"
            for name, parent, its in zip(own.joint_names, own.parents, found.parents)
            if parent != its
        ][:LISTED]
    if len(base.bodies) != len(other.bodies):
        return [*told, f"{len(other.bodies)} body meshes, not {len(base.bodies)}"]
    for body, its in zip(base.bodies, other.bodies):
        told += _of_mesh(body, its)
    return told


def _of_mesh(body: Body, its: Body) -> list[str]:
    mesh, other = body.mesh, its.mesh
    if other.vertex_count != mesh.vertex_count:
        return [f"{other.path} has {other.vertex_count} points, not {mesh.vertex_count}"]
    # Polygons, not triangles: which diagonal splits a quad depends on where its points are.
    counts, theirs = mesh.polygon_counts, other.polygon_counts
    assert counts is not None and theirs is not None
    same = np.array_equal(counts, theirs) and np.array_equal(mesh.indices_of_corners, other.indices_of_corners)
    if not same:
        return [f"the faces of {other.path} join other points"]
    return []


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:LISTED])


def need_family(characters: Sequence[Character], *, trained: bool = False) -> BodyFamily:
    """Return the family of characters, the base first.

    Args:
        trained: whether a garment is to be trained for it, for which joints must be bound at the same rotations.

    Raises:
        SsilkError: they are none; it names the first that differs, and what does.
    """
    base = characters[0]
    for other in characters[1:]:
        if told := differences(base, other):
            allowed = "members of a family have the same joints, parents and order of points"
            fail(other.path, f"it is no member of the family of {base.path}: {'; '.join(told)}", allowed)
        if trained and (turned := turned_joint(base.skeleton, other.skeleton)):
            joint, angle = turned
            name = base.skeleton.joint_names[joint]
            found = f"joint '{name}' is bound {angle:.1f} degrees from where {base.path} has it"
            allowed = "a garment is trained for members whose joints are moved in the bind pose and not turned"
            fail(other.path, found, allowed, "bind its joints at the rotations of the first member")
    return BodyFamily.of(characters)


def family_findings(characters: Sequence[Character]) -> Findings:
    """Yield an error for each character that is no member of the first one's family, and what the family is."""
    base, members = characters[0], [characters[0]]
    for other in characters[1:]:
        if told := differences(base, other):
            yield Finding(
                severity="error", code="no-family", prim=other.path,
                found=f"it is no member of the family of {base.path}: {'; '.join(told)}",
                why="one model dresses bodies of one skeleton and one topology",
                fix="export it from the same base mesh and rig, or leave it out",
            )  # fmt: skip
            continue
        members.append(other)
        yield from _on_member(base, other)
        if split_body(split_location(other.path)[0])[1]:
            yield _by_shapes(base, other)
    if len(members) > 1:
        yield _about(members)


def _on_member(base: Character, other: Character) -> Findings:
    if turned := turned_joint(base.skeleton, other.skeleton):
        joint, angle = turned
        yield Finding(
            severity="warning", code="turned-bind-pose", prim=other.path, elements="joints", indices=(joint,),
            found=f"joint '{base.skeleton.joint_names[joint]}' is bound {angle:.1f} degrees from where {base.path} "
                  "has it",
            why="a garment is trained for members whose joints are moved in the bind pose and not turned",
            fix="bind its joints at the rotations of the first member; 'ssilk rig --onto' takes it as it is",
        )  # fmt: skip
    joints = base.skeleton.joint_count
    for body, its in zip(base.bodies, other.bodies):
        apart = np.abs(body.skin.dense(joints) - its.skin.dense(joints)).max(axis=1)
        rows = np.flatnonzero(apart > OTHER_WEIGHTS)
        if len(rows):
            yield Finding(
                severity="warning", code="other-weights", prim=its.mesh.path, count=len(rows),
                elements="vertices", indices=tuple(rows.tolist()),
                found=f"{format_count(len(rows), 'points')} have other skinning weights than {body.mesh.path}",
                why="training poses all members with the weights of the first",
                fix="copy the weights of the first member",
            )  # fmt: skip


def _by_shapes(base: Character, other: Character) -> Finding:
    """Return by how much a body that weights of the stage's shapes make differs from the base."""
    own, its = base.merged_body().mesh.points, other.merged_body().mesh.points
    skin = 1000 * np.linalg.norm(its - own, axis=1)
    joints = 1000 * np.linalg.norm((other.skeleton.bind_transforms - base.skeleton.bind_transforms)[:, :3, 3], axis=1)
    farthest = base.skeleton.joint_names[int(joints.argmax())].rpartition("/")[2]
    return Finding(
        severity="info", code="body-shape", prim=other.path,
        found=f"its shapes move {format_count(int((skin > 0).sum()), 'points')} by {skin.mean():.1f} mm on average "
              f"and {skin.max():.1f} mm at most, and joints with them by {joints.mean():.1f} mm on average and "
              f"{joints.max():.1f} mm at most, which is '{farthest}'",
    )  # fmt: skip


def _about(members: Sequence[Character]) -> Finding:
    try:
        family = BodyFamily.of(members)
    except SsilkError as error:
        return Finding(severity="error", code="no-family", prim=members[1].path, found=error.found or str(error))
    points = np.array([member.merged_body().mesh.points - members[0].merged_body().mesh.points for member in members])
    joints = np.array([member.skeleton.bind_transforms - members[0].skeleton.bind_transforms for member in members])
    moved = [float(np.linalg.norm(each, axis=-1).max()) for each in (joints[..., :3, 3], points)]
    shared = f"{format_count(len(family.joints), 'joints')} and {format_count(len(family.points), 'points')}"
    return Finding(
        severity="info", code="family", prim=members[0].path, count=len(members),
        found=f"{len(members)} bodies are a family of {shared}: joints are up to {100 * moved[0]:.1f} cm and points "
              f"up to {100 * moved[1]:.1f} cm from the first one's, along "
              f"{format_count(family.size, 'directions')}",
    )  # fmt: skip
