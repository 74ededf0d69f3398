# SPDX-License-Identifier: Apache-2.0
"""A bake as layers: a lasting asset, and for each shot one small layer that a new bake replaces.

    FOLDER/assets/cape/asset.usda        component; payload and variants
    FOLDER/assets/cape/geometry.usdc     the payload: meshes, skeleton, blendshapes
    FOLDER/assets/cape/info.usda         a sublayer of the component: what it says of itself, such as its version
    FOLDER/assets/cape/used.json         what the name is used for; `ssilk_core.delivery.bake.names_used` writes it
    FOLDER/shots/walk/cape/anim.usdc     what moves; opens by itself
    FOLDER/shots/walk/cape/points.usdc   a point cache, where one is asked for
    FOLDER/shots/walk/shot.usda          every garment of the shot

Artists put layers of their own above these: nothing here is edited in place, and what has not changed is not touched.
"""

from __future__ import annotations

import os
from collections.abc import Container, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.errors import SsilkError, fail
from ssilk_core.files import replacing, sha256
from ssilk_core.scene.assets import Deformer, Floats, GarmentPose, Motion

from ..names import shape_name
from ..opening.garment_api import GarmentRecord
from ..opening.specs import free_when_closed
from ..opening.stage import open_stage
from ..reading.mesh import is_body
from ..units import StageUnits
from ..writing.asset_info import AssetInfo, author_asset_info
from ..writing.author import Asset, define_asset, define_blendshapes, define_rider_shapes, extent_array
from ..writing.body_faces import HiddenPolygons, hide_polygons
from ..writing.export import new_stage, save
from .layers_facts import AssetFacts, asset_facts
from .play import Shot
from .samples import PATH_OP, Samples, root_path
from .shot import ShotSummary, TimeSpan, set_metadata, set_visibility, summary, write_samples
from .velocities import cut_frames, with_velocities

if TYPE_CHECKING:
    from ssilk_core.scene.riders import RiderJoints

DEFORMATION, QUALITY, LEVEL = "deformation", "quality", "level"
OWN_LEVEL = "default"  # the level that a garment with others is itself
FRAMES_PER_SAVE = 64  # of points and velocities: 5 MB in memory for a garment of 3,000 vertices


@dataclass(frozen=True)
class Layout:
    """Paths of the files of one garment in one shot; `garment` is also the name of its prim."""

    folder: Path
    garment: str
    shot: str

    @property
    def asset(self) -> Path:
        return self.folder / "assets" / self.garment / "asset.usda"

    @property
    def geometry(self) -> Path:
        return self.asset.with_name("geometry.usdc")

    @property
    def info(self) -> Path:
        return self.asset.with_name("info.usda")

    @property
    def animation(self) -> Path:
        return self.folder / "shots" / self.shot / self.garment / "anim.usdc"

    @property
    def points(self) -> Path:
        return self.animation.with_name("points.usdc")

    @property
    def stage(self) -> Path:
        return self.folder / "shots" / self.shot / "shot.usda"


@dataclass(frozen=True)
class WrittenAsset:
    """An asset on disk.

    Attributes:
        asset: the paths of its prims.
        changes: that may break stronger layers.
        digests: path and SHA-256 of each file that shots depend on: not of what the asset says of itself.
    """

    asset: Asset
    changes: tuple[str, ...]
    digests: tuple[tuple[Path, str], ...]


def write_asset(
    layout: Layout,
    deformer: Deformer,
    units: StageUnits,
    *,
    include_body: bool = True,
    riders: RiderJoints | None = None,
    record: GarmentRecord | None = None,
    info: AssetInfo | None = None,
    lean: bool = True,
) -> WrittenAsset:
    """Write a garment's asset; files that hold the same already are left alone.

    Args:
        include_body: with the body meshes.
        riders: what rides on the garment; the deformer has its joints.
        record: how the garment was made, kept on its mesh.
        info: of the asset, in a layer of its own, so that another version makes no shot stale; its identifier is the
            asset's own layer where none is given.
        lean: with the translation of the SkelRoot by which lean shots move it (see `samples.Samples`), so that they
            are value clips of the asset alone.

    Raises:
        SsilkError: as `author.define_asset` does, or a file cannot be written.
    """
    before, unknown = _facts_before(layout)
    character = deformer.scene.character
    bodies = (*character.bodies, *character.stand_ins) if include_body else ()
    with replacing(layout.geometry, keep_same=True) as temporary:
        stage = new_stage(temporary, units)
        asset = define_asset(
            stage, deformer, bodies, units, riders=riders, name=layout.garment, record=record, output=layout.geometry
        )
        save(stage.GetRootLayer(), layout.geometry)
        box = _extent(stage, asset)
        del stage
        geometry = sha256(temporary)
    _write_info(layout, asset, info or AssetInfo())
    with replacing(layout.asset, keep_same=True) as temporary:
        stage = new_stage(temporary, units)
        stage.GetRootLayer().subLayerPaths.append(f"./{layout.info.name}")
        _define_component(stage, asset, layout, box)
        if lean:
            _define_path(stage.GetDefaultPrim()).Set(Gf.Vec3d(0))
        free_when_closed(stage.GetUsedLayers())
        save(stage.GetRootLayer(), layout.asset)
        del stage
        component = sha256(temporary)
    changes = unknown if before is None else asset_facts(layout.asset).changes_since(before)
    return WrittenAsset(asset, changes, ((layout.geometry, geometry), (layout.asset, component)))


def _write_info(layout: Layout, asset: Asset, info: AssetInfo) -> None:
    """Write what an asset says of itself."""
    with replacing(layout.info, keep_same=True) as temporary:
        stage = Usd.Stage.Open(Sdf.Layer.CreateNew(str(temporary)), None)
        identifier = info.identifier or f"./{layout.asset.name}"
        author_asset_info(stage.OverridePrim(asset.root), layout.garment, replace(info, identifier=identifier))
        save(stage.GetRootLayer(), layout.info)
        del stage


def _facts_before(layout: Layout) -> tuple[AssetFacts | None, tuple[str, ...]]:
    """Return the facts of an existing asset; None if there is none, or if it is damaged, with a message."""
    if not (layout.asset.is_file() and layout.geometry.is_file()):
        return None, ()
    try:
        return asset_facts(layout.asset), ()
    except SsilkError as error:
        return None, (f"the file that was there could not be read and is replaced ({str(error).rstrip('.')})",)


def _extent(stage: Usd.Stage, asset: Asset) -> Vt.Vec3fArray:
    """Return the bounds of each mesh at its bind pose."""
    meshes = [prim for prim in stage.GetPrimAtPath(asset.root).GetChildren() if prim.IsA(UsdGeom.Mesh)]
    corners = np.stack([np.array(UsdGeom.Mesh(prim).GetExtentAttr().Get()) for prim in meshes])
    return extent_array(corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))


def _define_component(stage: Usd.Stage, asset: Asset, layout: Layout, box: Vt.Vec3fArray) -> None:
    """Define the SkelRoot over its payload, with bounds that need no payload, and the variants."""
    root = UsdSkel.Root.Define(stage, asset.root).GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    UsdGeom.Boundable(root).CreateExtentAttr(box)
    root.GetPayloads().AddPayload(f"./{layout.geometry.name}", asset.root)
    with _variant(root, DEFORMATION, "rest"):
        UsdSkel.BindingAPI(root).CreateAnimationSourceRel().SetTargets([])
    with _variant(root, QUALITY, "skin"):
        soft = [path for path, shapes in zip(asset.rider_paths, asset.rider_shapes) if shapes is not None]
        for path in (asset.garment, *soft):
            binding = UsdSkel.BindingAPI(stage.OverridePrim(path))
            binding.CreateBlendShapesAttr().Block()
            binding.CreateBlendShapeTargetsRel().SetTargets([])
    _variant(root, DEFORMATION, "skel")
    _variant(root, QUALITY, "full")


def _variant(prim: Usd.Prim, name: str, choice: str) -> Usd.EditContext:
    """Add a variant and select it; return the context that authors in it."""
    variants = prim.GetVariantSets().AddVariantSet(name)
    variants.AddVariant(choice)
    variants.SetVariantSelection(choice)
    return Usd.EditContext(prim.GetStage(), variants.GetVariantEditTarget())


def write_animation(
    layout: Layout,
    asset: Asset,
    deformer: Deformer,
    motion: Motion,
    poses: Iterable[GarmentPose],
    *,
    units: StageUnits,
    start: float = 0.0,
    samples_per_frame: int = 1,
    lean: bool = True,
    riders: RiderJoints | None = None,
    hidden: Sequence[tuple[int, bool]] = (),
    hidden_polygons: HiddenPolygons | None = None,
    points: bool = False,
    provenance: Mapping[str, object] | None = None,
    path: Path | None = None,
) -> ShotSummary:
    """Write what moves in one shot as a layer that references its asset.

    Blendshapes of the deformer that the asset lacks are the shot's own, and are written with it.

    Args:
        motion, poses, start, samples_per_frame, hidden: as `shot.write_shot` takes them.
        lean: see `samples.Samples`.
        riders: what rides on the garment, as its asset has it.
        hidden_polygons: polygons of the bodies that this shot hides, in a variant.
        points: offer the point cache that `write_points` writes as a variant.
        path: the file to write, where it is not yet that of `layout`, which must be in the same folder.

    Raises:
        SsilkError: as `shot.write_shot` does.
    """
    span = TimeSpan.of(motion, start, samples_per_frame)
    with replacing(path or layout.animation) as temporary:
        layer = Sdf.Layer.CreateNew(str(temporary))
        stage = Usd.Stage.Open(layer, None)
        _define_animation(stage, asset, layout, deformer)
        asset = replace(asset, rider_shapes=riders.shapes if riders else asset.rider_shapes)
        asset = _define_own_shapes(stage, asset, deformer, units)
        set_metadata(stage, span, units)
        if lean:
            _define_path(stage.GetPrimAtPath(asset.root))
        set_visibility(stage, asset.root, span, hidden)
        if hidden_polygons and asset.bodies:
            meshes = [body.mesh for body in asset.bodies]
            hide_polygons(stage, asset.root, asset.body_paths, meshes, replace(hidden_polygons, variants=True))
        if points:
            _define_points(stage, asset, layout)
        free_when_closed(stage.GetUsedLayers())
        del stage  # nobody has to hear of each sample
        samples = Samples(layer, asset, deformer, motion, units, start=start, step=span.step, lean=lean)
        write_samples(samples, poses, layout.animation, provenance)
        del samples, layer  # the file is closed before it is renamed
    return summary(layout.animation, deformer, motion, span, len(asset.shapes))


def _define_path(root: Usd.Prim) -> Usd.Attribute:
    """Make the path of the character's root the translation of a SkelRoot."""
    UsdGeom.Xformable(root).CreateXformOpOrderAttr([PATH_OP])
    return root.CreateAttribute(PATH_OP, Sdf.ValueTypeNames.Double3, False)


def _define_animation(stage: Usd.Stage, asset: Asset, layout: Layout, deformer: Deformer) -> None:
    """Reference the asset, and override its SkelAnimation with the joints that the deformer has now."""
    joints = deformer.scene.joint_names
    root = stage.DefinePrim(asset.root)
    stage.SetDefaultPrim(root)
    root.GetReferences().AddReference(os.path.relpath(layout.asset, layout.animation.parent))
    animation = UsdSkel.Animation(stage.OverridePrim(asset.animation))
    animation.CreateJointsAttr(Vt.TokenArray(joints))
    animation.CreateRotationsAttr()
    animation.CreateTranslationsAttr()
    animation.CreateScalesAttr(Vt.Vec3hArray(len(joints), Gf.Vec3h(1)))
    if len(asset.shapes):
        animation.CreateBlendShapeWeightsAttr()
    UsdGeom.Boundable(root).CreateExtentAttr()


def _define_own_shapes(stage: Usd.Stage, asset: Asset, deformer: Deformer, units: StageUnits) -> Asset:
    """Define the blendshapes that the asset lacks, in the variant that has any; return the asset with them."""
    own = np.setdiff1d(np.flatnonzero(deformer.shapes.any(axis=(1, 2))), asset.shapes)
    if not own.size:
        return asset
    before, names = (list(map(shape_name, indices)) for indices in (asset.shapes, own))
    with _variant(stage.GetPrimAtPath(asset.root), QUALITY, "full"):
        mesh = UsdGeom.Mesh(stage.OverridePrim(asset.garment))
        define_blendshapes(mesh, names, deformer.shapes[own], units, before=before)
        for path, offsets in zip(asset.rider_paths, asset.rider_shapes):
            rider = UsdGeom.Mesh(stage.OverridePrim(path))
            define_rider_shapes(rider, offsets, own, units, before=asset.shapes)
    animation = UsdSkel.Animation(stage.GetPrimAtPath(asset.animation))
    animation.CreateBlendShapesAttr(Vt.TokenArray([*before, *names]))
    animation.CreateBlendShapeWeightsAttr()
    return replace(asset, shapes=np.concatenate([asset.shapes, own]))


def _define_points(stage: Usd.Stage, asset: Asset, layout: Layout) -> None:
    """Add a variant of the shot in which the garment is bound to nothing and has its points from a file."""
    root = stage.GetPrimAtPath(asset.root)
    with _variant(root, DEFORMATION, "points"):
        root.GetPayloads().AddPayload(f"./{layout.points.name}", asset.root)
        mesh = stage.OverridePrim(asset.garment)
        # The schema stays applied, since its properties come with the asset; without a skeleton nothing is skinned.
        UsdSkel.BindingAPI(mesh).CreateSkeletonRel().SetTargets([])
    root.GetVariantSet(DEFORMATION).SetVariantSelection("skel")


def write_points(
    layout: Layout,
    asset: Asset,
    vertices: Iterable[Floats],
    deformer: Deformer,
    motion: Motion,
    *,
    units: StageUnits,
    start: float = 0.0,
    samples_per_frame: int = 1,
    lean: bool = True,
) -> str:
    """Write the garment's points at each sample of a shot, [m] in world space, shape (V, 3), as a point cache.

    Velocities are those of the points beneath the SkelRoot, whose own path is a transform beside them.

    Returns:
        SHA-256 of the file.
    """
    span = TimeSpan.of(motion, start, samples_per_frame)
    paths = root_path(deformer, motion) if lean else np.zeros((motion.frame_count, 3))
    with replacing(layout.points) as temporary:
        layer = Sdf.Layer.CreateNew(str(temporary))
        stage = Usd.Stage.Open(layer, None)
        mesh = UsdGeom.Mesh(stage.OverridePrim(asset.garment))
        made = mesh.CreatePointsAttr(), mesh.CreateVelocitiesAttr(), mesh.CreateExtentAttr()
        attributes = [attribute.GetPath() for attribute in made]
        set_metadata(stage, span, units)
        del stage, made
        local = (units.points_from_core(points - path) for points, path in zip(vertices, paths, strict=True))
        cuts = cut_frames(motion, deformer.scene.character.skeleton)
        for frame, rows in enumerate(with_velocities(local, motion.fps, cuts)):
            placed, moving = (np.ascontiguousarray(each, dtype=np.float32) for each in rows)
            values = (
                Vt.Vec3fArray.FromNumpy(placed),
                Vt.Vec3fArray.FromNumpy(moving),
                extent_array(placed.min(axis=0), placed.max(axis=0)),
            )
            for attribute, value in zip(attributes, values):
                layer.SetTimeSample(attribute, start + span.step * frame, value)
            if frame % FRAMES_PER_SAVE == FRAMES_PER_SAVE - 1:
                save(layer, layout.points)
        save(layer, layout.points)
        del layer  # the file is closed before it is renamed
        return sha256(temporary)


def with_points(path: str | Path) -> Shot:
    """Open a shot, with its point cache in place of joints where it offers both; the file stays as it is.

    Raises:
        SsilkError: not a readable shot.
    """
    stage = open_stage(path)
    variants = stage.GetDefaultPrim().GetVariantSet(DEFORMATION)
    if "points" in variants.GetVariantNames():
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            variants.SetVariantSelection("points")
    return Shot(stage)


@dataclass(frozen=True)
class WrittenStage:
    """The stage of a shot.

    Attributes:
        unreadable: garments that are left out because they cannot be read, and why.
        bodies: garments whose body is not shown, with the garment whose body is.
        bodiless: levels without a body of a garment that shows it with its other levels, with that garment.
    """

    unreadable: Mapping[str, str]
    bodies: Mapping[str, str]
    bodiless: Mapping[str, str]


def write_stage(
    garments: Mapping[Layout, Hashable],
    needed: Container[str] = frozenset(),
    levels: Mapping[str, str] | None = None,
) -> WrittenStage:
    """Write the stage of a shot, which references each garment and spans all frames; keep an identical file.

    A garment with levels of quality is one prim, of which each is a variant of `LEVEL`.

    Args:
        garments: the garments of one shot, and who wears each: the body of a character is shown with the first of
            its garments that has one in all its levels, else in some. If none can be read, no stage is written.
        needed: names of garments that have to be in it; others are left out where they cannot be read.
        levels: names of garments that are levels of another one, by their own.

    Raises:
        SsilkError: a needed garment cannot be read, the garments have different units or axes, or the file cannot be
            written.
    """
    stages, unreadable = _opened(garments, needed)
    others: dict[str, str] = {}
    if not stages:
        return WrittenStage(unreadable, others, {})
    grouped: dict[str, list[Layout]] = {}
    for garment in stages:
        grouped.setdefault((levels or {}).get(garment.garment, garment.garment), []).append(garment)
    bodies = {garment: _body_names(stage) for garment, stage in stages.items()}
    shown = _shown_with(grouped, garments, bodies)
    layout, units = next(iter(stages)), _common_units(stages)
    first = stages[layout].GetRootLayer()
    spans = [_span(stage.GetRootLayer(), first.timeCodesPerSecond) for stage in stages.values()]
    with replacing(layout.stage, keep_same=True) as temporary:
        stage = new_stage(temporary, units)
        shot = UsdGeom.Xform.Define(stage, "/Shot").GetPrim()
        stage.SetDefaultPrim(shot)
        Usd.ModelAPI(shot).SetKind(Kind.Tokens.assembly)
        for name in ("timeCodesPerSecond", "framesPerSecond"):
            stage.SetMetadata(name, first.pseudoRoot.GetInfo(name))
        stage.SetStartTimeCode(min(start for start, _ in spans))
        stage.SetEndTimeCode(max(end for _, end in spans))
        for name, group in grouped.items():
            prim = stage.DefinePrim(shot.GetPath().AppendChild(name))
            _reference_levels(prim, name, group)
            for garment in group:
                if bodies[garment] and shown[garments[garment]] != name:
                    others[garment.garment] = shown[garments[garment]]
                    for body in bodies[garment]:
                        stage.OverridePrim(prim.GetPath().AppendChild(body)).SetActive(False)
        free_when_closed(stage.GetUsedLayers())
        save(stage.GetRootLayer(), layout.stage)
        del stage, shot, prim
    showing = {name: grouped[name] for name in shown.values()}
    bodiless = {each.garment: name for name, group in showing.items() for each in group if not bodies[each]}
    return WrittenStage(unreadable, others, bodiless)


def _shown_with(
    grouped: Mapping[str, Sequence[Layout]],
    wearers: Mapping[Layout, Hashable],
    bodies: Mapping[Layout, Sequence[str]],
) -> dict[Hashable, str]:
    """Return with which garment the body of each wearer is shown.

    A variant cannot show what is beneath another prim, so a garment that has the body in all its levels comes first:
    its body is there whichever levels are selected.
    """
    shown: dict[Hashable, str] = {}
    for all_levels in (True, False):
        for name, group in grouped.items():
            for one in filter(bodies.get, group):
                if not all_levels or all(bodies[each] and wearers[each] == wearers[one] for each in group):
                    shown.setdefault(wearers[one], name)
    return shown


def _reference_levels(prim: Usd.Prim, name: str, group: Sequence[Layout]) -> None:
    """Reference a garment, or each of its levels in a variant; the garment that gave the name is selected."""
    if [garment.garment for garment in group] == [name]:
        prim.GetReferences().AddReference(_from_stage(group[0]))
        return
    for garment in sorted(group, key=lambda each: each.garment == name):  # what is added last is selected
        with _variant(prim, LEVEL, level_name(garment.garment, name)):
            prim.GetReferences().AddReference(_from_stage(garment))


def level_name(garment: str, base: str) -> str:
    """Return the variant that a garment is as a level of another one: `cape_game` is the level `game` of `cape`."""
    own = garment.removeprefix(f"{base}_")
    return OWN_LEVEL if garment == base else garment if own in ("", OWN_LEVEL) else own


def _from_stage(layout: Layout) -> str:
    return os.path.relpath(layout.animation, layout.stage.parent)


def _opened(garments: Iterable[Layout], needed: Container[str]) -> tuple[dict[Layout, Usd.Stage], dict[str, str]]:
    """Return the stages of garments that can be read, and why others cannot."""
    stages, unreadable = {}, {}
    for garment in garments:
        try:
            stages[garment] = open_stage(garment.animation)
        except SsilkError as error:
            if garment.garment in needed:
                raise
            unreadable[garment.garment] = str(error)
    return stages, unreadable


def _common_units(stages: Mapping[Layout, Usd.Stage]) -> StageUnits:
    """Return the units of the garments of a shot, which references do not convert."""
    found = {garment: StageUnits.of(stage) for garment, stage in stages.items()}
    one = next(iter(found))
    for other, units in found.items():
        if units != found[one]:
            fail(
                str(one.stage),
                f"'{one.garment}' is in units of {found[one].meters_per_unit:g} m with {found[one].up_axis} up, "
                f"'{other.garment}' in units of {units.meters_per_unit:g} m with {units.up_axis} up",
                "the garments of a shot share units and axis",
                "bake them for one target, or into separate folders",
            )
    return found[one]


def _span(layer: Sdf.Layer, rate: float) -> tuple[float, float]:
    """Return the first and last time code of a layer, as a stage of another rate plays them."""
    scale = rate / layer.timeCodesPerSecond
    return layer.startTimeCode * scale, layer.endTimeCode * scale


def _body_names(stage: Usd.Stage) -> list[str]:
    """Return the names of the body meshes that come with a garment."""
    prims = stage.GetDefaultPrim().GetChildren()
    return [prim.GetName() for prim in prims if prim.IsA(UsdGeom.Mesh) and is_body(prim)]
