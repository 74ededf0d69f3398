# SPDX-License-Identifier: Apache-2.0
"""How a garment and its character fit together at the bind pose: size, place, body and penetration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints, Mesh
from ..fabrics import FABRICS
from ..mesh.topology import components, edge_use, edges
from ..setup.surface import closest_on_surface
from .finding import Finding, Findings, amount, listing

MARGIN = FABRICS["default"].margin  # [m]
Mask = NDArray[np.bool_]
SHALLOW = 5e-3  # [m]; penetration up to here is pushed out by --fix
DEEP_SHARE = 0.25  # of the vertices inside the body, from which on the garment cannot be meant to be so
SAMPLES = 400  # vertices that the alignment is measured on
SCALES = (1.0, 0.01, 100.0, 0.1, 10.0, 0.001, 1000.0, 0.0254, 1 / 0.0254)
# Rotations that undo a mistaken up axis: none, z up read as y up, y up read as z up.
TURNS = {
    "": np.eye(3),
    "Z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "Y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


@dataclass(frozen=True)
class Misplacement:
    """How a garment would have to be scaled and turned to fit; `up` is the axis that is really up, "" as it is."""

    scale: float
    up: str


def alignment(mesh: Mesh, body: Mesh, *, fixable: bool = False) -> Findings:
    """Yield that the garment is not where the body is, with the scale or up axis that would put it there.

    `fixable` says that its file leaves these open, so that --fix may write them.
    """
    guess, points = misplacement(mesh, body), mesh.points[np.unique(mesh.faces)]
    if not _apart(points, body) and guess is None:
        return
    distance, size = _distance(points, body), np.ptp(points, axis=0).max()
    yield Finding(
        severity="error",
        code="alignment",
        prim=mesh.path,
        found=f"the garment is {size:.3g} m in size and lies {distance.min():.3g} to {distance.max():.3g} m from "
        f"the body, which is {_height(body):.3g} m high{_described(guess)}",
        why="a garment is trained where it lies: it must be fitted to the body in its bind pose",
        fix="set metersPerUnit and upAxis of its file, or apply its transforms and move it onto the body",
        fixable=fixable,
    )


def misplacement(mesh: Mesh, body: Mesh) -> Misplacement | None:
    """Return the simplest scale and turn that put a garment on the body; None if it is there, or none does.

    Only what lies apart from the body is taken to be scaled: a wide gown is far from it, too, but touches it.
    """
    every = mesh.points[np.unique(mesh.faces)]
    points = every[:: max(1, len(every) // SAMPLES)]
    if _near(points, body):
        return None
    scales = SCALES if _apart(every, body) else (1.0,)
    guesses = (Misplacement(scale, up) for up in TURNS for scale in scales)
    return next((guess for guess in guesses if _worn(guess.scale * points @ TURNS[guess.up].T, body)), None)


def _height(body: Mesh) -> float:
    return float(np.ptp(body.points[:, 1]))


def _apart(points: Floats, body: Mesh) -> bool:
    """Return whether points are too far from the body, too small or too large to have to do with it."""
    size, height = np.ptp(points, axis=0).max(), _height(body)
    return not 0.04 * height < size < 5 * height or bool(_distance(points, body).min() > 0.1 * height)


def _near(points: Floats, body: Mesh) -> bool:
    return not _apart(points, body) and bool(np.median(_distance(points, body)) < 0.15 * _height(body))


def _worn(points: Floats, body: Mesh) -> bool:
    """Return whether points could be a garment that is worn: near the body, and mostly outside it."""
    return _near(points, body) and bool(np.mean(signed_distance(points, body) < 0) < 0.5)


def _distance(points: Floats, body: Mesh) -> Floats:
    return closest_on_surface(points, body).distance


def _described(guess: Misplacement | None) -> str:
    if guess is None:
        return ""
    words = [f"{1 / guess.scale:.4g} times its size"] if guess.scale != 1 else []
    words += [f"read with the wrong up axis ({guess.up} is up)"] if guess.up else []
    return "; it seems to be " + " and ".join(words)


def body_holes(body: Mesh) -> Findings:
    """Yield the borders of a body that is not closed."""
    pairs, uses = edge_use(body.faces)
    rim = np.unique(pairs[uses == 1])
    if len(rim):
        yield Finding(
            severity="warning",
            code="body-not-watertight",
            prim=body.path,
            count=len(rim),
            found=f"the body is open along {amount(int(np.count_nonzero(uses == 1)), 'edges')}",
            why="near a hole it is uncertain what is inside, so that cloth may slip through unnoticed",
            fix="close the holes that cloth can reach; others do no harm",
            elements="vertices",
            indices=listing(rim),
        )


def body_inside_out(body: Mesh) -> Findings:
    """Yield a body whose normals point inward: the volume that its faces enclose is negative."""
    a, b, c = np.moveaxis((body.points - body.points.mean(axis=0))[body.faces], 1, 0)
    if np.einsum("fi,fi->", a, np.cross(b, c)) < 0:
        yield Finding(
            severity="error",
            code="body-inside-out",
            prim=body.path,
            count=len(body.faces),
            found="the body's normals point inward",
            why="collisions push the cloth along the normals, here into the body",
            fix="flip the normals of the body",
            elements="faces",
        )


def penetration(mesh: Mesh, body: Mesh) -> Findings:
    """Yield the vertices inside the body and, apart, those nearer to it than the collision margin."""
    signed = signed_distance(mesh.points, body)
    repaired = signed_distance(mesh.points + push_out(mesh.points, edges(mesh.faces), body), body) >= MARGIN
    inside, near = np.flatnonzero(signed < 0), np.flatnonzero((signed >= 0) & (signed < MARGIN))
    if len(inside):
        yield Finding(
            severity="error" if len(inside) > DEEP_SHARE * mesh.vertex_count else "warning",
            code="penetration",
            prim=mesh.path,
            count=len(inside),
            found=f"{len(inside) / mesh.vertex_count:.1%} of all, inside the body, up to "
            f"{-1000 * signed.min():.1f} mm deep",
            why="this is the rest shape: cloth and collisions fight each other in every frame",
            fix="push these vertices out in the bind pose, or give the garment more room"
            + _partly(repaired[inside], f"pushes patches out that are at most {1000 * SHALLOW:g} mm deep"),
            fixable=bool(repaired[inside].all()),
            elements="vertices",
            indices=listing(inside),
        )
    if len(near):
        yield Finding(
            severity="info",
            code="inside-margin",
            prim=mesh.path,
            count=len(near),
            found=f"the nearest of them is {1000 * signed[near].min():.1f} mm from the body; collisions start at "
            f"{1000 * MARGIN:g} mm",
            why="there the cloth is pushed away a little even at rest",
            fixable=bool(repaired[near].all()),
            elements="vertices",
            indices=listing(near),
        )


def _partly(repaired: Mask, does: str) -> str:
    """Return what --fix does when it repairs some but not all."""
    count = int(repaired.sum())
    return f"; --fix {does}: {count} of these" if 0 < count < len(repaired) else ""


def signed_distance(points: Floats, body: Mesh) -> Floats:
    """Return the distance to the body's surface [m], negative inside (winding number above a half), shape (V,)."""
    import igl

    winding = igl.fast_winding_number(body.points, body.faces, np.ascontiguousarray(points))
    return np.where(np.abs(winding) > 0.5, -1.0, 1.0) * _distance(points, body)


def push_out(points: Floats, pairs: Ints, body: Mesh) -> Floats:
    """Return offsets [m] that bring shallow penetration out of the collision margin, shape (V, 3).

    Patches of vertices nearer than the margin move as a whole, or not at all if they are deeper than `SHALLOW`:
    moving a part of them would tear the cloth. `pairs` (E, 2) are its edges.
    """
    signed = signed_distance(points, body)
    near = signed < MARGIN
    patch = components(pairs[near[pairs].all(axis=1)], len(points))
    deepest = np.full(patch.max() + 1, np.inf)
    np.minimum.at(deepest, patch, signed)
    movable = near & (deepest > -SHALLOW)[patch]
    moved = np.array(points)
    for _ in range(5):  # near a crease the nearest surface changes on the way
        signed = signed_distance(moved, body)
        short = movable & (signed < MARGIN)
        moved[short] += _outward(moved[short], body) * (1.02 * MARGIN - signed[short])[:, None]
    return moved - points


def _outward(points: Floats, body: Mesh) -> Floats:
    return closest_on_surface(points, body).normals
