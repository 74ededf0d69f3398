# SPDX-License-Identifier: Apache-2.0
"""Work in other processes, and the Python that has ssilk, without Blender."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from blender_addon.outside import python as pythons
from blender_addon.outside.work import Work
from ssilk_core import events

from .conftest import ROOT


def work(*programs: str) -> Work:
    return Work("Testing", lambda _: [[sys.executable, "-c", program] for program in programs])


def wait(running: Work) -> Work:
    deadline = time.monotonic() + 120
    while not running.poll():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return running


def test_what_ssilk_says_is_heard(capsys):
    report = events.JsonReporter()
    report(events.Progress(3, 12, terms={"stretch": float("nan")}))
    report(events.Message("half way", "warning"))
    report(events.Failed("cape.usd: no garment."))
    said = capsys.readouterr().out
    heard = wait(work(f"print({said!r}, end=''); raise SystemExit(2)"))
    assert (heard.fraction, heard.text, heard.error) == (0.25, "cape.usd: no garment.", "cape.usd: no garment.")
    heard.close()


@pytest.mark.parametrize("line", ["Collecting torch", "[1, 2]", '"event"', '{"done": 1}', "12"])
def test_other_lines_are_messages(line):
    heard = wait(work(f"print({line!r})"))
    assert (heard.text, heard.error, heard.result) == (line, "", {})
    heard.close()


def test_work_hears_events_and_ends_with_a_result():
    said = [{"event": "progress", "done": 1, "total": 4}, {"event": "result", "task": "t", "detail": {"n": 5}}]
    done = wait(work("print('first')", f"print({json.dumps(said[0])!r}); print({json.dumps(said[1])!r})"))
    assert (done.error, done.text, done.fraction, done.result) == ("", "first", 0.25, {"n": 5})
    assert done.folder.is_dir()
    done.close()
    assert not done.folder.exists()


def test_work_tells_how_far_it_is_or_else_how_long_it_has_run(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("blender_addon.outside.work.time", SimpleNamespace(monotonic=lambda: now[0]))
    running = Work("Testing", lambda _: ())
    assert running.status == "Testing"
    now[0] += 65
    assert running.status == "Testing: 1 min 05 s"
    running.fraction = 0.5
    assert running.status == "Testing: 50%"
    running.cancel()
    assert running.status == "Testing: stopping"
    running.close()


def test_a_failed_command_ends_the_work_with_its_last_word():
    failed = wait(work("import sys; print('no room', file=sys.stderr); sys.exit(3)", "print('never')"))
    assert (failed.error, failed.text) == ("Testing failed: no room", "")
    silent = wait(work("import sys; sys.exit(3)"))
    assert silent.error == "Testing failed: the command ended with code 3"
    for ended in (failed, silent):
        ended.close()


def test_a_missing_interpreter_is_one_sentence(tmp_path):
    failed = wait(Work("Testing", lambda _: [[str(tmp_path / "python")]]))
    assert (
        failed.error == f"{tmp_path / 'python'} cannot be started (No such file or directory); choose another Python."
    )
    failed.close()


@pytest.mark.parametrize("heeds", [signal.default_int_handler, signal.SIG_IGN], ids=["heeded", "ignored"])
def test_work_is_cancelled_and_leaves_nothing(heeds):
    """Also where this process ignores interrupts, as a shell's background job does."""
    before = signal.signal(signal.SIGINT, heeds)
    try:
        running = work("import time; print('up', flush=True); time.sleep(600)", "print('never')")
        assert signal.getsignal(signal.SIGINT) is heeds
    finally:
        signal.signal(signal.SIGINT, before)
    while not running.text:
        assert not running.poll()
        time.sleep(0.01)
    running.cancel()
    assert wait(running).error == "Testing was cancelled."
    running.close()
    assert not running.folder.exists()


def test_closing_stops_a_command_that_will_not_stop(monkeypatch):
    monkeypatch.setattr("blender_addon.outside.process.PATIENCE", 0.2)
    running = work("import signal, time; signal.signal(2, signal.SIG_IGN); print('up', flush=True); time.sleep(60)")
    while not running.text:
        running.poll()
    process = running._process
    running.close()
    assert process.exit_code == -9


def test_a_folder_goes_when_its_commands_cannot_be_made(tmp_path):
    def commands(folder: Path) -> list[list[str]]:
        raise ValueError(str(folder))

    with pytest.raises(ValueError, match="ssilk-"):
        Work("Testing", commands, parent=str(tmp_path))
    assert not list(tmp_path.iterdir())


def test_blenders_python_does_not_reach_the_other(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/blender/modules")
    monkeypatch.setenv("PYTHONHOME", "/blender")
    done = wait(work("import os; print([name for name in os.environ if name in ('PYTHONPATH', 'PYTHONHOME')])"))
    assert (done.text, done.error) == ("[]", "")
    done.close()


FULL = {"ssilk": "0.1.3", "usd-core": "26.11", "libigl": "2.6", "scipy": "1.17", "python": "3.11.7", "torch": None}


@pytest.mark.parametrize(
    "changed, sentence",
    [
        ({}, ""),
        ({"ssilk": None}, "/p has no ssilk; install it there, or choose a Python that has it."),
        ({"ssilk": "0.2.0"}, "/p has ssilk 0.2.0, and this extension needs 0.1; update the older of the two."),
        ({"ssilk": "0"}, "/p has ssilk 0, and this extension needs 0.1; update the older of the two."),
        ({"scipy": None}, "/p has ssilk but not scipy; install ssilk[train,bake] there."),
    ],
)
def test_a_mismatch_is_one_sentence(changed, sentence):
    assert pythons.Handshake.of("/p", {"versions": {**FULL, **changed}}).mismatch == sentence


def test_probe_tells_versions_and_device(ssilk_python):
    asked = wait(Work("Asking", lambda _: [pythons.probe_command(ssilk_python)]))
    met = pythons.Handshake.of(ssilk_python, asked.result)
    asked.close()
    assert (asked.error, met.mismatch) == ("", "")
    assert met.summary.startswith("ssilk 0.1")
    assert met.device


def environment(folder: Path, *, ssilk: bool) -> str:
    python = pythons.venv_python(folder)
    python.parent.mkdir(parents=True)
    python.touch()
    name = "ssilk-0.1.0.dist-info" if ssilk else "other-1.dist-info"
    (folder / "lib" / "python3.11" / "site-packages" / name).mkdir(parents=True)
    return str(python)


def test_environments_with_ssilk_are_found_in_order(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    active = environment(tmp_path / "active", ssilk=True)
    monkeypatch.setenv("VIRTUAL_ENV", str(tmp_path / "active"))
    environment(tmp_path / "project" / "venv", ssilk=False)
    beside = environment(tmp_path / "project" / ".venv", ssilk=True)
    named = environment(tmp_path / ".virtualenvs" / "cloth", ssilk=True)
    assert pythons.find([tmp_path / "project", tmp_path / "nowhere"]) == [active, beside, named]


def test_the_python_of_a_command_on_the_path_is_found(tmp_path, monkeypatch):
    python = environment(tmp_path / "tools", ssilk=True)
    script = tmp_path / "bin" / "ssilk"
    script.parent.mkdir()
    script.write_text(f"#!{python}\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(script.parent))
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("VIRTUAL_ENV", "CONDA_PREFIX"):
        monkeypatch.delenv(name, raising=False)
    assert pythons.find([]) == [python]


def test_an_environment_is_made_from_a_wheel(tmp_path):
    if os.name == "nt":
        pytest.skip("paths of the wheel's check are those of POSIX")
    source, folder = write_wheel(tmp_path), tmp_path / "my environment"
    commands = pythons.venv_commands(sys.executable, folder, str(source))
    made = wait(Work("Making", lambda _: [*commands, pythons.probe_command(str(pythons.venv_python(folder)))]))
    made.close()
    assert made.error == ""
    assert made.result["versions"]["ssilk"] == "0.1.9"


def write_wheel(folder: Path) -> Path:
    """A wheel of ssilk as it is, but without dependencies, so that nothing is downloaded."""
    info, path = "ssilk-0.1.9.dist-info", folder / "ssilk-0.1.9-py3-none-any.whl"
    files = {
        str(file.relative_to(root)): file.read_bytes()
        for root, package in ((ROOT, "ssilk_core"), (ROOT / "usd", "ssilk_usd"))
        for file in sorted((root / package).rglob("*"))
        if file.is_file() and "__pycache__" not in file.parts and file.suffix != ".safetensors"
    }
    files |= {
        f"{info}/METADATA": b"Metadata-Version: 2.1\nName: ssilk\nVersion: 0.1.9\n"
        b"Provides-Extra: train\nProvides-Extra: bake\n",
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD"))
    with zipfile.ZipFile(path, "w") as wheel:
        for name, content in (*files.items(), (f"{info}/RECORD", record)):
            wheel.writestr(name, content)
    return path
