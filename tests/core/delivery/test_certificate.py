# SPDX-License-Identifier: Apache-2.0
"""Displacements as blendshapes of one run of frames, and what a certificate says in words."""

from __future__ import annotations

import numpy as np
import pytest

from ssilk_core.delivery.bake.certificate.blendshapes import LARGEST, parts_of, shapes_of
from ssilk_core.delivery.bake.certificate.verified import frames_said
from ssilk_core.delivery.bake.result import CertificateSummary, FrameSpan

VERTICES, MOVED = 400, slice(40, 140)


def displacements(frames: int, kinds: int) -> np.ndarray:
    """Sums of a few fields with random courses, on some of the vertices [m]."""
    rng = np.random.default_rng(0)
    fields = rng.normal(scale=2e-3, size=(kinds, 100, 3))
    found = np.zeros((frames, VERTICES, 3))
    found[:, MOVED] = np.einsum("fk,kvc->fvc", rng.uniform(0.2, 1, size=(frames, kinds)), fields)
    return found


@pytest.mark.parametrize("kinds", [1, 3])
def test_frames_share_shapes_where_their_displacements_are_alike(kinds):
    offsets = displacements(30, kinds)
    shapes, weights = shapes_of(offsets, exact=False)
    assert len(shapes) <= kinds + 1  # and where their ranges begin
    assert weights.min() >= 0 and weights.max() <= 1
    left = np.linalg.norm(np.einsum("fk,kvc->fvc", weights, shapes) - offsets, axis=2)
    assert left.max() <= 1.01 * LARGEST
    still = np.ones(VERTICES, dtype=bool)
    still[MOVED] = False
    assert not shapes[:, still].any()


def test_each_frame_has_its_shape_where_that_is_asked_or_less():
    offsets = displacements(6, 6)
    for exact in (True, False):
        shapes, weights = shapes_of(offsets, exact=exact)
        assert (shapes == offsets.astype(np.float32)).all() and (weights == np.eye(6)).all()


def test_frames_with_a_shape_each_are_parts_of_their_own():
    assert list(parts_of([(3, 9), (12, 12)], {5, 6, 12})) == [(3, 4), (5, 6), (7, 9), (12, 12)]


def test_one_line_says_what_holds_and_where_it_does_not():
    common = {"frames": 2400, "faulty": 31, "moved": (FrameSpan(1, 40),), "mean_mm": 0.5, "largest_mm": 7.0}
    free = CertificateSummary(intersecting=0, showing=0, left=(), codes=(), reasons=(), **common)
    assert str(free) == "0 of 2,400 frames intersect, 0 show covered skin"
    caught = CertificateSummary(
        intersecting=3, showing=0, left=(FrameSpan(42, 44),), codes=((1043.0, 1045.0),),
        reasons=("up to 4 pairs of triangles, such as with triangle 7 beside LeftThumb",), **common,
    )  # fmt: skip
    assert str(caught) == (
        "3 of 2,400 frames intersect, 0 show covered skin; 3 frames have no free position: 1043 to 1045, "
        "up to 4 pairs of triangles, such as with triangle 7 beside LeftThumb"
    )
    assert frames_said(caught.to_metadata()["frames left"]) == {42, 43, 44}
