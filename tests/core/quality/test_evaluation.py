# SPDX-License-Identifier: Apache-2.0
"""The evaluation of a toy garment: takes, methods, records, held poses, loops, and what splits come to."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.baselines.evaluation import method_over
from benchmarks.baselines.networks import METHODS, BaselineConfig, baseline
from ssilk_core.errors import SsilkError
from ssilk_core.events import Progress, finite
from ssilk_core.network.latent_solver import LatentOptions
from ssilk_core.network.latent_solver.shots import LatentShots
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.physics.energy import TERMS
from ssilk_core.physics.intersections.figures import EVERY, SelfIntersections
from ssilk_core.physics.skin.figures import ShownSkin
from ssilk_core.quality.evaluation.asked import EvaluationClips, EvaluationOptions
from ssilk_core.quality.evaluation.figures import ResultRow
from ssilk_core.quality.evaluation.methods import (
    CachedPoints,
    EvaluatedMethod,
    EvaluationScene,
    LinearBlendSkinning,
    Simulated,
    SolvedNetwork,
    TakeSet,
    build_take_set,
)
from ssilk_core.quality.evaluation.minimum import minima, minimum_errors
from ssilk_core.quality.evaluation.own_starts import MethodWindow, departures
from ssilk_core.quality.evaluation.probes import (
    REST_SPEED,
    joined_loop_drift,
    joined_minimum_errors,
    joined_settling,
    last_frames,
    loop_drift,
    looped_takes,
    settling,
    stopped_takes,
)
from ssilk_core.quality.evaluation.record import recorded
from ssilk_core.quality.evaluation.run import SIMULATOR, evaluate
from ssilk_core.quality.evaluation.solver_errors import solver_errors, windows_of
from ssilk_core.quality.evaluation.splits import chosen, read_index, splits_of
from ssilk_core.quality.evaluation.tables import aligned, in_parts, tables
from ssilk_core.quality.evaluation.takes import Take, back_and_forth, stopped, takes_of
from ssilk_core.quality.evaluation.tally import Tally, figures, reference_errors
from ssilk_core.scene.assets import TIGHT, Motion
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices
from ssilk_core.scene.plain import OtherFieldsError, from_plain
from ssilk_core.training.validation import Validator

pytestmark = pytest.mark.usefixtures("few_contacts")

FPS, JOINTS, CPU = 30.0, np.arange(3), torch.device("cpu")


@pytest.fixture
def dressed(scene) -> EvaluationScene:
    return EvaluationScene(scene, Fabric("toy", bending=1e-4, margin=0.02), FPS, CPU)


@pytest.fixture
def motion(scene, toy_motion) -> Motion:
    return toy_motion(scene, 40)


@pytest.fixture
def take_set(dressed, motion) -> TakeSet:
    return build_take_set(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), dressed, JOINTS)


class Still:
    """Cloth that moves by given offsets (N, 3) away from linear blend skinning, whose quasi-static state that is."""

    def __init__(self, dressed: EvaluationScene, take_set: TakeSet, offsets: Tensor) -> None:
        self.lbs, self.offsets = LinearBlendSkinning(dressed, take_set), offsets

    def vertices(self, take: int, frames: range) -> Tensor:
        return self.lbs.vertices(take, frames) + self.offsets[frames.start : frames.stop].T

    def still(self, take: int, frames: range) -> Tensor:
        return self.lbs.vertices(take, frames)


def test_takes_are_the_frames_of_a_simulated_shot(scene, toy_motion):
    """Cut where the root jumps, at the frames that a simulator would write."""
    fast = toy_motion(scene, 101, fps=50.0)
    places = fast.translations.copy()
    places[60:, 0] += 3.0
    takes = takes_of("clip", replace(fast, translations=places), scene.character.skeleton, FPS)
    assert [(take.first, take.frame_count) for take in takes] == [(0, 36), (36, 25)]
    np.testing.assert_allclose(takes[1].motion.translations[-1, 0], places[100, 0], atol=1e-9)
    later = takes_of("clip", replace(fast, translations=places, start=1001.0), scene.character.skeleton, FPS)[1]
    np.testing.assert_allclose(later.codes[[0, -1]], [1061, 1101])  # of the motion, whose rate is another
    parts = takes_of("clip", fast, scene.character.skeleton, FPS, longest=25)
    assert [(take.first, take.frame_count) for take in parts] == [(0, 25), (25, 25), (50, 11)]
    parts = takes_of("clip", fast.clip(0, 101), scene.character.skeleton, FPS, longest=58)
    assert [take.frame_count for take in parts] == [58]  # 3 are few


def test_a_motion_stops_and_loops_without_a_jolt(motion):
    still, first = stopped(motion, FPS, 0.5, 1.0)
    assert still.frame_count == first + 30 or still.frame_count == first + 31
    assert np.ptp(still.translations[first:], axis=0).max() == 0 and np.ptp(still.translations[:first, 0, 0]) > 0.01
    loop, length = back_and_forth(motion, FPS, 200)
    assert loop.frame_count >= 200 and loop.frame_count % length == 0
    np.testing.assert_array_equal(loop.translations[:length], loop.translations[length : 2 * length])
    speed = np.abs(np.diff(loop.translations[:, 0], axis=0)).max(axis=1) * FPS
    assert speed[length - 1] < 0.1 * speed.max()


@pytest.mark.parametrize("kind", ["ssilk", *METHODS])
def test_energies_are_those_of_the_validation(scene, dressed, toy_motion, toy_model, kind, monkeypatch):
    """Of models and baselines, also over several blocks."""
    model = toy_model(scene) if kind == "ssilk" else baseline(scene, BaselineConfig(method=kind), JOINTS)
    clip = toy_motion(scene, 23)
    take_set = build_take_set(takes_of("clip", clip, dressed.scene.character.skeleton, FPS), dressed, JOINTS)
    network = method_over(model, take_set)
    validator = Validator(
        network.take_set.bank, dressed.energy, dressed.body, scene, dressed.rest, FPS, clip.frame_count
    )
    expected = validator.frame_terms(range(23), model)
    monkeypatch.setattr("ssilk_core.quality.evaluation.record.FRAMES_PER_CHUNK", 9)
    found = recorded(dressed, take_set, network, 0).values
    for name in (*TERMS, "collisions"):
        np.testing.assert_allclose(found[name], expected[name].double(), rtol=1e-4, atol=1e-7)
    lbs = recorded(dressed, take_set, LinearBlendSkinning(dressed, take_set), 0).values
    np.testing.assert_allclose(lbs["stretch"], validator.frame_terms(range(23), None)["stretch"], rtol=1e-4)
    assert lbs["gravity"].abs().max() == 0 and "static distance" not in lbs


def test_a_record_in_blocks_is_that_of_the_whole(dressed, take_set, monkeypatch):
    offsets = 0.01 * torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    method, reference = Still(dressed, take_set, offsets), LinearBlendSkinning(dressed, take_set)
    whole = recorded(dressed, take_set, method, 0, reference)
    monkeypatch.setattr("ssilk_core.quality.evaluation.record.FRAMES_PER_CHUNK", 2)
    parts = recorded(dressed, take_set, method, 0, reference)
    assert whole.values.keys() == parts.values.keys() and torch.equal(whole.stretches, parts.stretches)
    for name, values in whole.values.items():
        np.testing.assert_allclose(parts.values[name], values, rtol=1e-3, atol=1e-9, err_msg=name)
    missing = {name: int(values.isnan().sum()) for name, values in whole.values.items()}
    assert {name: count for name, count in missing.items() if count} == {
        "kinetic energy": 1, "jerk": 3, "velocity error": 1, "acceleration error": 2,
    }  # fmt: skip


def test_errors_against_a_reference_are_those_of_the_offset(dressed, take_set):
    """Cloth that is carried along a wave beside the reference, as a whole."""
    rate, amplitude = 6.0, 0.02
    path = torch.zeros(40, 3)
    path[:, 1] = amplitude * torch.sin(rate * torch.arange(40) / FPS)
    reference = Tally({0: recorded(dressed, take_set, LinearBlendSkinning(dressed, take_set), 0)}, {0: "sway"})
    tally = Tally(
        {0: recorded(dressed, take_set, Still(dressed, take_set, path), 0, LinearBlendSkinning(dressed, take_set))},
        {0: "sway"},
    )
    simulator = figures(reference, reference.root("jerk"), dressed.weight, dressed.covered, dressed.intersections)
    found = reference_errors(tally, simulator, dressed.weight)
    exact = [path, path.diff(dim=0) * FPS, path.diff(n=2, dim=0) * FPS**2]
    expected = [float(values[:, 1].square().mean()) ** 0.5 for values in exact]
    errors = [found.position_error, found.velocity_error, found.acceleration_error]
    np.testing.assert_allclose(errors, expected, rtol=2e-3)
    mass = float(dressed.energy.mass.sum())
    lifted = mass * GRAVITY * float(path[:, 1].mean())
    assert found.gravity_excess == pytest.approx(lifted / dressed.weight, rel=1e-3)
    own = figures(tally, simulator.jerk, dressed.weight, dressed.covered, dressed.intersections)
    assert found.total_excess == pytest.approx(own.total - found.reference_total) and found.frames == 40
    assert own.static_distance == pytest.approx(expected[0], rel=1e-3)
    assert own.gravity_excess == pytest.approx(found.gravity_excess, rel=1e-3)
    assert own.jerk_ratio == pytest.approx(found.jerk_ratio)


def test_skin_that_shows_is_counted_where_cloth_sinks_into_the_body(dressed, motion, monkeypatch):
    """In one frame of the second take the cloth is pushed into the ball."""
    takes = takes_of("sway", replace(motion, start=100.0), dressed.scene.character.skeleton, FPS, longest=20)
    take_set = build_take_set(takes, dressed, JOINTS)
    pushed = torch.zeros(20, 3)
    pushed[7, 2] = 0.05
    lbs, into = LinearBlendSkinning(dressed, take_set), Still(dressed, take_set, pushed)
    monkeypatch.setattr("ssilk_core.quality.evaluation.record.FRAMES_PER_CHUNK", 8)
    records = {take: recorded(dressed, take_set, method, take) for take, method in enumerate((lbs, into))}
    found = Tally(records, {0: "sway", 1: "sway"}).shown_skin(dressed.covered)
    calm = [
        dressed.covered.states(lbs.vertices(take, range(20)), take_set.character(take, range(20))).shows
        for take in (0, 1)
    ]
    bad = dressed.covered.states(into.vertices(1, range(7, 8)), take_set.character(1, range(7, 8))).shows
    assert (found.frames, found.covered, found.clip, found.frame) == (40, len(dressed.covered), "sway", 127)
    assert found.worst == pytest.approx(float(bad.double().mean())) and found.worst > 0.02
    calm[1][:, 7] = bad[:, 0]
    assert found.mean == pytest.approx(float(torch.cat(calm, dim=1).double().mean()))
    assert sum(found.regions.values()) == pytest.approx(1) and set(found.regions) <= {"Hips", "Spine", "Arm"}
    assert "sway" in tables([ResultRow("strip", "pushed", "valid", figures(Tally(records, {0: "sway", 1: "sway"}),
                                       1.0, 1.0, dressed.covered, dressed.intersections))])  # fmt: skip


class Folded(Still):
    """The garment of linear blend skinning, pushed in one frame through itself: its loose end lies before its top."""

    def vertices(self, take, frames):
        x = super().vertices(take, frames)
        for number, frame in enumerate(frames):
            if frame == 12:
                x[-5:, :, number] = x[:5, :, number] + torch.tensor([[0.0, -0.1, 0.03]])
                x[-10:-5, :, number] = x[:5, :, number] + torch.tensor([[0.0, -0.1, -0.03]])
        return x


def test_triangles_that_intersect_are_counted_in_every_fourth_frame(dressed, motion, monkeypatch):
    takes = takes_of("sway", replace(motion, start=100.0), dressed.scene.character.skeleton, FPS, longest=20)
    take_set = build_take_set(takes, dressed, JOINTS)
    still = torch.zeros(20, 3)
    lbs, through = LinearBlendSkinning(dressed, take_set), Folded(dressed, take_set, still)
    monkeypatch.setattr("ssilk_core.quality.evaluation.record.FRAMES_PER_CHUNK", 7)
    records = {take: recorded(dressed, take_set, method, take) for take, method in enumerate((lbs, through))}
    found = Tally(records, {0: "sway", 1: "sway"}).intersections(dressed.intersections)
    crossed = dressed.intersections.triangles(through.vertices(1, range(12, 13))[..., 0].double().numpy())
    assert (found.frames, found.clip, found.frame) == (2 * 20 // EVERY, "sway", 132) and found.worst > 0.1
    assert found.worst == pytest.approx(crossed.mean()) and found.mean == pytest.approx(found.worst / found.frames)


def test_collisions_can_be_with_the_whole_body(scene, dressed, take_set):
    """A spike of the ball right behind tight cloth: its long triangles are near where its only vertex is far."""
    ball = scene.character.bodies[0]
    points = ball.mesh.points.copy()
    points[points[:, 2].argmin()] = [0.0, 0.9, -0.16]
    body = replace(ball, mesh=replace(ball.mesh, points=points))
    tight = replace(scene.garment, classes=np.full(len(scene.classes), TIGHT))
    spiked = replace(scene, character=replace(scene.character, bodies=(body,)), garment=tight)
    near, whole = (EvaluationScene(spiked, dressed.fabric, FPS, CPU, exact=exact) for exact in (False, True))
    found = [
        recorded(one, take_set, LinearBlendSkinning(one, take_set), 0).values["collision"] for one in (near, whole)
    ]
    character = take_set.character(0, range(40))
    sampled = whole.energy.cloth.positions(whole.lbs(character))
    distance, _ = whole.contacts.distances(sampled, whole.body.pose(character, exact=True))
    np.testing.assert_allclose(found[1], whole.energy.collision_at(distance), rtol=1e-5)
    assert (found[0] - found[1]).abs().max() > 1e-3


def test_the_weight_is_that_of_the_cloth_at_its_height(dressed):
    """A strip of 0.2 m by 0.55 m, of 0.15 kg/m2."""
    assert dressed.weight == pytest.approx(0.2 * 0.55 * 0.15 * 9.81 * 0.55)


def test_a_point_cache_is_measured_as_the_cloth_that_was_written(scene, dressed, take_set, motion):
    matrices = skinning_matrices(
        motion_transforms(motion, scene.character.skeleton.parents), scene.character.skeleton.bind_transforms
    )
    points = skin_points(scene.garment.mesh.points, scene.lbs_skin, matrices)
    cache = CachedPoints(lambda clip, frames: points[frames.start : frames.stop], dressed, take_set)
    lbs = LinearBlendSkinning(dressed, take_set)
    ours, theirs = (recorded(dressed, take_set, method, 0, lbs) for method in (cache, lbs))
    for name in (*TERMS, "kinetic energy"):
        np.testing.assert_allclose(ours.values[name], theirs.values[name], rtol=1e-3, atol=2e-6, err_msg=name)
    assert ours.values["position error"].max() < 1e-10
    elsewhere = CachedPoints(lambda clip, frames: points[frames.start : frames.stop] + 0.1, dressed, take_set)
    with pytest.raises(SsilkError, match=r"sway: in the point cache, pinned vertices are 0.173 m from"):
        elsewhere.vertices(0, range(5))


def test_a_swing_that_dies_away_settles(dressed, motion):
    """An offset that decays while the pose is held: energy, settling time and distance from rest follow from it."""
    takes, first = stopped_takes(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), FPS, 2, 2.0)
    assert [take.clip for take in takes] == ["sway"] * 2 and first[1] > first[0]
    take_set, tau, begun = build_take_set(takes, dressed, JOINTS), 0.3, 0.1
    count = max(take.frame_count for take in takes)
    offsets = torch.zeros(count, 3)
    offsets[:, 1] = begun * torch.exp(-(torch.arange(count) - first[0]) / FPS / tau)
    found = settling(dressed, take_set, Still(dressed, take_set, offsets), first)[0]
    decay = 1 - math.exp(-1 / FPS / tau)  # the first two frames at rest are apart by begun * decay
    speed, mass = begun * FPS * decay, float(dressed.energy.mass.sum())
    assert found.initial_kinetic_energy == pytest.approx(mass * speed**2 / 2, rel=1e-3)
    settled = tau * math.log(speed / REST_SPEED)
    assert settled <= found.settling_time < settled + 1 / FPS
    last = begun * math.exp(-(takes[0].frame_count - 1 - first[0]) / FPS / tau)
    assert found.static_distance == pytest.approx(last, rel=1e-3)
    assert found.gravity_excess == pytest.approx(mass * GRAVITY * last / dressed.weight, rel=1e-3)


def test_cloth_that_is_held_up_is_found_out(dressed, motion):
    """Ten centimetres above its quasi-static state for ever: it settles, and floats."""
    takes, first = stopped_takes(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), FPS, 1, 1.0)
    take_set = build_take_set(takes, dressed, JOINTS)
    lifted = torch.tensor([0.0, 0.1, 0.0]).expand(takes[0].frame_count, 3)
    found = joined_settling(settling(dressed, take_set, Still(dressed, take_set, lifted), first))
    assert (found.stops, found.settled_share) == (1, 1.0) and found.final_kinetic_energy < 1e-9
    assert found.static_distance == found.max_static_distance == pytest.approx(0.1, rel=1e-4)
    assert found.gravity_excess == pytest.approx(0.1 / 0.55, rel=1e-3)
    assert joined_settling([]) is None and joined_loop_drift([]) is None


def test_minima_are_where_forces_balance(dressed, motion):
    """Of two poses at once, from linear blend skinning: lower, in balance, and a place to measure heights from."""
    takes, _ = stopped_takes(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), FPS, 2, 0.5)
    take_set = build_take_set(takes, dressed, JOINTS)
    found = minima(dressed.simulator, takes, last_frames(LinearBlendSkinning(dressed, take_set), takes))
    np.testing.assert_allclose(found.start, found.poses.lbs, atol=1e-6)
    assert (found.residual < 0.01).all() and (found.energy_excess() > 0.01).all() and (found.distance() > 0.01).all()
    middle = dressed.simulator.inputs(found.poses, None).body.points.double().mean(0)
    assert (found.inside(0 * found.x + middle) == 1).all() and (found.inside(found.x + 100) == 0).all()
    lifted = found.x + torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)[:, None]
    mass = float(dressed.energy.mass.sum())
    np.testing.assert_allclose(found.gravity_excess(lifted), mass * GRAVITY * 0.1, rtol=1e-6)
    figures_of = minimum_errors(found, dressed.weight)
    joined = joined_minimum_errors(figures_of)
    assert (
        joined.gravity_excess == pytest.approx(joined.lbs_gravity_excess, rel=1e-4)
        and joined.stops == 2
        and joined_minimum_errors([]) is None
    )
    assert (
        joined.static_energy_excess == pytest.approx(float(found.energy_excess().mean()))
        and joined.max_residual == found.residual.max()
    )
    again = minima(dressed.simulator, takes, found.x.float() + found.poses.root - _origins(takes))
    assert (again.energy_excess().abs() < 1e-5).all() and (again.distance() < 1e-3).all()


def _origins(takes: Sequence[Take]) -> Tensor:
    return torch.as_tensor(np.stack([take.motion.translations[0, 0] for take in takes], axis=1))


@pytest.mark.slow
def test_the_simulator_comes_to_rest_at_its_own_minimum(scene, dressed, motion):
    """Played over a stop in thick air like any other method: calm at the end, where forces balance."""
    dressed = EvaluationScene(scene, replace(dressed.fabric, drag=1.2), FPS, CPU)
    takes, first = stopped_takes(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), FPS, 1, 1.5)
    take_set = build_take_set(takes, dressed, JOINTS)
    found = settling(dressed, take_set, Simulated(dressed, take_set), first)[0]
    assert found.initial_kinetic_energy > 100 * found.final_kinetic_energy and 0 < found.settling_time < 1.5
    assert found.static_distance < 0.01 and abs(found.gravity_excess) < 0.005


def test_holds_come_together(dressed, motion):
    takes, first = stopped_takes(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), FPS, 3, 1.0)
    take_set = build_take_set(takes, dressed, JOINTS)
    single = settling(dressed, take_set, Still(dressed, take_set, torch.zeros(100, 3)), first)
    never = replace(
        single[0], settled_share=0.0, settling_time=math.inf, static_distance=0.3, max_static_distance=0.3
    )
    assert joined_settling([never, never, single[1]]).settling_time == math.inf
    found = joined_settling([never, single[1], single[2]])
    assert found.settled_share == pytest.approx(2 / 3) and found.settling_time < math.inf and found.stops == 3
    assert found.static_distance == pytest.approx(0.3 / 3**0.5, rel=1e-3) and found.max_static_distance == 0.3


def test_drift_is_what_changes_from_loop_to_loop(dressed, motion):
    takes, lengths = looped_takes(takes_of("sway", motion, dressed.scene.character.skeleton, FPS), FPS, 400)
    take_set = build_take_set(takes, dressed, JOINTS)
    frames, length = takes[0].frame_count, lengths[0]
    same = loop_drift(dressed, take_set, Still(dressed, take_set, torch.zeros(frames, 3)), lengths)[0]
    assert frames >= 400 and abs(same.total_drift) < 1e-6 and same.loop_distance < 1e-6
    rising = torch.zeros(frames, 3)
    rising[:, 1] = 0.05 * torch.arange(frames) / frames
    found = loop_drift(dressed, take_set, Still(dressed, take_set, rising), lengths)[0]
    assert found.loop_distance == pytest.approx(0.05 * (frames - 2 * length) / frames, rel=1e-3)
    joined = joined_loop_drift([found, replace(found, total_drift=-1.0, max_total_drift=-1.0)])
    assert joined.max_total_drift == -1.0 and joined.total_drift == pytest.approx((found.total_drift - 1) / 2)


def evaluated(name: str, model: torch.nn.Module) -> EvaluatedMethod:
    return EvaluatedMethod(name, JOINTS, partial(method_over, model))


def playlist(dressed: EvaluationScene, motion: Motion, slow: Motion, **options: object) -> EvaluationClips:
    return EvaluationClips(
        clips={"sway": motion, "slow": slow}, splits={"valid": ["sway", "slow"], "flips": ["slow"]}, **options
    )


@pytest.mark.slow
def test_every_method_gets_its_row_in_every_split(scene, dressed, motion, toy_motion, toy_model):
    motion, slow = motion.clip(0, 10), toy_motion(scene, 6, speed=0.3)
    subjects = [
        evaluated("ssilk", toy_model(scene)),
        evaluated("ncs", baseline(scene, BaselineConfig(method="ncs"), JOINTS)),
    ]
    cache = {}

    def read(clip: str, frames: range) -> np.ndarray:
        if not cache:
            take_set = build_take_set(takes_of("slow", slow, dressed.scene.character.skeleton, FPS), dressed, JOINTS)
            cache["slow"] = (
                LinearBlendSkinning(dressed, take_set).vertices(0, range(6)).permute(2, 0, 1)
                + slow.translations[0, 0]
            )
        return cache[clip][frames.start : frames.stop].numpy()

    played = playlist(dressed, motion, slow, simulated=frozenset({"slow"}), read=read, seen=[motion])
    options = EvaluationOptions(stops=1, hold=0.2, minimum=True, simulate=True, loop=1)
    rows = list(evaluate(dressed, subjects, played, options))
    names = [(row.method, row.split) for row in rows]
    baselines = [(method, split) for split in ("valid", "flips") for method in ("LBS", SIMULATOR)]
    assert names == [*baselines, *((method, split) for method in ("ssilk", "ncs") for split in ("valid", "flips"))]
    by_name = {name: row.figures for name, row in zip(names, rows)}
    model, simulated = by_name["ssilk", "valid"], by_name[SIMULATOR, "valid"]
    assert (model.frames, model.reference.frames, simulated.frames, simulated.clips) == (16, 6, 6, 1)
    assert (
        by_name["LBS", "valid"].reference.position_error < 1e-6 < model.reference.position_error
    )  # LBS is what was written
    assert (model.settling.stops, model.minimum.stops, model.loop_drift.clips) == (2, 2, 2)
    assert model.minimum.static_energy_excess > 0
    assert by_name["LBS", "valid"].settling is None and simulated.settling.stops == 2
    # The training saw 'sway' and not 'slow', which is why the whole is nearer than the part.
    assert model.closed_loop.states == 12 and by_name["ncs", "valid"].closed_loop is None
    assert model.pose_novelty.mean_distance < by_name["ssilk", "flips"].pose_novelty.mean_distance
    assert model.clip_totals[0] <= model.total <= model.clip_totals[2]
    # Whatever part of the rows is known, the others come out as before, up to the rounding of smaller batches.
    kept = [from_plain(ResultRow, json.loads(json.dumps(finite(asdict(row)))), figures=True) for row in rows]
    for count in (3, 5, len(rows)):
        found = list(evaluate(dressed, subjects, played, options, known=kept[:count]))
        assert found[:count] == kept[:count]
        for row, again in zip(rows, found, strict=True):
            ours, theirs = asdict(row), asdict(again)
            assert leaves(ours)[0] == leaves(theirs)[0] and len(leaves(ours)[1]) == len(leaves(theirs)[1])
            for name in ("total", "jerk_ratio"):
                assert theirs["figures"][name] == pytest.approx(ours["figures"][name], rel=1e-3)
            if row.method != SIMULATOR:
                errors = [each["figures"]["reference"]["position_error"] for each in (ours, theirs)]
                assert errors[0] == pytest.approx(errors[1], rel=1e-3)
    text = tables(rows)
    first = [line.split("|")[2].strip() for line in text.split("\n\n")[0].splitlines()[2:]]
    assert first == ["valid"] * 4 + ["flips"] * 4  # the methods of a split stand together
    assert max(map(len, text.splitlines())) > 118 >= max(map(len, tables(rows, 118).splitlines()))
    assert text.count("| garment") == 10 and len({len(line) for line in text.split("\n\n")[0].splitlines()}) == 1


def leaves(value: object) -> tuple[list[object], list[float]]:
    """Return what nested dictionaries and sequences hold: everything else, and numbers."""
    if not isinstance(value, dict | tuple | list):
        if not isinstance(value, int | float):
            return [value], []
        return [], [float(value)]
    found = [leaves(item) for item in (value.items() if isinstance(value, dict) else value)]
    return [word for words, _ in found for word in words], [number for _, numbers in found for number in numbers]


def test_a_character_that_never_moves_has_no_jerk_to_compare_with(scene, dressed, motion, toy_model):
    frozen = replace(motion, rotations=motion.rotations[[5] * 12], translations=motion.translations[[5] * 12])
    played = EvaluationClips(clips={"frozen": frozen}, splits={"all": ["frozen"]})
    rows = list(
        evaluate(
            dressed, [evaluated("ssilk", toy_model(scene))], played, EvaluationOptions(stops=0, loop=0, linearised=0)
        )
    )
    assert rows[0].figures.jerk == 0 and math.isnan(rows[1].figures.jerk_ratio) and "nan" in tables(rows)


def test_nothing_is_asked_for_nothing_is_computed(scene, dressed, motion, toy_model):
    played = EvaluationClips(clips={"sway": motion}, splits={"all": ["sway"]})
    rows = list(
        evaluate(
            dressed, [evaluated("ssilk", toy_model(scene))], played, EvaluationOptions(stops=0, loop=0, linearised=0)
        )
    )
    assert [row.method for row in rows] == ["LBS", "ssilk"]
    found = rows[1].figures
    kinds = found.reference, found.pose_novelty, found.settling, found.loop_drift, found.closed_loop
    assert kinds == (None,) * 5


def test_an_index_says_which_clips_are_in_which_split(tmp_path):
    path = tmp_path / "index.json"
    path.write_text(json.dumps([
        {"clip": "a", "split": "train", "tags": ["inertia"]}, {"clip": "b", "split": "valid", "tags": ["inertia"]},
        {"clip": "c", "split": "valid", "tags": []}, {"clip": "d", "split": "flips"}, {"clip": "e", "split": "test"},
    ]))  # fmt: skip
    index = read_index(path)
    assert chosen(index, "train") == ["a"] and chosen(index, "inertia") == ["b"]
    assert splits_of(index) == {"valid": ["b", "c"], "test": ["e"], "inertia": ["b"], "flips": ["d"]}
    assert splits_of(index, ["c", "d"]) == {"valid": ["c"], "flips": ["d"]}


def test_a_written_row_is_read_again_and_what_was_not_finite_is_no_number():
    skin = {"frames": 2, "covered": 3, "mean": 0.1, "worst": 0.2, "clip": "a", "frame": 1.0, "regions": {"Hips": 1.0},
            "bare": 0.0, "worst_bare": 0.0, "pierced": None, "limbs": {}}  # fmt: skip
    crossed = {"frames": 1, "triangles": 9, "mean": 0.1, "worst": 0.2, "clip": "a", "frame": 1.0, "regions": {}}
    stop = dict.fromkeys(("initial_kinetic_energy", "final_kinetic_energy", "settled_share", "static_distance",
                          "max_static_distance", "static_energy_excess", "gravity_excess"), 0.5)  # fmt: skip
    numbers = dict.fromkeys(("total", "collisions", "gravity_excess", "kinetic_energy", "jerk", "jerk_ratio"), 1.5)
    others = dict.fromkeys(("reference", "solver", "pose_novelty", "minimum", "loop_drift", "static_distance"))
    written = {
        "garment": "Cape", "method": "ssilk", "split": "valid",
        "figures": {"clips": 1, "frames": 2, "terms": {"gravity": None}, "clip_totals": [1, 2.0, None],
                    "stretch_quantiles": [1.0], "shown_skin": skin, "intersections": crossed, **numbers, **others,
                    "settling": {"stops": 1, "settling_time": None, **stop},
                    "closed_loop": {"states": 3, "median_radius": 0.9, "max_radius": None}},
    }  # fmt: skip
    found = from_plain(ResultRow, written, figures=True)
    assert found.figures.intersections == SelfIntersections(**crossed)
    assert found.figures.shown_skin == ShownSkin(**skin) and found.figures.reference is None
    assert math.isnan(found.figures.settling.settling_time) and found.figures.settling.stops == 1
    assert found.figures.clip_totals[:2] == (1, 2.0) and math.isnan(found.figures.clip_totals[2])
    loop = found.figures.closed_loop
    assert (loop.states, loop.median_radius) == (3, 0.9) and math.isnan(loop.max_radius)
    assert math.isnan(found.figures.terms["gravity"]) and found.figures.static_distance is None
    for broken, complaint in (
        ({"total": "much"}, "'figures.total' is 'much'"),
        ({"clips": None}, "'figures.clips' is 'None'"),
        ({"clips": True}, "'figures.clips' is 'True'"),
        ({"terms": "gravity"}, "'figures.terms' is 'gravity'"),
        ({"clip_totals": 3}, "'figures.clip_totals' is '3'"),
    ):
        with pytest.raises(TypeError, match=complaint):
            from_plain(ResultRow, {**written, "figures": {**written["figures"], **broken}}, figures=True)
    del skin["pierced"]  # a field with a default, which an older version did not measure
    with pytest.raises(OtherFieldsError, match=r"'figures.shown_skin.pierced' is missing"):
        from_plain(ResultRow, written, figures=True)
    assert from_plain(ResultRow, {**written, "figures": {**written["figures"], "settling": None, "terms": {},
                      "clip_totals": [], "closed_loop": None}}).figures.shown_skin.pierced is None  # fmt: skip


@pytest.mark.parametrize(
    "text", ["", "{}", '[{"clip": 1, "split": "valid"}]', '[{"split": "valid"}]', '["a"]', "[3]"]
)
def test_a_malformed_index_is_refused(tmp_path, text):
    (tmp_path / "index.json").write_text(text)
    if text == "{}":
        assert read_index(tmp_path / "index.json") == []
        return
    with pytest.raises(SsilkError, match=r"index.json: no index of clips .*an index is a JSON list"):
        read_index(tmp_path / "index.json")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"sequence": 3}, "sequences of 3 frames"),
        ({"stops": -1}, "-1 stops"),
        ({"hold": 0.0}, "a hold of 0 s"),
        ({"hold": math.nan}, "a hold of nan s"),
        ({"loop": -5}, "loops of -5 frames"),
        ({"linearised": -1}, "-1 states to linearise about"),
    ],
)
def test_options_out_of_range_are_refused(options, complaint):
    with pytest.raises(SsilkError, match=complaint):
        EvaluationOptions(**options)


def test_no_take_is_refused(dressed, motion):
    nothing: Sequence[Take] = takes_of("short", motion.clip(0, 3), dressed.scene.character.skeleton, FPS)
    with pytest.raises(SsilkError, match="none of four frames"):
        build_take_set(nothing, dressed, JOINTS)


def test_tables_are_aligned():
    text = aligned(["name", "value"], [["1_a", "1.5"], ["longer", "-20"]], 1)
    assert text == "| name   | value |\n| ------ | ----: |\n| 1_a    |   1.5 |\n| longer |   -20 |\n"


def test_wide_tables_come_in_parts_that_repeat_the_words():
    header, rows = ["name", "first", "second value", "third"], [["a", "1", "2", "3"], ["bcde", "10", "20", "30"]]
    text = in_parts(header, rows, 1, 31)
    assert text.split("\n\n") == [
        "| name | first | second value |\n| ---- | ----: | -----------: |\n| a    |     1 |            2 |\n"
        "| bcde |    10 |           20 |",
        "| name | third |\n| ---- | ----: |\n| a    |     3 |\n| bcde |    30 |\n",
    ]
    assert in_parts(header, rows, 1, 200) == aligned(header, rows, 1)
    narrow = in_parts(header, rows, 1, 5)  # no column can be cut
    assert [line.split(" | ")[1].split(" |")[0].strip() for line in narrow.splitlines()[::5]] == header[1:]


def test_a_simulation_is_where_the_solver_goes_from_its_own_states(scene, dressed, toy_motion):
    takes = takes_of("sway", toy_motion(scene, 9), scene.character.skeleton, FPS)
    take_set = build_take_set(takes, dressed, JOINTS)
    simulated = Simulated(dressed, take_set)
    (window, *_) = windows_of(dressed, take_set, [0])
    events: list[Progress] = []
    found = solver_errors(dressed, take_set, simulated, [window], events.append)
    assert [event.done for event in events] == [1, 2, 3, 4, 5, 6, 7, 9]  # seven frames, then two single steps
    assert {event.total for event in events} == {9}
    assert found.windows == 1
    assert found.step_energy < 1e-6
    assert found.step_distance < 1e-4
    assert found.position_error[0] < 1e-3
    assert math.isnan(found.position_error[1])  # the take has nine frames
    moved = solver_errors(dressed, take_set, LinearBlendSkinning(dressed, take_set), [window])
    assert moved.step_distance > 10 * found.step_distance
    assert moved.velocity_error > 10 * found.velocity_error


def test_windows_begin_with_a_take_and_with_its_most_violent_second(dressed, scene, toy_motion):
    calm = toy_motion(scene, 150, speed=0.05)
    fast = toy_motion(scene, 40, speed=3.0)
    rotations = np.concatenate([calm.rotations[:70], fast.rotations, calm.rotations[110:]])
    translations = np.concatenate([calm.translations[:70], fast.translations, calm.translations[110:]])
    take = Take("", 0, replace(calm, rotations=rotations, translations=translations))
    windows = windows_of(dressed, build_take_set([take], dressed, JOINTS), [0])
    assert windows[0] == (0, range(62))
    assert 65 <= windows[1][1].start <= 85


def test_departures_are_those_of_cloth_that_leaves_the_simulation(scene, dressed, toy_motion):
    """A method that follows its own simulation, then is moved by steps of a millimetre; windows of two lengths."""
    takes = takes_of("sway", toy_motion(scene, 12), scene.character.skeleton, FPS)
    take_set = build_take_set(takes, dressed, JOINTS)
    simulated = Simulated(dressed, take_set)
    windows = [MethodWindow(dressed, take_set, simulated, (0, frames)) for frames in (range(9), range(3, 8))]
    for window in windows:
        window.x = window.x + 1e-3 * torch.arange(-1, len(window.x) - 1).clamp_min(0)[:, None, None] / 3**0.5
    counts: list[int] = []
    found = departures(dressed.simulator, windows, dressed.energy.mass, counts.append)
    assert counts == [1] * 10
    expected = torch.arange(1, 8) * 1e-3
    np.testing.assert_allclose(found.position[:, 0].sqrt(), expected, rtol=0.05)
    np.testing.assert_allclose(found.position[:3, 1].sqrt(), expected[:3], rtol=0.05)
    np.testing.assert_allclose(found.velocity[:, 0].sqrt(), torch.full((7,), 1e-3), rtol=0.1)
    assert found.position[3:, 1].isnan().all() and found.position_after(8).isnan().all()
    assert torch.equal(found.position_after(3), found.position[2])


def test_solved_latents_are_a_method(scene, dressed, toy_motion, toy_model):
    """Over takes of two lengths at once, each as it is solved alone, and lower in energy than the network."""
    model, fabric, options = toy_model(scene), dressed.fabric, LatentOptions(iterations=4)
    takes = [Take("short", 0, toy_motion(scene, 5)), Take("long", 0, toy_motion(scene, 7, speed=2.0))]
    take_set, ticks = build_take_set(takes, dressed, JOINTS), []
    solved = SolvedNetwork(model, fabric, options, take_set, lambda: ticks.append(1))
    assert [len(states) for states in solved.states] == [5, 7] and len(ticks) == 7 and solved.lost == 0
    for number, take in enumerate(takes):
        alone = list(LatentShots(model, fabric, options).frames([take.motion]))
        points = torch.cat([frame.solution.x for frame in alone], dim=-1)
        roots = torch.as_tensor(take.motion.translations[:, 0] - take.motion.translations[0, 0]).T
        found = solved.vertices(number, range(take.frame_count))
        np.testing.assert_allclose(found, points + roots, atol=2e-3)
    energies = [
        sum(recorded(dressed, take_set, method, 1).values[name].mean() for name in TERMS)
        for method in (solved, method_over(model, take_set))
    ]
    assert energies[0] < energies[1]
