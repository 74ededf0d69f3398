# SPDX-License-Identifier: Apache-2.0
"""Arrange pictures side by side and add captions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .render import Image

GAP = 4  # between panels [pixels]
BACKGROUND = 255
TEXT_COLOUR = (38, 42, 48)


def add_captions(image: Image, *, top: str = "", bottom: str = "") -> Image:
    """Return the image with text in its upper left and lower left corner."""
    if not (top or bottom):
        return image
    from PIL import Image as Pictures
    from PIL import ImageDraw, ImageFont

    picture = Pictures.fromarray(image)
    height = image.shape[0]
    font = ImageFont.load_default(size=max(11, height // 24))
    edge = max(6, height // 40)
    draw = ImageDraw.Draw(picture)
    draw.text((edge, edge), top, fill=TEXT_COLOUR, font=font, anchor="la")
    draw.text((edge, height - edge), bottom, fill=TEXT_COLOUR, font=font, anchor="ld")
    return np.asarray(picture)


def contact_sheet(images: Sequence[Image], *, columns: int) -> Image:
    """Return images of one size (h, w, 3) in rows of `columns`, with white gaps; a short row ends in white."""
    height, width, _ = images[0].shape
    rows = -(-len(images) // columns)
    shape = rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3
    sheet = np.full(shape, BACKGROUND, dtype=np.uint8)
    for number, image in enumerate(images):
        row, column = divmod(number, columns)
        y, x = row * (height + GAP), column * (width + GAP)
        sheet[y : y + height, x : x + width] = image
    return sheet


def compare(images: Sequence[Image]) -> Image:
    """Return images of one size side by side."""
    return contact_sheet(images, columns=len(images))
