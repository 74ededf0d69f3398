# SPDX-License-Identifier: Apache-2.0
"""What moves in one shot, as a layer over a garment's asset, and the point cache beside it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.files import replacing, sha256
from ssilk_core.scene.assets import Deformer, Floats, GarmentPose, Motion

from ..names import shape_name
from ..opening.garment_api import GarmentRecord, author_record
from ..opening.specs import free_when_closed
from ..opening.stage import open_stage
from ..units import StageUnits
from ..writing.author import Asset, define_blendshapes, define_body_shapes, define_rider_shapes, extent_array
from ..writing.body_faces import HiddenPolygons, hide_polygons
from ..writing.export import save
from .layers import DEFORMATION, QUALITY, Layout, define_path, variant
from .play import Shot
from .samples import Samples, root_path
from .shot import ShotSummary, TimeSpan, set_metadata, set_visibility, summary, write_samples
from .velocities import cut_frames, with_velocities

if TYPE_CHECKING:
    from ssilk_core.scene.riders import RiderJoints

FRAMES_PER_SAVE = 64  # of points and velocities: 5 MB in memory for a garment of 3,000 vertices


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
    record: GarmentRecord | None = None,
    provenance: Mapping[str, object] | None = None,
    path: Path | None = None,
) -> ShotSummary:
    """Write what moves in one shot as a layer that references its asset.

    Blendshapes of the deformer that the asset lacks are the shot's own, and so are those by which it shapes bodies.

    Args:
        motion, poses, start, samples_per_frame, hidden: as `shot.write_shot` takes them.
        lean: see `samples.Samples`.
        riders: what rides on the garment, as its asset has it.
        hidden_polygons: polygons of the bodies that this shot hides, in a variant.
        points: offer the point cache that `write_points` writes as a variant.
        record: of the garment, where it is of another fabric in this shot than its asset says.
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
        asset = define_body_shapes(stage, asset, motion, units, before=list(map(shape_name, asset.shapes)))
        if record:
            author_record(stage.OverridePrim(asset.garment), record)
        set_metadata(stage, span, units)
        if lean:
            define_path(stage.GetPrimAtPath(asset.root))
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
    with variant(stage.GetPrimAtPath(asset.root), QUALITY, "full"):
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
    with variant(root, DEFORMATION, "points"):
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
