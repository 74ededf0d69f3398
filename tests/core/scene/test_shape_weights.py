# SPDX-License-Identifier: Apache-2.0
"""Bodies of a stage as texts: weights of its shapes."""

from itertools import combinations, product

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.files import need_not_input, split_body, split_location
from ssilk_core.scene.family import BodyFamily
from ssilk_core.scene.shape_weights import bodies_within, body_name, body_of, is_shapes, parse_shapes, shapes_text

BODIES = {
    "a/hero.usd": ("a/hero.usd", ""),
    "a/hero.usdc:tall=1": ("a/hero.usdc", "tall=1"),
    "C:/hero.usda:tall=1,heavy=-.5": ("C:/hero.usda", "tall=1,heavy=-.5"),
    "C:/v=2/hero.usda": ("C:/v=2/hero.usda", ""),
    "v=2/hero": ("v=2/hero", ""),
    "a/hero.usd:body:tall=1": ("a/hero.usd", "body:tall=1"),
    "tall=1": ("tall=1", ""),
}


@pytest.mark.parametrize(("text", "parts"), BODIES.items())
def test_a_body_is_a_file_with_weights_of_shapes(text, parts):
    assert split_body(text) == parts
    assert split_location(f"{text}:/Hero/Body")[0] == text or "." not in text


def test_weights_alone_are_of_the_stage_of_the_command():
    assert is_shapes("tall=1") and is_shapes("tall=0.5,heavy=1") and is_shapes("tall=x")
    assert not any(map(is_shapes, ("tall.usd", "a/tall=1.usd", "hero.usd:tall=1", "a=b/tall")))
    assert body_of("tall=1", "a/hero.usd:heavy=1") == "a/hero.usd:tall=1"
    assert body_of("other.usd:tall=1", "hero.usd") == "other.usd:tall=1"
    assert split_body(body_of("body:tall=1", "hero.usd")) == ("hero.usd", "body:tall=1")


def test_weights_are_compared_whichever_way_they_are_written():
    one, other = (parse_shapes("here", text) for text in ("tall=1,heavy=.5", " heavy = 0.50,tall=1.0"))
    assert one == other == {"tall": 1, "heavy": 0.5} and shapes_text(one) == shapes_text(other) == "heavy=0.5,tall=1"


@pytest.mark.parametrize(
    ("text", "found"),
    [("tall", "'tall' is no shape"), ("tall=", "'tall='"), ("=1", "'=1'"), ("tall=nan", "'tall=nan'"),
     ("tall=1,,", "'' is no shape"), ("tall=1,tall=0", "two weights of the shape 'tall'")],
)  # fmt: skip
def test_malformed_weights_are_refused(text, found):
    with pytest.raises(SsilkError, match=f"^hero.usd: {found}"):
        parse_shapes("hero.usd", text)


def test_a_body_has_the_name_of_its_shapes_or_of_its_file():
    assert body_name("a/hero.usdc:tall=1,heavy=0.5") == "tall_heavy0.5"
    assert body_name("a/hero.usdc:tall=-1") == "tall-1" and body_name("a/hero.v2.usdc:/Hero") == "hero.v2"


def test_the_stage_of_a_body_is_not_written_over(tmp_path):
    (tmp_path / "hero.usd").touch()
    with pytest.raises(SsilkError, match="never overwritten"):
        need_not_input(tmp_path / "hero.usd", f"{tmp_path}/hero.usd:tall=1")


def test_bodies_within_ranges_have_one_shape_or_all_at_ends():
    alone, combined = bodies_within({"tall": (0, 1), "heavy": (-0.5, 1)})
    assert alone == ["tall=1", "heavy=-0.5", "heavy=1"]
    assert sorted(combined) == ["heavy=-0.5,tall=1", "heavy=1,tall=1"]  # other corners have one shape, or none
    assert bodies_within({"tall": (-1, 0.35)}) == (["tall=-1", "tall=0.35"], [])


@pytest.mark.parametrize("count", [3, 4, 5, 8, 9, 12, 13])
def test_any_three_shapes_are_combined_in_every_way_equally_often(count):
    names = [f"shape{number:02}" for number in range(count)]
    combined = bodies_within(dict.fromkeys(names, (-1, 1)))[1]
    corners = [parse_shapes("here", body) for body in combined]
    assert 2 * count <= len(corners) <= 4 * count
    for chosen in combinations(names, 3):
        ways = [tuple(corner[name] for name in chosen) for corner in corners]
        assert {ways.count(way) for way in product((-1, 1), repeat=3)} == {len(corners) / 8}


def test_combinations_that_no_member_has_are_near_the_members():
    names = "abcde"
    alone, combined = bodies_within(dict.fromkeys(names, (0, 1)))
    without, with_them = (family_of(names, bodies) for bodies in (alone, alone + combined))
    left_out = [
        corner for corner in product((0.0, 1.0), repeat=5) if corner not in set(map(tuple, with_them.members))
    ]
    assert len(left_out) == 32 - len(with_them.members)
    for corner in map(np.array, left_out[-3:]):
        assert with_them.beyond(corner) < 0.5 < without.beyond(corner)
        assert with_them.beyond(0.5 * corner) < 1e-3


def family_of(names: str, bodies: list[str]) -> BodyFamily:
    """Return the family of bodies by shapes, each of which moves a point of its own."""
    weights = [parse_shapes("here", body) for body in bodies]
    members = np.array([[0.0] * len(names), *([each.get(name, 0.0) for name in names] for each in weights)])
    moves, count = np.eye(len(names))[:, :, None] * [1.0, 0, 0], len(names)
    return BodyFamily(("base", *bodies), members, np.arange(count), np.zeros((1, 3)), np.zeros((count, 3)),
                      np.zeros((count, 1, 3)), moves, np.zeros(count), ("Body",), (count,))  # fmt: skip
