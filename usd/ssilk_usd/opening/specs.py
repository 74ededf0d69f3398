# SPDX-License-Identifier: Apache-2.0
"""Free what USD keeps of layers that were closed, so that a process can open and write any number of them.

USD identifies each spec that is looked at by 32 bytes, which stay with the layer when nobody holds the spec any more,
until 64 of them are deleted together. A layer that closes before forgets them without deleting them, as of USD 26.11
(`~Sdf_IdRegistryImpl` in pxr/usd/sdf/identity.cpp): up to 2 kB of each layer are lost. What is held until its layer
has closed is deleted by its last holder.
"""

from __future__ import annotations

from collections.abc import Iterable

from pxr import Sdf

_held: dict[str, list[Sdf.Spec]] = {}


def free_when_closed(layers: Iterable[Sdf.Layer]) -> None:
    """Keep all specs of layers alive until the layers are closed; release those of closed layers."""
    for name in [name for name, specs in _held.items() if specs[-1].expired]:
        del _held[name]
    for layer in layers:
        if layer.identifier not in _held:
            # Found by name, a layer is owned and not just known: of those known, Python's bindings keep 32 bytes.
            _held[layer.identifier] = _specs(Sdf.Layer.FindOrOpen(layer.identifier) or layer)


def _specs(layer: Sdf.Layer) -> list[Sdf.Spec]:
    """Return the spec at each path of a layer, the root last; relationship targets have no specs."""
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, paths.append)
    return [layer.GetObjectAtPath(path) for path in paths if not path.IsTargetPath()]
