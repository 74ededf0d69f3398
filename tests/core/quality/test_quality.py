# SPDX-License-Identifier: Apache-2.0
"""Levels and budgets: the best that fits is chosen, and what is measured is there."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import model_file
from ssilk_core.network.runtime import Player
from ssilk_core.quality import cost
from ssilk_core.quality.levels import (
    QUALITIES,
    Budget,
    best_within,
    candidate_sizes,
    format_amount,
    parse_budget,
    quality_named,
)
from ssilk_core.quality.reduction import ModelSize, Reducer
from ssilk_core.scene.fabrics import FABRICS


@pytest.fixture(scope="module")
def reducer(scene, toy_model, toy_motion):
    file = model_file(toy_model(scene, scale=0.1, shapes=8).eval(), FABRICS["silk"], {})
    return Reducer(file, [toy_motion(scene, 80)])


def packed_bytes(file) -> int:
    return cost.model_bytes(file, pack=True)


@pytest.mark.parametrize(
    ("text", "amount", "unit"),
    [("0.3ms", 0.3, "ms"), ("2MB", 2e6, "bytes"), (" 1.5 kB ", 1500, "bytes"), ("1e-1GB", 1e8, "bytes")],
)
def test_budgets_are_read(text, amount, unit):
    found = parse_budget(text)
    assert (found.amount, found.unit) == (pytest.approx(amount), unit)


@pytest.mark.parametrize("text", ["", "3", "ms", "0ms", "-2MB", "2TB", "nanms", "1e999MB", "1.2.3ms", "3 apples"])
def test_what_is_no_budget_is_refused(text):
    with pytest.raises(SsilkError, match="not a budget; a time for each frame"):
        parse_budget(text)


def test_amounts_read_well():
    assert [
        format_amount(*pair) for pair in ((0.31234, "ms"), (1.96e6, "bytes"), (0.5e3, "bytes"), (7e9, "bytes"))
    ] == [*("0.312 ms", "1.96 MB", "0.5 kB", "7 GB")]


def test_levels_keep_more_and_more():
    levels = list(QUALITIES.values())
    for less, more in pairwise(levels):
        assert less.size.within(more.size) == less.size and less.refine <= more.refine
        assert less.rate(60) <= more.rate(60)
    whole = ModelSize(shapes=64, joints=20, influences=8)
    assert levels[-1].size.within(whole) == whole
    assert quality_named("crowd").rate(60) == 15 and quality_named("crowd").rate(12) == 12
    assert quality_named("film").rate(60) == 60
    with pytest.raises(SsilkError, match="'best': no such level; it is one of crowd, game, film, latent, hero"):
        quality_named("best")


@pytest.mark.parametrize("share", [1.0, 0.9, 0.6, 0.2, 0.0])
def test_the_best_within_a_budget_is_chosen(reducer, share):
    sizes = candidate_sizes(reducer.whole)
    costs = {size: packed_bytes(reducer.reduce(size).file) for size in sizes}
    low, high = min(costs.values()), max(costs.values())
    budget = Budget(low + share * (high - low), "bytes")
    choice = best_within(reducer, budget, packed_bytes, reducer.whole)
    fitting = [size for size in sizes if costs[size] <= budget.amount]
    assert choice.cost == costs[choice.reduced.size] <= budget.amount
    least = min(reducer.predict_error(size) for size in fitting)
    assert reducer.predict_error(choice.reduced.size) == pytest.approx(least)


def test_nothing_more_is_kept_than_may_be(reducer):
    most = ModelSize(shapes=4, joints=1, influences=2)
    assert best_within(reducer, Budget(1e9, "bytes"), packed_bytes, most).reduced.size == most


def test_a_budget_for_nothing_is_refused_in_one_sentence(reducer):
    message = r"nothing fits 1 kB; this model needs at least [\d.]+ kB; raise the budget, or train"
    with pytest.raises(SsilkError, match=message):
        best_within(reducer, Budget(1000, "bytes"), packed_bytes, reducer.whole)


def test_what_is_predicted_is_about_what_is_lost(reducer):
    for size in candidate_sizes(reducer.whole)[1:]:
        found = reducer.reduce(size)
        assert reducer.predict_error(size) == pytest.approx(found.rms, rel=0.3)


def test_operations_are_those_of_the_matrix_products(reducer):
    file = reducer.reduce(ModelSize(shapes=3, joints=1, influences=1)).file
    found, free = cost.operations(file), int((file.scene.classes != 0).sum())
    static = 12 + 9  # two joints' rotations, and gravity in three frames
    assert found["P"] == static * 16 + 16 * 8
    assert found["D"] == 8 * 16 + 16 * (8 + 6)
    assert found["readout"] == 3 * 8 and found["blendshapes"] == 3 * free * 3
    assert found["skinning"] == 60 * (12 + 9)


def test_memory_falls_with_what_is_kept(reducer):
    sizes = [reducer.whole, ModelSize(shapes=4, joints=2, influences=2), ModelSize(shapes=0, joints=0, influences=1)]
    players = [Player(reducer.reduce(size).file) for size in sizes]
    found = [cost.memory(player) for player in players]
    assert found == sorted(found, reverse=True)
    vertices = players[0].file.scene.garment.mesh.vertex_count
    kept = [tile.weights.nbytes for tile in players[0].tiles]
    networks = sum(v.size for n, v in players[0].file.parameters.items() if not n.startswith("decoder"))
    assert found[0] == pytest.approx(4 * networks + 9 * 3 * vertices * 4 + sum(kept), abs=100)


def test_times_are_quantiles_over_blocks(reducer, scene, toy_motion):
    found = cost.play_time(reducer.player, toy_motion(scene, 70), seconds=0)
    assert 0 < found.median <= found.high
    assert cost.Time.of(list(np.arange(101.0))) == cost.Time(50, 95)
