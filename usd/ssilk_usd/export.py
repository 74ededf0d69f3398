# SPDX-License-Identifier: Apache-2.0
"""Writing a layer as a file, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf, UsdUtils

from ssilk_core.errors import fail, need
from ssilk_core.files import replacing

from .read_stage import LAYER_SUFFIXES, usd_reason


def need_layer_suffix(out: str | Path) -> None:
    """Raise `SsilkError` unless a name ends as a USD layer's does."""
    suffix, allowed = Path(out).suffix, ", ".join(LAYER_SUFFIXES)
    need(suffix in LAYER_SUFFIXES, str(out), f"the suffix is '{suffix}'", f"it is one of {allowed}")


def export(layer: Sdf.Layer, out: str | Path) -> None:
    """Write a layer in the format of the file's suffix.

    Raises:
        SsilkError: another suffix than .usdc, .usd or .usda, or the file cannot be written.
    """
    need_layer_suffix(out)
    with replacing(out) as temporary:
        try:
            layer.Export(str(temporary))
        except Tf.ErrorException as error:
            fail(str(out), f"writing failed ({usd_reason(error)})", "free some space or choose another output")


@contextmanager
def packaged(out: str | Path) -> Iterator[Path]:
    """Yield a layer to write: `out` itself, or one beside it that is then packed into it where it ends in .usdz.

    Raises:
        SsilkError: the package cannot be written.
    """
    out = Path(out)
    if out.suffix != ".usdz":
        yield out
        return
    with replacing(out.with_suffix(".usdc")) as layer:
        yield layer
        packed = UsdUtils.CreateNewUsdzPackage(str(layer), str(out), "shot.usdc")
        need(packed, str(out), "the package cannot be written", "free some space or choose another output")
