# SPDX-License-Identifier: Apache-2.0
"""Read a character from a stage: its skeleton and the body meshes bound to it."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.events import Reporter, silent
from ssilk_core.scene.assets import Body, Character, Floats, SkinWeights

from ..names import GEOM_BIND, SKEL
from ..opening.stage import (
    EARLIEST,
    PRIMS,
    StageLike,
    column_matrix,
    inherited,
    listed,
    location,
    named,
    needs_whole_files,
    open_stage,
)
from .bindings import need_skinned
from .carried import carried_by
from .mesh import is_body, is_drawn, read_mesh, rendered
from .shapes import shape_offsets
from .skeleton import bound_skeleton, character_skeleton, find_skeleton
from .skin import read_skin, tell_method
from .spaces import SkelSource

WITHOUT = "^"  # before a body that is left out; no prim's name begins with it


@needs_whole_files
def read_character(
    source: StageLike,
    *,
    root: str | None = None,
    bodies: Sequence[str] = (),
    garment: str | None = None,
    report: Reporter = silent,
) -> Character:
    """Read a character; its bodies are all drawn meshes bound to its skeleton, except garments.

    Meshes that a joint carries are bodies where they are named, or where none is bound. Those of purpose "proxy"
    stand in for bodies that are rendered, unless they are named.

    Blendshapes that are on at the earliest time are part of a body's shape. Points and bind transforms are in the
    core's bind space: UsdSkel's bind space (points after geomBindTransform) in metres, y up. It includes the uniform
    scale of the character's xforms but not their position; see `SkelSource.bind_to_core`. Rest transforms of root
    joints are in world space.

    Args:
        source: a file or an open stage.
        root: SkelRoot or Skeleton, by path or name, if there are several.
        bodies: body meshes, by path or name; all if none is named. `WITHOUT` stands before those that are left out.
        garment: a garment mesh that is not marked as one, by path or name.
        report: receives a warning about each body that does not use linear blend skinning, or whose weights do not
            sum to one.

    Raises:
        SsilkError: there is no character or several, a mesh is unknown, or the data is malformed.
    """
    skel = find_skeleton(open_stage(source), root=root, garment=garment)
    skeleton = character_skeleton(skel)
    order = skeleton.joint_names
    prims = _body_prims(skel, bodies, garment)
    shown = prims if _taken(bodies) else rendered(prims)
    return Character(
        location(skel.root),
        skeleton,
        tuple(_read_body(prim, skel, order, report) for prim in shown),
        tuple(_read_body(prim, skel, order, report) for prim in prims if prim not in shown),
    )


def unmarked_garments(source: StageLike, garments: Sequence[str], own: str | None = None) -> dict[str, list[str]]:
    """Return for each of a character's garments, by path or name, its meshes that count as bodies: none is marked.

    Args:
        own: the garment that is meant, which is none of them.

    Raises:
        SsilkError: as `read_character` does.
    """
    skel = find_skeleton(open_stage(source), garment=own)  # which keeps the stage, on which prims live
    every = _body_prims(skel, (), own)
    return {name: [str(prim.GetPath()) for prim in named(every, name)] for name in garments}


def bodies_there(
    source: StageLike,
    bodies: Sequence[str],
    kept: Collection[str],
    *,
    root: str | None = None,
    garment: str | None = None,
) -> list[str]:
    """Return `bodies` for another character, which may lack what is left out of them, or have it elsewhere.

    Args:
        kept: names of the first character's bodies: a mesh is not left out for such a name alone.

    Raises:
        SsilkError: as `read_character` does, whose other arguments these are.
    """
    skel, found = find_skeleton(open_stage(source), root=root, garment=garment), [*_taken(bodies)]
    every = [prim for prim in _meshes(skel) if is_skinned(prim, skel) or carried_by(prim, skel)]
    for name in _left_out(bodies):
        found += [f"{WITHOUT}{prim.GetPath()}" for prim in named(every, name) or _alike(every, name, kept)]
    return found


def _alike(prims: list[Usd.Prim], path: str, kept: Collection[str]) -> list[Usd.Prim]:
    """Return the prims whose paths end as one of another stage, in as many parts as any of them does."""
    parts = path.split("/")
    for first in range(1, len(parts)):
        end = "/".join(parts[first:])
        if found := [prim for prim in prims if str(prim.GetPath()).endswith(f"/{end}")]:
            return found if first + 1 < len(parts) or end not in kept else []
    return []


def has_meshes(stage: Usd.Stage, root: str | None, names: Sequence[str]) -> bool:
    """Return whether meshes of all these names lie beneath a character's SkelRoot; raise as `read_character` does."""
    beneath = Usd.PrimRange(find_skeleton(stage, root=root).root, PRIMS)
    return {prim.GetName() for prim in beneath if prim.IsA(UsdGeom.Mesh)}.issuperset(names)


def geom_to_core(prim: Usd.Prim, skel: SkelSource) -> Floats:
    """Return the transform from a bound mesh's local space to the core's bind space [m], column vectors, (4, 4)."""
    bind = inherited(prim, GEOM_BIND)
    matrix = None if bind is None else bind.Get(EARLIEST)
    return skel.bind_to_core if matrix is None else skel.bind_to_core @ column_matrix(matrix)


def is_skinned(prim: Usd.Prim, skel: SkelSource) -> bool:
    """Return whether a prim is bound to this skeleton and has influences."""
    return bound_skeleton(prim) == skel.prim and inherited(prim, SKEL[0]) is not None


def _meshes(skel: SkelSource) -> list[Usd.Prim]:
    return [prim for prim in Usd.PrimRange(skel.root, PRIMS) if prim.IsA(UsdGeom.Mesh)]


def _taken(bodies: Sequence[str]) -> list[str]:
    return [name for name in bodies if not name.startswith(WITHOUT)]


def _left_out(bodies: Sequence[str]) -> list[str]:
    return [name.removeprefix(WITHOUT) for name in bodies if name.startswith(WITHOUT)]


def _body_prims(skel: SkelSource, bodies: Sequence[str], garment: str | None) -> list[Usd.Prim]:
    every = _meshes(skel)
    meshes = [prim for prim in every if is_skinned(prim, skel)]
    known = [prim for prim in every if prim in meshes or carried_by(prim, skel)] if bodies else []
    unknown = next((name for name in (*_taken(bodies), *_left_out(bodies)) if not named(known, name)), None)
    if unknown is not None:
        fail(
            location(skel.root),
            f"no mesh '{unknown}' is bound to the skeleton",
            f"there are {listed(known)}",
            "name one of these with --body",
        )
    without = [prim for name in _left_out(bodies) for prim in named(every, name)]
    if taken := _taken(bodies):
        kept = [prim for name in taken for prim in named(known, name) if prim not in without]
        if not kept:
            given, allowed = " ".join(f"--body {name}" for name in bodies), "a body has a mesh at least"
            fail(location(skel.root), f"{given}, which leave no mesh", allowed, f"leave {WITHOUT}{taken[0]} out")
        return kept
    left_out = without + (named(every, garment) if garment else [])
    drawn = [prim for prim in every if is_drawn(prim) and is_body(prim) and prim not in left_out]
    return [prim for prim in drawn if prim in meshes] or [prim for prim in drawn if carried_by(prim, skel)]


def _read_body(prim: Usd.Prim, skel: SkelSource, order: tuple[str, ...], report: Reporter) -> Body:
    tell_method(prim, report)
    purpose = str(UsdGeom.Imageable(prim).ComputePurpose())
    carried = None if is_skinned(prim, skel) else carried_by(prim, skel)
    if carried:
        mesh = read_mesh(prim, skel.bind_to_core @ carried.to_bind, shape_offsets(prim, skel))
        joint = order.index(skel.joints[carried.joint])
        return Body(mesh, SkinWeights.rigid(mesh.path, joint, mesh.vertex_count), purpose)
    mesh = read_mesh(prim, geom_to_core(prim, skel), shape_offsets(prim, skel))
    skin = read_skin(prim, skel.joints, order, report)
    assert skin is not None  # is_skinned
    need_skinned(prim)
    return Body(mesh, skin, purpose)
