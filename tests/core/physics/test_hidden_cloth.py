# SPDX-License-Identifier: Apache-2.0
"""Inner cloth may be hidden only where outer cloth covers its outside and skin its inside, in every frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.physics.skin.hidden_cloth import HiddenCloth, turned_outward

from .test_hidden_faces import HIGH, LOW, MARGIN, RADIUS, tube

BODY = tube(RADIUS, 0.2, 1.4, 24, rows=41)
INNER, OUTER = tube(RADIUS + 0.01, 0.3, 1.3, 24, rows=35), tube(RADIUS + 0.02, LOW, HIGH, 24, 27)


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    """Which triangles of INNER are hidden."""
    return HiddenCloth(INNER, OUTER, BODY).mask()


def heights(mask: np.ndarray) -> np.ndarray:
    return INNER.points[INNER.faces[mask]][..., 1]


def test_what_lies_between_outer_cloth_and_skin_is_hidden_away_from_the_ends(plain):
    found = heights(plain)
    assert LOW + MARGIN <= found.min() < LOW + MARGIN + 0.06
    assert HIGH - MARGIN - 0.06 < found.max() <= HIGH - MARGIN


@pytest.mark.parametrize("turned", ["all", "a part"])
def test_it_is_the_same_however_the_inner_garment_is_wound(plain, turned):
    faces = INNER.faces.copy()
    if turned == "all":
        faces = faces[:, ::-1]
        inner = replace(INNER, faces=faces)
    else:  # two islands, one of which is inside out
        count = INNER.vertex_count
        away = INNER.points + [5.0, 0, 0]
        inner = replace(
            INNER, points=np.concatenate([INNER.points, away]), faces=np.concatenate([faces[:, ::-1], faces + count])
        )
    assert np.array_equal(HiddenCloth(inner, OUTER, BODY).mask()[: len(faces)], plain)
    assert np.array_equal(np.sort(turned_outward(inner, BODY), axis=1), np.sort(inner.faces, axis=1))


def test_a_skirt_that_stands_off_the_skin_is_seen_from_below():
    wide = tube(RADIUS + 0.15, 0.3, 1.3, rows=35)
    over = tube(RADIUS + 0.16, LOW, HIGH, rows=27)
    assert not HiddenCloth(wide, over, BODY).mask().any()


def test_an_outer_garment_that_moves_hides_what_it_covers_in_every_frame(plain):
    found = HiddenCloth(INNER, OUTER, BODY)
    for shift in (0.1, 0.2):
        found.add(INNER.points, OUTER.points + [0, shift, 0], BODY.points)
    assert found.mask().any() and not (found.mask() & ~plain).any()
    assert heights(found.mask()).min() >= LOW + 0.2 + MARGIN
    found.add(INNER.points, OUTER.points + [0, 2.0, 0], BODY.points)
    assert not found.mask().any()


def test_inner_cloth_that_shows_through_the_outer_is_hidden():
    """It is what hiding is for, as with skin."""
    bulging = INNER.points.copy()
    near = np.linalg.norm(bulging - [0, 0.8, RADIUS + 0.01], axis=1) < 0.06
    bulging[near] *= [1.12, 1, 1.12]  # 15 mm, through the outer garment
    found = HiddenCloth(INNER, OUTER, BODY)
    found.add(bulging, OUTER.points, BODY.points)
    through = near[INNER.faces].all(axis=1)
    assert through.any() and found.mask()[through].any()
