# SPDX-License-Identifier: Apache-2.0
"""`ssilk simulate` on the toy world: what the files hold, what is refused, and what an interruption leaves."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main, simulate
from ssilk_core.delivery.bake import BakeRequest, plan_layers
from ssilk_core.errors import fail
from ssilk_core.physics.simulate import Simulator


@pytest.fixture
def stage(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "brief.usda", frames=5)
    toy.write_clip(tmp_path / "short.usda", frames=3)
    return tmp_path


# What is tested here are files; the solver stops early.
SIMULATE = ["simulate", "rigged.usda", "--no-body", "--tolerance", "50", "--motion"]


def test_a_cache_holds_the_garment_beside_its_body(stage):
    words = "simulate rigged.usda --points --tolerance 50 --motion brief.usda -o cache.usda"
    assert main(words.split()) == 0
    baked, cache = Shot(stage / "shot.usda"), Shot(stage / "cache.usda")
    assert cache.fps == 30 and len(cache.frame_times) == 5
    assert [mesh.is_garment for mesh in cache.meshes] == [mesh.is_garment for mesh in baked.meshes]
    body = next(n for n, mesh in enumerate(cache.meshes) if not mesh.is_garment)
    skirt = next(n for n, mesh in enumerate(cache.meshes) if mesh.is_garment)
    for time in cache.frame_times:
        np.testing.assert_allclose(cache.points(time)[body], baked.points(time)[body], atol=1e-6)
    first, last = cache.points(cache.frame_times[0])[skirt], cache.points(cache.frame_times[-1])[skirt]
    assert np.isfinite(last).all() and np.abs(last - first).max() > 0.01
    # Nothing of the skeleton is left on the garment, and the bounds hold all that is drawn.
    prim = cache.stage.GetPrimAtPath(cache.meshes[skirt].path)
    assert not prim.HasAPI(UsdSkel.BindingAPI)
    assert not [name for name in prim.GetPropertyNames() if "skel:" in name]
    assert len(UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples()) == 5
    root = UsdGeom.Boundable(cache.stage.GetDefaultPrim())
    low, high = np.array(root.GetExtentAttr().Get(Usd.TimeCode(cache.frame_times[-1])))
    drawn = np.concatenate(cache.points(cache.frame_times[-1]))
    assert (drawn >= low - 1e-5).all() and (drawn <= high + 1e-5).all()


def test_joints_and_shapes_stand_for_the_points(stage, capsys):
    for form, out in (["--points"], "points.usda"), ([], "joints.usda"):
        assert main([*SIMULATE, "brief.usda", "-o", out, *form]) == 0
    told = capsys.readouterr().err
    assert "bytes of the points alone: 18720" in told and "within the tolerance: 100.0%" in told
    points, joints = Shot(stage / "points.usda"), Shot(stage / "joints.usda")
    assert joints.is_skinned and not points.is_skinned
    away = [
        np.linalg.norm(joints.garment_points(time) - points.garment_points(time), axis=-1)
        for time in points.frame_times
    ]
    assert np.max(away) <= 5e-3 and np.sqrt(np.square(away).mean()) <= 1e-3
    assert main(["verify", "joints.usda"]) == 2
    assert "its points were simulated and not kept" in capsys.readouterr().err


def test_points_that_no_skinning_reaches_are_kept_as_points(stage, monkeypatch, capsys):
    def folded(*_, **__):
        fail("clip", "its skinning folds", "joints cannot reach it")

    monkeypatch.setattr("ssilk_core.scene.decomposition.decompose", folded)
    assert main([*SIMULATE, "short.usda", "-o", "kept.usdc"]) == 0
    assert "its skinning folds" in capsys.readouterr().err and not Shot(stage / "kept.usdc").is_skinned


def test_a_range_is_that_of_a_bake_and_the_rest_state_is_announced(stage, capsys):
    assert main([*SIMULATE, "brief.usda", "--points", "--range", "2-3", "-o", "part.usda"]) == 0
    told = capsys.readouterr().err
    assert told.index("comes to rest in the first pose") < told.index("2/2")
    part = Shot(stage / "part.usda")
    codes = UsdGeom.Mesh(part.stage.GetPrimAtPath(part.meshes[-1].path)).GetPointsAttr().GetTimeSamples()
    assert codes == [2, 3]
    assert main([*SIMULATE, "brief.usda", "--range", "2-300", "-o", "all.usda"]) == 2
    assert "has samples from time code" in capsys.readouterr().err


def test_several_motions_become_files_of_their_own(stage):
    assert main([*SIMULATE, "brief.usda", "short.usda", "-o", "caches"]) == 0
    lengths = {path.name: len(Shot(path).frame_times) for path in (stage / "caches").iterdir()}
    assert lengths == {"brief.usdc": 5, "short.usdc": 3}
    assert main([*SIMULATE, "short.usda", "-o", "alone.usdc"]) == 0
    together, alone = Shot(stage / "caches" / "short.usdc"), Shot(stage / "alone.usdc")
    for time in alone.frame_times:  # the skirt folds as rounding has it, but in the same place
        np.testing.assert_allclose(
            together.garment_points(time).mean(0), alone.garment_points(time).mean(0), atol=0.01
        )


def test_shots_are_named_as_those_of_a_bake(stage):
    """By a pattern, and so that names in other alphabets and prims of one file stay apart."""
    motions = ["s010/anim.usdc", "衣/anim.usdc", "clips.usdc:/Walk", "clips.usdc:/Run"]
    unnamed = [*motions[1:], "s010/衣.usdc", "s010/空.usdc"]
    named = {path.name for path in simulate._outputs(stage / "caches", unnamed, None)}
    requests = [BakeRequest(model="m", stage="s", motion=motion) for motion in unnamed]
    assert named == {f"{task.shot}.usdc" for task in plan_layers(requests)} and len(named) == 5
    patterned = simulate._outputs(stage / "caches", motions[:2], "{parent}_{stem}")
    assert patterned[0].name == "s010_anim.usdc" and patterned[1] != patterned[0]


def test_an_interruption_leaves_nothing_half_written(stage, monkeypatch):
    advanced = Simulator.frames

    def interrupted(self, motions, worlds):
        for frame in advanced(self, motions, worlds):
            if frame.number == 1:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(Simulator, "frames", interrupted)
    before = sorted(stage.iterdir())
    assert main([*SIMULATE, "short.usda", "-o", "cache.usdc"]) == 130
    assert sorted(stage.iterdir()) == before


def test_what_an_interrupted_simulation_finished_is_not_done_again(stage, monkeypatch, capsys):
    words = [*SIMULATE, "brief.usda", "short.usda", "--batch", "1", "-o", "caches"]
    advanced, asked = Simulator.frames, []

    def interrupted(self, motions, worlds):
        asked.append(len(motions))
        for frame in advanced(self, motions, worlds):
            if len(asked) == 1 and frame.shot == 1:  # the longer one is through
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(Simulator, "frames", interrupted)
    assert main(words) == 130
    assert [path.name for path in (stage / "caches").iterdir()] == ["brief.usdc"]
    written = (stage / "caches" / "brief.usdc").stat().st_mtime_ns
    assert main(words) == 0 and asked == [2, 1]
    assert (stage / "caches" / "brief.usdc").stat().st_mtime_ns == written
    assert main(words) == 0 and asked == [2, 1] and "current: 2" in capsys.readouterr().err
    assert main([*words, "--material", "density=0.2"]) == 0 and asked == [2, 1, 2]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("--motion brief.usda short.usda -o one.usdc", "one file for 2 motions"),
        ("--motion brief.usda other/brief.usda -o caches", "'brief.usda' and 'other/brief.usda' would both be the"),
        ("--motion brief.usda brief.usda -o caches", "'brief.usda' is named twice"),
        ("--motion brief.usda -o one.usdc --fps -3", "a number from 0.01 to 10000"),
        ("--motion brief.usda -o one.usdc --tolerance 0", "a number from 1e-09 to 1000"),
        ("--motion nowhere.usda -o one.usdc", "there is no such file"),
        ("--motion brief.usda -o brief.usda", "output is also an input"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_sentence(stage, capsys, words, complaint):
    (stage / "other").mkdir(exist_ok=True)
    (stage / "other" / "brief.usda").touch()
    assert main(["simulate", "rigged.usda", *words.split()]) == 2
    assert complaint in capsys.readouterr().err
    assert not (stage / "one.usdc").exists() and not (stage / "caches").exists()


def test_a_file_is_simulated_again_where_cloth_may_no_more_pass_through_cloth(stage, capsys):
    words = [*SIMULATE, "short.usda", "-o", "shots"]
    for more, is_current in ([], False), (["--self-contact"], False), (["--self-contact"], True):
        assert main([*words, *more]) == 0
        told = capsys.readouterr().err
        assert ("current: 1" in told) is is_current
        assert is_current or "triangles that intersect others" in told
