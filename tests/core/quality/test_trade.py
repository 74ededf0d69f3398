# SPDX-License-Identifier: Apache-2.0
"""The trade: what is measured of a variant is what it does, the front is the front, and sweeps can stop."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, Progress
from ssilk_core.network.checkpoint import model_file
from ssilk_core.network.latent_solver import LatentOptions, LatentRoller
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.network.runtime.stored import StoredPlayer
from ssilk_core.network.sampling import sample_pose
from ssilk_core.physics.energy import TERMS
from ssilk_core.quality.cost import ShotBytes, model_bytes, operations, stored_memory, stored_operations
from ssilk_core.quality.evaluation.methods import EvaluationScene, Network, build_take_set
from ssilk_core.quality.evaluation.record import recorded
from ssilk_core.quality.evaluation.solver_errors import solver_errors
from ssilk_core.quality.evaluation.takes import takes_of, within
from ssilk_core.quality.kept_rows import GO_ON
from ssilk_core.quality.reduction import ModelSize, Reducer
from ssilk_core.quality.trade.collision_cost import CollisionCost, measure_collisions
from ssilk_core.quality.trade.measure import VariantMeter
from ssilk_core.quality.trade.plot import trade_panels
from ssilk_core.quality.trade.point import TradePoint, front
from ssilk_core.quality.trade.shot_method import ShotMethod
from ssilk_core.quality.trade.sweep import Results, sweep
from ssilk_core.quality.trade.table import caption, collision_table, table
from ssilk_core.quality.trade.variants import PRECISIONS, WHOLE, other_network, variants
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import deform, resample, sample_motion

pytestmark = pytest.mark.usefixtures("few_contacts")

FPS = 30.0
COST = CollisionCost("triangles", 9, 1.0, 0.1, 0.0)


@pytest.fixture(scope="module")
def model(scene, toy_model):
    return toy_model(scene, scale=0.1, shapes=6).eval()


@pytest.fixture(scope="module")
def bench(scene, model, toy_motion):
    """A reducer, and a dressed garment with a take_set of two takes."""
    file = model_file(model, FABRICS["silk"], {})
    dressed = EvaluationScene(scene, file.fabric, FPS, torch.device("cpu"))
    takes = [
        take
        for name, frames in (("long", 50), ("short", 20))
        for take in takes_of(name, toy_motion(scene, frames), scene.character.skeleton, FPS)
    ]
    return Reducer(file, [toy_motion(scene, 60, speed=1.3)]), dressed, build_take_set(takes, dressed, file.joints)


@pytest.fixture(scope="module")
def meter(bench):
    def weigh(file, fps, stored):
        shapes = file.config.shapes if stored is None else stored.shot.deformer.shape_count
        return ShotBytes(1000.0 * shapes, 60.0)

    return VariantMeter("toy", *bench, weigh)


def chosen(meter: VariantMeter, name: str):
    return next(v for v in variants(meter.reducer.whole, FPS) if v.name == name)


@pytest.fixture(scope="module")
def points(meter) -> dict[str, TradePoint]:
    names = ("as trained", "2 blendshapes", "0 proxies", "int16", "float16", "15 frames/s", "1 iterations")
    sizes = {name: chosen(meter, name) for name in names if name != "2 blendshapes"}
    sizes["2 blendshapes"] = replace(
        sizes["as trained"], name="2 blendshapes", size=ModelSize(shapes=2, joints=2, influences=2)
    )
    return {name: meter.point(variant) for name, variant in sizes.items()}


def test_one_thing_is_swept_at_a_time_and_levels_come_last():
    whole = ModelSize(shapes=64, joints=20, influences=8)
    tried = list(variants(whole, FPS))
    base = tried[0]
    assert base.size == whole and len({(v.swept, v.name) for v in tried}) == len(tried)
    for variant in tried[1:]:
        changed = [k for k, v in vars(variant).items() if v != vars(base)[k] and k not in ("swept", "name", "size")]
        changed += [k for k, v in vars(variant.size).items() if v != vars(whole)[k]]
        assert len(changed) == 1 or variant.swept == "level", variant
    assert [v.name for v in tried if v.swept == "level"] == ["crowd", "game", "film", "latent", "hero"]
    names = [
        "1 iterations",
        "2 iterations",
        "1 in latents",
        "2 in latents",
        "4 in latents",
        "latent",
        "hero",
        "simulator",
    ]
    assert [v.name for v in tried if v.solved] == names
    assert not any(v.solved for v in variants(whole, FPS, solved=False))
    assert [v.name for v in other_network(whole, FPS)] == ["as trained", "crowd", "game", "film"]


def test_precisions_round_as_they_should():
    values = np.random.default_rng(0).normal(size=(50, 40)).astype(np.float32)
    np.testing.assert_array_equal(PRECISIONS["bfloat16"](values), torch.tensor(values).bfloat16().float().numpy())
    np.testing.assert_array_equal(PRECISIONS["float16"](values), torch.tensor(values).half().float().numpy())
    assert np.abs(PRECISIONS["int16"](values) - values).max() <= np.abs(values).max() / 32767


def test_the_whole_model_is_what_the_network_in_pytorch_is(meter, bench, model, points):
    reducer, dressed, take_set = bench
    network = Network(model, take_set)
    records = [recorded(dressed, take_set, network, take) for take in range(2)]
    total = sum(torch.cat([r.values[name] for r in records]) for name in TERMS)
    whole = points["as trained"]
    assert whole.total == pytest.approx(float(total.mean()), rel=1e-3)
    assert whole.position == whole.velocity == whole.excess == 0
    assert whole.model_bytes == model_bytes(reducer.file, pack=False)
    assert whole.shot_bytes == 6000 + 300 * 60


def test_errors_are_distances_and_speeds_from_the_whole_model(meter, bench, points):
    reducer, dressed, take_set = bench
    small = Player(reducer.reduce(ModelSize(shapes=2, joints=2, influences=2)).file)
    mass, squares, speeds = dressed.energy.mass.numpy(), [], []
    for take in take_set.takes:
        played = [player.play(take.motion) for player in (small, reducer.player)]
        mine, theirs = (np.stack([p.vertices(f) for f in range(take.frame_count)]) for p in played)
        squares.append(((mine - theirs) ** 2).sum(2) @ mass / mass.sum())
        speeds.append(((np.diff(mine - theirs, axis=0) * FPS) ** 2).sum(2) @ mass / mass.sum())
    found = points["2 blendshapes"]
    assert found.position == pytest.approx(np.sqrt(np.concatenate(squares).mean()), rel=1e-3)
    assert found.velocity == pytest.approx(np.sqrt(np.concatenate(speeds).mean()), rel=1e-3)
    assert found.excess == pytest.approx(found.total - points["as trained"].total)


def test_collisions_are_told_with_any_body(meter, scene):
    fabric = replace(FABRICS["silk"], margin=0.2)  # as wide as the gap between the toy's garment and its body
    dressed = EvaluationScene(scene, fabric, FPS, torch.device("cpu"))
    surface, points, few = measure_collisions(dressed, meter.take_set, meter.whole)
    body = dressed.body.pose(meter.take_set.character(0, range(50)))
    x = meter.whole.vertices(0, range(50))
    met, nearest = dressed.contacts.distances(dressed.energy.cloth.positions(x), body)
    assert surface.inside == pytest.approx(float((nearest[: len(x)] < 0).double().mean()))
    assert surface.collision == pytest.approx(float(dressed.energy.collision_at(met).mean()))
    assert surface.vertices == points.vertices == scene.character.merged_body().mesh.vertex_count
    assert few.vertices == -(-points.vertices // 4) and few.collision != points.collision
    assert len(collision_table([surface, points, few]).splitlines()) == 5


def test_what_costs_less_is_seen_to_cost_less(points):
    whole = points["as trained"]
    assert points["2 blendshapes"].operations < whole.operations and points["2 blendshapes"].memory < whole.memory
    assert points["int16"].model_bytes < whole.model_bytes and points["float16"].model_bytes < whole.model_bytes
    assert 0 < points["int16"].position < points["float16"].position < 1e-3
    assert points["15 frames/s"].shot_bytes == 6000 + 150 * 60


def test_refined_variants_are_counted_as_what_a_bake_stores(meter, bench, points):
    whole, found = points["as trained"], points["1 iterations"]
    assert found.total < whole.total and found.torch is None
    assert whole.solving is None and found.solving > 0
    method = ShotMethod("refined", meter.reducer.player, *bench[1:], fps=FPS, refine=1)
    stored = method.vertices(0, range(50))
    shot = method.shots[0]
    assert shot.deformer.shape_count == shot.own_shapes
    assert found.shot_bytes == 1000 * shot.own_shapes + 300 * 60
    shapes, skinning = stored_operations(shot.deformer).values()
    assert found.operations == shapes + skinning and skinning == operations(bench[0].file)["skinning"]
    assert shapes == 3 * shot.own_shapes * shot.deformer.scene.garment.mesh.vertex_count
    assert found.memory == stored_memory(shot.deformer)
    # What is measured is what is stored, and it is played by numpy as by the reference.
    motion, player = method.take_set.takes[0].motion, StoredPlayer(shot.deformer)
    for pose in shot.poses:
        np.testing.assert_allclose(player.vertices(motion, pose), deform(shot.deformer, motion, pose), atol=1e-5)
    first = deform(shot.deformer, motion, shot.poses[0])[0] - motion.translations[0, 0]
    np.testing.assert_allclose(stored[..., 0].numpy(), first, atol=1e-5)


@pytest.mark.slow
def test_the_simulator_goes_on_from_the_networks_first_two_states(meter, bench, model, monkeypatch):
    reducer, dressed, take_set = bench
    method = ShotMethod("simulator", reducer.player, dressed, take_set, fps=FPS, simulated=True)
    stored = method.vertices(1, range(20)).permute(2, 0, 1).numpy()
    assert len(method.solving) == 1 and method.shots[1].own_shapes > 0
    monkeypatch.setattr(ShotMethod, "_stored", lambda self, take, points: points)
    told: list[int] = []
    exact = ShotMethod(
        "simulator", reducer.player, dressed, take_set, fps=FPS, simulated=True, advanced=lambda: told.append(1)
    )
    points = exact.vertices(1, range(20)).permute(2, 0, 1).numpy()
    assert len(told) == 18
    np.testing.assert_allclose(stored, points, atol=5e-3)  # a bake's bound
    network = every_frame(reducer, take_set.takes[1].motion) - take_set.takes[1].motion.translations[0, 0]
    np.testing.assert_array_equal(points[:2], network[:2].astype(np.float32))
    # It is the simulation that the network is compared with in the evaluation.
    missed = solver_errors(dressed, take_set, Network(model, take_set), [(1, range(20))])
    mass = dressed.energy.mass.numpy()
    away = np.sqrt(((points - network)[6] ** 2).sum(-1) @ mass / mass.sum())  # after five frames
    assert missed and missed.position_error[0] == pytest.approx(away, rel=1e-3) and away > 1e-3


def test_states_solved_in_latents_are_played_with_the_models_own_shapes(meter, bench, model, points):
    reducer, dressed, take_set = bench
    variant, told = chosen(meter, "2 in latents"), []
    file = reducer.player.file
    bare = replace(file.scene, character=replace(file.scene.character, bodies=()))  # as the demo's models ship
    method = ShotMethod(
        variant.name, Player(replace(file, scene=bare)), dressed, take_set, fps=FPS, latents=variant.latents,
        advanced=lambda: told.append(1),
    )  # fmt: skip
    found, motion = method.vertices(1, range(20)), take_set.takes[1].motion
    roller = LatentRoller(model, dressed.fabric, LatentOptions(iterations=2, sampled=True))
    frames = [decode(model, motion, pose) for pose in garment_poses(model, motion, FPS, roller=roller)]
    expected = np.concatenate(frames) - motion.translations[0, 0]
    np.testing.assert_allclose(found.permute(2, 0, 1), expected, atol=1e-5)
    network = reducer.player.play(motion)
    assert np.abs(network.vertices(19) - motion.translations[0, 0] - expected[19]).max() > 1e-3
    assert len(told) == 20 and len(method.solving) == 1 and method.solving[0] > 0
    assert method.shots[1].own_shapes == 0

    solved, whole = meter.point(variant), points["as trained"]
    assert solved.solving > 0 and solved.torch is None and solved.position > 1e-4
    shapes = reducer.player.deformer().shape_count
    assert solved.shot_bytes == 1000 * shapes + 300 * 60 and solved.model_bytes == whole.model_bytes


def test_takes_are_cut_to_the_first_frames_of_their_clip(bench):
    long, short = bench[2].takes
    cut = within([long, replace(short, first=30)], 36)
    assert [take.frame_count for take in cut] == [36, 6]
    np.testing.assert_allclose(cut[0].motion.rotations, long.motion.rotations[:36], atol=1e-12)
    assert [take.frame_count for take in within([long, replace(short, first=33)], 36)] == [36]  # three are too few
    assert [take.frame_count for take in within([long, replace(short, first=50)], 36)] == [36]


def test_points_that_joints_cannot_reach_are_counted_as_points(meter, bench, monkeypatch):
    def out_of_reach(*arguments, **options):
        raise SsilkError("the joints fold its skinning there")

    monkeypatch.setattr("ssilk_core.quality.trade.shot_method.decompose", out_of_reach)
    found = meter.point(chosen(meter, "1 iterations"))
    vertices = bench[1].scene.garment.mesh.vertex_count
    assert found.shot_bytes == 6000 + 300 * (60 + 12 * vertices) and found.solving > 0


def test_between_frames_of_a_shot_poses_are_interpolated(meter, bench, model):
    reducer, dressed, take_set = bench
    motion = take_set.takes[0].motion
    slow = ShotMethod("slow", reducer.player, dressed, take_set, fps=10.0).unrefined(motion)
    np.testing.assert_allclose(slow[::3], every_frame(reducer, motion)[::3], atol=1e-5)  # frames of the shot
    np.testing.assert_allclose(slow[-1], every_frame(reducer, motion)[-1], atol=1e-5)  # which none of them falls on
    shot, at = resample(motion, 10.0, cover=True), np.array([1 / 3])
    pose = sample_pose(next(iter(reducer.player.play(motion).poses())), np.array([3.0, 6.0]))
    rotations, translations = sample_motion(shot.clip(1, 3), at)
    between = replace(shot, rotations=rotations, translations=translations)
    np.testing.assert_allclose(slow[4], deform(model.deformer(), between, sample_pose(pose, at))[0], atol=1e-5)


def every_frame(reducer: Reducer, motion) -> np.ndarray:
    playback = reducer.player.play(motion)
    return np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])


def test_the_front_holds_what_nothing_beats():
    cloud = [tuple(place) for place in np.random.default_rng(3).uniform(0.1, 1, (60, 2)).round(1)]
    best = [cloud[index] for index in front(cloud)]
    assert best == sorted(set(best))
    for cost, error in cloud:
        beaten = any(c <= cost and e <= error and (c, e) != (cost, error) for c, e in cloud)
        assert ((cost, error) in best) != beaten


def test_a_sweep_that_was_stopped_goes_on(meter, points, tmp_path, monkeypatch):
    tried = [chosen(meter, name) for name in ("as trained", "int16", "float16")]
    measured: list[str] = []

    def counted(variant):
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(variant.name)
        return points[variant.name]

    monkeypatch.setattr(meter, "point", counted)
    path, asked = tmp_path / "trade.json", {"clips": ["a"], "n": (1, 2)}
    with pytest.raises(KeyboardInterrupt):
        sweep(meter, tried, Results(path, asked))
    assert [p["variant"] for p in json.loads(path.read_text())["points"]] == measured == ["as trained", "int16"]
    said, again = [], Results(path, asked)
    again.resume(said.append)
    assert "2 rows were measured before and are taken over; the others are measured" in said[0].text
    assert json.loads(path.read_text())["unfinished"] == GO_ON
    measured.clear()
    sweep(meter, tried, again)
    assert measured == ["float16"]
    assert len(again.points) == 3 and again.points[0] == points["as trained"]
    again.finish()
    assert "unfinished" not in json.loads(path.read_text())
    other = Results(path, {"clips": ["b"]})
    other.resume(said.append)
    assert not other.points and said[-1].text == f"{path}: begun anew, its figures are of other clips"
    document = json.loads(path.read_text())
    del document["points"][1]["shown_skin"]["bare"]
    path.write_text(json.dumps(document))
    older = Results(path, asked)
    older.resume(said.append)
    what = "another version measured its figures ('shown_skin.bare' is missing)"
    assert not older.points and said[-1].text == f"{path}: begun anew, {what}" and said[-1].level == "warning"


@pytest.mark.parametrize(
    ("cost", "what"),
    [
        ({"body": "triangles", "vertices": 9, "milliseconds": 1.0, "collision": 0.1}, "'inside' is missing"),
        ({**asdict(COST), "surface": True}, "'surface' is no field"),
    ],
)
def test_costs_of_an_older_version_are_measured_again_with_all_rows(points, tmp_path, cost, what):
    path, said = tmp_path / "trade.json", []
    results = Results(path, {}, [COST])
    results.add(points["int16"])
    again = Results(path, {})
    again.resume(said.append)
    assert again.collision_costs == [COST] and len(again.points) == 1
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "judging": [cost]}))
    older = Results(path, {})
    older.resume(said.append)
    assert not older.points and not older.collision_costs
    begun = f"{path}: begun anew, another version measured its figures"
    assert [event.text for event in said[1:]] == [f"{begun} ({what})"]
    path.write_text(json.dumps({**document, "points": [{**document["points"][0], "shown_skin": 0.5}]}))
    older.resume(said.append)
    assert not older.points and said[-1].text == f"{begun} ('shown_skin', '0.5' has no fields)"


def test_a_variant_that_fails_is_told_and_the_others_are_measured(meter, points, monkeypatch):
    tried, said = [chosen(meter, name) for name in ("as trained", "int16", "float16")], []

    def broken(variant):
        if variant.name == "int16":
            raise SsilkError("frame 3: the energy is not finite.")
        return points[variant.name]

    monkeypatch.setattr(meter, "point", broken)
    results = Results(None, {})
    assert sweep(meter, tried, results, said.append) == 1
    assert [point.variant for point in results.points] == ["as trained", "float16"]
    (warning,) = [event for event in said if isinstance(event, Message)]
    assert warning.level == "warning" and "int16: not measured, frame 3" in warning.text


def test_each_solver_tells_its_frames_after_the_quick_variants(meter, points, monkeypatch):
    tried, said = [chosen(meter, name) for name in ("as trained", "simulator", "hero", "int16")], []

    def told(variant, advanced=None):
        for _ in range((66 if variant.simulated else 70) if advanced else 0):
            advanced()
        return replace(points["int16"], swept=variant.swept, variant=variant.name)

    monkeypatch.setattr(meter, "point", told)
    results = Results(None, {})
    assert sweep(meter, tried, results, said.append) == 0
    assert [point.variant for point in results.points] == ["as trained", "int16", "simulator", "hero"]
    ends = [(event.done, event.total) for event in said if isinstance(event, Progress) and event.done == event.total]
    assert ends == [(2, 2), (66, 66), (70, 70)]
    messages = [event.text for event in said if isinstance(event, Message)]
    assert messages == [
        "toy, simulator: the solver computes 66 frames",
        "toy, hero: the solver computes 70 frames",
    ]


@pytest.mark.parametrize("text", ["", "[]", '{"asked": 1}', '{"asked": {}, "points": [{"model": "m"}]}'])
def test_files_that_hold_something_else_are_refused(tmp_path, text):
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(SsilkError, match=r"other.json: not figures of 'ssilk trade'"):
        Results(tmp_path / "other.json", {}).resume(lambda event: None)


def test_tables_and_charts_show_every_point(points):
    lines = table(list(points.values())).splitlines()
    assert len(lines) == len(points) + 2 and all(name in text for name, text in zip(points, lines[2:]))
    assert "time" in "".join(lines[2:]) and "nan" not in "".join(lines)
    assert caption({"jump": 60, "flip": 40}, simulated=False).endswith(
        "the same frames, the first 60 of jump, 40 of flip"
    )
    assert "first two states" in caption({"jump": 60}, simulated=True)
    for row in trade_panels(list(points.values()), {}):
        for panel in row:
            shown = [point for group in panel.points.values() for point in group]
            assert len(shown) == len(points) and set(panel.front) <= {place[:2] for place in shown}
            assert {"toy", "1 iterations"} <= {words for _, _, words in shown}
            assert "[" in panel.x and "[" in panel.y
    making = trade_panels(list(points.values()), {})[0][0].points["refinement"][0][0]
    assert making == pytest.approx(points["1 iterations"].milliseconds + points["1 iterations"].solving)


def test_garments_have_rows_of_their_own_and_networks_their_names(points):
    cape = [replace(point, garment="Cape") for point in points.values() if point.variant != "2 blendshapes"]
    light = replace(points["as trained"], garment="Cape", model="light", total=points["as trained"].total + 1)
    skirt = [replace(point, garment="Skirt", shown_skin=None) for point in cape]
    rows = trade_panels([*cape, light, *skirt], {"jump": 60, "flip": 40})
    titles = [f"{garment}, 100 frames, 2 clips" for garment in ("Cape", "Skirt")]
    assert [row[0].title for row in rows] == titles[:1] * 3 + titles[1:] * 3
    assert "RMS" not in rows[0][0].y and "RMS" in rows[3][0].y  # distances are from one's own whole model
    (_, first, _), (_, second, words) = rows[0][0].points[WHOLE]
    assert words == "light" and second - first == pytest.approx(1)
    assert min(y for row in rows for group in row[0].points.values() for _, y, _ in group) == 0


def test_points_survive_the_file_they_are_kept_in(points, tmp_path):
    results = Results(tmp_path / "t.json", {"a": 1})
    results.add(points["int16"])
    again = Results(tmp_path / "t.json", {"a": 1})
    again.resume(lambda event: None)
    assert asdict(again.points[0]) == asdict(points["int16"])
