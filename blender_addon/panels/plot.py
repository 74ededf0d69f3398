# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures that panels show, as icons."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import bpy.utils.previews
import numpy as np

from ..arrays.curves import COLORS, picture

SIZE = 192  # pixels
SWATCH = 16
_versions: dict[str, object] = {}
_pictures: bpy.utils.previews.ImagePreviewCollection | None = None


def plot(name: str, version: object, lines: Sequence[np.ndarray]) -> int:
    """Return the icon of a plot, which is drawn again when `version` is another one."""
    return _icon(name, version, lambda: picture(lines, SIZE))


def swatch(index: int) -> int:
    """Return an icon of the colour that a plot gives to a line."""
    color = np.append(COLORS[index % len(COLORS)], 1.0)
    return _icon(f"swatch {index}", None, lambda: np.broadcast_to(color, (SWATCH, SWATCH, 4)))


def forget() -> None:
    """Free all pictures."""
    global _pictures
    if _pictures is not None:
        bpy.utils.previews.remove(_pictures)
    _pictures = None
    _versions.clear()


def _icon(name: str, version: object, draw: Callable[[], np.ndarray]) -> int:
    global _pictures
    _pictures = _pictures or bpy.utils.previews.new()
    if name not in _versions or _versions[name] != version:
        shown = _pictures.get(name) or _pictures.new(name)
        image = draw()
        shown.icon_size = shown.image_size = image.shape[:2]
        for pixels in (shown.icon_pixels_float, shown.image_pixels_float):
            pixels.foreach_set(image.astype(np.float32).reshape(-1))
        _versions[name] = version
    return _pictures[name].icon_id
