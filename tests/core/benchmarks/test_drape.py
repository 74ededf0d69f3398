# SPDX-License-Identifier: Apache-2.0
"""Presets of fabrics hang in the simulator as textiles of their name are published to."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssilk_core.scene.fabrics import FABRICS


@pytest.fixture
def drape(monkeypatch):
    monkeypatch.syspath_prepend("benchmarks")
    import drape

    return drape


def test_a_strip_has_the_bending_length_of_its_rigidity_which_is_that_of_washed_denim(drape):
    """25 to 32 mm: Fashion and Textiles 1, 19 (2014), tables 1 and 2."""
    torch.set_num_threads(1)
    found = drape.bending_length(FABRICS["denim"], 0.01, 200)
    assert found == pytest.approx(drape.of_rigidity(FABRICS["denim"]), rel=0.03)
    assert 0.025 < found < 0.032


def test_level_cloth_casts_all_of_its_shadow_and_cloth_that_hangs_that_of_what_is_held(drape):
    level = drape.disc(0.01)
    assert drape.drape_coefficient(level.points, level.faces, 400) == pytest.approx(1, abs=0.01)
    hanging, radius = level.points.copy(), np.hypot(*level.points[:, [0, 2]].T)
    edge = radius[level.held].max()
    hanging[~level.held] *= edge / radius[~level.held, None]
    share = (edge**2 - drape.INNER**2) / (drape.OUTER**2 - drape.INNER**2)
    assert drape.drape_coefficient(hanging, level.faces, 400) == pytest.approx(share, abs=0.02)
