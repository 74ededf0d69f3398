# SPDX-License-Identifier: Apache-2.0
"""Check that a garment fits its character at the bind pose: scale, position, body mesh and penetration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...events import format_count
from ...scene.assets import Character, Floats, Ints, Mesh, is_carried_by, moved_by_joints
from ...scene.fabrics import FABRICS
from ...scene.mesh.topology import edge_use, is_inside_out, merged_places, vertex_mask
from ..setup.surface import closest_on_surface, is_enclosed
from .finding import Finding, Findings, format_joints, index_tuple
from .mesh import distinct_faces
from .settle import DEEPEST, FARTHEST, Settled, settle

COLLISION_MARGIN = FABRICS["default"].contact_distance  # [m]
TOO_DEEP = f"leaves a garment that is more than {1000 * DEEPEST:g} mm deep as it is, because it is not fitted"
NOT_SETTLED = "leaves this garment as it is, because no shape was found that is less deep in the body"
PIERCED = (
    "the body goes through the cloth, and settling leaves that part as it is because it would have to move "
    f"cloth by more than {1000 * FARTHEST:g} mm"
)
MAX_INSIDE_SHARE = 0.25  # share of vertices inside the body above which penetration is an error
ALIGNMENT_SAMPLES = 400  # number of vertices that the alignment is measured with
SCALES = (1.0, 0.01, 100.0, 0.1, 10.0, 0.001, 1000.0, 0.0254, 1 / 0.0254)
# Largest extents of garments, in heights of the body: those that can be, and those that most have.
SIZES, USUAL_SIZES = (0.04, 5.0), (0.1, 2.0)
MOVED = "; its size is that of a garment, so it appears to have been moved"
# Rotations that correct a wrong up axis: none, z up read as y up, y up read as z up.
UP_AXIS_ROTATIONS = {
    "": np.eye(3),
    "Z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "Y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


@dataclass(frozen=True)
class UnitCorrection:
    """The scale and up axis with which a mesh would fit; `up` is empty if the axis is already correct."""

    scale: float
    up: str


def alignment(mesh: Mesh, body: Mesh, *, fixable: bool = False) -> Findings:
    """Yield an error if the garment is not on the body, and say whether its size, its axis or its place is wrong.

    `fixable` means that its file authors neither units nor axis, so that --fix may write them.
    """
    guess, points = find_unit_correction(mesh, body), mesh.points[np.unique(mesh.faces)]
    if not _apart(points, body) and guess is None:
        return
    distance, size, height = _distance(points, body), float(np.ptp(points, axis=0).max()), _height(body)
    moved = guess is None and _is_between(size, height, SIZES)
    yield Finding(
        severity="error",
        code="alignment",
        prim=mesh.path,
        found=f"the garment is {size:.3g} m in size and lies {distance.min():.3g} to {distance.max():.3g} m from "
        f"the body, which is {height:.3g} m high{MOVED if moved else _described(guess)}",
        why="a garment is trained at its authored position: it must fit the body in the bind pose",
        fix="move it onto the body, and apply its transforms"
        if moved
        else "set metersPerUnit and upAxis of its file, or apply its transforms and move it onto the body",
        fixable=fixable,
    )


def find_unit_correction(mesh: Mesh, body: Mesh) -> UnitCorrection | None:
    """Return the scale and up axis that a garment's file should have stated; None if they explain nothing.

    The scale is judged by the sizes of garment and body, because any garment that is made small enough lies near the
    body's origin. Of several usual sizes, the simplest that puts the garment on the body is taken, and without one
    that nearest to the middle of the usual. Where the garment touches the body its scale is right: most of a wide
    gown is far from the body, too.
    """
    every = mesh.points[np.unique(mesh.faces)]
    points = every[:: max(1, len(every) // ALIGNMENT_SAMPLES)]
    if _near(points, body):
        return None
    size, height = float(np.ptp(every, axis=0).max()), _height(body)
    scales: list[float] = [1.0]
    if _apart(every, body) and not _is_between(size, height, USUAL_SIZES):
        scales = [scale for scale in SCALES if _is_between(scale * size, height, USUAL_SIZES)]
    for up, rotation in UP_AXIS_ROTATIONS.items():
        for scale in scales:
            if _worn(scale * points @ rotation.T, body):
                return UnitCorrection(scale, up)
    if not scales or _is_between(size, height, SIZES):
        return None
    middle = np.sqrt(np.prod(USUAL_SIZES)) * height
    return UnitCorrection(min(scales, key=lambda scale: abs(np.log(scale * size / middle))), "")


def _is_between(size: float, height: float, sizes: tuple[float, float]) -> bool:
    """Return whether a garment's largest extent is one of `sizes`, given in heights of the body."""
    return sizes[0] * height < size < sizes[1] * height


def _height(body: Mesh) -> float:
    return float(np.ptp(body.points[:, 1]))


def _apart(points: Floats, body: Mesh) -> bool:
    """Return whether points are too far from the body, too small or too large to belong to a garment on it."""
    size, height = float(np.ptp(points, axis=0).max()), _height(body)
    return not _is_between(size, height, SIZES) or bool(_distance(points, body).min() > 0.1 * height)


def _near(points: Floats, body: Mesh) -> bool:
    return not _apart(points, body) and bool(np.median(_distance(points, body)) < 0.15 * _height(body))


def _worn(points: Floats, body: Mesh) -> bool:
    """Return whether points could be a worn garment: near the body, and mostly outside it."""
    return _near(points, body) and bool(np.mean(signed_distance(points, body) < 0) < 0.5)


def _distance(points: Floats, body: Mesh) -> Floats:
    return closest_on_surface(points, body).distance


def _described(guess: UnitCorrection | None) -> str:
    if guess is None:
        return ""
    words = [f"{1 / guess.scale:.4g} times its size"] if guess.scale != 1 else []
    words += [f"read with the wrong up axis ({guess.up} is up)"] if guess.up else []
    return "; it appears to be " + " and ".join(words)


def open_border(body: Mesh) -> tuple[Ints, int]:
    """Return the vertices along which a body is open, and how many edges that are.

    Vertices in one place count as one: glTF files split a mesh along the seams of its texture.
    """
    place = merged_places(body.points)
    pairs, uses = edge_use(distinct_faces(place[body.faces]))
    return np.flatnonzero(np.isin(place, pairs[uses == 1])), int(np.count_nonzero(uses == 1))


def body_holes(body: Mesh) -> Findings:
    """Yield the border vertices of a body that is not closed."""
    rim, edges = open_border(body)
    if len(rim):
        yield Finding(
            severity="warning",
            code="body-not-watertight",
            prim=body.path,
            count=len(rim),
            found=f"the body is open along {format_count(edges, 'edges')}",
            why="inside and outside are ambiguous near a hole, so cloth may pass through undetected",
            fix="close the holes that cloth can reach; others are harmless",
            elements="vertices",
            indices=index_tuple(rim),
        )


def body_inside_out(body: Mesh) -> Findings:
    """Yield an error if the body's normals point inward: its faces enclose a negative volume."""
    if is_inside_out(body.points, body.faces):
        yield Finding(
            severity="error",
            code="body-inside-out",
            prim=body.path,
            count=len(body.faces),
            found="the body's normals point inward",
            why="collisions push the cloth along the normals, which here lead into the body",
            fix="flip the normals of the body",
            elements="faces",
        )


def carried_by_no_joint(character: Character) -> Findings:
    """Yield a warning where bodies hang from no joint that is taken to carry them."""
    skeleton = character.skeleton
    weights = [body.skin.dense(skeleton.joint_count) for body in character.bodies]
    moved = [moved_by_joints(body.mesh.points, each) for body, each in zip(character.bodies, weights)]
    if is_carried_by(moved, skeleton.parents, skeleton.hub):
        return
    moving = np.flatnonzero(np.sum(moved, axis=0) > 0)
    apart = [joint for joint in moving.tolist() if skeleton.hub not in _above(joint, skeleton.parents)]
    yield Finding(
        severity="warning",
        code="carried-by-no-joint",
        prim=skeleton.path,
        count=len(apart),
        found=f"no joint that moves with the bodies carries all of them; {skeleton.joint_names[skeleton.hub]} is "
        f"taken to, and {len(apart)} of {len(moving)} joints do not hang from it",
        why="the network sees how these are tilted and sped up, and not where they are",
        fix="parent them to it, as exports for games do, or expect limbs that cloth misses",
        elements="joints",
        indices=tuple(apart),
    )


def _above(joint: int, parents: Ints) -> list[int]:
    """Return a joint and those above it."""
    found = [joint]
    while parents[found[-1]] >= 0:
        found.append(int(parents[found[-1]]))
    return found


def penetration(mesh: Mesh, body: Mesh) -> Findings:
    """Yield the vertices inside the body and, separately, where it pierces the cloth, and the collision margin."""
    signed = signed_distance(mesh.points, body)
    used = vertex_mask(mesh.faces, mesh.vertex_count)
    share = float(np.mean(signed[used] < 0))
    near = np.flatnonzero(used & (signed >= 0) & (signed < COLLISION_MARGIN))
    settled = settle(mesh, body)
    pierced, part = settled.pierced, settled.before
    inside = np.setdiff1d(part.vertices, pierced)
    if len(pierced):
        yield Finding(
            severity="error",
            code="pierced",
            prim=mesh.path,
            count=len(pierced),
            found=f"a limb goes through the cloth, which no way of at most {1000 * FARTHEST:g} mm takes off it",
            why="this is the rest shape: elastic and collision forces oppose each other there in every frame",
            fix="move this part, or the limb in the bind pose, until the limb is on one side of the cloth; --fix "
            "leaves it as it is",
            elements="vertices",
            indices=index_tuple(pierced),
        )
    if len(inside):
        fixable = bool(settled.moved) and not len(np.setdiff1d(settled.after.vertices, pierced))
        what = f"{share:.1%} of all vertices, and points inside triangles," if share else "points inside triangles"
        yield Finding(
            severity="error" if share > MAX_INSIDE_SHARE else "warning",
            code="penetration",
            prim=mesh.path,
            count=len(inside),
            found=f"{what} are inside the body, up to {1000 * part.depth:.1f} mm deep",
            why="this is the rest shape: elastic and collision forces oppose each other in every frame",
            fix="settle the garment out of the body in the bind pose, or make it wider; --fix "
            + ("settles it" if fixable else _not_all(settled)),
            fixable=fixable,
            elements="vertices",
            indices=index_tuple(inside),
        )
    if len(near):
        yield Finding(
            severity="info",
            code="inside-margin",
            prim=mesh.path,
            count=len(near),
            found=f"the nearest of them is {1000 * signed[near].min():.1f} mm from the body; collisions start at "
            f"{1000 * COLLISION_MARGIN:g} mm",
            why="collisions push the cloth slightly outward there, even at rest",
            elements="vertices",
            indices=index_tuple(near),
        )


def describe_move(settled: Settled, verb: str) -> str:
    """Say how many vertices a settled garment moves, and how far: "moved 12 vertices, by 2.1 mm on average ..."."""
    return (
        f"{verb} {format_count(settled.moved, 'vertices')}, by {1000 * settled.mean:.1f} mm on average and "
        f"{1000 * settled.largest:.1f} mm at most"
    )


def describe_left(settled: Settled, mesh: Mesh, character: Character) -> str:
    """Say what of a settled garment stays inside the body, and where; empty if nothing does."""
    if not settled.left:
        return ""
    left = settled.after.vertices
    where = format_joints(
        character.skeleton, joints_at(left, replace(mesh, points=mesh.points + settled.offsets), character), 3
    )
    what = "inside the body or beneath other garments" if settled.layered else "inside the body"
    deep = f"{format_count(len(left), 'vertices')} {what}, up to {1000 * settled.after.depth:.1f} mm deep"
    return ": ".join([f"left {deep}, at {where}", *_why_left(settled)])


def joints_at(vertices: Ints, mesh: Mesh, character: Character) -> Ints:
    """Return the joints that move the skin nearest to vertices (N,) of a garment, those of most vertices first."""
    body = character.merged_body()
    nearest = closest_on_surface(mesh.points[vertices], body.mesh)
    beneath = nearest.corners[np.arange(len(vertices)), nearest.barycentric.argmax(axis=1)]
    strongest = body.skin.weights[beneath].argmax(axis=1)
    joints, count = np.unique(body.skin.indices[beneath, strongest], return_counts=True)
    return np.asarray(joints[np.argsort(-count, kind="stable")])


def _not_all(settled: Settled) -> str:
    """Say why --fix does not take all cloth out of the body."""
    left = f"leaves {format_count(len(settled.after.vertices), 'vertices')} inside"
    return left if settled.moved else _why_still(settled)


def _why_left(settled: Settled) -> list[str]:
    if not len(settled.pierced):
        return [] if settled.moved else [f"settling {_why_still(settled)}"]
    rest = np.setdiff1d(settled.after.vertices, settled.pierced)
    part = f"at {len(settled.pierced)} of them " if len(rest) else ""
    return [part + PIERCED]


def _why_still(settled: Settled) -> str:
    return TOO_DEEP if settled.before.depth > DEEPEST else NOT_SETTLED


def signed_distance(points: Floats, body: Mesh) -> Floats:
    """Return the distance to the body's surface [m], negative inside, shape (V,)."""
    return np.where(is_enclosed(points, body), -1.0, 1.0) * _distance(points, body)
