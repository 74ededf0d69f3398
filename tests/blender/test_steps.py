# SPDX-License-Identifier: Apache-2.0
"""Work that begins or ends with steps in Blender's own process, a little at a time."""

from __future__ import annotations

import sys
import time

import pytest

from blender_addon.errors import SetupError
from blender_addon.outside import work as works
from blender_addon.outside.work import Work


def steps(done: list[int], *, failing: bool = False):
    for number in range(3):
        if failing and number == 2:
            raise SetupError("'Rig' was deleted meanwhile; nothing was changed.")
        done.append(number)
        yield number / 3


@pytest.fixture(autouse=True)
def no_time(monkeypatch):
    """Let each look last for one step alone."""
    monkeypatch.setattr(works, "SLICE", -1.0)


def test_one_step_is_done_at_each_look_and_commands_follow():
    done: list[int] = []
    work = Work("Testing", lambda _: done.append(9) or [[sys.executable, "-c", "print('hello')"]], steps=steps(done))
    seen = [(work.poll(), list(done), work.fraction) for _ in range(3)]
    assert seen == [(False, [0], 0.0), (False, [0, 1], 1 / 3), (False, [0, 1, 2], 2 / 3)]
    while not work.poll():
        time.sleep(0.01)
    assert (done, work.error, work.text) == ([0, 1, 2, 9], "", "hello")
    work.close()


def test_work_may_consist_of_steps_alone():
    done: list[int] = []
    work = Work("Testing", lambda _: (), steps=steps(done))
    while not work.poll():
        pass
    assert (done, work.error) == ([0, 1, 2], "")
    work.close()


@pytest.mark.parametrize("program", ["print('hello')", "raise SystemExit(3)", None])
def test_closing_steps_follow_commands_that_succeeded(program):
    done: list[int] = []
    commands = [[sys.executable, "-c", program]] if program else []
    work = Work("Testing", lambda _: done.append(9) or commands, steps=steps(done), closing=steps(done))
    while not work.poll():
        time.sleep(0.01)
    failed = bool(program) and "SystemExit" in program
    assert done == [0, 1, 2, 9, *([] if failed else [0, 1, 2])] and bool(work.error) == failed
    work.close()


def test_a_step_that_fails_ends_the_work_before_its_commands():
    done: list[int] = []
    work = Work("Testing", lambda _: done.append(9) or (), steps=steps(done, failing=True))
    while not work.poll():
        pass
    assert (done, work.error) == ([0, 1], "'Rig' was deleted meanwhile; nothing was changed.")
    work.close()


def test_steps_end_when_work_is_cancelled():
    done: list[int] = []
    work = Work("Testing", lambda _: done.append(9) or (), steps=steps(done))
    work.poll()
    work.cancel()
    assert work.poll()
    assert (done, work.error) == ([0], "Testing was cancelled.")
    work.close()


def test_steps_that_take_no_time_are_done_at_one_look(monkeypatch):
    monkeypatch.setattr(works, "SLICE", 10.0)
    done: list[int] = []
    work = Work("Testing", lambda _: (), steps=steps(done))
    assert (work.poll(), done, work.fraction) == (True, [0, 1, 2], None)
    work.close()
