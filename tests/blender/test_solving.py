# SPDX-License-Identifier: GPL-3.0-or-later
"""Live playback of solved frames: Blender shows what a bake at that level shows, and no process is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback import playing

from .scenes import shown
from .test_panels import drawn

ROOT = Path(__file__).parents[2]
EXACT = 2e-5  # [m]
FRAMES = range(1, 41)
PATIENCE = 300  # seconds, on a busy machine


@pytest.fixture
def wanted(ready, trained, folder) -> np.ndarray:
    """What Blender shows of a bake at the level, over the same frames."""
    path = folder / "solved.npy"
    if not path.exists():
        assert ready.ops.ssilk.bake(quality="latent") == {"FINISHED"}
        np.save(path, shown(ready, trained, FRAMES))
        assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    return np.load(path)


@pytest.fixture
def windowed(monkeypatch) -> None:
    """Reading and solving go on in small steps, as where a window is to be kept alive."""
    monkeypatch.setattr(playing, "_read_all", lambda: None)


def ended(pid: int) -> bool:
    """Wait for a process to end; return whether it has."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def play(bpy, garment):
    garment.ssilk.live_quality = "latent"
    assert bpy.ops.ssilk.play_live() == {"FINISHED"}
    return playing.live(garment)


def step_until(reached) -> None:
    """Let reading and solving go on as a timer does, until it is as asked."""
    deadline = time.monotonic() + PATIENCE
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(playing._read() or 0.01)


def line(bpy) -> str:
    from blender_addon.panels.playback import PlaybackPanel

    return " ".join(drawn(PlaybackPanel, bpy.context)).partition("live_quality ")[2]


def test_every_frame_shows_what_a_bake_at_this_level_shows(ready, trained, wanted):
    live = play(ready, trained)
    assert live.solving.complete and live.solved == len(FRAMES) and not live.wrong
    found = shown(ready, trained, FRAMES)
    assert np.abs(found - wanted).max() < EXACT
    assert line(ready).startswith("Follows the armature, solved up to frame 40")
    trained.ssilk.live_quality = "NETWORK"
    assert live.solving is None
    network = shown(ready, trained, FRAMES)
    assert np.abs(network - wanted).max() > 100 * EXACT
    trained.ssilk.live_quality = "latent"
    assert np.abs(shown(ready, trained, reversed(FRAMES))[::-1] - wanted).max() < EXACT


def test_few_elements_come_near_it(ready, trained, wanted):
    trained.ssilk.live_quality = "NETWORK"
    ready.ops.ssilk.play_live()
    network = np.abs(shown(ready, trained, FRAMES) - wanted).mean()
    trained.ssilk.live_quality = "latent_few"
    assert playing.live(trained).solving.complete
    few = np.abs(shown(ready, trained, FRAMES) - wanted).mean()
    assert EXACT < few < network


def test_frames_are_shown_as_they_come_and_the_network_after_them(ready, trained, wanted, windowed):
    trained.ssilk.live_quality = "NETWORK"
    ready.ops.ssilk.play_live()
    step_until(lambda: playing.live(trained).done is None)
    network = shown(ready, trained, FRAMES)
    ready.ops.ssilk.stop_live()
    live = play(ready, trained)
    step_until(lambda: live.done is None)
    assert line(ready) == "The solver starts; the network is played"
    os.kill(live.solving.pid, signal.SIGSTOP)
    np.testing.assert_allclose(shown(ready, trained, FRAMES), network, atol=EXACT)
    os.kill(live.solving.pid, signal.SIGCONT)
    step_until(lambda: live.solved >= 8)
    os.kill(live.solving.pid, signal.SIGSTOP)
    count = live.solved
    assert count < len(FRAMES) and line(ready) == f"Solved up to frame {count} of 40; then the network is played"
    found = shown(ready, trained, FRAMES)
    assert np.abs(found[:count] - wanted[:count]).max() < EXACT
    np.testing.assert_allclose(found[count:], network[count:], atol=EXACT)
    os.kill(live.solving.pid, signal.SIGCONT)
    step_until(lambda: not live.busy)
    assert np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT


def test_an_edit_is_solved_from_where_it_begins(ready, trained, windowed):
    """At the model's rate, at which no frame looks ahead."""
    ready.context.scene.render.fps = 30
    live = play(ready, trained)
    step_until(lambda: not live.busy)
    before, pid = shown(ready, trained, FRAMES), live.solving.pid
    spine = ready.data.objects["Rig"].pose.bones["Spine"]
    spine.rotation_quaternion = (1, 0.5, 0.3, 0)
    spine.keyframe_insert("rotation_quaternion", frame=33)
    playing._read_again(ready.context.scene)  # as Blender tells of edited keys
    assert line(ready).startswith("The motion changed since it was read")
    step_until(lambda: live.done is None and not live.stale)
    assert 20 < live.solved < len(FRAMES), "what comes before the edit is kept"
    step_until(lambda: not live.busy)
    after = shown(ready, trained, FRAMES)
    assert live.solving.pid == pid
    np.testing.assert_allclose(after[:24], before[:24], atol=1e-6)
    assert np.abs(after[32:] - before[32:]).max() > 1e-3
    ready.ops.ssilk.stop_live()
    again = play(ready, trained)
    step_until(lambda: not again.busy)
    assert np.abs(shown(ready, trained, FRAMES) - after).max() < EXACT


def test_a_pose_that_is_not_keyed_is_noticed_and_solved(ready, trained, windowed):
    live = play(ready, trained)
    step_until(lambda: not live.busy)
    constraint = ready.data.objects["Rig"].pose.bones["Spine"].constraints.new("LIMIT_ROTATION")
    constraint.use_limit_x, constraint.owner_space = True, "LOCAL"
    ready.context.scene.frame_set(20)
    assert live.stale and live.solved < 20 and live.solver.noticed
    step_until(lambda: not live.busy)
    assert live.solved == len(FRAMES) and live.stale


def test_a_process_that_dies_is_told_and_the_network_played(ready, trained, wanted, windowed):
    live = play(ready, trained)
    step_until(lambda: live.solved >= 4)
    os.kill(live.solving.pid, signal.SIGKILL)
    step_until(lambda: not live.busy)
    assert line(ready) == "The network is played: its process ended with code -9."
    assert live.solving.pid is None and shown(ready, trained, FRAMES).shape == wanted.shape
    ready.ops.ssilk.refresh_live()
    step_until(lambda: not live.busy)
    assert not live.wrong and np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT


PYTHONS = {
    "gone": (None, r"cannot be started \(No such file or directory\); choose another Python"),
    "without PyTorch": (
        'import sys; sys.modules["torch"] = None; from ssilk_core.cli import main; sys.exit(main(sys.argv[3:]))',
        r"'live' needs torch, which is not installed; install the extra ssilk\[bake\]",
    ),
    "garbled": ('print("hello" * 9)', r"its answer cannot be read: it begins with b'hell'"),
}


@pytest.mark.parametrize("kind", PYTHONS)
def test_a_python_that_cannot_solve_is_told(ready, trained, ssilk_python, tmp_path, kind):
    """It was checked once, and is another one by now."""
    program, complaint = PYTHONS[kind]
    preferences, python = ready.context.preferences.addons["blender_addon"].preferences, tmp_path / "python"
    handshake = preferences.handshake
    if program:
        (tmp_path / "program.py").write_text(program)
        python.write_text(f'#!/bin/sh\nexec "{ssilk_python}" "{tmp_path}/program.py" "$@"\n')
        python.chmod(0o755)
    preferences.python, preferences.handshake = str(python), ""
    preferences.handshake = handshake
    live = play(ready, trained)
    with pytest.raises(AssertionError, match=complaint):
        assert not live.wrong
    assert line(ready).startswith("The network is played: ") and live.solving.pid is None


def test_without_a_python_it_is_refused_and_what_was_keyed_stays(ready, trained, wanted, tmp_path):
    preferences = ready.context.preferences.addons["blender_addon"].preferences
    play(ready, trained)
    ready.ops.wm.save_as_mainfile(filepath=str(tmp_path / "solved.blend"), copy=True)
    preferences.python = ""
    ready.ops.wm.open_mainfile(filepath=str(tmp_path / "solved.blend"))
    garment = ready.data.objects["Skirt"]
    assert playing.live(garment) is None and playing.reason(garment).startswith("No Python with ssilk is chosen")
    assert np.abs(shown(ready, garment, FRAMES) - wanted).max() < EXACT
    with pytest.raises(RuntimeError, match="No Python with ssilk is chosen"):
        ready.ops.ssilk.play_live()
    garment.ssilk.live_quality = "NETWORK"
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    garment.ssilk.live_quality = "latent"
    assert line(ready).startswith("The network is played: No Python with ssilk is chosen")


def test_keys_that_an_undo_brings_back_are_put_again(ready, trained, wanted, windowed):
    live = play(ready, trained)
    step_until(lambda: live.done is None)
    ready.ops.ed.undo_push(message="the network is keyed")
    step_until(lambda: not live.busy)
    trained.location.x += 1e-9
    ready.ops.ed.undo_push(message="something else")
    ready.ops.ed.undo()
    step_until(lambda: not live.busy)
    assert playing.live(ready.data.objects["Skirt"]) is live
    assert np.abs(shown(ready, ready.data.objects["Skirt"], FRAMES) - wanted).max() < EXACT


@pytest.mark.parametrize("how", ["stop", "quality", "file", "extension", "deleted", "undo"])
def test_the_process_ends_with_what_it_solves_for(ready, trained, windowed, how):
    import addon_utils

    ready.ops.ed.undo_push(message="before")
    live = play(ready, trained)
    step_until(lambda: live.solving is not None and live.solving.pid is not None)
    pid, folder = live.solving.pid, live.solving.folder
    assert folder.exists()
    if how == "stop":
        ready.ops.ssilk.stop_live()
    elif how == "quality":
        trained.ssilk.live_quality = "NETWORK"
    elif how == "file":
        ready.ops.wm.read_homefile(use_empty=True)
    elif how == "extension":
        addon_utils.disable("blender_addon", default_set=True)
        assert addon_utils.enable("blender_addon", default_set=True)
    elif how == "deleted":
        ready.data.objects.remove(ready.data.objects["Rig"])
        ready.context.scene.frame_set(10)
    else:
        trained.ssilk.live = False
        playing._undone()
    assert ended(pid) and not folder.exists()


KILLED = """
    import os, signal, sys, time
    sys.path[:0] = [{root!r}, {usd!r}]
    import bpy, addon_utils
    addon_utils.enable("blender_addon", default_set=True)
    preferences = bpy.context.preferences.addons["blender_addon"].preferences
    preferences.python = {python!r}
    preferences.handshake = {handshake!r}
    from blender_addon.playback import playing
    playing._read_all = lambda: None
    bpy.ops.wm.open_mainfile(filepath={path!r})
    garment = bpy.data.objects["Skirt"]
    bpy.context.view_layer.objects.active = garment
    garment.ssilk.live_quality = "latent"
    bpy.ops.ssilk.play_live()
    live = playing.live(garment)
    while not live.solved and not live.wrong:
        time.sleep(playing._read() or 0.01)
    print("PID", live.solving.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_process_ends_with_blender_even_where_that_is_killed(ready, trained, folder, met, ssilk_python):
    program = textwrap.dedent(KILLED).format(
        root=str(ROOT), usd=str(ROOT / "usd"), python=ssilk_python, handshake=met["handshake"],
        path=str(folder / "trained.blend"),
    )  # fmt: skip
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == -signal.SIGKILL, done.stderr
    (pid,) = [int(said.split()[1]) for said in done.stdout.splitlines() if said.startswith("PID")]
    assert ended(pid)


def test_a_render_waits_for_all_frames(ready, trained, wanted, windowed):
    live = play(ready, trained)
    step_until(lambda: live.done is None)
    assert live.busy
    playing._read_all = PLAIN_READ_ALL
    playing._render_began(ready.context.scene)
    try:
        assert live.solving.complete and not live.busy
        assert np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT  # by its keys alone
    finally:
        playing._render_ended()


PLAIN_READ_ALL = playing._read_all


def test_a_render_whose_frames_cannot_be_solved_says_so(ready, trained, windowed, capfd):
    live = play(ready, trained)
    step_until(lambda: live.done is None)
    os.kill(live.solving.pid, signal.SIGKILL)
    step_until(lambda: not live.busy)
    live.solving._command[0] = "/no/python"
    playing._read_all = PLAIN_READ_ALL
    playing._render_began(ready.context.scene)
    playing._render_ended()
    assert "SSILK: The render shows the network's motion of 'Skirt'" in capfd.readouterr().out
    assert "cannot be started" in playing.warning(trained)
