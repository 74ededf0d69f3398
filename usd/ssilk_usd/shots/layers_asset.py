# SPDX-License-Identifier: Apache-2.0
"""The asset of a garment, which lasts: component, payload, and what it says of itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.errors import SsilkError
from ssilk_core.files import replacing, sha256
from ssilk_core.scene.assets import Deformer

from ..opening.garment_api import GarmentRecord
from ..opening.specs import free_when_closed
from ..units import StageUnits
from ..writing.asset_info import AssetInfo, author_asset_info
from ..writing.author import Asset, define_asset, extent_array
from ..writing.export import new_stage, save
from .layers import DEFORMATION, QUALITY, Layout, define_path, variant
from .layers_facts import AssetFacts, asset_facts

if TYPE_CHECKING:
    from ssilk_core.scene.riders import RiderJoints


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
            define_path(stage.GetDefaultPrim()).Set(Gf.Vec3d(0))
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
    with variant(root, DEFORMATION, "rest"):
        UsdSkel.BindingAPI(root).CreateAnimationSourceRel().SetTargets([])
    with variant(root, QUALITY, "skin"):
        soft = [path for path, shapes in zip(asset.rider_paths, asset.rider_shapes) if shapes is not None]
        for path in (asset.garment, *soft):
            binding = UsdSkel.BindingAPI(stage.OverridePrim(path))
            binding.CreateBlendShapesAttr().Block()
            binding.CreateBlendShapeTargetsRel().SetTargets([])
    variant(root, DEFORMATION, "skel")
    variant(root, QUALITY, "full")
