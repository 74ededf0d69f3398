# SPDX-License-Identifier: Apache-2.0
"""Bodies of a stage as texts: weights of its shapes."""

import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.files import need_not_input, split_body, split_location
from ssilk_core.scene.shape_weights import body_name, body_of, is_shapes, parse_shapes, shapes_text

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
