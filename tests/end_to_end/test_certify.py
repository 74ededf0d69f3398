# SPDX-License-Identifier: Apache-2.0
"""`ssilk bake --certify` on the toy world: what UsdSkel re-skins from the file, what stays, what verifying finds."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Usd, UsdSkel, Vt
from ssilk_usd.reading.facts import read_provenance
from ssilk_usd.shots.layers_animation import with_points
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import hiding
from ssilk_core.delivery.bake.certificate import blendshapes
from ssilk_core.delivery.bake.certificate.requirements import need_certifier
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.physics.intersections.pairs import self_intersections

FRAMES = 21
BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "bow.usda", "--lbs"]
MIDDLE = ["--range", "7-13"]  # in which it bends most


def write_bow(path) -> None:
    """A clip in which the spine bends, until its skirt folds through itself."""
    stage = Usd.Stage.Open(str(path))
    rotations = UsdSkel.Animation(stage.GetPrimAtPath("/Clip")).GetRotationsAttr()
    for frame in range(FRAMES):
        angle = 0.75 * np.sin(np.pi * frame / (FRAMES - 1)) ** 2
        bent = Gf.Quatf(float(np.cos(angle / 2)), Gf.Vec3f(float(np.sin(angle / 2)), 0, 0))
        rotations.Set([Gf.Quatf(1), bent, Gf.Quatf(1)], frame)
    stage.GetRootLayer().Save()


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    folder = toy.copy(tmp_path_factory.mktemp("certified"))
    write_bow(toy.write_clip(folder / "bow.usda", frames=FRAMES))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*BAKE, "-o", "plain.usda"]) == 0
        assert main([*BAKE, "-o", "certified.usda", "--certify"]) == 0
    return folder


@pytest.fixture
def there(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def skinned(path, frames: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """The garment's points (F, V, 3), float32, as UsdSkel alone has them, and its faces."""
    stage = Usd.Stage.Open(str(path))
    root = UsdSkel.Root(next(prim for prim in stage.Traverse() if prim.IsA(UsdSkel.Root)))
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(binding.GetSkeleton())
    target = next(each for each in binding.GetSkinningTargets() if each.GetPrim().GetName() == "Skirt")
    mesh, found = UsdSkel.BindingAPI(target.GetPrim()), []
    shapes = UsdSkel.BlendShapeQuery(mesh)
    rest = target.GetPrim().GetAttribute("points").Get()
    for time in range(frames):
        points = Vt.Vec3fArray(rest)
        weights = query.GetAnimQuery().ComputeBlendShapeWeights(time)
        if weights and target.GetBlendShapeMapper():
            weights = target.GetBlendShapeMapper().Remap(weights)
            sub, which, shape = shapes.ComputeSubShapeWeights(weights)
            shapes.ComputeDeformedPoints(sub, which, shape, shapes.ComputeBlendShapePointIndices(),
                                         shapes.ComputeSubShapePointOffsets(), points)  # fmt: skip
        transforms = query.ComputeSkinningTransforms(time)
        target.ComputeSkinnedPoints(transforms, points, time)
        found.append(np.array(points))
    return np.stack(found), np.array(target.GetPrim().GetAttribute("faceVertexIndices").Get()).reshape(-1, 3)


def crossing(path) -> list[int]:
    points, faces = skinned(path)
    return [frame for frame, each in enumerate(points) if len(self_intersections(each.astype(float), faces))]


def test_the_written_file_has_no_intersecting_triangle(there):
    before = crossing("plain.usda")
    assert before and crossing("certified.usda") == []
    said = read_provenance("certified.usda")["certificate"]
    assert said["found"] == f"0 of {FRAMES} frames intersect, 0 show covered skin"
    assert said["frames wrong before"] >= len(before) and not said.get("frames left")


def test_other_frames_are_those_of_the_bake_without(there):
    plain, certified = skinned("plain.usda")[0], skinned("certified.usda")[0]
    said = read_provenance("certified.usda")["certificate"]["moved frames"]
    moved = {frame for span in said for frame in range(*map(sum, zip(map(int, span.split(" to ")), (0, 1))))}
    assert 0 < len(moved) < FRAMES
    for frame in range(FRAMES):
        assert (plain[frame] == certified[frame]).all() == (frame not in moved)


def test_it_verifies_and_one_that_someone_bent_does_not(there, capsys):
    assert main(["verify", "certified.usda"]) == 0
    told, free = capsys.readouterr().err, f"0 of {FRAMES} frames intersect, 0 show covered skin"
    assert f"certificate of the file: {free}\n" in told and f"counted in it: {free}\n" in told
    stage = Usd.Stage.Open("certified.usda")
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Animation):
            weights = prim.GetAttribute("blendShapeWeights")
            for time in weights.GetTimeSamples():
                weights.Set(Vt.FloatArray(len(weights.Get(time))), time)
    stage.Export("bent.usda")
    assert main(["verify", "bent.usda"]) == 3
    assert "where its certificate says that none does" in capsys.readouterr().err


def test_a_refined_shot_verifies_where_frames_of_it_were_moved(there):
    assert main([*BAKE[:-1], "-o", "refined.usda", "--certify", "--refine", "2", "--range", "3-9"]) == 0
    assert read_provenance("refined.usda")["certificate"]["moved frames"] and crossing("refined.usda") == []
    assert main(["verify", "refined.usda"]) == 0


def test_hero_is_certified_from_where_the_solver_leaves_it(there):
    hero = [*BAKE[:-1], "-o", "heroic.usda", "--certify", "--quality", "hero", "--range", "0-4"]
    assert main(hero) == 0
    said = read_provenance("heroic.usda")["certificate"]
    assert said["found"] == "0 of 5 frames intersect, 0 show covered skin" and said["frames wrong before"]
    assert crossing("heroic.usda") == []


def test_refined_frames_that_joints_cannot_reach_have_no_certificate(there, capsys, monkeypatch):
    def folded(*args, **options):
        raise SsilkError("bow.usda: joints and blendshapes are 7 mm RMS off.")

    monkeypatch.setattr("ssilk_core.scene.decomposition.decompose", folded)
    assert main([*BAKE[:-1], "-o", "none.usda", "--certify", "--refine", "1", "--range", "0-1"]) == 2
    told = capsys.readouterr().err
    assert "--certify: refined frames do not fit joints and blendshapes (bow.usda: joints and" in told
    assert told.endswith("leave --certify out.\n") and not (there / "none.usda").exists()


@pytest.fixture
def missing_at_first(monkeypatch):
    """Shapes that move nothing, until frames get one each: the first file is as wrong as without a certificate."""
    found = blendshapes.shapes_of

    def shapes(offsets, *, exact):
        shapes, weights = found(offsets, exact=exact)
        return (shapes if exact else 0 * shapes), weights

    monkeypatch.setattr(blendshapes, "shapes_of", shapes)


@pytest.mark.slow
def test_points_of_layers_are_those_of_the_last_attempt(there, missing_at_first):
    assert main([*BAKE, "-o", "attempts/", "--certify", "--points", *MIDDLE]) == 0
    faces, (path,) = skinned("plain.usda")[1], there.glob("attempts/shots/*/*/anim.usdc")
    shot = with_points(path)
    assert not any(len(self_intersections(shot.garment_points(time), faces)) for time in shot.frame_times)


def test_what_is_hidden_is_what_the_last_attempt_covers(there, missing_at_first, monkeypatch):
    seen, found = [], hiding.covered_polygons
    monkeypatch.setattr(hiding, "covered_polygons", lambda rollout, report: seen.append(rollout) or found(rollout))
    assert main([*BAKE, "-o", "hidden.usda", "--certify", "--hide-covered", *MIDDLE]) == 0
    cloth = np.stack(list(seen[-1].vertices()))
    np.testing.assert_allclose(cloth, skinned("hidden.usda")[0][7:14], atol=1e-5)


def test_a_bake_without_a_certificate_records_nothing_of_it(there):
    assert main([*BAKE, "-o", "bare/"]) == 0
    (record,) = there.glob("bare/shots/*/*/bake.json")
    assert "certificate" not in record.read_text()


def test_pairs_that_do_not_count_are_told(there, capsys):
    file = load_model("model.safetensors")
    garment = file.scene.garment
    points = garment.mesh.points.copy()
    points[len(points) // 2] = [-1.3, 1, -1.2] * points[len(points) // 2] + [0, 0.007, 0]  # through the opposite side
    crossed = replace(garment, mesh=replace(garment.mesh, points=points))
    save_model("crossed.safetensors", replace(file, scene=replace(file.scene, garment=crossed)))
    assert main(["bake", "crossed.safetensors", *BAKE[2:], "-o", "crossed.usda", "--range", "0-1", "--certify"]) == 0
    assert "that intersect in the bind pose, or that stitches join, do not count" in capsys.readouterr().err


def test_layers_hold_it_too(there):
    assert main([*BAKE, "-o", "layers/", "--certify", *MIDDLE]) == 0
    (path,) = there.glob("layers/shots/*/*/anim.usdc")
    faces, shot = skinned("plain.usda")[1], Shot(path)
    assert not any(len(self_intersections(shot.garment_points(time), faces)) for time in shot.frame_times)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            ["--refine", "1", "--refined-output", "points"],
            "what a certificate moves is put on joints and blendshapes",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(there, capsys, more, said):
    assert main([*BAKE[:-1], "-o", "none.usda", "--certify", *more]) == 2
    assert said in capsys.readouterr().err and not (there / "none.usda").exists()


def test_a_missing_library_is_told_before_work(there, capsys, monkeypatch):
    monkeypatch.setattr("ssilk_core.delivery.bake.certificate.requirements.NEEDED", ("no_such_library",))
    assert main([*BAKE, "-o", "none.usda", "--certify"]) == 2
    assert "pip install 'ssilk[certify]'" in capsys.readouterr().err and not (there / "none.usda").exists()


def test_an_ipctk_that_cannot_be_loaded_is_told_before_any_work(tmp_path, monkeypatch):
    (tmp_path / "ipctk.py").write_text("raise ImportError('libtbb.so.12: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "ipctk", raising=False)
    with pytest.raises(
        SsilkError, match=r"^--certify: ipctk cannot be loaded: libtbb\.so\.12: .*force-reinstall ipctk"
    ):
        need_certifier()
