# SPDX-License-Identifier: Apache-2.0
"""Write a layer as a file, completely or not at all."""

from __future__ import annotations

import hashlib
import re
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdUtils

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter, silent
from ssilk_core.files import replacing

from ..names import LAYER_SUFFIXES
from ..opening.specs import free_when_closed
from ..opening.stage import usd_reason
from ..units import StageUnits

UDIM = "<UDIM>"  # stands for the numbers of tiles
PACKED = "shot.usdc"  # the layer in a package
ZIP_HEADER, EXTRA_HEADER, EXTRA_FIELD, ALIGNMENT = 30, 4, 0x1986, 64  # bytes, and the field that USD pads with


def need_layer_suffix(out: str | Path) -> None:
    """Raise `SsilkError` unless a name has the suffix of a USD layer."""
    suffix, allowed = Path(out).suffix, ", ".join(LAYER_SUFFIXES)
    if suffix not in LAYER_SUFFIXES:
        fail(str(out), f"the suffix is '{suffix}'", f"it must be one of {allowed}")


def new_stage(path: Path, units: StageUnits) -> Usd.Stage:
    """Create a stage on a new layer at `path` with these units, without a session layer."""
    stage = Usd.Stage.Open(Sdf.Layer.CreateNew(str(path)), None)
    UsdGeom.SetStageMetersPerUnit(stage, units.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, units.up_axis)
    return stage


def save(layer: Sdf.Layer, name: str | Path) -> None:
    """Write pending changes of a layer to its file; messages call it `name`."""
    try:
        layer.Save()
    except Tf.ErrorException as error:
        fail(str(name), f"writing failed ({usd_reason(error)})", "free some space or choose another output")
    free_when_closed([layer])


def export(layer: Sdf.Layer, out: str | Path) -> None:
    """Write a layer in the format of the file's suffix.

    Raises:
        SsilkError: the suffix is not .usdc, .usd or .usda, or the file cannot be written.
    """
    need_layer_suffix(out)
    with replacing(out) as temporary:
        try:
            layer.Export(str(temporary))
        except Tf.ErrorException as error:
            fail(str(out), f"writing failed ({usd_reason(error)})", "free some space or choose another output")


@contextmanager
def packaged(out: str | Path, report: Reporter = silent, *, name: str | Path = "") -> Iterator[Path]:
    """Yield the path of a layer to write: `out`, or for .usdz a temporary layer that is then packed into `out`.

    Args:
        report: is told which textures are not found, and are not in the package.
        name: what messages call `out`, where that is not its name yet.

    Raises:
        OSError: the package cannot be written.
    """
    out = Path(out)
    if out.suffix != ".usdz":
        yield out
        return
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        layer = Path(folder) / PACKED
        yield layer
        if lost := _pack(layer, out):
            more = f" and {len(lost) - 1} more are" if len(lost) > 1 else " is"
            text = f"the texture '{lost[0]}'{more} not found, and not in the package; viewers elsewhere show none"
            report(Message(f"{name or out}: {text}; correct the path in the stage, and bake again", "warning"))


def _pack(layer: Path, out: Path) -> list[str]:
    """Write a package of a layer and its textures: a zip without compression, data 64 bytes aligned, as USD maps it.

    USD's own function stores times of day, so that no two packages are alike.

    Returns:
        The paths of textures that are not found.
    """
    found, lost = _gathered(layer)
    files = {layer.name: layer, **found}
    with zipfile.ZipFile(out, "w") as package:
        for name, file in files.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            start = package.fp.tell() if package.fp else 0
            padding = -(start + ZIP_HEADER + len(entry.filename.encode()) + EXTRA_HEADER) % ALIGNMENT
            entry.extra = struct.pack("<HH", EXTRA_FIELD, padding) + bytes(padding)
            with file.open("rb") as source, package.open(entry, "w") as target:
                shutil.copyfileobj(source, target)
    return lost


def _gathered(path: Path) -> tuple[dict[str, Path], list[str]]:
    """Rename the textures of a layer to their names in a package; return these with their files, and those not found.

    Textures in other packages are unpacked into the layer's folder, which is temporary.
    """
    layer, found, folders = Sdf.Layer.FindOrOpen(str(path)), dict[str, Path](), dict[str, str]()
    missing: set[str] = set()

    def packaged_name(name: str) -> str:
        file = _unpacked(name, path.parent) if Ar.IsPackageRelativePath(name) else path.parent / name
        tiles = sorted(file.parent.glob(file.name.replace(UDIM, "[0-9]" * 4))) if UDIM in name else [file]
        tiles = [tile for tile in tiles if name and tile.is_file()]
        if not tiles:
            missing.add(name)
            return name
        folder = folders.setdefault(str(file.parent.resolve()), f"textures/{len(folders)}")
        found.update({f"{folder}/{tile.name}": tile for tile in tiles})
        return f"{folder}/{file.name}"

    UsdUtils.ModifyAssetPaths(layer, packaged_name)
    if found:
        save(layer, path)
    return found, sorted(missing.intersection(_files_of_attributes(layer)))


def _files_of_attributes(layer: Sdf.Layer) -> set[str]:
    """Return the files that attributes name, as shaders name textures; metadata may name what nobody opens."""
    names: set[str] = set()

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetAttributeAtPath(path) if path.IsPropertyPath() else None
        if spec and spec.typeName == Sdf.ValueTypeNames.Asset and spec.default:
            names.add(spec.default.path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return names - {""}


def _unpacked(name: str, home: Path) -> Path:
    """Unpack "file.usdz[texture]", with all tiles of UDIMs, beneath a folder; return where the texture lies then."""
    package, inner = Ar.SplitPackageRelativePathOuter(name)
    folder, _, leaf = inner.rpartition("/")
    place = home / "unpacked" / hashlib.sha256(f"{package}/{folder}".encode()).hexdigest()[:12]
    tiles = re.compile(re.escape(inner).replace(re.escape(UDIM), "[0-9]{4}"))
    if zipfile.is_zipfile(home / package):
        with zipfile.ZipFile(home / package) as archive:
            for member in filter(tiles.fullmatch, archive.namelist()):
                place.mkdir(parents=True, exist_ok=True)
                (place / member.rpartition("/")[2]).write_bytes(archive.read(member))
    return place / leaf
