# SPDX-License-Identifier: Apache-2.0
"""Playing without PyTorch: what comes out is what the network in PyTorch gives, in whatever order it is asked for."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssilk_core.demo.motions import demo_shot
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import model_file, save_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.parameters import parameter_shapes
from ssilk_core.network.rollout import decode, garment_poses, roll
from ssilk_core.network.runtime import Playback, Player
from ssilk_core.network.runtime.character import character_matrices
from ssilk_core.network.runtime.decoder import NumpyDecoder
from ssilk_core.network.runtime.playback import BLOCK
from ssilk_core.network.runtime.stepper import SoftClamp
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.scene.assets import Motion
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import deform, resample

FRAMES = 150  # more than two blocks of decoded frames, the last one short


def player_of(model: GarmentModel) -> Player:
    return Player(model_file(model, FABRICS["silk"], {}))


def expected_vertices(model: GarmentModel, motion) -> np.ndarray:
    return np.concatenate([decode(model, motion, pose) for pose in garment_poses(model, motion, motion.fps)])


def states_of(model: GarmentModel, motion) -> np.ndarray:
    return player_of(model).play(motion).rolled_spans[0].states(motion.frame_count)


def all_vertices(playback) -> np.ndarray:
    return np.stack([playback.vertices(frame) for frame in range(playback.frame_count)])


@pytest.fixture(scope="module")
def model(scene, toy_model) -> GarmentModel:
    # Weak enough not to be chaotic, so that rounding in another order stays rounding.
    return toy_model(scene, scale=0.1).eval()


@pytest.fixture(scope="module")
def motion(scene, toy_motion):
    return toy_motion(scene, FRAMES)


@pytest.fixture(scope="module")
def playback(model, motion):
    return player_of(model).play(motion)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"widths": (16, 24, 12)},
        {"latent_bound": 0.0, "max_latent_step": 0.0},
        {"shapes": 0},
        {"translations": True},
    ],
)
@pytest.mark.parametrize("proxies, shuffled", [(2, False), (2, True), (0, False)])
def test_vertices_are_those_of_the_network(toy_scene, toy_model, toy_motion, options, proxies, shuffled):
    scene = toy_scene(proxies=proxies, shuffled=shuffled)
    model, motion = toy_model(scene, scale=0.1, **options).eval(), toy_motion(scene, 20)
    np.testing.assert_allclose(
        all_vertices(player_of(model).play(motion)), expected_vertices(model, motion), rtol=0, atol=1e-5
    )


def windy(motion):
    """The motion in a wind that turns and grows."""
    at = np.linspace(0, 1, motion.frame_count)[:, None]
    return replace(motion, gravity=(1 - at) * [0, -9.81, 0] + at * [25.0, -2.0, 8.0])


@pytest.mark.parametrize("fps", [30.0, 24.0])
def test_wind_and_gravity_move_it_as_they_move_the_network(model, motion, fps):
    blown = windy(resample(motion, fps))
    playback, still = player_of(model).play(blown, pre_roll=0.5), player_of(model).play(replace(blown, gravity=None))
    expected = [decode(model, blown, pose) for pose in garment_poses(model, blown, fps, pre_roll=0.5)]
    found = all_vertices(playback)
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=0, atol=1e-5)
    assert np.abs(found - all_vertices(still)).max() > 1e-3
    later = replace(blown, gravity=blown.gravity + np.where(np.arange(blown.frame_count)[:, None] < 60, 0, 5.0))
    np.testing.assert_array_equal(all_vertices(playback.with_motion(later, 60))[:59], found[:59])


def test_limits_are_reached_and_kept_as_in_the_network(scene, toy_model, motion):
    model = toy_model(scene, scale=0.1, latent_bound=0.2, max_latent_step=0.02).eval()
    free = toy_model(scene, scale=0.1, latent_bound=0.0, max_latent_step=0.0).eval()
    states = states_of(model, motion)
    assert 0.1 < np.abs(states).max() < 0.2001 < np.abs(states_of(free, motion)).max()
    found, theirs = player_of(model).play(motion).poses(), garment_poses(model, motion, motion.fps)
    np.testing.assert_allclose(next(found).weights[-1], next(theirs).weights[63], atol=1e-5)


def test_s_is_limited_as_in_the_network(scene, toy_model, motion):
    model = toy_model(scene, scale=0.2, velocity_allowance=0.0).eval()
    free = toy_model(scene, scale=0.2, velocity_allowance=1.0).eval()
    assert np.abs(states_of(model, motion) - states_of(free, motion)).max() > 0.01  # the limit is met
    playback = player_of(model).play(motion)
    np.testing.assert_allclose(all_vertices(playback), expected_vertices(model, motion), atol=1e-4)


@pytest.mark.parametrize("bound", [0.0, 0.3, 4.0])
def test_a_limit_is_that_of_the_integrators(bound):
    from ssilk_core.network.model.integrators import soft_clamp

    for reach in (0.1, 1.0, 30.0):
        values = np.linspace(-reach, reach, 101, dtype=np.float32)
        expected = soft_clamp(torch.from_numpy(values.copy()), bound)
        SoftClamp(bound, values.shape)(values)
        np.testing.assert_allclose(values, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("translations", [False, True], ids=["turning", "moving"])
def test_poses_are_what_a_file_stores(scene, toy_model, motion, translations):
    model = toy_model(scene, scale=0.1, translations=translations).eval()
    playback = player_of(model).play(motion)
    mine, theirs = list(playback.poses()), list(garment_poses(model, motion, motion.fps))
    assert [pose.start for pose in mine] == [0, 64, 128] and sum(pose.frame_count for pose in mine) == FRAMES
    for name in ("rotations", "weights", *(["translations"] if translations else [])):
        found, expected = (np.concatenate([getattr(pose, name) for pose in poses]) for poses in (mine, theirs))
        np.testing.assert_allclose(found, expected, atol=5e-5)
        assert np.ptp(found, axis=0).max() > 0.01  # it moves


def test_a_reader_of_the_file_deforms_to_the_same_vertices(model, motion, playback):
    frames = np.concatenate([deform(model.deformer(), motion, pose) for pose in playback.poses()])
    np.testing.assert_allclose(all_vertices(playback), frames, atol=1e-5)


@pytest.mark.parametrize("options", [{}, {"shapes": 0}, {"activations": 9}])
def test_what_hosts_are_given_is_what_files_hold(scene, toy_model, options):
    model = toy_model(scene, **options)
    mine, theirs = player_of(model).deformer(), model.deformer()
    np.testing.assert_allclose(mine.shapes, theirs.shapes, atol=1e-7)
    joints = len(scene.joint_names)
    np.testing.assert_allclose(mine.skin.dense(joints), theirs.skin.dense(joints), atol=1e-6)


def test_matrices_are_those_of_forward_kinematics(model, motion, playback):
    character = torch.from_numpy(character_matrices(motion, model.scene.character.skeleton)[0])
    step = next(roll(model, motion, FRAMES))
    expected = model.decoder.proxy_matrices(step.transforms, character).detach().numpy()
    for frame in (0, 63, 64, FRAMES - 1):
        matrices, origin = playback.matrices(frame)
        np.testing.assert_allclose(matrices, expected[..., frame], atol=1e-5)
        np.testing.assert_array_equal(origin, motion.translations[frame, 0])


def test_any_order_gives_the_same_bits(model, motion, playback):
    order = np.random.default_rng(0).permutation(FRAMES)
    other = player_of(model).play(motion)
    shuffled = {int(frame): (other.vertices(int(frame)), *other.matrices(int(frame))) for frame in order}
    for frame in range(FRAMES):
        for mine, theirs in zip(shuffled[frame], (playback.vertices(frame), *playback.matrices(frame))):
            np.testing.assert_array_equal(mine, theirs)


def test_negative_frames_count_from_the_end_and_others_are_refused(playback):
    np.testing.assert_array_equal(playback.vertices(-1), playback.vertices(FRAMES - 1))
    for frame in (FRAMES, -FRAMES - 1):
        with pytest.raises(IndexError):
            playback.vertices(frame)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_shortest_motions_play(model, scene, toy_motion, frames):
    motion = toy_motion(scene, frames)
    np.testing.assert_allclose(
        all_vertices(player_of(model).play(motion)), expected_vertices(model, motion), atol=1e-5
    )


def test_far_from_the_origin_nothing_is_lost(model, motion, playback):
    far = motion.translations.copy()
    far[:, 0] += [3000.0, 40, -7000]
    found = player_of(model).play(replace(motion, translations=far)).vertices(5)
    np.testing.assert_allclose(found - [3000, 40, -7000], playback.vertices(5), atol=1e-5)


@pytest.mark.parametrize("fps", [24.0, 29.97, 60.0])
def test_motions_of_other_rates_are_interpolated_as_in_a_bake(model, motion, fps):
    shot = resample(motion.clip(0, 90), fps)
    playback = player_of(model).play(shot, block=16)
    mine, theirs = list(playback.poses()), list(garment_poses(model, shot, fps))
    found, expected = (np.concatenate([pose.weights for pose in poses]) for poses in (mine, theirs))
    np.testing.assert_allclose(found, expected, atol=5e-5)
    found, expected = (np.concatenate([pose.rotations for pose in poses]) for poses in (mine, theirs))
    np.testing.assert_allclose(np.abs((found * expected).sum(-1)), 1, atol=1e-8)  # q and -q are the same rotation
    np.testing.assert_allclose(all_vertices(playback), expected_vertices(model, shot), atol=2e-5)


@pytest.mark.parametrize("fps", [24.0, 30.0])
def test_a_garment_starts_anew_where_the_motion_is_cut(model, motion, fps):
    shot = resample(motion.clip(0, 80), fps)
    far = shot.translations.copy()
    far[37:, 0] += [9.0, 0, 4]
    shot = replace(shot, translations=far)
    playback = player_of(model).play(shot, block=16)
    assert playback.firsts == [0, 37]
    np.testing.assert_allclose(all_vertices(playback), expected_vertices(model, shot), atol=2e-5)
    assert [pose.start for pose in playback.poses()] == [0, 16, 32, 37, 53, *([69] if fps == 30 else [])]
    np.testing.assert_array_equal(playback.pose(40).weights, list(playback.poses())[3].weights[3:4])


@pytest.mark.parametrize("fps", [24.0, 30.0])
def test_what_changes_later_leaves_the_frames_before_as_they_are(model, motion, fps):
    """Bit by bit what a new playback gives, with the frames before taken over rather than rolled again."""
    shot = resample(motion.clip(0, 90), fps)
    edited = shot.rotations.copy()
    edited[50:] = edited[50:, ::-1]
    edited = replace(shot, rotations=edited)
    player = player_of(model)
    before = player.play(shot, block=8)
    before.vertices(70)
    after, anew = before.with_motion(edited, 50), player.play(edited, block=8)
    assert 32 <= after.rolled_spans[0].rolled <= 64 and anew.rolled_spans[0].rolled == 0
    for frame in (69, 10, 50, 49):
        np.testing.assert_array_equal(after.vertices(frame), anew.vertices(frame))
    assert not np.array_equal(after.vertices(69), before.vertices(69))
    assert before.with_motion(edited, 0).rolled_spans[0].rolled == 0


@pytest.mark.parametrize("fps", [24.0, 30.0])
def test_garments_run_up_to_the_first_frame_as_in_a_bake(model, motion, fps):
    shot = resample(motion.clip(0, 60), fps)
    playback = player_of(model).play(shot, pre_roll=0.7, block=16)
    theirs = np.concatenate([pose.weights for pose in garment_poses(model, shot, fps, pre_roll=0.7)])
    for frame in (40, 0, 17):
        np.testing.assert_allclose(playback.pose(frame).weights[0], theirs[frame], atol=5e-5)
    assert np.abs(theirs[0] - player_of(model).play(shot).pose(0).weights[0]).max() > 1e-3
    edited = replace(shot, rotations=np.concatenate([shot.rotations[:40], shot.rotations[40:, ::-1]]))
    after, anew = playback.with_motion(edited, 40), player_of(model).play(edited, pre_roll=0.7, block=16)
    assert after.rolled_spans[0].rolled > after.rolled_spans[0].before == 21
    np.testing.assert_array_equal(after.vertices(47), anew.vertices(47))


def test_lost_states_rest_for_a_while_as_in_a_bake(scene, toy_model, motion):
    model = toy_model(scene, scale=0.1, latent_bound=0.0, max_latent_step=0.0).eval()
    with torch.no_grad():
        model.integrator.beta.fill_(1.6)  # flies off
    mine, theirs = (
        states_of(model, motion),
        np.concatenate([pose.weights for pose in garment_poses(model, motion, 30.0)]),
    )
    assert np.isfinite(mine).all() and 100 < np.abs(mine).max() < 1000
    found = np.concatenate([pose.weights for pose in player_of(model).play(motion, block=256).poses()])
    np.testing.assert_allclose(found, theirs, atol=1e-3)


@pytest.mark.parametrize("beta", [0.9, 1.6], ids=["steady", "lost at times"])
def test_what_s_saw_of_each_state_is_what_its_frame_shows(scene, toy_model, motion, beta, monkeypatch):
    model = toy_model(scene, scale=0.1, latent_bound=0.0, max_latent_step=0.0).eval()
    with torch.no_grad():
        model.integrator.beta.fill_(beta)
    playback, decode_again = player_of(model).play(motion), NumpyDecoder.decode
    monkeypatch.setattr(NumpyDecoder, "decode", None)  # a second time
    found = [playback._at(first)[0].decoded for first in range(0, FRAMES, BLOCK)]
    expected = decode_again(playback.player.decoder, playback.rolled_spans[0].states(FRAMES))
    for name, value in zip(("activations", "transforms"), expected):
        shown = np.concatenate([getattr(decoded, name) for decoded in found], axis=-1)
        np.testing.assert_allclose(shown, value, atol=1e-4)


@pytest.fixture
def compiled(monkeypatch) -> Callable[[Player, Motion], tuple[Playback, Playback]]:
    """What plays a motion with numpy alone, and again in compiled loops, as a longer one."""
    pytest.importorskip("numba")

    def play(player: Player, motion: Motion) -> tuple[Playback, Playback]:
        alone = player.play(motion)
        monkeypatch.setattr("ssilk_core.network.runtime.playback.COMPILED_FROM", motion.frame_count)
        looped = player.play(motion)
        assert player.stepper._compiled() and looped.compiled and not alone.compiled
        return alone, looped

    return play


@pytest.mark.parametrize("options", [{}, {"translations": True}, {"proximity_points": 3}])
@pytest.mark.parametrize("proxies, shuffled", [(2, True), (0, False)])
def test_compiled_loops_are_what_numpy_is(toy_scene, toy_model, toy_motion, compiled, options, proxies, shuffled):
    scene = toy_scene(proxies=proxies, shuffled=shuffled)
    model, motion = toy_model(scene, scale=0.1, **options).eval(), toy_motion(scene, 70)
    if "proximity_points" in options:  # planes in which points lie
        near = np.random.default_rng(0).normal(size=(70, model.proximity // 3, 5)) * [1, 1, 1, 0.1, 0.5]
        motion = replace(motion, proximity=near)
    alone, looped = compiled(player_of(model), motion)
    np.testing.assert_allclose(all_vertices(looped), all_vertices(alone), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "options", [{"latent_bound": 0.2, "max_latent_step": 0.02}, {"scale": 0.2, "velocity_allowance": 0.0}]
)
def test_compiled_loops_are_what_numpy_is_where_limits_are_met(scene, toy_model, motion, compiled, options):
    model = toy_model(scene, **({"scale": 0.1} | options)).eval()  # as above
    alone, looped = map(all_vertices, compiled(player_of(model), motion))
    np.testing.assert_allclose(looped, alone, rtol=0, atol=1e-4)


def test_compiled_loops_lose_states_as_numpy_does(scene, toy_model, motion, compiled):
    model = toy_model(scene, scale=0.1, latent_bound=0.0, max_latent_step=0.0).eval()
    with torch.no_grad():
        model.integrator.beta.fill_(1.6)  # flies off
    alone, looped = (playback.rolled_spans[0].states(FRAMES) for playback in compiled(player_of(model), motion))
    assert 100 < np.abs(alone).max() < 1000
    np.testing.assert_allclose(looped, alone, rtol=1e-3, atol=1e-3)


def test_integers_of_a_file_stay_integers_in_compiled_loops(compiled):
    player = Player.load(shipped_path("cape"))
    alone, looped = compiled(player, demo_shot(player.skeleton).clip(0, FRAMES))
    # What rounding in another order comes to in a recurrence; PyTorch is as far off (see above).
    np.testing.assert_allclose(all_vertices(looped), all_vertices(alone), rtol=0, atol=1e-5)
    assert {weights.dtype for weights in player.stepper._arrays[2][2][0]} == {np.dtype(np.int16)}


def test_schemes_without_loops_play_long_motions_with_numpy(scene, toy_model, toy_motion, monkeypatch):
    monkeypatch.setattr("ssilk_core.network.runtime.playback.COMPILED_FROM", 20)
    model = toy_model(scene, scale=0.1, scheme="verlet").eval()
    motion, player = toy_motion(scene, 20), player_of(model)
    assert player.stepper._compiled() is None
    exact = expected_vertices(model.double(), motion)  # nothing draws rounding back: PyTorch's grows to 1e-5
    np.testing.assert_allclose(all_vertices(player.play(motion)), exact, rtol=0, atol=1e-5)


def test_a_motion_of_another_character_is_refused(model, scene, toy_motion):
    player, motion = player_of(model), toy_motion(scene, 5)
    with pytest.raises(SsilkError, match="2 joints; the model's character has 3"):
        player.play(replace(motion, rotations=motion.rotations[:, :2], translations=motion.translations[:, :2]))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("widths", [(16,), (8, 24, 12)])
def test_parameter_shapes_are_those_of_the_network(scene, toy_model, scheme, widths):
    model = toy_model(scene, scheme=scheme, widths=widths)
    found = parameter_shapes(scene, model.config, model.joints)
    assert found == {name: tuple(value.shape) for name, value in model.state_dict().items()}


def test_loading_and_playing_load_no_torch(model, motion, tmp_path: Path):
    save_model(tmp_path / "model.safetensors", model_file(model, FABRICS["silk"], {}))
    np.savez(tmp_path / "motion.npz", rotations=motion.rotations, translations=motion.translations)
    code = (
        "import sys, numpy as np\n"
        "from ssilk_core.scene.assets import Motion\n"
        "from ssilk_core.network.runtime import Player\n"
        "assert 'torch' not in sys.modules\n"
        "motion = Motion('/m', 30.0, **np.load('motion.npz'))\n"
        "playback = Player.load('model.safetensors').play(motion)\n"
        "np.save('points.npy', playback.vertices(70))\n"
        "list(playback.poses())\n"
        "assert not {'torch', 'scipy', 'pxr', 'safetensors'} & sys.modules.keys()\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    expected = expected_vertices(model, motion)[70]
    np.testing.assert_allclose(np.load(tmp_path / "points.npy"), expected, rtol=0, atol=1e-5)


def test_other_schemes_are_refused(scene, toy_model, monkeypatch):
    from benchmarks.helpers.paper_schemes import PAPER_SCHEMES

    monkeypatch.setitem(SCHEMES, "direct", PAPER_SCHEMES["direct"])
    with pytest.raises(SsilkError, match="scheme is 'direct'; the runtime plays 'spring_verlet', 'verlet'"):
        player_of(toy_model(scene, scale=0.1, scheme="direct"))
