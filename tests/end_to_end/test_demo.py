# SPDX-License-Identifier: Apache-2.0
"""The demo: models that ship fit what it builds, and all that it does is commands that a user can type."""

from __future__ import annotations

import io
import shlex
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdSkel
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path
from ssilk_usd.writing.files import write_garment, write_motion

from ssilk_core.cli import demo, main, view
from ssilk_core.cli.main import parser
from ssilk_core.cli.options.scene import load_scene
from ssilk_core.delivery.bake import BakeRequest, load_rollout
from ssilk_core.delivery.view.shots import Look
from ssilk_core.demo import garments, motions, shipped
from ssilk_core.events import silent
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import ModelFile, load_model, save_model
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.intersections.pairs import intersections_between
from ssilk_core.scene.assets import PINNED, Garment, Motion, Scene, Skeleton
from ssilk_core.training.wardrobe.listing import read_list

BUILT = (*garments.GARMENTS, *garments.OVER)
SHIPPED = (*BUILT, demo.FAMILY)
SHORT = shlex.split(
    "--set iterations=2 --set static_fraction=0.5 --set validate_every=2 --set valid_frames=4 --set batch=1 --set "
    "pretraining_batch=4 "
    "--set window=3"
)


@cache
def wardrobe() -> dict[str, Garment]:
    character, build = read_character(demo_body_path()), garments.build_garment
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(garments, "build_garment", lambda name, _: kept(name))  # outer garments ask for inner ones
        kept = cache(lambda name: build(name, character))
        return {name: kept(name) for name in BUILT}


@contextmanager
def briefly() -> Iterator[None]:
    """A wardrobe that is built once, a shot of four frames instead of 225, small pictures, and two short motions."""
    built, every, shot = wardrobe(), motions.training_motions, motions.demo_shot

    def few(skeleton: Skeleton) -> list[Motion]:
        return [motion.clip(0, 8) for motion in every(skeleton)[:2]]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(garments, "build_garment", lambda name, character: built[name])
        patch.setattr(motions, "training_motions", few)
        patch.setattr(motions, "demo_shot", lambda skeleton: shot(skeleton).clip(60, 64))
        patch.setattr(view, "_look", lambda options, film: Look(width=96, height=128, samples=1))
        yield


@pytest.fixture
def brief() -> Iterator[None]:
    with briefly():
        yield


@pytest.fixture(scope="module")
def drafted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a whole demo of the cape, and what it said."""
    folder, said = tmp_path_factory.mktemp("drafted"), io.StringIO()
    with briefly(), redirect_stderr(said):
        assert main(["demo", "-o", str(folder), *SHORT]) == 0
    return folder, said.getvalue()


def rigged(garment: str, folder: Path) -> Scene:
    """Return the scene of the stage that the demo's own command rigs, unless a demo has rigged it already.

    It has few proxies then: what is looked at is the garment.
    """
    chosen = Namespace(output=folder, garment=garment, settings=[], pretrained=True)
    rig = demo._shipped(chosen)[0]
    assert rig[0] == "rig"
    if not Path(rig[-1]).exists():
        write_garment(folder / "wardrobe" / f"{garment}.usdc", wardrobe()[garment].mesh)
        assert main([*rig, "--proxies", "4"]) == 0
    return load_scene(parser().parse_args(["rig", rig[-1], "-o", "unused"]), silent)


@pytest.mark.parametrize("name", (*garments.GARMENTS, demo.FAMILY))
def test_shipped_models_fit_what_the_demo_builds(name, drafted, tmp_path):
    """The garment and its classes; a model keeps its own weights and rig. Settling may move the garment."""
    garment = shipped.garment_of(name)
    folder = drafted[0] if garment == "cape" else tmp_path
    built, model = rigged(garment, folder), load_model(shipped.shipped_path(name))
    mine, theirs = model.scene, replace(built, character=replace(built.character, bodies=()))
    np.testing.assert_array_equal(mine.classes, theirs.classes)
    assert mine.garment.mesh.faces.shape == theirs.garment.mesh.faces.shape
    np.testing.assert_allclose(mine.garment.mesh.points, theirs.garment.mesh.points, atol=shipped.TOLERANCE)


@pytest.mark.parametrize("garment", SHIPPED)
def test_shipped_models_do_what_they_did_when_they_were_packed(garment, tmp_path):
    """A network whose inputs were scaled anew since would load, and flail."""
    model, shot = shipped.shipped_path(garment), tmp_path / "shot.usdc"
    file, skeleton = load_model(model), read_character(demo_body_path()).skeleton
    write_motion(shot, motions.demo_shot(skeleton), skeleton)
    bake = load_rollout(BakeRequest(model=str(model), stage=str(demo_body_path()), motion=str(shot)))
    points = torch.tensor(np.stack(list(bake.vertices())), dtype=torch.float32)
    energy = GarmentEnergy(file.scene.garment.mesh, file.fabric, device=torch.device("cpu"))
    found = float(energy.stretch(points.permute(1, 2, 0).contiguous()).mean())
    assert found == pytest.approx(file.provenance["shipped"]["stretch on the demo's shot [J]"], rel=0.01)


@pytest.mark.parametrize("garment", SHIPPED)
def test_shipped_models_tell_files_but_no_folders(garment):
    model = load_model(shipped.shipped_path(garment))
    bodies = model.bodies.family.bodies.names if model.bodies else ()
    paths = (*model.provenance["inputs"], *model.provenance["motions"], model.scene.garment.mesh.path, *bodies)
    for name in paths:
        assert name and "/" not in name.partition(":/")[0]


def typed(said: str) -> list[list[str]]:
    """Return the commands that the demo printed; each must be one that the command line takes."""
    commands = [shlex.split(line)[2:] for line in said.splitlines() if line.startswith("$ ssilk ")]
    for command in commands:
        parser().parse_args(command)
    return commands


@pytest.mark.usefixtures("brief")
def test_the_shipped_model_is_filmed_without_any_training(tmp_path, monkeypatch, capsys):
    """By commands that the demo with a training runs as well, and that are not run again here."""
    ran = []
    monkeypatch.setattr(sys.modules[main.__module__], "main", lambda words: ran.append(words) or 0)
    assert main(["demo", "--pretrained", "-o", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert ran == typed(said)
    assert [command[0] for command in typed(said)] == ["rig", "bake", "bake", "view", "view"]
    assert "warning" not in said
    made = load_model(shipped.shipped_path("cape")).provenance
    chain = [made]
    while "base" in chain[-1]:
        chain.append(chain[-1]["base"])
    first, *later = reversed(chain)
    alone = ["" if each.get("whole") else " of the stepper alone" for each in later]
    trained = f"{first['iteration']:,} iterations" + "".join(
        f", then {each['iteration']:,}{words}" for each, words in zip(later, alone)
    )
    assert "of the stepper alone" in trained and not alone[-1]
    assert f"shipped cape: {trained} on {len(made['motions'])} motions, seed" in said
    assert {path.name for path in tmp_path.iterdir()} == {"wardrobe", "motions", "shot.usdc"}


def first_points(shot: Path) -> dict[str, np.ndarray]:
    """Points (V, 3) of the meshes of a shot in its first frame, as UsdSkel skins them."""
    stage, cache, found = Usd.Stage.Open(str(shot)), UsdSkel.Cache(), {}
    at = Usd.TimeCode(stage.GetStartTimeCode())
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Root):
            cache.Populate(UsdSkel.Root(prim), Usd.PrimDefaultPredicate)
            UsdSkel.BakeSkinning(UsdSkel.Root(prim), Gf.Interval(at.GetValue()))
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            found[prim.GetName()] = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(at))
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("brief")
def test_one_model_is_filmed_on_three_bodies(tmp_path, capsys):
    assert main(["demo", "--garment", "cape_family", "-o", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    commands = typed(said)
    assert [command[0] for command in commands] == ["bake", "bake", "bake", "view", "view"]
    assert {command[1] for command in commands[:3]} == {str(shipped.shipped_path("cape_family"))}
    assert commands[-1][1:4] == [str(tmp_path / f"cape_{name}.usdc") for name in ("neutral", "tall", "heavy")]
    neutral, tall, heavy = (first_points(tmp_path / f"cape_{name}.usdc") for name in ("neutral", "tall", "heavy"))
    high = [np.ptp(shot["Mesh"][:, 1]) for shot in (neutral, tall, heavy)]
    assert high[1] > 1.1 * high[0] and abs(high[2] - high[0]) < 0.1 * high[0]
    assert all(shot["Mesh"][:, 1].min() == pytest.approx(0, abs=0.03) for shot in (neutral, tall, heavy))
    assert min(np.abs(shot["Cape"] - neutral["Cape"]).max() for shot in (tall, heavy)) > 0.03


@pytest.mark.slow
@pytest.mark.usefixtures("brief")
def test_one_model_is_filmed_in_three_fabrics(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(view, "run", lambda *_: 0)  # three shots are drawn side by side above
    assert main(["demo", "--garment", "cape_fabrics", "-o", str(tmp_path)]) == 0
    commands = typed(capsys.readouterr().err)
    assert [command[0] for command in commands] == ["rig", "bake", "bake", "bake", "view", "view"]
    assert commands[-1][1:4] == [command[-1] for command in commands[1:4]]
    assert {command[1] for command in commands[1:4]} == {str(shipped.shipped_path("cape"))}
    names = [command[command.index("--fabric") + 1] for command in commands[1:4]]
    assert names == ["silk", "default", "leather"]
    silk, own, leather = (first_points(tmp_path / f"cape_{name}.usdc")["Cape"] for name in names)
    assert 1e-3 < np.abs(leather - own).max() < 0.2 and 1e-3 < np.abs(leather - silk).max() < 0.2


def test_the_draft_is_trained_and_filmed_beside_what_ships(drafted):
    folder, said = drafted
    commands = typed(said)
    both = [*("rig", "bake", "bake", "view", "view"), *("train", "bake", "view", "view")]
    assert [command[0] for command in commands] == both
    rates = [command[command.index("--fps") + 1] for command in (commands[4], commands[-1])]
    assert rates == ["15", "30"] and "has every second frame" in said
    names = ("lbs.usdc", "cape_draft.usdc", "cape_shipped.usdc")
    assert commands[-1][1:4] == [str(folder / name) for name in names]
    made = ("cape_stage.usdc", "lbs.usdc", "cape_shipped.usdc", "shipped.png", "shipped.mp4")
    for name in (*made, "cape_draft.safetensors", "draft.mp4", "draft.png"):
        assert (folder / name).stat().st_size > 1000


@pytest.mark.parametrize("garment", garments.OVER)
def test_a_garment_that_ships_over_another_fits_it(garment):
    """It starts clear of the one that ships, over which it was trained; what lay over that is no longer pinned."""
    inner = shipped.shipped_path(garments.OVER[garment][1])
    model, below = load_model(shipped.shipped_path(garment)), load_model(inner).scene.garment.mesh
    assert model.provenance["over"] == {inner.stem: sha256(inner)}
    mesh, built = model.scene.garment.mesh, wardrobe()[garment].mesh
    np.testing.assert_allclose(mesh.points, built.points, atol=shipped.TOLERANCE)
    assert not len(intersections_between(mesh.points, mesh.faces, below.points, below.faces))
    assert not (model.scene.classes == PINNED).any()


@pytest.mark.slow
@pytest.mark.usefixtures("brief")
def test_an_outfit_is_baked_and_filmed_and_its_list_written(tmp_path, capsys):
    assert main(["demo", "--garment", "cape_over_dress", "-o", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert [command[0] for command in typed(said)] == ["bake", "bake", "view", "view"]
    assert "triangles that intersect hooded_dress: 0.0" in said.rpartition("$ ssilk bake")[2]
    for folder in ("outfit", "outfit_lbs"):
        shots = tmp_path / folder / "shots" / "shot"
        assert {each.parent.name for each in shots.glob("*/anim.usdc")} == {"cape_over_dress", "hooded_dress"}
    assert (tmp_path / "shipped.mp4").stat().st_size > 1000
    inner, outer = read_list(tmp_path / "outfit.toml")
    assert (inner.name, outer.name, outer.over) == ("hooded_dress", "cape_over_dress", ("hooded_dress",))
    for entry in (inner, outer):  # what the garments are is tested above, and lists in `test_outfit`
        asked = entry.located(tmp_path)
        assert all(Path(path).exists() for path in (asked["stage"], asked["garment"], *asked["motions"]))


def thinner(model: ModelFile) -> ModelFile:
    mesh = model.scene.garment.mesh
    bare = replace(mesh, faces=mesh.faces[1:], polygon_counts=None, polygon_indices=None, uvs=None)
    return replace(model, scene=replace(model.scene, garment=replace(model.scene.garment, mesh=bare)))


def longer(model: ModelFile) -> ModelFile:
    mesh = model.scene.garment.mesh
    moved = replace(mesh, points=mesh.points * 1.01)
    return replace(model, scene=replace(model.scene, garment=replace(model.scene.garment, mesh=moved)))


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (None, "the shipped model is missing"),
        (thinner, "trained on a garment of 2718 vertices and 5225 triangles"),
        (longer, "m away from /Cape"),
    ],
)
def test_a_shipped_model_that_is_missing_or_of_another_garment_is_refused(
    change: Callable[[ModelFile], ModelFile] | None, words, tmp_path, monkeypatch, capsys
):
    model = load_model(shipped.shipped_path("cape"))
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    if change:
        save_model(shipped.shipped_path("cape"), change(model))
    assert main(["demo", "--pretrained", "-o", str(tmp_path / "out")]) == 2
    error = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("error: "))
    assert words in error and str(tmp_path) in error and error.endswith(".")
    assert not (tmp_path / "out" / "shipped.mp4").exists()
