# SPDX-License-Identifier: Apache-2.0
"""How stages say that a garment is held: where the attribute stands, and when it is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from ssilk_usd.reading.direction import read_direction
from ssilk_usd.writing.files import write_direction

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Motion

FPS, FRAMES, FIRST = 25.0, 5, 10  # of the motion; its shot has two time codes a frame


def motion() -> Motion:
    return Motion("shot", FPS, np.tile([1.0, 0, 0, 0], (FRAMES, 1, 1)), np.zeros((FRAMES, 1, 3)), FIRST)


def key(stage: Usd.Stage, path: str, values: dict[float, float]) -> None:
    attribute = stage.GetPrimAtPath(path).CreateAttribute("ssilk:free", Sdf.ValueTypeNames.Float)
    for code, value in values.items():
        attribute.Set(value, code)
    stage.GetRootLayer().Save()


@pytest.fixture
def home(tmp_path) -> Usd.Stage:
    """A character in a cape."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    UsdSkel.Root.Define(stage, "/Hero")
    rig = UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    rig.CreateJointsAttr(["Hips"])
    for attribute in (rig.CreateBindTransformsAttr(), rig.CreateRestTransformsAttr()):
        attribute.Set([Gf.Matrix4d(1)])
    animation = UsdSkel.Animation.Define(stage, "/Hero/Walk")
    UsdSkel.BindingAPI.Apply(rig.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    body = UsdGeom.Mesh.Define(stage, "/Hero/Body").GetPrim()
    UsdSkel.BindingAPI.Apply(body).CreateSkeletonRel().SetTargets([rig.GetPath()])
    cape = UsdGeom.Mesh.Define(stage, "/Hero/Cape").GetPrim()
    cape.CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    stage.GetRootLayer().Save()
    return stage


@pytest.fixture
def shot(home, tmp_path) -> Usd.Stage:
    """Two of them, neither at the path that the character has at home."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.SetTimeCodesPerSecond(2 * FPS)
    for name in ("One", "Two"):
        stage.DefinePrim(f"/Crowd/{name}").GetReferences().AddReference("./hero.usda", "/Hero")
    stage.GetRootLayer().Save()
    return stage


def read(shot: Usd.Stage, home: Usd.Stage, who: str = "One", proxies: Sequence[str] = ()):
    files = (stage.GetRootLayer().realPath for stage in (shot, home))
    source, stage = files
    return read_direction(f"{source}:/Crowd/{who}/Walk", stage, ["/Hero/Cape"], motion(), proxies)


def test_each_of_a_crowd_is_held_by_its_own_prim_at_the_time_codes_of_the_shot(shot, home):
    key(shot, "/Crowd/One/Cape", {20.0: 0.0, 28.0: 1.0})
    np.testing.assert_allclose(read(shot, home).free, [0, 0.25, 0.5, 0.75, 1])
    assert read(shot, home, "Two").free is None and read(shot, home, "Two").hold == 1


def test_the_stage_of_the_character_says_what_the_shot_does_not(shot, home):
    key(home, "/Hero/Cape", {0.0: 0.5})
    home.GetPrimAtPath("/Hero/Cape").CreateAttribute("ssilk:hold", Sdf.ValueTypeNames.Int).Set(3)
    home.GetRootLayer().Save()
    shot.Reload()
    key(shot, "/Crowd/Two/Cape", {0.0: 1.0})
    assert read(shot, home).free == pytest.approx(np.full(FRAMES, 0.5)) and read(shot, home).hold == 3
    assert read(shot, home, "Two").free is None and read(shot, home, "Two").hold == 3


def test_a_clip_says_it_by_an_over_at_the_path_of_the_garment(home, tmp_path):
    clip = Usd.Stage.CreateNew(str(tmp_path / "clip.usda"))
    clip.SetTimeCodesPerSecond(FPS)
    UsdSkel.Animation.Define(clip, "/Clip")
    clip.GetRootLayer().Save()
    path = clip.GetRootLayer().realPath
    write_direction(path, "/Hero/Cape", np.linspace(0, 1, FRAMES), FIRST, 2)
    found = read_direction(path, home.GetRootLayer().realPath, ["/Hero/Cape"], motion())
    np.testing.assert_allclose(found.free, np.linspace(0, 1, FRAMES))
    assert found.hold == 2


def define_subset(home: Usd.Stage, kind: str, rows: list[int]) -> None:
    """Give the cape two triangles, and a subset of these or of its four points."""
    cape = UsdGeom.Mesh(home.GetPrimAtPath("/Hero/Cape"))
    cape.CreateFaceVertexCountsAttr([3, 3])
    cape.CreateFaceVertexIndicesAttr([0, 1, 2, 2, 1, 3])
    subset = UsdGeom.Subset.Define(home, "/Hero/Cape/left")
    subset.CreateElementTypeAttr(kind)
    subset.CreateIndicesAttr(rows)
    home.GetRootLayer().Save()


@pytest.mark.parametrize(("kind", "rows", "vertices"), [("point", [0, 3], [0, 3]), ("face", [1], [1, 2, 3])])
def test_parts_are_proxies_or_subsets_each_with_values_of_its_own(shot, home, kind, rows, vertices):
    define_subset(home, kind, rows)
    shot.Reload()
    cape = shot.GetPrimAtPath("/Crowd/One/Cape")
    for name, keys in {"free:left": {20: 0, 28: 1}, "posed:Fold": {20: 0.25}, "free:Fold": {20: 1}}.items():
        attribute = cape.CreateAttribute(f"ssilk:{name}", Sdf.ValueTypeNames.Float)
        for code, value in keys.items():
            attribute.Set(value, code)
    shot.GetRootLayer().Save()
    found = {part.name: part for part in read(shot, home, proxies=["Hips/Fold"]).parts}
    assert set(found) == {"left", "Fold"} and not found["left"].posed and found["Fold"].posed
    np.testing.assert_array_equal(found["left"].vertices, vertices)
    np.testing.assert_allclose(found["left"].share, [1, 0.75, 0.5, 0.25, 0])
    assert found["Fold"].vertices is None and (found["Fold"].share == 0.25).all()
    assert not read(shot, home, "Two").parts


def test_a_subset_of_vertices_that_are_not_there_is_refused(shot, home):
    define_subset(home, "point", [0, 4])
    home.GetPrimAtPath("/Hero/Cape").CreateAttribute("ssilk:free:left", Sdf.ValueTypeNames.Float).Set(0.0)
    home.GetRootLayer().Save()
    shot.Reload()
    with pytest.raises(SsilkError, match=r"a subset of points \[0, 4\], .*of which there are 4"):
        read(shot, home)


def test_a_part_of_no_such_name_is_told_with_those_that_there_are(shot, home):
    define_subset(home, "point", [0, 3])
    home.GetPrimAtPath("/Hero/Cape").CreateAttribute("ssilk:free:lefft", Sdf.ValueTypeNames.Float).Set(0.0)
    home.GetRootLayer().Save()
    shot.Reload()
    text = r"ssilk:free:lefft names neither .*; its subsets: left; its proxies: A, B; did you mean 'left'\?$"
    with pytest.raises(SsilkError, match=text):
        read(shot, home, proxies=["Hips/B", "Hips/A"])


def test_a_prim_with_a_misspelt_name_is_told_until_the_garment_itself_is_directed(shot, home):
    shot.OverridePrim("/Crowd/One/Cpae")
    key(shot, "/Crowd/One/Cpae", {20.0: 0.0})
    shot.OverridePrim("/Crowd/Prop")
    key(shot, "/Crowd/Prop", {20.0: 0.0})
    (told,) = read(shot, home).unheard
    assert "shot.usda:/Crowd/One/Cpae: ssilk:free directs nothing; the garment is /Hero/Cape" in told
    key(shot, "/Crowd/One/Cape", {20.0: 0.0})
    assert not read(shot, home).unheard and len(read(shot, home, "Two").unheard) == 1


@pytest.mark.parametrize(("path", "kind"), [
    ("/Crowd/One/Rig", "Skeleton"), ("/Crowd/One/Walk", "SkelAnimation"), ("/Crowd", "prim above the garment"),
])  # fmt: skip
def test_what_poses_or_holds_the_garment_directs_nothing_and_is_told(shot, home, path, kind):
    key(shot, path, {20.0: 0.0})
    key(shot, "/Crowd/One/Cape", {20.0: 0.0})
    (told,) = read(shot, home).unheard
    assert f"shot.usda:{path}: ssilk:free directs nothing on a {kind}; it is an attribute of the garment" in told


def test_a_primvar_that_would_direct_the_garment_is_refused(shot, home):
    cape = shot.GetPrimAtPath("/Crowd/One/Cape")
    UsdGeom.PrimvarsAPI(cape).CreatePrimvar("ssilk:class", Sdf.ValueTypeNames.IntArray)  # a garment has that one
    read(shot, home)
    UsdGeom.PrimvarsAPI(cape).CreatePrimvar("ssilk:free:left", Sdf.ValueTypeNames.Float).Set(0.0)
    shot.GetRootLayer().Save()
    with pytest.raises(SsilkError, match=r"an attribute primvars:ssilk:free:left; .* did you mean 'ssilk:free:left'"):
        read(shot, home)


def test_a_value_that_is_refused_is_the_one_that_was_keyed(shot, home):
    key(shot, "/Crowd/One/Cape", {20.0: 0.5, 23.0: np.nan, 28.0: 1.0})  # between the frames at 22 and 24
    with pytest.raises(SsilkError, match="ssilk:free is nan at time code 23;"):
        read(shot, home)


def test_two_garments_that_may_be_meant_are_refused(shot, home):
    twin = UsdGeom.Mesh.Define(shot, "/Crowd/One/Wardrobe/Cape").GetPrim()
    twin.CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    shot.GetRootLayer().Save()
    with pytest.raises(SsilkError, match=r"several garments may be Cape: .*one is needed"):
        read(shot, home)


@pytest.mark.parametrize(
    ("name", "kind", "value", "complaint"),
    [
        ("ssilk:free", Sdf.ValueTypeNames.String, "all", "ssilk:free is all; a number from 0 to 1 is needed"),
        ("ssilk:free", Sdf.ValueTypeNames.Float, -0.5, "ssilk:free is -0.5 at time code 20"),
        ("ssilk:hold", Sdf.ValueTypeNames.Float, 2.5, "ssilk:hold is 2.5; a whole number of frames"),
        ("ssilk:hold", Sdf.ValueTypeNames.Bool, True, "ssilk:hold is True; a whole number of frames"),
        ("ssilk:fre:left", Sdf.ValueTypeNames.Float, 0.0, "an attribute ssilk:fre:left; .*did you mean 'ssilk:free'"),
    ],
)
def test_what_is_no_direction_is_refused(shot, home, name, kind, value, complaint):
    shot.GetPrimAtPath("/Crowd/One/Cape").CreateAttribute(name, kind).Set(value)
    shot.GetRootLayer().Save()
    with pytest.raises(SsilkError, match=complaint):
        read(shot, home)


def test_a_hold_that_changes_is_refused(shot, home):
    hold = shot.GetPrimAtPath("/Crowd/One/Cape").CreateAttribute("ssilk:hold", Sdf.ValueTypeNames.Int)
    hold.Set(1, 0)
    hold.Set(2, 20)
    shot.GetRootLayer().Save()
    with pytest.raises(SsilkError, match="ssilk:hold changes over time"):
        read(shot, home)
