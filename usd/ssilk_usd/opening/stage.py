# SPDX-License-Identifier: Apache-2.0
"""Functions shared by all readers: open stages, find prims by name, and read values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import wraps
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
from pxr import Ar, Pcp, Tf, Usd, UsdGeom, UsdUtils

from ssilk_core.errors import fail
from ssilk_core.files import split_body
from ssilk_core.scene.assets import Floats
from ssilk_core.scene.shape_weights import need_weights

from ..names import LAYER_SUFFIXES
from . import memory, trial
from .garment_api import register_schema
from .memory import allowed_gib, bounded_memory
from .shaped import shape_body, shaped_as
from .specs import free_when_closed
from .times import EARLIEST, earliest
from .trial import allowed_seconds, tried

Reader = TypeVar("Reader", bound=Callable[..., Any])
StageLike: TypeAlias = str | Path | Usd.Stage
LONGEST_QUOTE = 200  # characters of a damaged file that are told
USD_SUFFIXES = (*LAYER_SUFFIXES, ".usdz")
# Readers traverse instance proxies, because a referenced character may be instanceable.
PRIMS = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
register_schema()  # before the first stage is opened, because USD reads its schema list only once
_MISSING = (Pcp.ErrorInvalidAssetPath, Pcp.ErrorInvalidSublayerPath, Pcp.ErrorUnresolvedPrimPath)


def explains_damage(read: Reader) -> Reader:
    """Decorate a function, whose first argument is its source, so that a damaged file raises one `SsilkError`."""

    @wraps(read)
    def reader(source: StageLike, *args: Any, **options: Any) -> Any:
        try:
            with bounded_memory():
                return read(source, *args, **options)
        except MemoryError:
            fail(_named(source), "it declares arrays that do not fit into memory", _allowed())
        except (Tf.ErrorException, UnicodeDecodeError) as error:
            usd = isinstance(error, Tf.ErrorException)
            reason = usd_reason(error) if usd else "it holds text that is not UTF-8"
            fail(_named(source), f"it cannot be read as USD ({reason})", _allowed())

    return cast(Reader, reader)


def needs_whole_files(read: Reader) -> Reader:
    """Decorate a reader as `explains_damage` does; what would crash or hang raises one `SsilkError` as well.

    It is called twice: first where a crash or a hang harms nobody (`trial`).
    """
    explained = explains_damage(read)

    @wraps(read)
    def reader(source: StageLike, *args: Any, **options: Any) -> Any:
        silent = {name: value for name, value in options.items() if name != "report"}
        in_memory = isinstance(source, Usd.Stage) and not source.GetRootLayer().realPath
        with nullcontext("") if in_memory else tried(reader, _named(source), *args, **silent) as ending:
            if ending:
                fail(_named(source), ending, _allowed())
            return explained(source, *args, **options)

    return cast(Reader, reader)


def _named(source: StageLike) -> str:
    return stage_name(source) if isinstance(source, Usd.Stage) else str(source)


def _allowed() -> str:
    return (
        "a complete .usd, .usda, .usdc or .usdz file is needed, which can be read with arrays of at most "
        f"{allowed_gib():g} GiB ({memory.VARIABLE}) and in {allowed_seconds():g} s ({trial.VARIABLE})"
    )


def usd_reason(error: Tf.ErrorException) -> str:
    """Return the first message of a USD error on one line; of a line of a file that it quotes, the beginning."""
    if not error.args:
        return "unknown reason"
    says, quote, quoted = " ".join(error.args[0].commentary.split()).partition("'")
    return f"{says}{quote}{quoted[:LONGEST_QUOTE]}..." if len(quoted) > LONGEST_QUOTE else says + quote + quoted


@needs_whole_files
def open_stage(source: StageLike) -> Usd.Stage:
    """Open a stage with all payloads from the current content of its file; return an open stage unchanged.

    "FILE:SHAPE=WEIGHT,..." opens the stage as the body that has these weights of its blendshapes (`shaped`).

    Raises:
        SsilkError: the file is missing, damaged or not USD, a layer that it needs cannot be found, or it has not the
            shapes.
    """
    if isinstance(source, Usd.Stage):
        return source
    file, shapes = split_body(str(source))
    if Path(file).is_dir():
        fail(str(source), "this is a folder", "a USD file is needed", "name one of its files")
    if not Path(file).is_file():
        need_weights(str(source))
        fail(str(source), "there is no such file", "a USD file is needed", "check the path")
    if Path(file).suffix == ".safetensors":
        fail(str(source), "this is a trained model", "a USD file is needed", "model and stage may have been swapped")
    quiet = UsdUtils.CoalescingDiagnosticDelegate()  # the errors below replace what USD would print
    stage = Usd.Stage.Open(file, Usd.Stage.LoadAll)
    stage.Reload()
    del quiet
    missing = [
        " ".join(str(error).split()).rstrip(".")
        for error in _composition_errors(stage)
        if isinstance(error, _MISSING)
    ]
    free_when_closed(stage.GetUsedLayers())
    if missing:
        fail(str(source), " and ".join(missing[:2]), "every layer must be found", "restore it or its path")
    if shapes:
        shape_body(stage, shapes, str(source))
    return stage


def _composition_errors(stage: Usd.Stage) -> list[Any]:
    """Return the composition errors of a stage; USD 24.5 (Blender 4.2) lists them by prim and layer stack."""
    if hasattr(stage, "GetCompositionErrors"):
        return list(stage.GetCompositionErrors())
    root = stage.GetPseudoRoot()
    found = list(root.GetPrimIndex().rootNode.layerStack.localErrors)
    for prim in Usd.PrimRange(root, Usd.PrimAllPrimsPredicate):
        found += prim.GetPrimIndex().localErrors
    return found


def used_files(source: StageLike) -> list[str]:
    """Return the files of a stage's root layer and of everything that it uses, the root first.

    Raises:
        SsilkError: as `open_stage`.
    """
    stage = open_stage(source)
    root = stage.GetRootLayer().realPath
    paths = [root, *(layer.realPath for layer in stage.GetUsedLayers() if layer.realPath), *_clips(stage)]
    whole, *used = (Ar.SplitPackageRelativePathOuter(path)[0] for path in paths)  # of a package, its file
    return [whole, *sorted(set(used) - {whole})]


def _clips(stage: Usd.Stage) -> Iterator[str]:
    """Yield the files of value clips, which USD opens only when a time in them is read."""
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS):
        clips = Usd.ClipsAPI(prim)
        for name in clips.GetClips() or {}:
            yield from (path.resolvedPath for path in clips.ComputeClipAssetPaths(name) if path.resolvedPath)


def location(prim: Usd.Prim) -> str:
    """Return "file:/Prim/Path", for messages and for `ssilk_core.files.split_location`."""
    return f"{stage_name(prim.GetStage())}:{prim.GetPath()}"


def stage_name(stage: Usd.Stage) -> str:
    """Return the path of a stage's root layer as the user gave it, with the shapes that it was opened with."""
    shapes = shaped_as(stage)
    return str(stage.GetRootLayer().identifier) + (f":{shapes}" if shapes else "")


def named(prims: list[Usd.Prim], name: str) -> list[Usd.Prim]:
    """Return the prims with the path `name`, or else with that name, or else those that such a prim holds.

    Many programs write an object as an Xform with its name, and the mesh beneath it with another one.
    """
    for some in (prims, [prim.GetParent() for prim in prims]):
        for found in (str(prim.GetPath()) == name for prim in some), (prim.GetName() == name for prim in some):
            if chosen := [prim for prim, match in zip(prims, found) if match]:
                return chosen
    return []


def listed(prims: list[Usd.Prim]) -> str:
    """Format prim paths for a message."""
    return ", ".join(str(prim.GetPath()) for prim in prims) or "none"


def inherited(prim: Usd.Prim, name: str) -> Usd.Property | None:
    """Return the nearest authored property `name` of a prim or its ancestors, as UsdSkel bindings inherit.

    A value that is blocked is none, and hides none above it.
    """
    while prim and not prim.IsPseudoRoot():
        found = prim.GetProperty(name) if prim.HasProperty(name) else None
        if found and (found.HasAuthoredValue() if isinstance(found, Usd.Attribute) else found.IsAuthored()):
            return found
        prim = prim.GetParent()
    return None


def inherited_target(prim: Usd.Prim, name: str) -> Usd.Prim | None:
    """Return the prim that the nearest authored relationship `name` points at, or None."""
    relationship = inherited(prim, name)
    targets = relationship.GetForwardedTargets() if isinstance(relationship, Usd.Relationship) else []
    target = prim.GetStage().GetPrimAtPath(targets[0]) if targets else None
    return target or None


def value(prim: Usd.Prim, name: str) -> Any:
    """Return an attribute's value at its earliest time, or None."""
    attribute = prim.GetAttribute(name)
    return attribute.Get(EARLIEST) if attribute else None


def has_value(prim: Usd.Prim, name: str) -> bool:
    """Return whether an attribute has an authored value; schemas also declare attributes that are not authored."""
    return bool(prim.GetAttribute(name).HasAuthoredValue())


def column_matrix(matrix: object) -> Floats:
    """Return USD matrices (row vectors) as float64 column-vector matrices, shape (..., 4, 4)."""
    return np.swapaxes(np.array(matrix, dtype=np.float64), -1, -2)


def world_matrix(prim: Usd.Prim, time: Usd.TimeCode | None = None) -> Floats:
    """Return a prim's local-to-world matrix in stage units at a time, else the earliest, column vectors, (4, 4)."""
    return column_matrix(UsdGeom.XformCache(earliest(prim) if time is None else time).GetLocalToWorldTransform(prim))


def apply(matrix: Floats, points: Floats) -> Floats:
    """Return points (..., 3) transformed by an affine column-vector matrix (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
