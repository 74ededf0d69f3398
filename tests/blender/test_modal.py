# SPDX-License-Identifier: Apache-2.0
"""How operators watch work outside while Blender goes on, with a window that is not there."""

from __future__ import annotations

import sys
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")


class Windows:
    """A window manager that counts timers."""

    windows = ()

    def __init__(self):
        self.timers, self.handlers = [], []

    def event_timer_add(self, seconds, window):
        self.timers.append(seconds)
        return seconds

    def event_timer_remove(self, timer):
        self.timers.remove(timer)

    def modal_handler_add(self, operator):
        self.handlers.append(operator)


@pytest.fixture
def world(bpy, monkeypatch):
    """Blender with a window, in object mode; `undone` are the steps that were pushed."""
    from blender_addon.operators import tasks

    world = SimpleNamespace(tasks=tasks, window_manager=Windows(), window=None, mode="OBJECT", undone=[], told=[])
    world.workspace = SimpleNamespace(status_text_set=world.told.append)
    push = SimpleNamespace(undo_push=lambda message: world.undone.append(message))
    fake = SimpleNamespace(app=SimpleNamespace(background=False), ops=SimpleNamespace(ed=push))
    monkeypatch.setattr(tasks, "bpy", fake)
    return world


def operator(tasks, program: str):
    """An operator that runs a program outside."""

    class Run(tasks.OutsideOperator):
        undo = "Run"

        def prepare(self, context):
            return tasks.Work("Running", lambda _: [[sys.executable, "-c", program]])

        def finish(self, context, work):
            return f"said {work.text}"

        def report(self, kind, text):
            self.told = (kind, text)

    return Run()


TIMER, KEY = SimpleNamespace(type="TIMER"), SimpleNamespace(type="A")


def watch(run, world) -> set[str]:
    """Send timer events until something else than patience is answered."""
    deadline = time.monotonic() + 20
    while (answer := run.modal(world, TIMER)) == {"PASS_THROUGH"}:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return answer


def test_work_is_watched_and_its_result_taken(world):
    run = operator(world.tasks, "print('hello')")
    assert run.execute(world) == {"RUNNING_MODAL"}
    assert (world.tasks.busy(), world.window_manager.handlers) == ("Running still runs", [run])
    assert run.modal(world, KEY) == {"PASS_THROUGH"}
    assert watch(run, world) == {"FINISHED"}
    assert (run.told, world.undone) == (({"INFO"}, "said hello"), ["Run"])
    assert (world.window_manager.timers, world.tasks.current) == ([], None)
    assert world.told[:-1]
    assert all(said.startswith("Running") for said in world.told[:-1]) and world.told[-1] is None  # in the status bar
    assert not run.work.folder.exists()


def test_a_result_waits_for_object_mode(world):
    run = operator(world.tasks, "print('hello')")
    run.execute(world)
    world.mode = "EDIT_MESH"
    while "Object Mode" not in run.work.text:
        assert run.modal(world, TIMER) == {"PASS_THROUGH"}
        time.sleep(0.01)
    assert run.modal(world, TIMER) == {"PASS_THROUGH"}
    world.mode = "OBJECT"
    assert watch(run, world) == {"FINISHED"}


def test_a_failure_is_reported_and_changes_nothing(world):
    run = operator(world.tasks, "import sys; sys.exit('no luck')")
    run.execute(world)
    assert watch(run, world) == {"CANCELLED"}
    assert (run.told, world.undone) == (({"ERROR"}, "Running failed: no luck"), [])


@pytest.mark.parametrize("how", ["button", "file", "disable"])
def test_work_is_stopped(world, how):
    run = operator(world.tasks, "import time; print('up', flush=True); time.sleep(60)")
    run.execute(world)
    process = run.work._process
    while not run.work.text:
        run.modal(world, TIMER)
    if how == "button":
        run.work.cancel()
        assert watch(run, world) == {"CANCELLED"}
        assert run.told == ({"WARNING"}, "Running was cancelled.")
    elif how == "file":
        run.cancel(world)
    else:
        world.tasks.stop()
        assert run.modal(world, TIMER) == {"CANCELLED"}
    assert not process.running
    assert (world.window_manager.timers, world.tasks.current) == ([], None)
    assert not run.work.folder.exists()


def test_a_dialog_is_left_before_anything_began(world):
    """Blender tells an operator that its dialog was cancelled, too."""
    run = operator(world.tasks, "print('never')")
    run.cancel(world)
    assert (run.work, world.window_manager.timers) == (None, [])
