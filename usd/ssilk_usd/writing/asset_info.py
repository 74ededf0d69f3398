# SPDX-License-Identifier: Apache-2.0
"""What a garment says of itself as an asset (`assetInfo`), for resolvers and publishing tools."""

from __future__ import annotations

from dataclasses import dataclass

from pxr import Sdf, Usd


@dataclass(frozen=True, kw_only=True)
class AssetInfo:
    """Entries of `assetInfo`; empty ones are left out.

    Attributes:
        version: of the asset.
        identifier: where it is found, by a path from its own layer or by whatever a resolver takes.
    """

    version: str = ""
    identifier: str = ""


def author_asset_info(prim: Usd.Prim, name: str, info: AssetInfo) -> None:
    """Author the name, version and identifier of an asset on its root prim."""
    model = Usd.ModelAPI(prim)
    model.SetAssetName(name)
    if info.version:
        model.SetAssetVersion(info.version)
    if info.identifier:
        model.SetAssetIdentifier(Sdf.AssetPath(info.identifier))
