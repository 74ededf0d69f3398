# SPDX-License-Identifier: Apache-2.0
"""`SsilkGarmentAPI`: a garment's origin, authored on its mesh, as a codeless schema that readers do not need.

`usd/ssilk_usd/schema` holds it; programs that set PXR_PLUGINPATH_NAME to that folder know it too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pxr import Plug, Sdf, Usd, Vt

SCHEMA = "SsilkGarmentAPI"
SCHEMA_FOLDER = Path(__file__).parents[1] / "schema"
_TYPES = Sdf.ValueTypeNames


@dataclass(frozen=True, kw_only=True)
class GarmentRecord:
    """How a garment's model was made.

    Attributes:
        model_hash: SHA-256 of the model file.
        version: of SSILK, when it was trained.
        seed: of the training.
        fabric: the material's name; `parameters` its numbers [SI units].
    """

    model_hash: str
    version: str = ""
    seed: int = 0
    fabric: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)


def register_schema() -> None:
    """Make the schema known to USD; without effect once USD has built its list of schemas."""
    Plug.Registry().RegisterPlugins(str(SCHEMA_FOLDER))


def apply_garment_api(prim: Usd.Prim, record: GarmentRecord | None = None) -> None:
    """Mark a mesh as a garment, whether or not USD knows the schema, and author how its model was made."""
    prim.AddAppliedSchema(SCHEMA)
    if record is not None:
        author_record(prim, record)


def author_record(prim: Usd.Prim, record: GarmentRecord) -> None:
    """Author on a garment's mesh how its model was made, and the fabric that it plays."""
    names = Vt.TokenArray(list(record.parameters))
    values = Vt.DoubleArray([float(value) for value in record.parameters.values()])
    for name, kind, value in (
        ("modelHash", _TYPES.String, record.model_hash),
        ("version", _TYPES.String, record.version),
        ("seed", _TYPES.Int64, record.seed),
        ("fabric", _TYPES.String, record.fabric),
        ("parameterNames", _TYPES.TokenArray, names),
        ("parameterValues", _TYPES.DoubleArray, values),
    ):
        prim.CreateAttribute(f"ssilk:{name}", kind, False, Sdf.VariabilityUniform).Set(value)


def read_garment_record(prim: Usd.Prim) -> GarmentRecord | None:
    """Return how a garment's model was made, or None where the mesh does not say."""

    def get(name: str, otherwise: object) -> object:
        attribute = prim.GetAttribute(f"ssilk:{name}")
        value = attribute.Get() if attribute else None
        return otherwise if value is None else value

    model_hash = str(get("modelHash", ""))
    if not model_hash:
        return None
    return GarmentRecord(
        model_hash=model_hash,
        version=str(get("version", "")),
        seed=int(get("seed", 0)),  # type: ignore[call-overload]
        fabric=str(get("fabric", "")),
        parameters=dict(zip(get("parameterNames", ()), get("parameterValues", ()))),  # type: ignore[call-overload]
    )
