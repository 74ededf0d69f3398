# SPDX-License-Identifier: Apache-2.0
"""Farms: what docs/farm.md promises of jobs that run, fail, are killed, and run again."""

from __future__ import annotations

import importlib.util
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from pxr import Sdf, Usd
from ssilk_usd.reading import visibility as read_visibility
from ssilk_usd.shots import layers_animation, layers_asset

from ssilk_core import files
from ssilk_core.cli import main
from ssilk_core.delivery.bake import LayerFolder
from ssilk_core.delivery.farm import cluster
from ssilk_core.delivery.farm.job import read_job
from ssilk_core.errors import SsilkError
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model, save_model

BIN = Path(sys.executable).parent
SHOTS = ("a", "b", "c")
WORDS = "farm model.safetensors --stage rigged.usda --motion a.usda b.usda c.usda"


@pytest.fixture
def farm(toy, tmp_path, monkeypatch):
    """The toy world with three clips, and a job of them in `bundle`."""
    toy.copy(tmp_path)
    for index, name in enumerate(SHOTS):
        toy.write_clip(tmp_path / f"{name}.usda", frames=6 + index)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    run(f"{WORDS} --bundle bundle")
    return tmp_path


def run(words: str) -> int:
    return main(shlex.split(words))


def task(words: str = "") -> int:
    return run(f"task bundle/job.json -o out {words}")


def started(words: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "ssilk_core", "task", "bundle/job.json", "-o", "out", *shlex.split(words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def layers(folder: str = "out") -> dict[str, str]:
    found = Path(folder).rglob("*.usd*")
    return {str(path.relative_to(folder)): sha256(path) for path in found if path.is_file()}


def animations(folder: str) -> dict[str, str]:
    """Return what the shots hold, by their names; where they come from differs with the paths they were asked by."""
    found = {}
    for path in Path(folder).glob("shots/*/model/anim.usdc"):
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
        layer.customLayerData = {}
        found[path.parts[-3]] = layer.ExportToString()
    return found


def unfinished() -> list[Path]:
    return [path for path in Path("out").rglob(".*") if "partial" in path.name]


def openjd_run(chunk: int) -> subprocess.CompletedProcess[str]:
    parameters = "-p", f"Ssilk={BIN / 'ssilk'}", "-p", f"ChunkSize={chunk}", "--timestamp-format", "utc"
    command = [BIN / "openjd", "run", "bundle/template.json", *parameters]
    return subprocess.run(command, capture_output=True, text=True)


def test_commands_that_are_told_can_be_pasted_into_a_shell(farm, capsys):
    capsys.readouterr()
    assert run(f"{WORDS} --bundle 'my job' -o 'my layers' --json") == 0
    detail = json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]
    here, cloud = (shlex.split(detail[name]) for name in ("on this machine", "on Deadline Cloud"))
    assert here == ["openjd", "run", "my job/template.json", "-p", f"Output={farm / 'my layers'}"]
    assert cloud == ["deadline", "bundle", "submit", "my job"]


def test_a_job_that_no_worker_could_do_is_refused_and_nothing_is_written(farm, capsys):
    """What can be seen at the submission: no input can be read, or a file lies where a folder is to be."""
    Path("notes.txt").write_text("mine")
    Path("clips").mkdir()
    base = "farm model.safetensors --stage rigged.usda"
    for words, text in (
        (f"{base} --motion gone.usda clips --bundle new", "clips: this is a folder; a USD file is needed"),
        (f"{base} --motion clips --bundle new", "clips: a folder, and no file; each motion of a shot is a USD file"),
        (f"{base} --motion a.usda -o notes.txt --bundle new", "notes.txt: this is a file; the output is a folder"),
        (f"{base} --motion a.usda --bundle notes.txt", "notes.txt: this is a file; the output is a folder"),
        (f"{WORDS.replace('farm', 'bake', 1)} -o a.usda/layers", "a.usda: this is a file; the output is a folder"),
    ):
        assert run(words) == 2
        assert text in capsys.readouterr().err
    assert Path("notes.txt").read_text() == "mine" and not Path("new").exists()
    assert run(f"{base} --motion gone.usda a.usda --bundle new") == 0
    assert "gone.usda: there is no such file" in capsys.readouterr().err


def test_what_every_task_would_refuse_is_refused_when_a_job_is_submitted(farm, capsys):
    """Colliders that are none, poses that stages hold, and a body of another character; one shot of two is kept."""
    held = Usd.Stage.Open("a.usda")
    held.OverridePrim("/Hero/Skirt").CreateAttribute("ssilk:hold", Sdf.ValueTypeNames.Int).Set(2)
    held.Save()
    Path("other.usda").write_text(Path("rigged.usda").read_text().replace("Spine", "Chest"))
    base = "farm model.safetensors --bundle new --stage"
    for words, says in (
        ("rigged.usda --motion b.usda --collider Flor", "--collider Flor: "),
        ("rigged.usda --motion a.usda --refine 2", "a.usda: poses that are held for 2 frames, and --refine"),
        ("other.usda --motion b.usda", "of the model's joints are missing"),
    ):
        assert run(f"{base} {words}") == 2
        assert says in capsys.readouterr().err and not Path("new").exists()
    assert run(f"{base} rigged.usda --motion a.usda b.usda --refine 2") == 0
    assert capsys.readouterr().err.count("a.usda: poses that are held for 2 frames") == 1


@pytest.mark.slow
def test_a_bundle_runs_unchanged_and_a_bad_shot_ends_no_session(farm):
    """A shot fails, the other of its chunk and the next chunk are baked, and the last step says which is missing.

    When its motion is whole, the same bundle bakes that shot and finds the others current.
    """
    whole = Path("a.usda").read_bytes()
    Path("a.usda").write_bytes(whole[:300])
    done = openjd_run(chunk=2)
    assert done.returncode != 0 and "openjd_fail: a/model: error:" in done.stdout, done.stdout
    assert "1 of 3 tasks are not done" in done.stdout and "(a/model)" in done.stdout, done.stdout
    assert "largest error" in done.stdout and "openjd_status: bake b/model" in done.stdout, done.stdout
    assert Path("bundle/layers/shots/b/shot.usda").is_file() and Path("bundle/layers/shots/c/shot.usda").is_file()
    assert not Path("bundle/layers/shots/a").exists()
    Path("a.usda").write_bytes(whole)
    again = openjd_run(chunk=3)
    assert again.returncode == 0 and again.stdout.count("current True") == 2, again.stdout
    assert "Session ended successfully" in again.stdout and "openjd_progress: 100.0" in again.stdout, again.stdout
    assert set(layers("bundle/layers")) == {
        "assets/model/asset.usda", "assets/model/geometry.usdc", "assets/model/info.usda",
        *(f"shots/{shot}/{name}" for shot in SHOTS for name in ("shot.usda", "model/anim.usdc")),
    }  # fmt: skip


def test_bad_input_fails_its_task_alone_and_what_is_done_stays_done(farm, capsys):
    whole = Path("b.usda").read_bytes()
    Path("b.usda").write_bytes(whole[:300])
    assert task() == 4
    capsys.readouterr()
    assert task("--openjd") == 0
    said = capsys.readouterr().out
    assert said.count("openjd_fail: b/model: error:") == 1 and "b.usda" in said and said.count("openjd_fail") == 1
    assert Path("out/shots/a/model/anim.usdc").is_file() and Path("out/shots/c/model/anim.usdc").is_file()
    assert not Path("out/shots/b/model/anim.usdc").exists() and not unfinished()
    assert task("--check") == 3
    Path("b.usda").write_bytes(whole)
    before = Path("out/shots/a/model/anim.usdc").stat().st_mtime_ns
    assert task() == 0 and task("--check") == 0
    assert Path("out/shots/a/model/anim.usdc").stat().st_mtime_ns == before


def test_a_chunk_writes_its_asset_once_while_it_stays_as_it_was(farm, monkeypatch):
    written, write = [], layers_asset.write_asset

    def counted(layout, *args, **options):
        written.append(layout.shot)
        return write(layout, *args, **options)

    monkeypatch.setattr(layers_asset, "write_asset", counted)
    assert task() == 0 and written == ["a"]
    folder, job = LayerFolder("out"), read_job("bundle/job.json").tasks
    folder.bake(job[0], again=True)
    whole = sha256("out/assets/model/geometry.usdc")
    Path("out/assets/model/geometry.usdc").write_bytes(b"")
    folder.bake(job[1], again=True)
    assert written == ["a", "a", "b"] and sha256("out/assets/model/geometry.usdc") == whole


def test_the_last_step_finds_what_is_not_as_it_was_written(farm, toy, capsys):
    assert task() == 0 and task("--check") == 0
    path = Path("out/shots/b/model/anim.usdc")
    whole = path.read_bytes()

    def check_fails() -> None:
        capsys.readouterr()
        assert task("--check") == 3
        assert "1 of 3 tasks" in capsys.readouterr().err

    path.unlink()
    check_fails()
    path.write_bytes(whole[:500])
    check_fails()
    path.write_bytes(whole)
    assert task("--check") == 0
    toy.write_clip(farm / "b.usda", frames=5)
    check_fails()


@pytest.mark.slow
def test_killed_workers_lose_no_finished_shot_and_leave_no_half_file(farm):
    """Killed as soon as something is being written, and when a shot is finished; then let through.

    The bytes are the same as of one undisturbed run.
    """
    assert run("task bundle/job.json -o quiet --tasks 0-2") == 0 and run("task bundle/job.json -o quiet --check") == 0
    finished: dict[Path, int] = {}
    for awaited in (".*partial*", "bake.json"):
        worker = started("--tasks 0-2")
        while worker.poll() is None and not any(Path("out").rglob(awaited)):
            time.sleep(0.001)
        os.kill(worker.pid, signal.SIGKILL)
        worker.communicate()
        records = {path: path.stat().st_mtime_ns for path in Path("out").glob("shots/*/*/bake.json")}
        assert finished.items() <= records.items()  # what was finished was not done again
        assert all(sha256(path.with_name("anim.usdc")) == json.loads(path.read_text())["files"]["anim.usdc"]
                   for path in records)  # fmt: skip
        finished = records
    assert finished and worker.returncode == -signal.SIGKILL
    assert task() == 0 and task("--check") == 0 and not unfinished()
    assert layers("out") == layers("quiet")


def test_the_last_step_removes_what_killed_workers_left(farm):
    assert task() == 0
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()  # nobody has its number now
    machine, _, began = files._writer().split(".")
    ours = f"{machine}.{process.pid}.{began}"
    for name in ("assets/model/.geometry.partial-{}-1.usdc", "assets/model/.asset.partial-{}-2.usda",
                 "shots/b/.shot.partial-{}-3.usda", "shots/b/model/.anim.partial-{}-4.usdc",
                 "shots/b/model/..anim.partial-{}-4.partial-{}-5.usdc", "shots/b/model/.bake.partial-{}-6.json",
                 "shots/b/model/.anim.partial-{}-7.usdc.x8"):  # fmt: skip
        (Path("out") / name.format(ours, ours)).write_text("half")
    writing = Path(f"out/shots/b/model/.anim.partial-{files._writer()}-9.usdc")
    writing.touch()
    assert task("--check") == 0
    assert unfinished() == [writing]


def test_workers_that_bake_the_same_task_at_once_all_succeed(farm, monkeypatch):
    """A second worker begins each task, and ends it, while the first has written half of it: twice within."""
    assert run("task bundle/job.json -o quiet") == 0
    (tasks, write, depth) = read_job("bundle/job.json").tasks, layers_animation.write_animation, []

    def interrupted(layout, *args, **options):
        options["path"].write_text("half")
        if len(depth) < 2:
            depth.append(layout)
            other = next(task for task in tasks if task.shot == layout.shot)
            assert not LayerFolder("out").bake(other).current
            depth.pop()
        options["path"].unlink()
        return write(layout, *args, **options)

    monkeypatch.setattr(layers_animation, "write_animation", interrupted)
    assert task() == 0 and task("--check") == 0 and not unfinished()
    assert animations("out") == animations("quiet") and set(animations("out")) == set(SHOTS)


def other_model(path: Path) -> Path:
    """Write the model with every parameter of its blendshapes and skin changed; its file has the same size."""
    model = load_model("model.safetensors")
    save_model(path, replace(model, parameters={name: value * 0.5 for name, value in model.parameters.items()}))
    return path


def test_a_model_that_is_published_while_a_chunk_runs_is_refused(farm, capsys):
    folder, (first, second, _) = LayerFolder("out"), read_job("bundle/job.json").tasks
    folder.bake(first)
    shutil.copy("model.safetensors", "old.safetensors")
    other_model(farm / "new.safetensors").replace("model.safetensors")
    for layers in (folder, LayerFolder("out")):  # warm and cold
        with pytest.raises(SsilkError, match="the model has changed since the job was submitted"):
            layers.bake(second)
    capsys.readouterr()
    assert task("--check") == 3
    said = capsys.readouterr().err
    assert said.count("the model has changed since the job was submitted") == 1 and "3 of 3 tasks" in said
    os.replace("old.safetensors", "model.safetensors")
    folder.bake(second)
    assert task() == 0 and task("--check") == 0


def test_what_is_baked_without_a_job_is_what_its_key_says(farm):
    """The model is replaced between two shots of one process: each is baked as a process does that sees it alone."""
    folder, tasks = LayerFolder("out"), [replace(task, pinned=None) for task in read_job("bundle/job.json").tasks]
    folder.bake(tasks[0])
    other_model(farm / "new.safetensors").replace("model.safetensors")
    folder.bake(tasks[1])
    LayerFolder("fresh").bake(tasks[1])
    assert animations("out")["b"] == animations("fresh")["b"]
    assert folder.is_done(tasks[1]) and not folder.is_done(tasks[0])


@pytest.mark.parametrize(("changes", "says"), [(1, None), (99, "it changes while it is read")])
def test_a_motion_that_changes_while_it_is_read_is_read_again(farm, toy, monkeypatch, changes, says):
    """Its key is of the bytes that were used, or there is none."""
    tasks, read, left = [replace(task, pinned=None) for task in read_job("bundle/job.json").tasks], [], [changes]
    original = read_visibility.read_hidden

    def replaced_before(source, motion, **options):
        read.append(motion.frame_count)
        if left[0]:
            left[0] -= 1
            toy.write_clip(farm / "next.usda", frames=20 + left[0]).replace("a.usda")
        return original(source, motion, **options)

    monkeypatch.setattr(read_visibility, "read_hidden", replaced_before)
    if says:
        with pytest.raises(SsilkError, match=says):
            LayerFolder("out").bake(tasks[0])
        assert not Path("out/shots").exists()
    else:
        assert LayerFolder("out").bake(tasks[0]).frames == 20 and read == [6, 20]
        assert LayerFolder("out").is_done(tasks[0])


@pytest.mark.slow
def test_a_cancelled_worker_stops_in_time_and_leaves_nothing_half_written(farm, toy):
    toy.write_clip(farm / "a.usda", frames=1200)
    assert run(f"{WORDS} --bundle bundle") == 0  # the job holds a hash of the clip
    worker = started("--tasks 0 --openjd")
    assert worker.stdout is not None
    for line in worker.stdout:
        if line.startswith("openjd_progress"):
            break
    worker.send_signal(signal.SIGTERM)
    said, _ = worker.communicate(timeout=30)
    assert worker.returncode == 130 and "interrupted" in said and not unfinished()


def test_a_job_runs_where_its_inputs_lie_elsewhere(farm):
    (farm / "moved").mkdir()
    for name in ("model.safetensors", "rigged.usda", "hero.usda", "a.usda"):
        shutil.move(farm / name, farm / "moved" / name)
    rules = [{"source_path_format": "POSIX", "source_path": str(farm), "destination_path": str(farm / "moved")}]
    Path("rules.json").write_text(json.dumps({"version": "pathmapping-1.0", "path_mapping_rules": rules}))
    assert task("--tasks 0") == 4
    assert task("--tasks 0 --path-mapping rules.json") == 0


@pytest.mark.slow
def test_tasks_do_not_wait_for_a_gpu_that_this_machine_does_not_have(farm, monkeypatch, capsys):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert run(f"{WORDS} -o out --device cuda --cluster") == 2
    assert "--device: a GPU; this machine has none" in capsys.readouterr().err
    assert not Path("out").exists()


def test_a_cluster_whose_workers_die_bakes_every_shot_once(farm, monkeypatch, capsys):
    """Each worker dies at its first try of a task: before it, after its file is there, or with the whole cluster.

    The first cluster ends the process that connects to it, as Ray does where it is lost meanwhile; another does not
    start.
    """
    if "SSILK_TEST_CLUSTER" not in os.environ:
        pytest.skip("a minute and a half: SSILK_TEST_CLUSTER=1 runs it")
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    assert run("task bundle/job.json -o quiet") == 0

    def dying(job, folder):
        from ssilk_core.delivery.farm.cluster import bake_here

        first = not (tried := folder.with_name(f"tried_{job.shot}")).exists()
        tried.touch()
        if first and job.shot == "a":
            os.kill(os.getpid(), signal.SIGKILL)
        result = bake_here(job, folder)
        if first and job.shot == "b":
            (folder / "shots/b/model/bake.json").unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        if not result.current:
            with folder.with_name("log").open("a") as log:
                log.write(f"{job.name}\n")
        if first and job.shot == "c":
            os.kill(os.getppid(), signal.SIGKILL)  # the raylet
            time.sleep(60)
        return result

    connected = cluster._connected

    def ending(address, cores):
        with Path("started").open("a") as started:
            started.write(".")
        starts = Path("started").stat().st_size
        if starts == 1:
            os._exit(1)
        if starts == 2:
            raise cluster.NoClusterError("it does not start.")
        return connected(address, cores)

    monkeypatch.setattr(cluster, "bake_here", dying)
    monkeypatch.setattr(cluster, "_connected", ending)
    Path("d.usda").write_text("no usd")
    capsys.readouterr()
    assert run(f"{WORDS} d.usda -o out --cluster") == 4
    heard, said = capsys.readouterr()
    assert not heard  # standard output is for events
    assert said.count("d/model: error:") == 1 and "d.usda" in said
    assert "failed: 1" in said
    assert sorted(Path("log").read_text().split()) == [f"{shot}/model" for shot in SHOTS]  # none lost, none twice
    assert task("--check") == 0
    assert animations("out") == animations("quiet") and set(animations("out")) == set(SHOTS)


def test_what_a_killed_process_started_ends_with_it(tmp_path):
    """Nothing else ends."""
    if not sys.platform.startswith("linux"):
        pytest.skip("processes are found in /proc")
    child = [sys.executable, "-c", "import time; time.sleep(60)"]
    words = f"""
import subprocess, time
from ssilk_core.delivery.farm.watchdog import ended_together
with ended_together():
    print(subprocess.Popen({child}).pid, flush=True)
    time.sleep(60)
"""
    other = subprocess.Popen(child)
    driver = subprocess.Popen([sys.executable, "-c", words], stdout=subprocess.PIPE, text=True)
    assert driver.stdout is not None
    started = Path("/proc") / driver.stdout.readline().strip()
    assert started.exists()
    driver.kill()
    driver.communicate()
    deadline = time.monotonic() + 30
    while started.exists() and "\nState:\tZ" not in (started / "status").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert other.poll() is None
    other.kill()
    other.wait()
