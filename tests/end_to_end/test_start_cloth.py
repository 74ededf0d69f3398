# SPDX-License-Identifier: Apache-2.0
"""A shot that goes on from the cloth of another: as UsdSkel plays both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, Vt

from .conftest import define_mesh, run
from .test_direction import direct, lively, points_of
from .test_loops import write_cycle

BAKE = "bake lively.safetensors --stage rigged.usda --motion clip.usda"


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory) -> Path:
    """The toy with a lively model, a whole shot, and its first half."""
    folder = tmp_path_factory.mktemp("start")
    toy.copy(folder)
    toy.write_clip(folder / "clip.usda", frames=30)
    lively(folder / "model.safetensors", folder / "lively.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert run(f"{BAKE} -o whole.usdc") == 0
        assert run(f"{BAKE} --range 0-14 -o first.usdc") == 0
    return folder


def test_two_shots_are_as_one(copy, capsys):
    assert run(f"{BAKE} --range 14-29 --start-cloth first.usdc -o second.usdc") == 0
    assert "the cloth begins as in first.usdc at 14; latents come within" in capsys.readouterr().err
    whole, second = points_of("whole.usdc"), points_of("second.usdc")
    assert np.abs(second - whole[14:]).max() < 2e-4
    assert run("verify second.usdc") == 0


def test_without_samples_before_it_a_shot_begins_where_the_other_ends(copy):
    """Its motion begins there too: at rest the cloth would be elsewhere."""
    clip = Usd.Stage.Open("clip.usda")
    for attribute in clip.GetPrimAtPath("/Clip").GetAttributes():
        for code in [code for code in attribute.GetTimeSamples() if code < 14]:
            attribute.ClearAtTime(code)
    clip.Export("late.usda")
    words, whole = BAKE.replace("clip.usda", "late.usda"), points_of("whole.usdc")[14:]
    assert run(f"{words} --range 14-29 -o anew.usdc") == 0
    assert run(f"{words} --range 14-29 --start-cloth first.usdc -o second.usdc") == 0
    anew, second = points_of("anew.usdc"), points_of("second.usdc")
    assert np.abs(second[0] - whole[0]).max() < 2e-4
    assert np.abs(anew[0] - whole[0]).max() > 20 * np.abs(second[0] - whole[0]).max()


def test_it_may_begin_at_any_frame_of_a_longer_shot(copy):
    assert run(f"{BAKE} --range 20-29 --start-cloth whole.usdc@20 -o late.usdc") == 0
    assert np.abs(points_of("late.usdc") - points_of("whole.usdc")[20:]).max() < 2e-4


def test_a_shot_with_handles_begins_with_the_cloth_of_its_first_handle(copy):
    assert run(f"{BAKE} --range 20-25 --handles 2 --start-cloth whole.usdc@18 -o late.usdc") == 0
    assert np.abs(points_of("late.usdc") - points_of("whole.usdc")[18:28]).max() < 2e-4


def write_cache(path: str, frames: list[np.ndarray], first: int) -> None:
    """Write points as a cache of the toy's garment, one frame after the other, as other programs do."""
    rigged = Usd.Stage.Open("rigged.usda")
    mesh = UsdGeom.Mesh(rigged.GetPrimAtPath("/Hero/Skirt"))
    counts, indices = mesh.GetFaceVertexCountsAttr().Get(), mesh.GetFaceVertexIndicesAttr().Get()
    stage = Usd.Stage.CreateNew(path)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(30)
    written = UsdGeom.Mesh(define_mesh(stage, "/Cloth", frames[0], np.zeros((0, 3), int)))
    written.GetFaceVertexCountsAttr().Set(counts)
    written.GetFaceVertexIndicesAttr().Set(indices)
    for number, points in enumerate(frames, first):
        written.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)), number)
    stage.GetRootLayer().Save()


def write_bumps(path: str) -> np.ndarray:
    """Write a cache whose bumps no latents have; return how far they are from the whole shot (F, V, 3)."""
    whole = points_of("whole.usdc")
    bumps = 0.004 * np.sin(40 * whole[:, :, :1]) * np.array([1.0, 0.5, -1.0])
    write_cache(path, list((whole + bumps)[12:15]), 12)
    return bumps


def test_what_latents_miss_fades_from_the_first_frame_on(copy, capsys):
    whole, bumps = points_of("whole.usdc"), write_bumps("other.usdc")
    assert run(f"{BAKE} --range 14-29 --start-cloth other.usdc -o second.usdc") == 0
    assert "a blendshape that fades in 0.5 s makes up for the rest" in capsys.readouterr().err
    second, free = points_of("second.usdc"), ~pinned()
    assert np.abs(second[0] - (whole + bumps)[14])[free].max() < 2e-5
    assert np.abs(np.diff(second, axis=0)).max() < 3 * np.abs(np.diff(whole, axis=0)).max()
    assert np.abs(second[-1] - whole[-1]).max() < 5e-3
    assert run("verify second.usdc") == 0


def pinned() -> np.ndarray:
    from ssilk_core.network.checkpoint import load_model
    from ssilk_core.scene.assets import PINNED

    return load_model("lively.safetensors").scene.classes == PINNED


def test_one_frame_tells_nothing_of_how_cloth_moves(copy, capsys):
    write_cache("pose.usdc", [points_of("whole.usdc")[14]], 14)
    assert run(f"{BAKE} --range 14-29 --start-cloth pose.usdc -o second.usdc") == 0
    assert "nothing is known of how it moves there" in capsys.readouterr().err
    np.testing.assert_allclose(points_of("second.usdc")[0], points_of("whole.usdc")[14], atol=2e-4)


def test_the_solver_refines_what_goes_on(copy):
    assert run(f"{BAKE} --range 14-17 --start-cloth first.usdc --refine 1 -o second.usdc") == 0
    assert len(points_of("second.usdc")) == 4


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--start-cloth none.usdc", "none.usdc"),
        ("--start-cloth first.usdc@abc", "'abc' after '@' is no time code"),
        ("--start-cloth first.usdc@99", "a start at time code 99; it lasts from 0 to 14"),
        ("--start-cloth first.usdc --range 15-29", "it lasts from 0 to 14, and the shot begins at 15"),
        ("--start-cloth whole.usdc --range 14-29", "it lasts from 0 to 29, and the shot begins at 14"),
        ("--start-cloth hero.usda:/Hero/Body", "points"),
        ("--start-cloth first.usdc --pre-roll 1", "a start and a run-up"),
        ("--start-cloth first.usdc --loop", "a start and a loop"),
        ("--start-cloth first.usdc --hold 2", "a start and poses that are held"),
        ("--start-cloth first.usdc --range 14-20 --handles 2", "a start and handles, which come before it"),
        ("--start-cloth first.usdc --lbs", "a start and linear blend skinning"),
        ("--start-cloth first.usdc --latent-iterations 1", "a start and a solver in latents"),
    ],
)
def test_what_no_start_can_be_is_refused(copy, capsys, words, text):
    assert run(f"{BAKE} {words} -o shot.usdc") == 2
    assert text in capsys.readouterr().err
    assert not Path("shot.usdc").exists()


def test_a_start_far_from_the_character_is_refused(copy, capsys):
    write_cache("far.usdc", [points_of("first.usdc")[-1] + [50.0, 0, 0]], 14)
    assert run(f"{BAKE} --start-cloth far.usdc -o shot.usdc") == 2
    assert "m away from the character's first pose" in capsys.readouterr().err


def test_layers_refuse_a_start(copy, capsys):
    assert run(f"{BAKE} --start-cloth first.usdc -o layers") == 2
    assert "in a folder of layers or a job" in capsys.readouterr().err and not Path("layers").exists()


def test_what_latents_miss_is_gone_where_the_garment_is_held(copy):
    """It would fade until frame 29; skinning holds the garment from frame 22 on."""
    bumps = write_bumps("other.usdc")
    direct("clip.usda", free={18: 1.0, 22: 0.0})
    assert run(f"{BAKE} --range 14-29 -o plain.usdc") == 0
    assert run(f"{BAKE} --range 14-29 --start-cloth other.usdc -o second.usdc") == 0
    plain, second, free = points_of("plain.usdc"), points_of("second.usdc"), ~pinned()
    np.testing.assert_allclose(second[8:], plain[8:], atol=1e-5)
    assert np.abs(second[0] - (points_of("whole.usdc") + bumps)[14])[free].max() < 2e-5
    assert run("verify second.usdc") == 0


def test_a_shot_that_its_stage_calls_a_loop_has_no_start(copy, capsys):
    write_cycle("cycle.usda")
    words = BAKE.replace("clip.usda", "cycle.usda")
    assert run(f"{words} -o first.usdc") == 0
    shot = Usd.Stage.Open("cycle.usda")
    shot.OverridePrim("/Hero/Skirt").CreateAttribute("ssilk:loop", Sdf.ValueTypeNames.Bool).Set(True)
    shot.GetRootLayer().Save()
    capsys.readouterr()
    assert run(f"{words} --start-cloth first.usdc@0 -o shot.usdc") == 2
    assert "a start and a loop; one of both; leave --loop out, and ssilk:loop" in capsys.readouterr().err


@pytest.mark.parametrize("start", ["first.usdc", "first.usdc@14"])
def test_the_cloth_that_a_shot_begins_with_is_not_overwritten(copy, capsys, start):
    before = Path("first.usdc").read_bytes()
    assert run(f"{BAKE} --range 14-29 --start-cloth {start} -o first.usdc") == 2
    assert "first.usdc: the output is also an input" in capsys.readouterr().err
    assert Path("first.usdc").read_bytes() == before


def test_verify_finds_a_start_in_layers_and_tells_that_it_has_changed(copy, capsys):
    layer = "layers/shots/clip/lively/anim.usdc"
    assert run(f"{BAKE} --range 0-14 -o layers") == 0
    assert run(f"{BAKE} --range 14-29 --start-cloth {layer} -o second.usdc") == 0
    capsys.readouterr()
    assert run("verify second.usdc") == 0
    assert "has changed" not in capsys.readouterr().err
    assert run(f"{BAKE} --range 0-14 --pre-roll 1 -o layers") == 0
    assert run("verify second.usdc") in (0, 3)
    assert f"{layer}: the start cloth has changed since the shot was baked" in capsys.readouterr().err
