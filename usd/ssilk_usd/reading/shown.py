# SPDX-License-Identifier: Apache-2.0
"""How a shot shows a character's meshes otherwise than the character's stage, which is what cloth meets.

Blendshapes that it weighs otherwise or alone has, points that it has moved, point caches, and parts that it hides.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, Reporter
from ssilk_core.files import split_location
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Character, Floats, Motion

from ..opening.stage import EARLIEST, PRIMS, StageLike, needs_whole_files, open_stage
from ..opening.times import change_times, visibility_attributes
from .animation import animation_source
from .character import is_skinned, read_character
from .clips import spread
from .mesh import is_body, is_drawn, is_garment, is_rider, is_stand_in
from .motion import find_animation, read_motion
from .posed import posed_mesh, skinning_of
from .shapes import animated_shapes, tell_animated_shapes
from .skeleton import bound_skeleton, find_skeleton
from .spaces import SkelSource

SAME = 1e-3  # of a mesh's size, by which its points may differ unseen
LOOKED_AT = 32  # times at which points are compared


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
        known: names of meshes whose shape is known to differ.

    Raises:
        SsilkError: as `read_motion` and `read_character`.
    """
    stage, (file, prim) = open_stage(source), split_location(motion)
    skel = find_skeleton(stage, root=root, garment=garment)
    own = {mesh.GetName(): mesh for mesh in _meshes(skel) if is_drawn(mesh)}
    found = [_hidden(mesh, skel, " of its own stage") for mesh in own.values()]
    _, placed = find_animation(of_motion := open_stage(file), prim, root)
    if placed is None:
        return [*filter(None, found)]
    try:
        there = find_skeleton(of_motion, root=str(placed.GetPath()), garment=garment)
    except SsilkError:  # a motion plays on a skeleton that nothing can be bound to, without bind pose
        return [*filter(None, found)]
    if there.prim == skel.prim:
        return [*filter(None, found)]
    same = _same_meshes(there, own)
    character = read_character(stage, root=root, bodies=bodies, garment=garment)
    compared = _Compared(character, read_motion(of_motion, character.skeleton, prim=prim, root=root), there)
    for mesh, original in same.items():
        name, body = mesh.GetName(), not is_garment(original)
        if body and _is_cache(mesh, there):
            text = f"{name} is a point cache, which is not followed"
            found.append(f"{text}; cloth meets it as its joints move it")
        elif body and original.GetName() not in known and (away := compared.away(original, mesh)) != 0:
            found.append(_otherwise(name, away))
        found.append(_hidden(mesh, there))
    shown = [mesh for mesh in own.values() if str(mesh.GetPath()) in compared.bodies and not is_stand_in(mesh)]
    found += _other_bodies(shown, same, skel, there)
    return [*filter(None, found)]


def _meshes(skel: SkelSource) -> Iterator[Usd.Prim]:
    """Yield the meshes that are bound to a skeleton; what rides on a garment is placed by its cloth."""
    for prim in Usd.PrimRange(skel.root, PRIMS):
        if prim.IsA(UsdGeom.Mesh) and bound_skeleton(prim) == skel.prim and not is_rider(prim):
            yield prim


def _same_meshes(there: SkelSource, own: Mapping[str, Usd.Prim]) -> dict[Usd.Prim, Usd.Prim]:
    """Return for meshes of a shot which of a character's own meshes they are.

    They have its name, or its faces alone: programs add a namespace to names, or a number.
    """
    every = [prim for prim in Usd.PrimRange(there.root, PRIMS) if prim.IsA(UsdGeom.Mesh)]
    bound = {prim.GetName() for prim in every if bound_skeleton(prim) == there.prim}
    meshes = [
        prim for prim in every if (to := bound_skeleton(prim)) == there.prim or not (to or prim.GetName() in bound)
    ]
    found = {mesh: own[mesh.GetName()] for mesh in meshes if mesh.GetName() in own}
    others = [mesh for mesh in meshes if mesh not in found]
    missing = [mesh for mesh in own.values() if others and mesh not in found.values()]
    for faces in dict.fromkeys(map(_faces, missing)):
        pairs = [[mesh for mesh in each if _faces(mesh) == faces] for each in (others, missing)]
        if len(pairs[0]) == len(pairs[1]):  # such as two shoes, in the order of their stages
            found.update(zip(*pairs))
    return found


def _faces(mesh: Usd.Prim) -> tuple[bytes, bytes]:
    """Return the faces of a mesh, to be compared."""
    described = UsdGeom.Mesh(mesh)
    values = (described.GetFaceVertexCountsAttr().Get(EARLIEST), described.GetFaceVertexIndicesAttr().Get(EARLIEST))
    counts, indices = (np.array(each or [], dtype=np.int32).tobytes() for each in values)
    return counts, indices


def _otherwise(name: str, away: float | None) -> str:
    """Return in words that a shot has a body of another shape, by so much [m], or of other points if None."""
    how = "with other points" if away is None else f"by up to {1000 * away:.3g} mm"
    return f"it shapes {name} otherwise, {how}; cloth meets the shape of the character's stage throughout"


def _is_cache(mesh: Usd.Prim, skel: SkelSource) -> bool:
    """Return whether no joint moves a mesh, and its points change over time."""
    return not is_skinned(mesh, skel) and len(change_times([UsdGeom.Mesh(mesh).GetPointsAttr()])) > 1


class _Compared:
    """Bodies as a motion's joints move those of the character, beside the meshes that its own stage shows."""

    def __init__(self, character: Character, motion: Motion, there: SkelSource) -> None:
        self.bodies = {
            "/" + body.mesh.path.rpartition(":/")[2]: body for body in (*character.bodies, *character.stand_ins)
        }
        self.motion, self.skeleton, self.there = motion, character.skeleton, there
        self.skinned = skinning_of(there.stage)

    def away(self, own: Usd.Prim, other: Usd.Prim) -> float | None:
        """Return how far points of a body are at most from where the motion shows them [m], 0 if unseen.

        None: these are other points, and not in the same places.
        """
        body = self.bodies.get(str(own.GetPath()))
        if body is None:
            return 0.0
        codes = self._codes(other)
        at = np.array(codes) * self.motion.fps / self.there.stage.GetTimeCodesPerSecond() - self.motion.start
        frames = np.clip(at.round().astype(int), 0, self.motion.frame_count - 1)
        shown, away = posed_mesh(other, self.skinned), 0.0
        unseen = SAME * float(np.ptp(body.mesh.points, axis=0).max(initial=0))
        for code, frame in zip(codes, frames):
            rigid = self.motion.clip(frame, frame + 1)
            world = kinematics.motion_transforms(rigid, self.skeleton.parents)
            matrices = kinematics.skinning_matrices(world, self.skeleton.bind_transforms)
            (met,) = kinematics.skin_points(body.mesh.points, body.skin, matrices)
            seen = self.there.units.points_to_core(shown.points(Usd.TimeCode(code), UsdGeom.XformCache(code)))
            unseen = max(unseen, 1e-6 * float(np.abs(met).max(initial=0)))  # of float32, far from the origin
            if len(seen) != len(met):
                return None if _nearest(met, seen) > unseen else 0.0
            away = max(away, float(np.linalg.norm(seen - met, axis=1).max(initial=0)))
        return away if away > unseen else 0.0

    def _codes(self, mesh: Usd.Prim) -> list[float]:
        """Return times of frames, and of changes of blendshapes that are at one or beyond them; some if many."""
        rate = self.there.stage.GetTimeCodesPerSecond() / self.motion.fps
        frames = (self.motion.start + np.arange(self.motion.frame_count)) * rate
        animation = animation_source(self.there.prim).prim
        shaped = animation and UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get()
        times = np.array(change_times([UsdSkel.Animation(animation).GetBlendShapeWeightsAttr()] if shaped else []))
        whole = np.abs((times - frames[0]) / rate % 1 - 0.5) > 0.49
        times = times[(times < frames[0]) | (times > frames[-1]) | whole]
        return sorted({*spread(frames, LOOKED_AT).tolist(), *spread(times, LOOKED_AT).tolist()})


def _nearest(points: Floats, others: Floats) -> float:
    """Return how far points are at most from the nearest of others; infinite without others."""
    from scipy.spatial import cKDTree

    return float(max(cKDTree(a).query(b)[0].max(initial=0) for a, b in ((points, others), (others, points))))


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
    guides = [own for mesh, own in same.items() if UsdGeom.Imageable(mesh).ComputePurpose() == UsdGeom.Tokens.guide]
    for body in bodies:
        if body not in same.values() or body in guides:
            text = f"it shows no mesh {body.GetName()} that is the character's"
            yield f"{text}; cloth meets it, and it is seen in what is written"
    extra = [mesh for mesh in _meshes(there) if mesh not in same and is_drawn(mesh) and is_body(mesh)]
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
