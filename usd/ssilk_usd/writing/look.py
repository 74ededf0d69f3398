# SPDX-License-Identifier: Apache-2.0
"""What look development puts on a mesh, copied to where the mesh is written anew.

Materials with their networks, subsets, sides, subdivision and creases, primvars with all UV sets, custom attributes
and custom data. What skinning and simulation say is written by others, and normals of the bind pose are left out:
they would not turn with the cloth.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from ssilk_core.errors import SsilkError
from ssilk_core.events import format_count
from ssilk_core.files import split_body, split_location
from ssilk_core.scene.assets import Garment, Ints, Mesh

from ..opening.stage import EARLIEST, PRIMS, location, open_stage
from ..reading.garment import with_stiffness
from ..reading.mesh import display_colour, is_garment, kept_faces, polygons
from ..reading.uv_sets import texture_coordinates
from .body_faces import face_kind
from .look_above import OTHER_PRIMVARS, PURPOSES, bound_material_path, inherited_primvars
from .look_spaces import keep_colour_space, move_spaces

LOOKS = "Looks"  # scope of materials beneath the root
NEAR = 3  # meshes that are told where none is the one
_OTHERS = {
    "points", "faceVertexCounts", "faceVertexIndices", "holeIndices", "orientation", "extent", "xformOpOrder",
    "visibility", "purpose", "proxyPrim",
}  # fmt: skip
_OTHER_SPACES = (
    *OTHER_PRIMVARS, "xformOp:", "skel:", "ssilk:", "physics:", "omniphysics:", "physx", "material:binding",
)  # fmt: skip
_LEFT = ("normals", "primvars:normals", "velocities", "accelerations")
_METADATA = ("customData", "assetInfo", "displayName", "documentation", "comment", "hidden", "kind")
_OTHER_SCHEMAS = ("Skel", "Ssilk", "MaterialBinding", "Physics", "Physx", "Omni", "Deformable")


@dataclass(frozen=True, eq=False)
class LookSource:
    """A prim with the look of a mesh; `corners` and `faces` of it are those that the mesh has, in its order."""

    prim: Usd.Prim
    corners: Ints
    faces: Ints


@dataclass
class LeftOut:
    """What was not copied, by mesh, for messages."""

    names: dict[str, list[str]] = field(default_factory=dict)

    def add(self, mesh: str, *names: str) -> None:
        for name in names:
            found = self.names.setdefault(mesh, [])
            if name not in found:
                found.append(name)

    def __str__(self) -> str:
        return "; ".join(f"{mesh} loses {', '.join(names)}" for mesh, names in self.names.items())


def look_source(mesh: Mesh, stage: Usd.Stage, root: str | None = None) -> LookSource | None:
    """Return the prim of a stage that a mesh was read from, or is of the same polygons as; None without one.

    Where a root is named, it is a prim below that.

    A garment that was trained from another file is found by its polygons, those marked as garments and those of its
    name first.
    """
    sources = _look_sources(mesh, stage)
    return next((each for each in sources if not root or each.prim.GetPath().HasPrefix(root)), None)


def stiff_otherwise(mesh: Mesh, stage: Usd.Stage) -> str | None:
    """Return where a garment has its look, if another stiffness is painted there than it has; else None."""
    look = look_source(mesh, stage)
    if look is None or len(UsdGeom.Mesh(look.prim).GetPointsAttr().Get(EARLIEST) or ()) != mesh.vertex_count:
        return None
    own, found = mesh.stiffness, with_stiffness(mesh, look.prim).stiffness
    none = np.ones(mesh.vertex_count)
    same = np.allclose(none if found is None else found, none if own is None else own)
    return None if same else location(look.prim)


def as_it_looks(garment: Garment, source: str) -> Garment:
    """Return a garment with the colour and texture coordinates that its prim in a file has by now.

    Where the file has no such prim, or none of these on it, those of the garment stay.
    """
    stage = open_stage(source) if Path(split_body(source)[0]).is_file() else None
    look = look_source(garment.mesh, stage) if stage else None
    if look is None:
        return garment
    mesh, colour = garment.mesh, display_colour(look.prim)
    _, indices = polygons(look.prim, mesh.vertex_count, location(look.prim))
    uvs = texture_coordinates(look.prim, indices)
    mesh = mesh if uvs is None else replace(mesh, uvs=uvs[look.corners])
    return replace(garment, mesh=mesh, colour=colour or garment.colour)


def _twin(mesh: Mesh, look: LookSource, stage: Usd.Stage) -> Usd.Prim | None:
    """Return another mesh that is as much like one as the mesh whose look it is given; None where its path tells."""
    path = split_location(mesh.path)[1] or "/"
    if str(look.prim.GetPath()) == path or look.prim.GetName() == path.rpartition("/")[2]:
        return None
    others = (found.prim for found in _look_sources(mesh, stage) if found.prim != look.prim)
    return next((prim for prim in others if is_garment(prim) == is_garment(look.prim)), None)


def _look_sources(mesh: Mesh, stage: Usd.Stage) -> Iterator[LookSource]:
    path = split_location(mesh.path)[1] or "/"
    meshes = [prim for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS) if prim.IsA(UsdGeom.Mesh)]
    name = path.rpartition("/")[2]
    meshes.sort(key=lambda prim: (str(prim.GetPath()) != path, not is_garment(prim), prim.GetName() != name))
    counts = np.asarray(mesh.polygon_counts)
    for prim in meshes:
        if len(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get(EARLIEST) or []) < len(counts):
            continue
        points = len(UsdGeom.Mesh(prim).GetPointsAttr().Get(EARLIEST) or [])
        if points != mesh.vertex_count:
            continue
        try:
            own, indices = polygons(prim, points, location(prim))
        except SsilkError:  # a prop that is malformed, which nobody asked for
            continue
        corners, kept, faces = kept_faces(prim, own)
        if np.array_equal(kept, counts) and np.array_equal(indices[corners], mesh.indices_of_corners):
            yield LookSource(prim, corners, faces)


def _without_look(mesh: Mesh, stage: Usd.Stage, source: str) -> str:
    """Return why a mesh has no look in a stage, which meshes come near, and what to do."""
    name = mesh.path.rpartition("/")[2]
    counts = mesh.vertex_count, len(np.asarray(mesh.polygon_counts))
    text = f"it is {mesh.path} of {_sizes(*counts)}, and {source} has no such mesh"
    near = list[tuple[tuple[bool, ...], str]]()
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS):
        if not prim.IsA(UsdGeom.Mesh):
            continue
        shape = UsdGeom.Mesh(prim)
        own = [len(each.Get(EARLIEST) or ()) for each in (shape.GetPointsAttr(), shape.GetFaceVertexCountsAttr())]
        alike = prim.GetName() == name, *(own[at] == counts[at] for at in range(2)), is_garment(prim)
        if any(alike):
            marked = ", marked as a garment" if is_garment(prim) else ""
            others = " in another order" if own == [*counts] else ""
            near.append((alike, f"{prim.GetPath()} ({_sizes(*own)}{others}{marked})"))
    if not near:
        todo = f"'ssilk rig STAGE --onto {source}' writes a stage that has it"
        return f"{text}; {todo}, for its own body 'ssilk rig {source} --garment FILE'"
    near.sort(key=lambda each: each[0], reverse=True)
    found = ", ".join(each for _, each in near[:NEAR])
    todo = f"name a stage with {name}, or the model of the garment that is meant; train it anew if it has changed"
    return f"{text}; what comes near is {found}; {todo}"


def _sizes(points: int, faces: int) -> str:
    return f"{format_count(points, 'points')} and {format_count(faces, 'polygons')}"


def copy_looks(
    stage: Usd.Stage, root: Sdf.Path, source: str, meshes: Sequence[tuple[Mesh, Sdf.Path]], output: str | Path
) -> LeftOut:
    """Copy the looks of meshes from a stage to where they were defined; return what is left out.

    Args:
        root: prim that materials are written beneath.
        source: file of the stage, with the shapes of a body.
        meshes: each with the path of its prim in `stage`.
        output: where the layer of `stage` will lie, which relative paths of textures are relative to.
    """
    left = LeftOut()
    if not Path(split_body(source)[0]).is_file():
        return left
    opened = open_stage(source)
    found = [(mesh, path, look_source(mesh, opened)) for mesh, path in meshes]
    for mesh, _, look in found:
        if look is None:
            left.add(mesh.path.rpartition("/")[2], f"its look, if it had any: {_without_look(mesh, opened, source)}")
        elif twin := _twin(mesh, look, opened):
            text = f"its look, unless it is that of {look.prim.GetPath()}: {twin.GetPath()} has the same polygons"
            left.add(mesh.path.rpartition("/")[2], text)
    looks = [(path, look) for _, path, look in found if look is not None]
    flat = _flattened(opened, [look.prim for _, look in looks], stage.GetTimeCodesPerSecond())
    layer = stage.GetEditTarget().GetLayer()
    materials: dict[Sdf.Path, Sdf.Path] = {}
    with Sdf.ChangeBlock():
        for path, look in looks:
            _copy_properties(flat, layer, look, path, left)
    for path, look in looks:
        above = [opened.GetPrimAtPath(prefix) for prefix in look.prim.GetPath().GetPrefixes()]
        for variants in map(variants_of, above):
            left.add(path.name, *variants)
        _copy_meaning(look, UsdGeom.Mesh(stage.GetPrimAtPath(path)))
        stayed = move_spaces(layer, look.prim, stage.GetPrimAtPath(path), EARLIEST)
        left.add(path.name, *(f"the place of {name}, which is of another shape" for name in stayed))
        keep_colour_space(look.prim, stage.GetPrimAtPath(path))
        _copy_subsets(flat, stage, look, path, left)
        _bind_materials(flat, stage, root, look, path, materials, left)
        _keep_stand_in(stage, look, path, looks)
    written = {look.prim.GetPath(): path for path, look in looks} | materials
    for path, look in looks:
        prim = stage.GetPrimAtPath(path)
        _keep_targets(look.prim, prim.GetAuthoredProperties(), path.name, written, left)
        _tell_bindings(stage, look, path, materials, left)
    for material, path in materials.items():
        for prim in Usd.PrimRange(stage.GetPrimAtPath(path)):
            shader = opened.GetPrimAtPath(prim.GetPath().ReplacePrefix(path, material))
            _keep_targets(shader, prim.GetAuthoredRelationships(), path.name, written, left)
    name_files_from(layer, output)
    return left


def name_files_from(layer: Sdf.Layer, output: str | Path) -> None:
    """Make absolute paths of files in a layer relative to where it will lie, so that a folder can be moved."""
    folder = os.path.abspath(os.path.dirname(output))
    UsdUtils.ModifyAssetPaths(layer, lambda name: os.path.relpath(name, folder) if os.path.isabs(name) else name)


def variants_of(prim: Usd.Prim) -> list[str]:
    """Return in words which variant sets of a prim a copy of what is selected in them lacks.

    A set whose only variant is selected has nothing to lose.
    """
    sets = prim.GetVariantSets()
    names = [
        name
        for name in sets.GetNames()
        if sets.GetVariantSet(name).GetVariantNames() != [sets.GetVariantSelection(name)]
    ]
    kept = {name: sets.GetVariantSelection(name) for name in names}
    return [
        f"the variant set {name}, in which its stage has {repr(kept[name]) if kept[name] else 'none'}"
        for name in names
    ]


def _keep_targets(
    source: Usd.Prim, properties: Sequence[Usd.Property], holder: str, written: Mapping[Sdf.Path, Sdf.Path],
    left: LeftOut,
) -> None:  # fmt: skip
    """Let relationships and connections of a copy name what is written; those that would name nothing are left out.

    Args:
        source: the prim that was copied.
        properties: of the copy.
        holder: name of the mesh or material, for messages.
        written: where meshes and materials of the source are written, with all that is in them.
    """
    for found in properties:
        name = found.GetName()
        own = source.GetProperty(name) if source else None
        if not own or name.startswith(_OTHER_SPACES) or name in _OTHERS:
            continue
        is_relationship = isinstance(found, Usd.Relationship)
        targets = own.GetForwardedTargets() if is_relationship else own.GetConnections()
        if not targets and not is_relationship:
            continue
        named = [_rewritten(target, written) for target in targets]
        kept = [target for target in named if found.GetStage().GetObjectAtPath(target)]
        if not is_relationship:
            found.SetConnections(kept) if kept else found.ClearConnections()
        elif kept:
            found.SetTargets(kept)
        else:
            found.GetPrim().RemoveProperty(name)
        if len(kept) < len(named):
            missing = next(target for target in named if target not in kept)
            left.add(holder, f"{name} to {missing}, which is not written with it")


def _rewritten(target: Sdf.Path, written: Mapping[Sdf.Path, Sdf.Path]) -> Sdf.Path:
    """Return where a prim or property is written; as it is where nobody knows."""
    above = [path for path in target.GetPrimPath().GetPrefixes() if path in written]
    return target.ReplacePrefix(above[-1], written[above[-1]]) if above else target


def _flattened(stage: Usd.Stage, prims: Sequence[Usd.Prim], rate: float) -> Sdf.Layer:
    """Return a layer of the meshes and of all materials that are bound to them or to their subsets, composed.

    Its samples have `rate` time codes in a second.
    """
    wanted = [prim.GetPath() for prim in prims]
    for prim in prims:
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim))
        for holder in (prim, *(subset.GetPrim() for subset in subsets)):
            wanted += [material.GetPath() for material, _ in _bound(holder)]
    mask = Usd.StagePopulationMask([Sdf.Path(path) for path in wanted] or [Sdf.Path("/__none")])
    top = stage.GetRootLayer()
    if rate != stage.GetTimeCodesPerSecond():  # USD scales the times of a sublayer that has another rate
        top = Sdf.Layer.CreateAnonymous()
        top.subLayerPaths.append(stage.GetRootLayer().identifier)
        top.timeCodesPerSecond, top.expressionVariables = rate, stage.GetRootLayer().expressionVariables
    part = Usd.Stage.OpenMasked(top, Sdf.Layer.CreateAnonymous(), mask)
    part.ExpandPopulationMask()
    part.SetEditTarget(part.GetSessionLayer())
    for path in wanted:
        for prefix in path.GetPrefixes():
            prim = part.GetPrimAtPath(prefix)
            if prim and prim.IsInstance():
                prim.SetInstanceable(False)
    flat = part.Flatten()
    anchor_tiles(part, flat)
    return flat


def anchor_tiles(part: Usd.Stage, flat: Sdf.Layer) -> None:
    """Make paths of tiled textures absolute where USD finds tiles by the layer that names them.

    USD flattens those that begin with a dot alone.
    """
    for prim in Usd.PrimRange.Stage(part, PRIMS):
        for attribute in prim.GetAuthoredAttributes():
            named = attribute.Get() if attribute.GetTypeName() == Sdf.ValueTypeNames.Asset else None
            spec = flat.GetAttributeAtPath(attribute.GetPath())
            if not (named and spec and UsdShade.UdimUtils.IsUdimIdentifier(named.path)):
                continue
            layer = attribute.GetPropertyStack()[0].layer
            found = UsdShade.UdimUtils.ResolveUdimPath(named.path, layer)
            if found:
                spec.default = Sdf.AssetPath(found)


def _copy_properties(flat: Sdf.Layer, layer: Sdf.Layer, look: LookSource, path: Sdf.Path, left: LeftOut) -> None:
    prim = flat.GetPrimAtPath(look.prim.GetPath())
    above = [flat.GetPropertyAtPath(found) for found in inherited_primvars(look.prim)]
    for spec in [*(prim.properties if prim else ()), *filter(None, above)]:
        name = spec.name
        if name in _OTHERS or name.startswith(_OTHER_SPACES):
            continue
        if name in _LEFT:
            left.add(path.name, name)
            continue
        to = path.AppendProperty(name)
        Sdf.CopySpec(flat, spec.path, layer, to)
        if isinstance(spec, Sdf.RelationshipSpec):
            continue
        if flat.ListTimeSamplesForPath(spec.path):
            for time in layer.ListTimeSamplesForPath(to):
                layer.EraseTimeSample(to, time)
            source = look.prim.GetStage().GetAttributeAtPath(spec.path)
            layer.GetAttributeAtPath(to).default = source.Get(EARLIEST)
            left.add(path.name, f"the animation of {name}, which keeps its first value")
        _keep_rows(layer, look, to, name)
    here = layer.GetPrimAtPath(path)
    for key in _METADATA:
        if prim and prim.HasInfo(key):
            here.SetInfo(key, prim.GetInfo(key))


def _keep_rows(layer: Sdf.Layer, look: LookSource, to: Sdf.Path, name: str) -> None:
    """Keep of a value for each face or corner those that the written mesh has."""
    kind = face_kind(look.prim, name)
    if kind is None:
        return
    spec = layer.GetAttributeAtPath(to)
    values, rows = spec.default, look.corners if kind == "corner" else look.faces
    size = UsdGeom.Primvar(look.prim.GetAttribute(name)).GetElementSize() if not name.endswith(":indices") else 1
    if isinstance(values, Sdf.ValueBlock | None) or len(values) < size * len(rows):
        return
    chosen = (rows[:, None] * size + np.arange(size)).reshape(-1)
    if hasattr(values, "FromNumpy"):
        spec.default = type(values).FromNumpy(np.ascontiguousarray(np.array(values)[chosen]))
    else:  # words
        spec.default = type(values)([values[index] for index in chosen.tolist()])


def _copy_meaning(look: LookSource, mesh: UsdGeom.Mesh) -> None:
    applied = look.prim.GetMetadata("apiSchemas")
    for schema in applied.GetAppliedItems() if applied else ():
        if not schema.startswith(_OTHER_SCHEMAS):
            mesh.GetPrim().AddAppliedSchema(schema)
    purpose = UsdGeom.Imageable(look.prim).ComputePurpose()
    if purpose != UsdGeom.Tokens.default_:
        mesh.CreatePurposeAttr(purpose)
    mesh.GetSubdivisionSchemeAttr().Set(UsdGeom.Mesh(look.prim).GetSubdivisionSchemeAttr().Get())
    sets, own = UsdGeom.PrimvarsAPI(mesh), look.prim.GetAttribute("primvars:st")
    if sets.HasPrimvar("st") and not own:  # the set has a name of its own
        sets.RemovePrimvar("st")


def _keep_stand_in(
    stage: Usd.Stage, look: LookSource, path: Sdf.Path, looks: Sequence[tuple[Sdf.Path, LookSource]]
) -> None:
    """Let a mesh that is rendered name its stand-in, where one mesh of these is what its source names, or in it."""
    found = UsdGeom.Imageable(look.prim).ComputeProxyPrim()
    if found:
        named = [to for to, other in looks if other.prim.GetPath().HasPrefix(found[0].GetPath())]
        if len(named) == 1:
            UsdGeom.Imageable(stage.GetPrimAtPath(path)).CreateProxyPrimRel().SetTargets(named)


def _copy_subsets(flat: Sdf.Layer, stage: Usd.Stage, look: LookSource, path: Sdf.Path, left: LeftOut) -> None:
    layer = stage.GetEditTarget().GetLayer()
    position = np.full(int(look.faces.max(initial=-1)) + 1, -1)
    position[look.faces] = np.arange(len(look.faces))
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(look.prim)):
        to = path.AppendChild(subset.GetPrim().GetName())
        Sdf.CopySpec(flat, subset.GetPath(), layer, to)
        spec = layer.GetPrimAtPath(to)
        for name in [each.name for each in spec.properties if each.name.startswith("material:binding")]:
            spec.RemoveProperty(spec.properties[name])
        copied = UsdGeom.Subset(stage.GetPrimAtPath(to))
        first = subset.GetIndicesAttr().Get(EARLIEST) or []
        if copied.GetIndicesAttr().GetNumTimeSamples():
            copied.GetIndicesAttr().Clear()
            copied.GetIndicesAttr().Set(first)
            left.add(path.name, f"the animation of {to.name}.indices, which keeps its first value")
        if copied.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            indices = np.array(first, dtype=np.int64)
            found = position[indices[(indices >= 0) & (indices < len(position))]]
            copied.GetIndicesAttr().Set(Vt.IntArray.FromNumpy(found[found >= 0].astype(np.int32)))
    family = flat.GetPrimAtPath(look.prim.GetPath())
    for spec in family.properties if family else []:
        if spec.name.startswith("subsetFamily:"):
            Sdf.CopySpec(flat, spec.path, layer, path.AppendProperty(spec.name))


def _bound(prim: Usd.Prim) -> Iterator[tuple[UsdShade.Material, str]]:
    """Yield the materials that are bound to a prim, each with the purpose of its binding."""
    for purpose in PURPOSES:
        material, relationship = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
        if material and (purpose == UsdShade.Tokens.allPurpose or purpose in relationship.GetName().split(":")):
            yield material, purpose


def _bind_materials(
    flat: Sdf.Layer, stage: Usd.Stage, root: Sdf.Path, look: LookSource, path: Sdf.Path,
    materials: dict[Sdf.Path, Sdf.Path], left: LeftOut,
) -> None:  # fmt: skip
    """Bind what is bound to a mesh and to its subsets, copied beneath the root, once each."""
    pairs = [(look.prim, path)]
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(look.prim)):
        pairs.append((subset.GetPrim(), path.AppendChild(subset.GetPrim().GetName())))
    inherited = {(purpose, material.GetPath()) for material, purpose in _bound(look.prim)}
    for source, to in pairs:
        for material, purpose in _bound(source):
            if source != look.prim and (purpose, material.GetPath()) in inherited:
                continue
            copied = materials.get(material.GetPath()) or _copy_material(flat, stage, root, look, material, left)
            materials[material.GetPath()] = copied
            api = UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath(to))
            api.Bind(UsdShade.Material(stage.GetPrimAtPath(copied)), UsdShade.Tokens.fallbackStrength, purpose)


def _tell_bindings(
    stage: Usd.Stage, look: LookSource, path: Sdf.Path, materials: Mapping[Sdf.Path, Sdf.Path], left: LeftOut
) -> None:
    """Tell where USD binds another material to a mesh or a subset of it than it did: what is above takes hold."""
    for holder in (
        look.prim,
        *(each.GetPrim() for each in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(look.prim))),
    ):
        written = stage.GetPrimAtPath(holder.GetPath().ReplacePrefix(look.prim.GetPath(), path))
        for purpose in PURPOSES:
            before, now = (bound_material_path(each, purpose) for each in (holder, written))
            if now != materials.get(before, before):
                had = f"the material {before.name} of" if before else "the lack of a material of"
                to = f"takes on {now.name} from above" if now else "has none"
                left.add(path.name, f"{had} {written.GetName()}, which {to}")


def _copy_material(
    flat: Sdf.Layer, stage: Usd.Stage, root: Sdf.Path, look: LookSource, material: UsdShade.Material, left: LeftOut
) -> Sdf.Path:
    layer, scope = stage.GetEditTarget().GetLayer(), root.AppendChild(LOOKS)
    if not stage.GetPrimAtPath(scope):
        UsdGeom.Scope.Define(stage, scope)
    taken = {child.GetName() for child in stage.GetPrimAtPath(scope).GetAllChildren()}
    own = material.GetPrim().GetName()
    name = next(each for each in (own, *(f"{own}_{copy}" for copy in range(2, len(taken) + 3))) if each not in taken)
    to = scope.AppendChild(name)
    Sdf.CopySpec(flat, material.GetPath(), layer, to)
    keep_colour_space(material.GetPrim(), stage.GetPrimAtPath(to))
    above = [material.GetPrim().GetStage().GetPrimAtPath(prefix) for prefix in material.GetPath().GetPrefixes()]
    for prim in (*above[:-1], *Usd.PrimRange(material.GetPrim(), PRIMS)):
        if not look.prim.GetPath().HasPrefix(prim.GetPath()):  # those above the mesh are told of it
            left.add(name, *variants_of(prim))
    for prim in Usd.PrimRange(stage.GetPrimAtPath(to)):
        for attribute in prim.GetAuthoredAttributes():
            outside = [path for path in attribute.GetConnections() if not path.HasPrefix(to)]
            if outside:
                attribute.SetConnections([path for path in attribute.GetConnections() if path.HasPrefix(to)])
                left.add(name, f"{outside[0]}, which stands outside the material")
    return to
