# SPDX-License-Identifier: Apache-2.0
"""Trainings that outlive Blender, with programs that only say what `ssilk train` would."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

from blender_addon.errors import SetupError
from blender_addon.outside import jobs

SAYS = """
import json, signal, sys, time
def say(**fields): print(json.dumps(fields), flush=True)
say(event="started", task="train", total=4, detail={})
print("a library's own words")
for done in range(1 if "--resume" not in sys.argv else 3, 5):
    say(event="progress", done=done, total=4, seconds_left=4 - done, terms={"stretch": 1 / done, "bending": None})
say(event="message", text="validation at 4", level="info")
say(event="checkpoint", path="model.safetensors", done=4, best=True)
"""
WAITS = """
import json, signal, sys, time
stopped = []
signal.signal(signal.SIGINT, lambda *_: stopped.append(1))
with open("begun", "a") as file: file.write("x")
print(json.dumps({"event": "progress", "done": 1, "total": 9, "seconds_left": None, "terms": {}}), flush=True)
for _ in range(1500):
    if stopped: break
    time.sleep(0.02)
sys.exit(130)
"""

DONE_ONCE = "import sys\nif '--resume' not in sys.argv: sys.exit()\n"
IMPROVES = """
import json, sys
with open("rounds", "a+") as file:
    file.write(json.dumps(sys.argv[1:]) + chr(10))
    file.seek(0)
    done = 10 * len(file.readlines())
print(json.dumps({"event": "progress", "done": done, "total": done, "seconds_left": 0, "terms": {}}))
if done < 40: print(json.dumps({"event": "checkpoint", "path": "model.safetensors", "done": done, "best": True}))
"""


@pytest.fixture(autouse=True)
def own_queue(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "queue_folder", lambda: tmp_path / "queue")


@pytest.fixture
def folder(tmp_path) -> Path:
    return jobs.create(tmp_path / "a file's folder, größer", "Röck")


def until(folder: Path, *states: str) -> jobs.JobState:
    """Wait until a job is in one of these states."""
    deadline = time.monotonic() + 30
    while (state := jobs.read_state(folder)) is None or state.state not in states:
        assert time.monotonic() < deadline, state
        time.sleep(0.02)
    return state


def until_heard(folder: Path) -> None:
    deadline = time.monotonic() + 30
    while not (jobs.read_state(folder) or jobs.JobState("")).done:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_state_is_what_the_training_said(folder):
    jobs.begin(sys.executable, folder, ["-c", SAYS])
    state = until(folder, "done")
    assert (state.done, state.total, state.checkpoint, state.fraction) == (4, 4, 4, 1.0)
    assert jobs.JobState("done", 3, 4).fraction == 1.0 and jobs.JobState("running", 3, 4).fraction == 0.75
    assert (state.text, state.error, state.seconds_left, state.alive) == ("validation at 4", "", None, False)
    assert state.terms == {"stretch": 0.25, "bending": None}
    assert [done for done, _ in state.curve] == [1, 2, 3, 4]


def test_a_training_whose_model_is_worse_than_none_is_done_and_says_so(folder):
    warns = "say(event='message', text='worse than none', level='warning'); sys.exit(5)"
    jobs.begin(sys.executable, folder, ["-c", SAYS + warns])
    state = until(folder, "done")
    assert (state.text, state.error, state.checkpoint) == ("worse than none", "", 4)


def test_a_curve_goes_on_where_a_job_is_resumed(folder):
    jobs.begin(sys.executable, folder, ["-c", SAYS])
    until(folder, "done")
    jobs.resume(sys.executable, folder)  # it ended before its training wrote a state: there is nothing to resume
    until(folder, "done")
    assert "--resume" not in json.loads((folder / "job.json").read_text())["command"]
    (folder / "model.resume.safetensors").touch()
    jobs.resume(sys.executable, folder)
    state = until(folder, "done")
    assert [done for done, _ in state.curve] == [1, 2, 3, 4]
    assert json.loads((folder / "job.json").read_text())["command"][-1] == "--resume"
    jobs.resume(sys.executable, folder)
    until(folder, "done")
    assert json.loads((folder / "job.json").read_text())["command"].count("--resume") == 1


def test_cancel_lets_the_training_end_by_itself(folder):
    jobs.begin(sys.executable, folder, ["-c", WAITS])
    until_heard(folder)
    with pytest.raises(SetupError, match="under way already"):
        jobs.resume(sys.executable, folder)
    jobs.cancel(folder)
    assert until(folder, "stopped").done == 1


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ('print(\'{"event": "failed", "error": "no motions."}\'); raise SystemExit(2)', "no motions."),
        ("raise SystemExit('no such module')", "no such module"),
        ("import os; os.kill(os.getpid(), 9)", "it ended without a word"),
    ],
)
def test_why_a_job_failed_is_kept(folder, program, told):
    jobs.begin(sys.executable, folder, ["-c", program])
    assert until(folder, "failed").error == told


def test_a_job_that_improves_goes_on_in_rounds_until_one_finds_nothing_better(folder):
    jobs.begin(sys.executable, folder, ["-c", IMPROVES, "--resume"], improves=True)  # as after a loss of the machine
    state = until(folder, "done")
    rounds = [json.loads(line) for line in (folder / "rounds").read_text().splitlines()]
    minutes = [float(words[-1]) for words in rounds[1:]]
    assert rounds[0] == ["--resume"] and all(words[:-1] == ["--resume", "--minutes"] for words in rounds[1:])
    assert len(minutes) == 3 and 0 < minutes[0] < minutes[1] < minutes[2]
    assert (state.round, state.checkpoint, state.done) == (3, 30, 40) and 60 * minutes[-1] < 2 * state.spent


def test_an_improvement_makes_way_for_a_training_and_goes_on_after_it(folder, tmp_path):
    jobs.begin(sys.executable, folder, ["-c", DONE_ONCE + WAITS], improves=True)
    until_heard(folder)
    jobs.begin(sys.executable, other := jobs.create(tmp_path, "B"), ["-c", SAYS])
    until(other, "done")
    assert (until(folder, "running").round, until(other, "done").round) == (1, 0)
    deadline = time.monotonic() + 30
    while len((folder / "begun").read_text()) < 2:  # an interrupt before that would be lost
        assert time.monotonic() < deadline
        time.sleep(0.02)
    jobs.cancel(folder)
    assert (until(folder, "stopped").done, jobs.read_state(folder).round) == (1, 1)


def test_an_improvement_that_somebody_else_interrupts_is_stopped(folder):
    jobs.begin(sys.executable, folder, ["-c", DONE_ONCE + "sys.exit(130)"], improves=True)
    assert until(folder, "stopped").round == 1


def test_jobs_line_up_and_one_at_a_time_runs(folder, tmp_path):
    other, third = jobs.create(tmp_path, "B"), jobs.create(tmp_path, "C")
    jobs.begin(sys.executable, folder, ["-c", WAITS])
    until_heard(folder)
    jobs.begin(sys.executable, other, ["-c", SAYS])
    jobs.begin(sys.executable, third, ["-c", SAYS])
    time.sleep(1.0)
    assert [jobs.read_state(place).state for place in (folder, other, third)] == ["running", "waiting", "waiting"]
    jobs.cancel(third)
    until(third, "stopped")
    jobs.cancel(folder)
    until(other, "done")
    assert until(folder, "stopped").done == 1
    assert jobs.read_state(third).done == 0


@pytest.mark.skipif(os.name == "nt", reason="kills by a POSIX signal")
def test_a_killed_runner_is_lost_and_leaves_its_place(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "SILENCE", 3.0)
    jobs.begin(sys.executable, folder, ["-c", WAITS])
    until_heard(folder)
    (place,) = (tmp_path / "queue").iterdir()
    os.kill(int(place.name.partition("-")[2]), signal.SIGKILL)
    assert until(folder, "lost").done == 1
    jobs.begin(sys.executable, other := jobs.create(tmp_path, "B"), ["-c", SAYS])
    until(other, "done")
    assert not list((tmp_path / "queue").iterdir())


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for a process where Linux lists them")
def test_a_training_ends_when_its_folder_is_removed(folder):
    program = f"# {folder}\n{WAITS}"
    jobs.begin(sys.executable, folder, ["-c", program])
    until_heard(folder)
    assert running(program)
    shutil.rmtree(folder)
    deadline = time.monotonic() + 30
    while running(program):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def running(program: str) -> bool:
    """Return whether a Python runs a program."""
    return any(program.encode() in read_bytes(path) for path in Path("/proc").glob("[0-9]*/cmdline"))


def read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:  # it has ended
        return b""


def test_what_cannot_be_started_or_read_is_said(folder, tmp_path):
    assert jobs.read_state(folder) is None
    with pytest.raises(SetupError, match="There is no training in"):
        jobs.resume(sys.executable, folder)
    with pytest.raises(SetupError, match="cannot be started"):
        jobs.begin(str(tmp_path / "python"), folder, [])
    (folder / "state.json").write_text("{")
    assert jobs.read_state(folder) is None
    (tmp_path / "file").touch()
    with pytest.raises(SetupError, match="cannot be made"):
        jobs.create(tmp_path / "file", "A")


def test_folders_of_jobs_are_never_used_twice(tmp_path):
    assert [jobs.create(tmp_path, "Skirt").name for _ in range(2)] == ["Skirt-001", "Skirt-002"]
