# SPDX-License-Identifier: Apache-2.0
"""The skin that shows, as a bake tells it, counted again: OpenUSD bakes the file's skinning, and all rays are solved.

Nothing of the count is shared but the points on the skin; others of another number and seed tell the same.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdSkel
from ssilk_usd.reading.facts import read_provenance

from ssilk_core.cli import main
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.physics.intersections.cloth import ClothIntersections
from ssilk_core.physics.intersections.figures import EVERY, NOT_COUNTED
from ssilk_core.physics.skin.covered_points import SEED, SKIN_POINTS, spread_points
from ssilk_core.scene.assets import PINNED, Mesh

COVER, SHOW = 0.08, 0.03  # [m]
FRAMES = 5


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    """A model whose blendshapes draw the loose cloth towards the axis of the pillar, so that skin shows."""
    folder = toy.copy(tmp_path_factory.mktemp("shown"))
    toy.write_clip(folder / "brief.usda", frames=FRAMES)
    file = load_model(folder / "model.safetensors")
    inward, free = file.parameters["decoder.shapes"].copy(), file.scene.classes != PINNED
    inward[:, [0, 2]] = -0.3 * file.scene.garment.mesh.points[free][:, [0, 2], None]
    last = max(name for name in file.parameters if re.fullmatch(r"output.\d.bias", name))
    active = file.parameters[last].copy()
    active[: inward.shape[2]] += np.linspace(0.2, 0.5, inward.shape[2])
    parameters = {**file.parameters, "decoder.shapes": inward, last: active}
    save_model(folder / "model.safetensors", replace(file, parameters=parameters))
    return folder


def posed_by_usd(path) -> tuple[list[Mesh], np.ndarray, np.ndarray]:
    """Body and garment at rest, and their points in each frame, (F, V, 3), once UsdSkel has baked the skinning."""
    stage = Usd.Stage.Open(str(path))
    prims = [stage.GetPrimAtPath(f"/Hero/{name}") for name in ("Body", "Skirt")]
    rest = [np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), dtype=np.float64) for prim in prims]
    faces = [np.array(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get()).reshape(-1, 3) for prim in prims]
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim()), Gf.Interval.GetFullInterval())
    posed = [
        np.array([UsdGeom.Mesh(prim).GetPointsAttr().Get(float(time)) for time in range(FRAMES)], dtype=np.float64)
        for prim in prims
    ]
    return [Mesh(str(prim.GetPath()), *each) for prim, *each in zip(prims, rest, faces)], *posed


def met(body: Mesh, points: np.ndarray, cloth: np.ndarray, places) -> tuple[np.ndarray, np.ndarray]:
    """Which points on the skin have cloth (T, 3, 3) above and beneath, along the normals of their triangles."""
    faces, weights = places
    corners = points[body.faces[faces]]
    start, normal = np.einsum("pc,pcx->px", weights, corners), np.cross(*np.moveaxis(np.diff(corners, axis=1), 1, 0))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    a, first, second = cloth[:, 0], cloth[:, 1] - cloth[:, 0], cloth[:, 2] - cloth[:, 0]
    above, beneath = np.zeros((2, len(start)), dtype=bool)
    for some in np.array_split(np.arange(len(start)), 20):
        away = start[some, None] - a
        across = np.cross(normal[some, None], second)
        turned, volume = np.cross(away, first), (first * across).sum(-1)
        volume[volume == 0] = np.nan  # parallel to the ray
        u, v, distance = (
            (one * other).sum(-1) / volume
            for one, other in ((away, across), (normal[some, None], turned), (second, turned))
        )
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)
        above[some] = (inside & (distance >= 0) & (distance <= COVER)).any(axis=1)
        beneath[some] = (inside & (distance < 0) & (distance >= -SHOW)).any(axis=1)
    return above, beneath


def counted(path, count: int, seed: int) -> tuple[int, np.ndarray, np.ndarray]:
    """How many points are covered, and the shares of them that show and that are bare in each frame, (F,)."""
    (body, skirt), bodies, skirts = posed_by_usd(path)
    faces, weights = spread_points(body, count, seed)
    covered, _ = met(body, body.points, skirt.points[skirt.faces], (faces, weights))
    places = faces[covered], weights[covered]
    found = [met(body, points, cloth[skirt.faces], places) for points, cloth in zip(bodies, skirts)]
    shows = [(beneath & ~above).mean() for above, beneath in found]
    bare = [(~beneath & ~above).mean() for above, beneath in found]
    return int(covered.sum()), np.array(shows), np.array(bare)


SOLVED = [pytest.param(words, marks=pytest.mark.slow) for words in (["--refine", "2"], ["--quality", "latent"])]


@pytest.mark.parametrize("words", [[], *SOLVED], ids=" ".join)
def test_the_figure_is_that_of_the_written_file(folder, monkeypatch, capsys, words):
    monkeypatch.chdir(folder)
    bake = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "brief.usda", "-o", "shot.usdc"]
    assert main([*bake, *words]) == 0
    said, printed = read_provenance("shot.usdc")["shown_skin"], capsys.readouterr().err
    covered, shows, bare = counted("shot.usdc", SKIN_POINTS, SEED)
    assert shows.mean() > 5e-4  # or else nothing would be compared
    few = 1 / covered  # a point may fall on either side where float32 rounds
    assert (said["covered"], said["frames"]) == (pytest.approx(covered, abs=2), FRAMES)
    assert said["mean"] == pytest.approx(shows.mean(), abs=few) and said["bare"] == pytest.approx(
        bare.mean(), abs=few
    )
    assert said["worst"] == pytest.approx(shows.max(), abs=few) and said["frame"] == shows.argmax()
    for name, figure in (("covered skin that shows", "mean"), ("bare", "bare")):
        told = re.search(rf"^ *{name}: ([0-9.]+)%$", printed, re.MULTILINE)
        assert float(told[1]) == pytest.approx(100 * said[figure], rel=1e-3, abs=0.01)
    crossed = read_provenance("shot.usdc")["intersections"]
    (_, skirt), _, skirts = posed_by_usd("shot.usdc")
    expected = ClothIntersections(skirt).counts(list(skirts[::EVERY]), range(0, FRAMES, EVERY))
    assert (crossed["frames"], crossed["triangles"]) == (len(expected.frames), len(skirt.faces))
    one = 1 / len(skirt.faces)  # a pair that merely touches may part where float32 rounds
    assert crossed["mean"] == pytest.approx(expected.shares.mean(), abs=2 * one, rel=1e-3)
    assert re.search(r"^ *triangles that intersect others: [0-9.]+%, the mean of 2 frames$", printed, re.MULTILINE)
    _, others, _ = counted("shot.usdc", 12_000, SEED + 1)
    assert others.mean() == pytest.approx(shows.mean(), rel=0.1, abs=1e-3)  # few points show


def test_a_bake_without_libigl_says_that_cloth_was_not_counted(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("ssilk_core.delivery.bake.counted.can_find", lambda: False)
    bake = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "brief.usda", "-o", "bare.usdc"]
    assert main(bake) == 0
    said = read_provenance("bare.usdc")
    assert said["intersections"] == {"none": NOT_COUNTED} and said["shown_skin"]["frames"] == FRAMES
    assert f"triangles that intersect others: {NOT_COUNTED}" in capsys.readouterr().err
