# SPDX-License-Identifier: Apache-2.0
"""`ssilk simulate` of a list: garments that move together, each in a file of its own."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.physics.intersections.pairs import intersections_between

from .test_outfit import crossing, write_dented_coat

LIST = """
[defaults]
stage = "rigged.usda"
motions = "clip.usda"
{defaults}
[coat]
garment = "coat.usda:/Hero/Skirt"
over = ["skirt"]
fabric = "wool"
material = {{ friction = 0.3 }}
{coat}
[skirt]
garment = "/Hero/Skirt"
"""
SIMULATE = "simulate outfit.toml --motion brief.usda --no-body -o out"
ROUGHLY = SIMULATE + " --tolerance 50"  # where files alone are looked at


@pytest.fixture
def stage(toy, tmp_path, monkeypatch) -> Path:
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "brief.usda", frames=3)
    write_list()
    write_dented_coat()
    return tmp_path


def write_list(defaults: str = "", coat: str = "") -> None:
    Path("outfit.toml").write_text(LIST.format(defaults=defaults, coat=coat))


def crossings(coat: Shot, skirt: Shot) -> list[int]:
    """Triangles of the coat that intersect the skirt in each frame, by libigl, as USD poses both files."""
    faces = [next(mesh.faces for mesh in shot.meshes if mesh.is_garment) for shot in (coat, skirt)]
    return [
        len(intersections_between(coat.garment_points(time), faces[0], skirt.garment_points(time), faces[1]))
        for time in coat.frame_times
    ]


@pytest.mark.slow
def test_what_starts_in_a_tangle_is_settled_apart_and_stays_so(stage, capsys):
    assert crossing("coat.usda:/Hero/Skirt", "/Hero/Skirt") > 0
    assert main([*shlex.split(SIMULATE), "--tolerance", "0.3", "--points", "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    texts = [event["text"] for event in events if event["event"] == "message"]
    assert any("coat: starts settled, which moves" in text for text in texts)
    assert any("pinned vertices lie over cloth that moves, and are tight" in text for text in texts)
    detail = next(event["detail"] for event in events if event["event"] == "result")
    assert detail["coat: triangles that intersect skirt"] == "0.000%"
    coat, skirt = (Shot(Path("out", "brief", f"{name}.usdc")) for name in ("coat", "skirt"))
    assert len(coat.frame_times) == len(skirt.frame_times) == 3
    assert crossings(coat, skirt) == [0, 0, 0]


def test_each_garment_is_a_file_that_plays_alone_and_nothing_is_done_again(stage, capsys):
    write_dented_coat(dent=0.0)  # which need not be settled each time
    assert main([*shlex.split(ROUGHLY), "--json"]) == 0
    coat, skirt = (Path("out", "brief", f"{name}.usdc") for name in ("coat", "skirt"))
    for path in (coat, skirt):
        shot = Shot(path)
        assert shot.is_skinned and sum(mesh.is_garment for mesh in shot.meshes) == 1
        assert np.isfinite(shot.garment_points(shot.frame_times[-1])).all()
    capsys.readouterr()
    written = coat.stat().st_mtime_ns
    assert main([*shlex.split(ROUGHLY), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]
    assert result["current"] == 1 and coat.stat().st_mtime_ns == written
    skirt.unlink()  # a garment alone would not move as it did
    assert main([*shlex.split(ROUGHLY), "--json"]) == 0
    assert skirt.is_file() and coat.stat().st_mtime_ns > written
    written = coat.stat().st_mtime_ns
    write_list(coat="set = { seed = 1 }")  # is about training
    assert main([*shlex.split(ROUGHLY), "--json"]) == 0
    assert coat.stat().st_mtime_ns == written
    Path("outfit.toml").write_text(Path("outfit.toml").read_text().replace("0.3", "0.1"))
    assert main([*shlex.split(ROUGHLY), "--json"]) == 0
    assert coat.stat().st_mtime_ns > written


@pytest.mark.parametrize(
    ("defaults", "coat", "words", "told"),
    [
        ("", "", SIMULATE + ".usdc", "out.usdc: one file for a list of garments"),
        ("", "", SIMULATE + " --garment /Hero/Skirt", "--garment: outfit.toml is a list"),
        ("", "", SIMULATE + " --fabric silk", "--fabric: outfit.toml is a list"),
        ("", 'stage = "wide.usda"', SIMULATE, "garments of an outfit are worn by one character"),
        ('over = ["a.safetensors"]', "", SIMULATE, "an outfit is simulated of the garments of its list"),
        ("", "", SIMULATE.replace("outfit", "missing"), "missing.toml: there is no such file"),
    ],
)
def test_what_is_no_outfit_is_refused_in_one_sentence(stage, capsys, defaults, coat, words, told):
    write_list(defaults, coat)
    assert main(shlex.split(words)) == 2
    assert told in capsys.readouterr().err
    assert not Path("out").exists()
