# SPDX-License-Identifier: Apache-2.0
"""How a shot shows a character's meshes otherwise than the character's stage, which is what cloth meets.

Points that it has moved, point caches, and parts that it hides. Blendshapes of bodies are followed (`body_shapes`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, Reporter
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Garment, ProxyRig, Skeleton

from ..names import SHAPES_SET
from ..opening.garment_api import read_garment_record
from ..opening.stage import PRIMS, USD_SUFFIXES, StageLike, named, needs_whole_files, open_stage, value
from ..opening.times import change_times, visibility_attributes
from .animation import animation_source
from .body_shapes import with_body_shapes
from .character import is_skinned, read_character
from .compared import Compared, rest_off
from .garment import find_garment, read_garment
from .mesh import is_body, is_drawn, is_garment, is_stand_in, kept_faces
from .motion import find_animation, read_motion
from .rig import read_proxy_rig
from .same_meshes import same_meshes, skinned_meshes
from .shapes import SAME, animated_shapes, tell_animated_shapes
from .skeleton import bound_skeleton, find_skeleton
from .spaces import SkelSource

KEPT = "what is written has the garment of the character's stage"


def tell_shown_otherwise(
    source: StageLike,
    motions: Iterable[str],
    report: Reporter,
    *,
    root: str | None = None,
    garment: str | None = None,
    bodies: Sequence[str] = (),
) -> None:
    """Report what of a character's meshes motions show otherwise than its stage, in which cloth does not meet them.

    Args are those of `shown_otherwise`, for each of several motions.

    Raises:
        SsilkError: as `animated_shapes`.
    """
    for motion in motions:
        weighed = animated_shapes(source, motion, root=root, garment=garment)
        tell_animated_shapes(motion, weighed, report)
        known = {found.mesh for found in weighed}
        for text in shown_otherwise(source, motion, root=root, garment=garment, bodies=bodies, known=known):
            report(Message(f"{motion}: {text}", "warning"))


@needs_whole_files
def shown_otherwise(
    source: StageLike,
    motion: str,
    *,
    root: str | None = None,
    garment: str | None = None,
    bodies: Sequence[str] = (),
    known: Iterable[str] = (),
) -> list[str]:
    """Return in words what a motion's stage shows of a character's meshes otherwise than the character's stage.

    A motion that stands alone shows no mesh. Meshes are the same where their names are, or where their faces are.

    Args:
        source, motion, root, garment: as for `animated_shapes`.
        bodies: those that cloth meets, as for `read_character`.
        known: names of garments whose shape is known to differ.

    Raises:
        SsilkError: as `read_motion` and `read_character`.
    """
    stage, (file, prim) = open_stage(source), split_location(motion)
    skel = find_skeleton(stage, root=root, garment=garment)
    own = [mesh for mesh in skinned_meshes(skel) if is_drawn(mesh)]
    found = [_hidden(mesh, skel, " of its own stage") for mesh in own]
    animation, placed = find_animation(of_motion := open_stage(file), prim, root)
    set_shapes = {str(name) for mesh in own for name in value(mesh, SHAPES_SET) or ()}
    found.append(_animates(animation, set_shapes))
    if placed is None:
        return [*filter(None, found)]
    try:
        there = find_skeleton(of_motion, root=str(placed.GetPath()), garment=garment)
    except SsilkError:  # a motion plays on a skeleton that nothing can be bound to, without bind pose
        return [*filter(None, found)]
    if there.prim == skel.prim:
        return [*filter(None, found)]
    character = read_character(stage, root=root, bodies=bodies, garment=garment)
    cloth = None
    try:
        cloth = _read_cloth(stage, character.skeleton, garment, root)
    except SsilkError as error:  # a model has its own, whatever the stage holds
        found.append(f"its garment is not compared with the character's: {error}")
    if cloth is not None and cloth.prim not in own:
        own.append(cloth.prim)
    same = same_meshes(there, skel, own, cloth.prim if cloth else None)
    read = read_motion(of_motion, character.skeleton, prim=prim, root=root)
    read = with_body_shapes(stage, motion, read, character, root=root, garment=garment)
    compared = Compared(character, cloth.garment if cloth else None, cloth.rig if cloth else None, read, there)
    # Cloth that was simulated, in place of the character's, over bodies whose faces may be hidden.
    is_baked = any(_is_baked(mesh) for mesh in Usd.PrimRange.Stage(of_motion, PRIMS) if mesh.IsA(UsdGeom.Mesh))
    for mesh, original in same.items():
        if cloth is not None and original == cloth.prim:
            found += _garment_otherwise(mesh, original, compared, known)
        elif set_shapes and not value(mesh, SHAPES_SET):
            pass  # it shows the body without these
        elif not is_garment(original) and compared.meets(original):
            found += _body_otherwise(mesh, original, compared, is_baked)
        found.append(_hidden(mesh, there))
    if cloth is not None and cloth.prim not in same.values() and not is_baked:
        found.append(_deactivated(cloth.prim, skel, there))
    met = [mesh for mesh in own if compared.meets(mesh) and not is_stand_in(mesh)]
    found += _other_bodies([mesh for mesh in met if cloth is None or mesh != cloth.prim], same, skel, there)
    return [*filter(None, found)]


def _animates(animation: Usd.Prim, set_shapes: set[str]) -> str:
    """Return in words which shapes that the body sets a motion animates; "" for none."""
    source = UsdSkel.Animation(animation)
    names, weights = source.GetBlendShapesAttr().Get() or (), source.GetBlendShapeWeightsAttr()
    rows = [row for code in weights.GetTimeSamples() if len(row := weights.Get(code) or ()) == len(names)]
    most = np.ptp(rows, axis=0) if rows else np.zeros(len(names))
    moving = [str(name) for name, each in zip(names, most) if str(name) in set_shapes and each > SAME]
    if not moving:
        return ""
    return f"it animates {', '.join(moving)}, by which the character's stage sets the body: it stays as it is there"


@dataclass(frozen=True, eq=False)
class _Cloth:
    """The garment of a character, as its own stage or file has it."""

    prim: Usd.Prim
    garment: Garment
    rig: ProxyRig | None


def _read_cloth(stage: Usd.Stage, skeleton: Skeleton, garment: str | None, root: str | None) -> _Cloth | None:
    """Return the garment that is meant; None where there is none, or several of which none is named.

    Args:
        garment: as for `read_scene`.
    """
    file, prim = split_location(garment) if garment else (None, None)
    if file and Path(file).suffix in USD_SUFFIXES:
        stage, garment, root = open_stage(file), prim, None
    meshes = [mesh for mesh in Usd.PrimRange.Stage(stage, PRIMS) if mesh.IsA(UsdGeom.Mesh)]
    if len(named(meshes, garment) if garment else [*filter(is_garment, meshes)]) != 1:
        return None
    read = read_garment(stage, skeleton, garment=garment, root=root)
    rig = read_proxy_rig(stage, skeleton, garment=garment, root=root)
    return _Cloth(find_garment(stage, garment), read, rig)


def _body_otherwise(mesh: Usd.Prim, own: Usd.Prim, compared: Compared, is_baked: bool) -> Iterator[str]:
    """Yield in words that a shot has a body of another shape than blendshapes make it, or with other faces."""
    name, to = mesh.GetName(), bound_skeleton(mesh)
    off = compared.off(own, mesh)
    if off and _is_cache(mesh, compared.there):
        yield f"{name} is a point cache, which is not followed; cloth meets it as its joints move it, elsewhere {off}"
    elif off and to and to != compared.there.prim:
        text = f"{name} follows another Skeleton, {to.GetPath()}"
        yield f"{text}; cloth meets it as the character's own moves it, elsewhere {off}"
    elif off:
        yield f"it shapes {name} otherwise, {off}; cloth meets the shape of the character's stage throughout"
    elif not is_baked and (text := _faces(mesh, own)):
        yield f"{text}; cloth meets all of it, and all of it is seen in what is written"


def _garment_otherwise(mesh: Usd.Prim, own: Usd.Prim, compared: Compared, known: Iterable[str]) -> Iterator[str]:
    """Yield in words that a shot has a garment of another shape as its joints move it, or with other faces."""
    name, to = mesh.GetName(), bound_skeleton(mesh)
    is_still = to and to != compared.there.prim and animation_source(to).prim is None  # nothing moves it in the shot
    if own.GetName() in known or is_still or _is_baked(mesh) or _is_cache(mesh, compared.there):
        return
    if off := compared.off(own, mesh) if compared.meets(own) else rest_off(own, mesh):
        yield f"it shapes the garment {name} otherwise, {off}; {KEPT}"
    elif text := _faces(mesh, own) or _as_guide(mesh, own):
        yield f"{text}; {KEPT}"


def _is_cache(mesh: Usd.Prim, skel: SkelSource) -> bool:
    """Return whether no joint moves a mesh, and its points change over time."""
    return not is_skinned(mesh, skel) and len(change_times([UsdGeom.Mesh(mesh).GetPointsAttr()])) > 1


def _is_baked(mesh: Usd.Prim) -> bool:
    """Return whether a mesh is a garment that was baked, simulated or fitted here."""
    if not is_garment(mesh):
        return False
    written = any("ssilk" in spec.layer.customLayerData for spec in mesh.GetPrimStack())
    return written or read_garment_record(mesh) is not None


def _faces(mesh: Usd.Prim, own: Usd.Prim) -> str:
    """Return in words that a shot's mesh has another number of faces that are no holes; else empty."""
    counts = (np.array(value(prim, "faceVertexCounts") or [], dtype=np.int64) for prim in (mesh, own))
    shown, kept = (len(kept_faces(prim, each)[1]) for prim, each in zip((mesh, own), counts))
    return f"it shows {shown} faces of {mesh.GetName()} instead of {kept}" if shown != kept else ""


def _as_guide(mesh: Usd.Prim, own: Usd.Prim) -> str:
    """Return in words that a shot leaves a mesh out of renders by its purpose; else empty."""
    now, before = (UsdGeom.Imageable(prim).ComputePurpose() for prim in (mesh, own))
    unseen = (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy)
    return f"it gives {mesh.GetName()} the purpose {now}" if now != before and now in unseen else ""


def _deactivated(own: Usd.Prim, skel: SkelSource, there: SkelSource) -> str:
    """Return in words that a shot deactivates a garment, or what holds it; else empty."""
    if not own.GetPath().HasPrefix(skel.root.GetPath()):
        return ""
    path = own.GetPath().ReplacePrefix(skel.root.GetPath(), there.root.GetPath())
    found = next(prim for each in reversed(path.GetPrefixes()) if (prim := there.stage.GetPrimAtPath(each)))
    return "" if found.IsActive() else f"it deactivates {found.GetPath()}, and with it the garment; {KEPT}"


def _is_same_character(skel: SkelSource, there: SkelSource) -> bool:
    """Return whether a file has a say in the skeletons of both a character's stage and a shot's."""
    own, other = ({spec.layer.identifier for spec in each.prim.GetPrimStack()} for each in (skel, there))
    return bool(own & other)


def _other_bodies(
    bodies: Iterable[Usd.Prim], same: Mapping[Usd.Prim, Usd.Prim], skel: SkelSource, there: SkelSource
) -> Iterator[str]:
    """Yield in words which bodies a shot lacks, and which it alone has, if it is a shot of this character."""
    if not same and not _is_same_character(skel, there):
        return
    guides = {own: said for mesh, own in same.items() if (said := _as_guide(mesh, own))}
    for body in bodies:
        if body not in same.values() or body in guides:
            text = guides.get(body, f"it shows no mesh {body.GetName()} that is the character's")
            yield f"{text}; cloth meets it, and it is seen in what is written"
    extra = [mesh for mesh in skinned_meshes(there) if mesh not in same and is_drawn(mesh) and is_body(mesh)]
    for mesh in extra:
        if not is_stand_in(mesh):
            text = f"{mesh.GetName()} follows its skeleton and is not in the character's stage"
            yield f"{text}; cloth does not meet it, and what is written lacks it"


def _hidden(mesh: Usd.Prim, skel: SkelSource, where: str = "") -> str:
    """Return in words that a mesh is hidden while its skeleton, by which a shot is hidden, is not; else empty."""
    for code in change_times([*visibility_attributes(mesh), *visibility_attributes(skel.prim)]) or [0.0]:
        at = (UsdGeom.Imageable(prim).ComputeVisibility(Usd.TimeCode(code)) for prim in (mesh, skel.prim))
        of_mesh, of_character = at
        if of_mesh == UsdGeom.Tokens.invisible != of_character:
            text = f"{mesh.GetName()} is hidden at time code {code:g}{where}"
            return f"{text}; it is met, and seen in what is written, as long as the character is"
    return ""
