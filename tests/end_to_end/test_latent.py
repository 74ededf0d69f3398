# SPDX-License-Identifier: Apache-2.0
"""`ssilk bake --quality latent` on the toy world: its size, its motion, what is stated, verified and done once."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdSkel
from ssilk_usd.reading.facts import read_provenance
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, bake
from ssilk_core.network.latent_solver import LatentOptions
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.quality.levels import QUALITIES

BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "brief.usda"]
REQUEST = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="brief.usda")


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    folder = toy.copy(tmp_path_factory.mktemp("latent"))
    toy.write_clip(folder / "brief.usda", frames=9)
    return folder


@pytest.fixture(scope="module")
def told(folder):
    """What is told of latent.usda; network.usda is baked beside it."""
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*BAKE, "-o", "network.usda"]) == 0
        with contextlib.redirect_stdout(out):
            assert main([*BAKE, "-o", "latent.usda", "--quality", "latent", "--json"]) == 0
    return [json.loads(line) for line in out.getvalue().splitlines()]


@pytest.fixture
def there(folder, told, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def points_of(path: str | Path) -> np.ndarray:
    shot = Shot(path)
    return np.stack([shot.garment_points(time) for time in shot.frame_times])


def shapes_of(path: str) -> dict[str, np.ndarray]:
    stage = Usd.Stage.Open(path)
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdSkel.BlendShape)]
    return {prim.GetName(): np.array(UsdSkel.BlendShape(prim).GetOffsetsAttr().Get()) for prim in prims}


def test_it_has_the_size_of_the_network_and_a_motion_of_its_own(there):
    own, network = shapes_of("latent.usda"), shapes_of("network.usda")
    assert own.keys() == network.keys()
    assert all(np.array_equal(own[name], network[name]) for name in own)
    away = np.linalg.norm(points_of("latent.usda") - points_of("network.usda"), axis=-1)
    assert away.shape[0] == 9 and away.max() > 1e-3


def test_it_says_how_well_it_was_solved_and_how_far_it_has_come(there, told):
    stated, detail = read_provenance("latent.usda")["solved in latents"], told[-1]["detail"]
    assert stated["iterations"] == QUALITIES["latent"].latent_iterations and stated["frames"] == 9
    assert stated["energy [J]"] < stated["energy before [J]"] and 0 <= stated["left of the gain"] <= 1
    assert 0 <= stated["frames not converged"] <= 9
    shown = {name.removeprefix("latents: "): value for name, value in detail.items() if name.startswith("latents: ")}
    counts = {"frames not converged", "line searches that failed"}
    assert shown == {name: value for name, value in stated.items() if name not in counts}
    tolerated = 1000 * LatentOptions().tolerance * GRAVITY / 30**2
    median, most = (stated[f"left to move, {which} [mm]"] for which in ("median", "at most"))
    assert (most > tolerated) == (stated["frames not converged"] > 0) and 0 <= median <= most
    (said,) = (event["text"] for event in told if "solved in 2 iterations, not in full" in event.get("text", ""))
    assert f"may still move by {median:.2g} mm" in said and "'--latent-iterations 4' lowers it" in said
    done = [event["done"] for event in told if event["event"] == "progress" and event["total"] == 9]
    assert done[:9] == list(range(1, 10))


def test_a_solved_shot_is_verified_for_being_complete(there, capsys):
    assert main(["verify", "latent.usda"]) == 0
    assert "solved in latents; its vertices are not compared" in capsys.readouterr().err
    stage = Usd.Stage.Open("latent.usda")
    stage.SetEndTimeCode(2)
    stage.Export("cut.usda")
    assert main(["verify", "cut.usda"]) == 3 and "3 samples; 9 are needed" in capsys.readouterr().err


def test_the_same_number_of_iterations_is_the_same_shot_and_more_are_another(there):
    few = QUALITIES["latent"].latent_iterations
    assert main([*BAKE, "-o", "said.usda", "--latent-iterations", str(few)]) == 0
    np.testing.assert_array_equal(points_of("said.usda"), points_of("latent.usda"))
    bake(replace(REQUEST, latent_iterations=few + 4), "more.usda")
    stated = [read_provenance(name)["solved in latents"] for name in ("latent.usda", "more.usda")]
    for figure in ("left of the gain", "left to move, median [mm]"):
        assert stated[1][figure] < stated[0][figure]


def test_few_elements_are_another_way_to_nearly_the_same_shot(there):
    assert main([*BAKE, "-o", "few.usda", "--quality", "latent", "--latent-elements", "few"]) == 0
    stated = {name: read_provenance(f"{name}.usda")["solved in latents"] for name in ("few", "latent")}
    assert {name: each["elements"] for name, each in stated.items()} == {"few": "few", "latent": "all"}
    away = np.linalg.norm(points_of("few.usda") - points_of("latent.usda"), axis=-1)
    network = np.linalg.norm(points_of("network.usda") - points_of("latent.usda"), axis=-1)
    assert 0 < np.sqrt((away**2).mean()) < np.sqrt((network**2).mean())


def test_the_garment_is_on_its_way_when_a_range_begins(there):
    bake(replace(REQUEST, latent_iterations=2, range="4-8"), "part.usda")
    np.testing.assert_allclose(points_of("part.usda"), points_of("latent.usda")[-5:], atol=1e-5)


def test_after_a_cut_and_a_run_up_it_begins_at_rest(there, toy):
    clip = Usd.Stage.Open(str(toy.write_clip(there / "jump.usda", frames=8)))
    translations = UsdSkel.Animation(clip.GetPrimAtPath("/Clip")).GetTranslationsAttr()
    for frame in range(4, 8):
        values = translations.Get(frame)
        translations.Set([values[0] + type(values[0])(9, 0, 0), *values[1:]], frame)
    clip.GetRootLayer().Save()
    request = replace(REQUEST, motion="jump.usda", latent_iterations=2, pre_roll=0.1)
    bake(request, "jumped.usda")
    assert read_provenance("jumped.usda")["solved in latents"]["frames"] == 8 + 2 * 3
    found = points_of("jumped.usda")
    assert np.abs(found[4:] - found[4:].mean(axis=1, keepdims=True)).max() < 1


def test_other_rates_are_interpolated(there):
    bake(replace(REQUEST, latent_iterations=1, fps=60.0), "fast.usda")
    assert len(points_of("fast.usda")) == 17


def test_layers_are_solved_once_on_the_asset_of_the_network(there, capsys):
    words = ["-o", "layers", "--latent-iterations", "2"]
    assert main([*BAKE, *words]) == 0
    layer = Path("layers/shots/brief/model/anim.usdc")
    np.testing.assert_allclose(points_of(layer), points_of("latent.usda"), atol=2e-6)
    assert main(["verify", str(layer)]) == 0
    before = layer.stat().st_mtime_ns
    assert main([*BAKE, *words, "--json"]) == 0
    assert layer.stat().st_mtime_ns == before and '"current": true' in capsys.readouterr().out
    assert main([*BAKE, "-o", "layers"]) == 0  # the network's own
    np.testing.assert_allclose(points_of(layer), points_of("network.usda"), atol=2e-6)


def test_solved_states_may_be_refined(there):
    bake(replace(REQUEST, latent_iterations=2, refine=2), "refined.usda")
    stated = read_provenance("refined.usda")
    assert stated["refined"]["shapes of the shot"] > 0 and stated["solved in latents"]["frames"] == 9


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--latent-elements", "some"], "'some'; it is one of all, few"),
        (["--latent-iterations", "-1"], "a whole number from 0 to 10000"),
        (["--latent-iterations", "2", "--lbs"], "linear blend skinning has no latents"),
    ],
)
def test_what_cannot_be_solved_is_refused(there, capsys, words, complaint):
    assert main([*BAKE, "-o", "refused.usda", *words]) == 2
    assert complaint in capsys.readouterr().err and not (there / "refused.usda").exists()
