# SPDX-License-Identifier: Apache-2.0
"""Pages: energies of points, charts that show their peaks, words that cannot become markup."""

import json
import re
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from ssilk_core.cli.report import _told
from ssilk_core.delivery.report.figures import learning_of, section_of
from ssilk_core.delivery.report.page import Section, facts, figure, flattened, page, table
from ssilk_core.delivery.report.shots import ShotGarment, shot_sections
from ssilk_core.delivery.report.terms import BARE, SHARE, SHOWN, STRETCH, TermsMeter, worst_frames
from ssilk_core.delivery.report.verdict import verdict
from ssilk_core.errors import SsilkError
from ssilk_core.physics.intersections.figures import SelfIntersections
from ssilk_core.physics.skin.figures import ShownSkin
from ssilk_core.quality.charts import ChartPanel, svg_chart
from ssilk_core.quality.kept_rows import UNFINISHED
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.mesh.joined import joined

CLOTH = Fabric("toy", density=0.2, contact_model="vertex", margin=0.0, thickness=0.0, collision=7.0)


@pytest.fixture
def sheet(toy_grid) -> Mesh:
    points, faces = toy_grid(12, 5)
    return Mesh("/sheet", points, faces)


def ball(radius: float = 0.3, subdivisions: int = 4) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh("/ball", np.asarray(sphere.vertices), np.asarray(sphere.faces))


def test_a_sheet_that_falls_freely_has_the_energies_of_one(sheet):
    meter, times = TermsMeter(sheet, None, CLOTH, 50.0), np.arange(6) / 50
    for time in times:
        meter.add(sheet.points - [0, 4.9 * time**2, 0], None, 0.0)
    mass = 0.2 * 0.55 * 0.2
    np.testing.assert_allclose(meter.values["stretch"], 0, atol=1e-6)
    np.testing.assert_allclose(meter.values["gravity"], -mass * 9.81 * 4.9 * times**2, atol=1e-9)
    inertia = [0, 0, *[mass * (9.8 / 50**2) ** 2 * 50**2 / 2] * 4]
    np.testing.assert_allclose(meter.values["inertia"], inertia, atol=1e-9)
    np.testing.assert_allclose(meter.values["total"], np.add(meter.values["gravity"], inertia), atol=1e-5)


def test_what_is_inside_the_body_is_counted_and_costs_its_depth(sheet):
    """Far from the origin: points are taken about the garment, where single precision is fine."""
    body, far = ball(0.24), np.array([4000.0, 0, -9000])
    meter = TermsMeter(sheet, body, CLOTH, 30.0)
    points = sheet.points + [0, 0.275, 0]  # its middle in the ball's
    meter.add(points + far, body.points + far, 1.0)
    depth = 0.24 - np.linalg.norm(points, axis=1)
    assert meter.values[SHARE] == [pytest.approx(100 * np.mean(depth > 0), abs=2)]
    assert meter.values["collision"][0] == pytest.approx(7.0 * (depth.clip(0) ** 2).sum(), rel=0.03)
    assert meter.values["gravity"][0] == pytest.approx(9.81 * 0.022 * 0.275, rel=1e-6)


def test_skin_that_shows_through_a_sheet_is_a_cap_of_the_ball(toy_grid):
    """A wide sheet in front of a ball, then 20 mm behind its foremost point: a cap of height 20 mm shows.

    When it is lifted off by 50 mm, nothing shows and a rim is bare.
    """
    points, faces = toy_grid(40, 40, height=1.0, width=1.0)
    cover = Mesh("/cover", points + [0, 0.5, -0.31], faces)
    body = ball()
    meter = TermsMeter(cover, body, CLOTH, 30.0)
    for time, depth in ((1001.0, 0.0), (1001.5, 0.03), (1002.0, -0.05)):
        meter.add(cover.points + [0, 0, depth], body.points, time)
    found = meter.shown_skin("shot")
    # A ray along the normal at an angle a from the axis meets the plane at d / cos(a) from the centre.
    first, second, third = 1 - 0.31 / 0.38, 1 - 0.28 / 0.3, 1 - 0.36 / 0.38
    assert found.covered == pytest.approx(8000 * first / 2, rel=0.02)
    assert meter.values[SHOWN] == [0, pytest.approx(100 * second / first, rel=0.05), 0]
    assert meter.values[BARE] == [0, 0, pytest.approx(100 * (1 - third / first), rel=0.05)]
    assert (found.clip, found.frame, found.regions) == ("shot", 1001.5, {})
    assert 100 * found.worst == meter.values[SHOWN][1] and found.mean == found.worst / 3
    assert 100 * found.worst_bare == meter.values[BARE][2] and found.bare == found.worst_bare / 3


def test_frames_that_are_not_finite_are_counted_and_named_by_their_time_code(toy_grid, monkeypatch):
    monkeypatch.setattr("ssilk_core.delivery.report.shots.WIDTH", 60)
    monkeypatch.setattr("ssilk_core.delivery.report.shots.HEIGHT", 80)
    points, faces = toy_grid(12, 12, height=0.3, width=0.3)
    cover, body = Mesh("/cover", points + [0, 0.15, -0.31], faces), ball(subdivisions=2)

    class Lost:
        fps, frame_times = 30.0, [1001.0, 1002.0, 1003.0, 1004.0, 1005.0, 1006.0]
        meshes = (
            SimpleNamespace(name="Cover", faces=faces, is_garment=True, colour=None, is_rider=False),
            SimpleNamespace(name="Ball", faces=body.faces, is_garment=False, colour=None, is_rider=False),
        )

        def points(self, time: float) -> list[np.ndarray]:
            lost = np.nan if time in (1002, 1006) else 0.02 * (time == 1005)
            return [cover.points + [0, 0, lost], body.points]

    opening, playing, worst, energies = shot_sections(Lost(), [ShotGarment(0, cover, CLOTH)], {1: body})
    assert "it is lost and skin shows through" in opening.body and playing.plays
    assert "not finite in 2 of 6 frames, first in frame 1002, at 0.03 s" in opening.body
    assert "not finite in 2 of 6 frames, first in frame 1002." in energies.body and "nan" not in energies.body
    assert "all triangles (100 %) as intersecting others" in energies.body
    figures = energies.figures["Cover"]
    assert figures["non-finite frames"] == 2 and figures["shown_skin"]["frame"] == 1002
    assert "A: frame 1005, at 0.13 s, " in worst.body and "frame 1002" not in worst.body


def test_a_verdict_tells_what_is_wrong_where_and_when():
    values = {SHOWN: np.array([0.0, 0.0, 0.8]), STRETCH: np.array([3.0, 21.0, 4.0]), SHARE: np.zeros(3)}
    skin = ShownSkin(frames=3, covered=100, mean=0.0027, worst=0.008, bare=0.12, worst_bare=0.2, clip="c", frame=13,
                     regions={"LeftArm": 1.0})  # fmt: skip
    crossed = SelfIntersections(
        frames=1, triangles=9, mean=0.031, worst=0.25, clip="c", frame=11, regions={"LeftArm": 1.0}
    )
    body = verdict("Cape", values, skin, crossed, [11, 12, 13], 30.0).body
    assert "Look at Cape: skin shows through and the cloth stretches." in body
    assert "0.267 % of the covered skin shows on average, and 0.80 % in frame 13, at 0.07 s, most at LeftArm" in body
    assert "; 12.0 % is bare, 20.0 % at most." in body
    assert "stretch by at most 4 % as a rule, and by 21 % in frame 12, at 0.03 s" in body and "At most" not in body
    share = "3.10 % of its triangles intersect others of it on average, and 25.0 % in frame 11."
    assert f"{share} One frame in 4 is counted." in body
    lost = {**values, STRETCH: np.array([np.nan, 21.0, 4.0])}
    told = verdict("Cape", lost, skin, crossed, [11, 12, 13], 30.0).body
    assert f"{share} One frame in 4 is counted, and one that is not finite as 100 %." in told
    flat = replace(crossed, mean=0.0, worst=0.0)
    calm = verdict("Cape", {name: np.zeros(3) for name in values}, None, flat, [11, 12, 13], 30.0).body
    assert "Cape holds" in calm and "skin" not in calm
    assert "intersect" not in calm
    few = verdict("Cape", {**values, SHARE: np.array([0.0, 0.0368, 0.0])}, skin, crossed, [11, 12, 13], 30.0).body
    assert "At most 0.04 % of its vertices are inside the body, in frame 12" in few
    assert "Frames are time codes of the shot." in few and "limb" not in few
    for pierced, said in (
        (0.018, "A limb is through the cloth in 1.8 % of the frames (LeftHand in 1.2 %)"),
        (0.0, "No limb is"),
    ):
        limbs = replace(skin, pierced=pierced, limbs={"LeftHand": 0.012} if pierced else {})
        assert said in verdict("Cape", values, limbs, crossed, [11, 12, 13], 30.0).body
    assert "skin that the cloth covers in the bind pose" in few and "Covered skin" not in calm


def test_figures_are_printed_in_words():
    figures = dict.fromkeys(("mean", "worst", "bare", "worst_bare"), 0.0)
    skin = asdict(ShownSkin(frames=3, covered=100, clip="c", frame=1, regions={}, **figures))
    told = _told({"Cape": {"shown_skin": skin, "non-finite frames": 2}, "Belt": {"non-finite frames": 0}})
    assert told == {
        "Cape": "0.000% of the covered skin shows, 0.00% is bare (0.00% at most)",
        "Cape: frames that are not finite": 2,
        "Belt": "it covers no skin",
    }


def test_bodies_are_joined_in_their_order():
    whole = joined([ball(0.1), ball(0.2)])
    count = ball().vertex_count
    assert whole.vertex_count == 2 * count and whole.faces.max() == 2 * count - 1 and joined([]) is None
    np.testing.assert_array_equal(whole.faces[len(whole.faces) // 2 :], ball().faces + count)


def test_the_worst_frames_are_apart():
    values = np.zeros(100)
    values[[10, 11, 40, 80]] = 5, 6, 3, 4
    assert worst_frames(values, 3, 5) == [11, 80, 40]
    assert worst_frames(values, 9, 200) == [11]


def test_words_cannot_become_markup():
    evil = "<img src=x onerror=alert(1)>\"'&"
    text = page(evil, [Section(evil, table([evil], [[evil]]) + facts({evil: evil}))])
    text += svg_chart(
        evil, [[ChartPanel(title=evil, x=evil, y=evil, points={evil: [(0.0, 1.0, evil)]}, marks={evil: (0, 1)})]]
    )
    assert "<img" not in text and text.count("&lt;img") >= 11


def test_a_page_refers_to_nothing_outside():
    picture = figure(np.zeros((4, 6, 3), dtype=np.uint8), "black")
    chart = svg_chart("chart", [[ChartPanel(x="s", y="J", curves={"one": ([0, 1], [2, 3])})]])
    text = page("page", [Section("one", picture + chart)])
    targets = re.findall(r'(?:src|href|url)\s*[=(]\s*"?([^">]{0,22})', text)
    assert "data:image/png;base64," in targets and len(targets) > 1
    assert all(target.startswith(("data:", "#")) for target in targets)
    assert "default-src 'none'" in text and "<script" not in text


def test_nested_values_are_flattened_to_words():
    found = flattened({"a": {"b": [1, 2.5], "c": None}, "d": True})
    assert found == {"a.b": "1, 2.5", "a.c": "–", "d": "yes"}


OUTCOME = {
    "name": "x", "group": "motion", "verdict": "breaks", "said": "", "seconds": 1.0,
    "measured": {
        "extent": {"frames": 5, "finite": False, "speed": None, "distance": 1.0, "allowed": 1.0, "latent": 2.0,
                   "growth": 1.0, "recovered": 0},
        "error": None, "unit": "", "note": "",
    },
}  # fmt: skip
POINT = {
    "garment": "g", "model": "m", "swept": "shapes", "variant": "16 blendshapes", "shapes": 16, "joints": 2,
    "influences": 4, "precision": "float32", "fps": 30.0, "refine": 0, "milliseconds": 0.5, "high": 0.6,
    "torch": None, "operations": 10, "memory": 10, "model_bytes": 1000, "shot_bytes": 1000.0,
    "total": 1.5, "excess": 0.0, "collisions": 0.0, "position": 0.002, "velocity": 0.0,
    "shown_skin": None, "solving": None,
    "intersections": {"frames": 1, "triangles": 9, "mean": 0.1, "worst": 0.2, "clip": "a", "frame": 1.0,
                      "regions": {}},
}  # fmt: skip
FIGURES = {
    "Extremes": ({"model": "m", "inputs": {"quick": True}, "outcomes": [OUTCOME]}, "breaks"),
    "Trade": ({"asked": {"clips": ["a"]}, "points": [POINT]}, "0.002"),
    "Evaluation": ({"units": "SI", "figures": [{"method": "LBS", "figures": {"total": 2.5}}]}, "figures.total"),
}


@pytest.mark.parametrize("title", FIGURES)
def test_figures_become_sections_by_what_they_hold(tmp_path, title):
    document, word = FIGURES[title]
    path = tmp_path / "figures.json"
    path.write_text(json.dumps(document))
    section = section_of(path)
    assert section.title == title and word in section.body
    if title == "Extremes":
        assert '<tr class="bad">' in section.body and "nan" in section.body


def test_an_unfinished_evaluation_says_so(tmp_path):
    document, word = FIGURES["Evaluation"]
    path = tmp_path / "figures.json"
    path.write_text(json.dumps({UNFINISHED: "<b>", "inputs": {"secret": 1}, **document}))
    section = section_of(path)
    assert section.title == "Evaluation, unfinished" and word in section.body and "secret" not in section.body
    assert section.body.startswith('<p class="note">Unfinished: rows are missing; the same command')


@pytest.mark.parametrize(
    ("text", "said"),
    [("{", "not a JSON file"), ("[1]", "not figures of a known kind"), ('{"points": [{}]}', "incomplete ('garment')"),
     ('{"outcomes": [{"name": 1}]}', "'group' is missing")],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, text, said):
    path = tmp_path / "figures.json"
    path.write_text(text)
    with pytest.raises(SsilkError, match=re.escape(said)):
        section_of(path)


def test_a_learning_curve_marks_its_best(tmp_path):
    score, path = {"total": 2.0, "collisions": 0.01}, tmp_path / "model.curve.json"
    assert learning_of(path) == []
    points = [{"seconds": 9.0 * i, "validation": {**score, "total": abs(i - 2) + 0.5}} for i in range(5)]
    path.write_text(json.dumps({"lbs": score, "points": points}))
    (section,) = learning_of(path)
    assert "Best: 0.5 J at 18 s. Linear blend skinning: 2 J, 1.00% inside the body." in section.body
    assert section.body.count("<svg") == 1 and section.body.count(">best</text>") == 2
    shown = {
        "frames": 9,
        "covered": 80,
        "mean": 0.01,
        "worst": 0.02,
        "bare": 0.25,
        "worst_bare": 0.5,
        "clip": "walk",
        "frame": 3,
        "regions": {"Hips": 1.0},
    }
    for point in points:
        point["validation"]["shown_skin"] = shown
        point["validation"]["intersections"] = POINT["intersections"]
    path.write_text(json.dumps({"lbs": score, "points": points}))
    (section,) = learning_of(path)
    assert section.body.count(">best</text>") == 4
    assert "At the best, 10.000% of the triangles intersect others" in section.body
    assert (
        "1.000% of the covered skin shows, 2.00% in the worst frame (walk, frame 3; most at Hips 100%)"
        in section.body
    )
    path.write_text(json.dumps({"lbs": score, "points": []}))
    assert learning_of(path) == []
    path.write_text(json.dumps({"points": points}))
    with pytest.raises(SsilkError, match="incomplete \\('lbs'\\)"):
        learning_of(path)
