# SPDX-License-Identifier: Apache-2.0
"""The instrument for extremes: every case on a toy model, and each of its parts against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import ModelFile
from ssilk_core.network.fabrics import SeenFabrics, unseen
from ssilk_core.quality.stress import drives, measures, meter, surroundings, worlds
from ssilk_core.quality.stress.cases import CASES, Case
from ssilk_core.quality.stress.outcome import CaseMeasurement, markdown
from ssilk_core.quality.stress.subject import Effort, StressSubject
from ssilk_core.quality.stress.trials import gradient_error, train_trial
from ssilk_core.scene.assets import Motion, Scene
from ssilk_core.scene.fabric_range import FabricRange
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.kinematics import motion_transforms, split_at_cuts

pytestmark = pytest.mark.usefixtures("few_contacts")

TINY = Effort(seconds=1.0, frames=0.02, steps=2, simulated=2, vertices=20, patch=20)
FABRIC = Fabric("toy", bending=1e-4)


@pytest.fixture(scope="module")
def subject(scene, toy_model) -> StressSubject:
    model = toy_model(scene, scale=0.1)
    parameters = {name: value.detach().numpy() for name, value in model.named_parameters()}
    return StressSubject(ModelFile(scene, model.config, FABRIC, model.joints, parameters), scene, None, TINY)


@pytest.fixture(scope="module")
def base(scene) -> drives.ProceduralMotion:
    return drives.sway(scene.character.skeleton, 30.0).with_loops(1.0)


# One of the cases that differ in a number alone.
KINDS = {
    (case.group, case.measure.__code__, case.allowed, case.name if case.group in ("motion", "slivers") else ""): case
    for case in reversed(CASES)
}


@pytest.mark.parametrize("case", KINDS.values(), ids=lambda case: f"{case.group}: {case.name}")
def test_the_product_does_what_it_may(subject, case):
    outcome = case.run(subject)
    assert case.allows(outcome.verdict), outcome.said
    if outcome.verdict == "refuses":
        assert outcome.said.endswith(".") and "\n" not in outcome.said
    elif outcome.verdict == "does not apply":  # the toy sees no colliders and one fabric, and nothing is stitched
        assert case.name.startswith(("through", "in one", "stretch", "no density")), outcome.said
    else:
        found = outcome.measured.extent
        assert found.finite and 0 <= found.distance <= found.allowed and found.latent <= 4.001
        assert len(outcome.row()) == markdown([outcome]).splitlines()[0].count("|") - 1


def test_names_are_unique_and_match():
    names = [f"{case.group}: {case.name}" for case in CASES]
    assert len(set(names)) == len(names)
    assert [case.name for case in CASES if case.matches(["size: 1"])] == ["100 m"]


@pytest.mark.parametrize("points", [np.nan, 1e3])
def test_what_leaves_all_bounds_is_a_fault(subject, monkeypatch, points):
    monkeypatch.setattr(meter, "decode", lambda model, motion, pose: np.full((pose.frame_count, 60, 3), points))
    outcome = Case("motion", "none", measures.roll_out_motion(lambda subject, base: base)).run(subject)
    assert outcome.verdict == "breaks" and not outcome.measured.extent.bounded


def test_what_raises_is_a_fault_and_what_is_refused_is_none(subject):
    def stumbles(subject: StressSubject) -> CaseMeasurement:
        raise RuntimeError("numbers ran out\nmore")

    assert Case("", "", stumbles).run(subject).said == "RuntimeError: numbers ran out"
    nan = next(case for case in CASES if "NaN" in case.name).run(subject)
    assert nan.verdict == "refuses" and "first number 7" in nan.said


def test_a_lost_rollout_falls_back(subject):
    lost = replace(
        subject,
        file=replace(subject.file, config=replace(subject.file.config, latent_bound=0.0, max_latent_step=0.0)),
    )
    lost.file.parameters["integrator.beta"] = np.full(lost.file.config.latent, -3.0, dtype=np.float32)
    outcome = Case("motion", "none", measures.roll_out_motion(lambda subject, base: base), ("falls back",)).run(lost)
    assert outcome.verdict == "falls back" and outcome.measured.extent.recovered > 10


# What surrounds the character


def outcome_of(subject, monkeypatch, measure, moved):
    """The outcome of a measure where cloth is moved by so much [m] as soon as anything surrounds the character."""
    found = lambda model, drive: subject.free[: drive.frames] + (moved if drive.felt else 0.0)  # noqa: E731
    monkeypatch.setattr(measures, "positions", found)
    return Case("", "", measure).run(subject)


def test_cloth_that_goes_against_the_wind_is_a_fault(subject, monkeypatch):
    measure = measures.roll_out_wind(surroundings.steady(60.0))
    outcome = outcome_of(subject, monkeypatch, measure, [0.3, 0, 0])
    assert outcome.verdict == "works" and outcome.measured.error == pytest.approx(0.3)
    assert outcome_of(subject, monkeypatch, measure, [-0.3, 0, 0]).said.startswith("ArithmeticError: wind moves")


def test_cloth_that_heeds_no_prop_or_never_forgets_it_is_a_fault(subject, toy_model, monkeypatch):
    model = toy_model(subject.scene, proximity_points=8)
    parameters = {name: value.detach().numpy() for name, value in model.named_parameters()}
    seeing = replace(subject, file=replace(subject.file, config=model.config, parameters=parameters))
    measure = measures.roll_out_prop(surroundings.appearing)
    assert "of the cloth are inside" in outcome_of(seeing, monkeypatch, measure, 0.0).said
    assert "leaves cloth 5.2 m away" in outcome_of(seeing, monkeypatch, measure, 3.0).said


def test_a_prop_is_where_it_says_in_the_frames_that_it_says(scene, base):
    motion, still = base.motion(), np.tile(scene.garment.mesh.points[None], (361, 1, 1))
    prop = surroundings.appearing(scene, motion, still)
    (box,) = prop.world(motion.fps).colliders
    assert np.flatnonzero(np.diff(prop.present.astype(int))).tolist() == [29, 59, 149, 179, 269, 299]
    middle = box.placements[:, :3, 3] - motion_transforms(motion, scene.character.skeleton.parents)[:, 0, :3, 3]
    np.testing.assert_allclose(middle, np.broadcast_to(still[0, -5:].mean(axis=0), (361, 3)), atol=0.02)
    inside = np.abs(still[0] - middle[0]).max(axis=1) < 0.15 * worlds.garment_size(scene) - 5e-3
    assert 0 < prop.share_inside(still) == pytest.approx(inside.mean())
    passed = surroundings.passing(2.0)(scene, motion, still).places[:, 0]
    assert passed[60] == pytest.approx(0) and np.ptp(passed) == pytest.approx(2 * (4 - 1 / 30))


# Models


def test_a_fabric_beyond_the_range_is_told(subject, toy_model, monkeypatch):
    range_ = FabricRange.of(FABRIC, ["4"])
    seen = SeenFabrics(range_, unseen(subject.file.parameters))
    ranged = replace(subject, file=replace(subject.file, fabrics=seen))
    found = {factor: Case("", "", measures.roll_out_fabric(stretch=factor)).run(ranged) for factor in (4.0, 10.0)}
    assert {outcome.verdict for outcome in found.values()} == {"works"}
    assert not found[4.0].said and "beyond: stretch 10 (trained from 0.25 to 4)" in found[10.0].said
    monkeypatch.setattr(FabricRange, "beyond", lambda self, factors: "")
    assert "nothing is told" in Case("", "", measures.roll_out_fabric(stretch=10.0)).run(ranged).said


def test_a_finer_model_rests_where_it_did_and_one_that_does_not_is_a_fault(subject):
    file, scene = worlds.refine_model(subject.file, subject.scene, 400)
    assert scene.garment.mesh.vertex_count == 400 and len(np.unique(scene.garment.mesh.faces)) == 400
    found = measures.roll_out_changed(subject, file, scene, subject.base)
    assert found.error < 1e-6 and found.extent.bounded
    broken = replace(file, parameters=file.parameters | {"decoder.shapes": 2 * file.parameters["decoder.shapes"]})
    with pytest.raises(ArithmeticError, match="at rest it is"):
        measures.roll_out_changed(subject, broken, scene, subject.base)


# Motions


def test_drives_are_the_same_in_blocks_and_repeat(base):
    whole = base.motion()
    parts = list(base.blocks(7))
    np.testing.assert_array_equal(whole.rotations, np.concatenate([part.rotations for part in parts]))
    length = round(base.loop * base.fps)
    np.testing.assert_allclose(whole.rotations[:length], whole.rotations[length : 2 * length], atol=1e-12)
    assert whole.frame_count == 3 * length + 1


def test_a_clip_loops_there_and_back_at_its_own_speed(scene, toy_motion):
    clip = toy_motion(scene, 61, 30.0)
    loop = drives.loop_clip(clip, 30.0)
    length = round(loop.loop * 30)
    motion = replace(loop, frames=2 * length + 1).motion()
    assert length == round(np.pi * 60)
    np.testing.assert_allclose(motion.translations[length], clip.translations[0], atol=1e-9)
    np.testing.assert_allclose(motion.translations[length // 2], clip.translations[60], atol=1e-3)
    np.testing.assert_allclose(motion.translations[1:length], motion.translations[1:length][::-1], atol=1e-9)


def test_a_turn_turns_everything_about_the_first_joint(scene, base):
    skeleton = scene.character.skeleton
    spun = drives.rotate_character(base, skeleton, drives.about((0, 1, 0), speed=30.0)).motion(0, 5)
    before, after = (motion_transforms(motion, skeleton.parents) for motion in (base.motion(0, 5), spun))
    angle = 30.0 * np.arange(5) / 30
    turn = np.zeros((5, 1, 3, 3))
    turn[:, 0, 1, 1], turn[:, 0, 0, 0], turn[:, 0, 2, 2] = 1, np.cos(angle), np.cos(angle)
    turn[:, 0, 0, 2], turn[:, 0, 2, 0] = np.sin(angle), -np.sin(angle)
    np.testing.assert_allclose(after[..., :3, :3], turn @ before[..., :3, :3], atol=1e-12)
    arms = before[..., :3, 3] - before[:, :1, :3, 3]
    moved = before[:, :1, :3, 3] + (turn @ arms[..., None])[..., 0]
    np.testing.assert_allclose(after[..., :3, 3], moved, atol=1e-12)


def test_rides_are_no_cuts_and_teleports_are(scene, base):
    skeleton = scene.character.skeleton
    ride = drives.translate_character(base, measures.ride, skeleton).motion()
    steps = np.diff(ride.translations[:, 0, 0] - base.motion().translations[:, 0, 0])
    np.testing.assert_allclose(steps * 30, 50.0)
    assert len(split_at_cuts(ride, skeleton)) == 1
    assert (
        len(split_at_cuts(drives.translate_character(base, measures.jumps, skeleton).motion(), skeleton)) == 13
    )  # after each of 12 s


def test_stopped_contorted_and_broken_motions_are_what_they_say(scene, base):
    skeleton = scene.character.skeleton
    held = drives.freeze_after(base, 0.5).motion().rotations
    assert np.ptp(held[15:], axis=0).max() == 0 < np.ptp(held[:15], axis=0).max()
    wild = drives.randomize_rotations(base, skeleton, 0.5).motion()
    roots = skeleton.parents < 0
    np.testing.assert_array_equal(wild.rotations[:, roots], base.motion().rotations[:, roots])
    assert np.abs((wild.rotations[0] * wild.rotations[15]).sum(-1))[~roots].min() < 0.9
    with pytest.raises(SsilkError, match="1 of 361 frames of rotations hold NaN or infinity, first number 7;"):
        drives.insert_nan(base, 7).motion()


# What is measured


def test_a_garment_on_linear_blend_skinning_is_nowhere_else_and_moves_as_it_does(scene, base):
    """Pinned to a root that spins, a vertex at a distance r from the axis moves at r w."""
    held = drives.rotate_character(
        drives.freeze_after(base, 0.0), scene.character.skeleton, drives.about((0, 1, 0), speed=6.0)
    )
    motion = held.motion(0, 20)
    matrices, origin = meter.matrices_about_root(motion, scene)
    tool = meter.ExtentMeter(scene, FABRIC, 30.0, [range(1, 5), range(10, 20)])
    lbs = tool.skin(tool.rest, None, tool.skin.weights, matrices).permute(2, 0, 1).numpy() + origin
    tool.add(motion, lbs)
    radius = np.linalg.norm((lbs - origin)[0][:, [0, 2]], axis=1).max()
    assert tool.distance < 1e-9 and tool.growth == pytest.approx(1.0, abs=1e-9)
    assert tool.speed == pytest.approx(2 * radius * np.sin(0.1) * 30, rel=1e-6)
    tool.add(motion, lbs + [0, 0, 0.25])
    assert tool.distance == pytest.approx(0.25)


def test_growth_compares_the_second_loop_with_the_last(base):
    assert meter.compared_loops(base) == (range(120, 240), range(240, 360))
    assert meter.compared_loops(replace(base, frames=100)) == ()


def test_streaming_gives_what_a_bake_gives(subject, monkeypatch):
    baked = meter.positions(subject.model, subject.base)
    monkeypatch.setattr(meter, "STREAMING_FRAMES", 100)
    streamed = meter.positions(subject.model, subject.base)
    np.testing.assert_allclose(streamed, baked, atol=1e-5)


def test_a_model_of_another_rate_is_measured_at_its_own(subject):
    odd = replace(subject, file=replace(subject.file, config=replace(subject.file.config, fps=23.976)))
    outcome = next(case for case in CASES if case.matches(["rate: 60"])).run(odd)
    assert outcome.verdict == "works" and outcome.measured.error is None


def test_a_clip_of_one_frame_is_a_pose_that_is_held(subject, toy_motion):
    still = replace(subject, clip=toy_motion(subject.scene, 1))
    found = next(case for case in CASES if case.matches(["upside down"])).run(still).measured.extent
    assert found.finite and found.speed < 1e-3 and found.growth == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_double_precision_is_its_own_truth_and_half_is_not(subject):
    exact = subject.in_precision(torch.float64)
    assert meter.precision_errors(exact, exact, subject.base) == (0, 0)
    single, half = (
        meter.precision_errors(subject.in_precision(dtype), exact, subject.base)[1]
        for dtype in (torch.float32, torch.bfloat16)
    )
    assert 0 < 100 * single < half


# Scenes


@pytest.mark.parametrize("scale", [1e-3, 100.0])
def test_a_larger_scene_is_the_same_but_larger(scene, base, scale):
    large = worlds.scale_scene(scene, scale)
    assert worlds.garment_size(large) == pytest.approx(scale * worlds.garment_size(scene))
    pair = []
    for world, drive in ((scene, base), (large, drives.scale_motion(base, scale))):
        tool = meter.ExtentMeter(world, FABRIC, 30.0)
        pair.append(
            tool.skin(tool.rest, None, tool.skin.weights, meter.matrices_about_root(drive.motion(0, 3), world)[0])
        )
    torch.testing.assert_close(pair[1], scale * pair[0])


@pytest.fixture
def elsewhere(scene):
    """The garment on a body for which it was not sewn."""
    return replace(scene, garment=replace(scene.garment, sewn=0.8 * scene.garment.mesh.points))


def test_a_garment_on_another_body_is_scaled_with_the_shape_it_was_sewn_in(elsewhere):
    large = worlds.scale_scene(elsewhere, 100.0)
    np.testing.assert_allclose(large.garment.sewn, 80.0 * elsewhere.garment.mesh.points)


def test_slivers_of_a_garment_on_another_body_are_sewn_as_such(elsewhere):
    mesh = worlds.add_slivers(elsewhere, 1e-3, every=20).garment.sewn_mesh
    a, b, c = mesh.points[mesh.faces[::20]].swapaxes(0, 1)
    ratio = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.linalg.norm(b - a, axis=1) ** 2
    assert np.isclose(ratio, 1e-3, rtol=1e-6).sum() >= 3


@pytest.mark.parametrize("count", [30, 60, 500, 2000])
def test_a_garment_of_any_number_of_vertices(scene, count):
    found = worlds.resize_garment(scene, count)
    mesh = found.garment.mesh
    assert count - 3 <= mesh.vertex_count <= count
    assert len(np.unique(mesh.faces)) == mesh.vertex_count and set(found.classes) <= set(scene.classes)
    whole = scene.garment.mesh.points
    assert (mesh.points.min(0) >= whole.min(0) - 1e-9).all() and (mesh.points.max(0) <= whole.max(0) + 1e-9).all()


@pytest.mark.parametrize("height", [1e-2, 1e-5])
def test_slivers_are_as_high_as_asked(scene, height):
    mesh = worlds.add_slivers(scene, height, every=20).garment.mesh
    a, b, c = mesh.points[mesh.faces[::20]].swapaxes(0, 1)
    base = np.linalg.norm(b - a, axis=1)
    ratio = np.linalg.norm(np.cross(b - a, c - a), axis=1) / base**2
    assert np.isclose(ratio, height, rtol=1e-6).sum() >= 3


def stretched(world: Scene, motion: Motion) -> float:
    """Stretch energy of linear blend skinning whose points are moved at random by a millimetre."""
    tool = meter.ExtentMeter(world, FABRIC, 30.0)
    x = tool.skin(tool.rest, None, tool.skin.weights, meter.matrices_about_root(motion, world)[0])
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    return float(tool.energy.stretch(x + 1e-3 * noise))


def test_slivers_do_not_outweigh_the_garment(scene, base):
    found = [
        stretched(worlds.add_slivers(scene, height, every=20), base.motion(0, 1)) for height in (1e-2, 1e-3, 1e-5)
    ]
    assert max(found) < 3 * min(found)


def test_single_precision_costs_what_rounding_costs(scene, base):
    assert 1e-8 < gradient_error(scene, FABRIC, base.motion(0, 1)) < 1e-3


def test_a_trial_trains_what_it_says(scene, base):
    trial = train_trial(scene, FABRIC, replace(base, frames=30), 2)
    assert (trial.steps, trial.undone, trial.extent.frames) == (2, 0, 30) and trial.extent.bounded


def test_a_training_that_never_moves_is_a_fault(subject):
    def measure(subject: StressSubject) -> CaseMeasurement:
        trial = train_trial(subject.scene, FABRIC, replace(subject.base, frames=30), 2)
        return measures.trial_measurement(replace(trial, undone=2))

    assert Case("", "", measure).run(subject).said == "ArithmeticError: 2 of 2 steps undone"
