# SPDX-License-Identifier: Apache-2.0
"""The queue behind the paper's tables: order, needs, failures and time; and that its commands can be understood."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from ssilk_core.cli.main import parser

PYTHON = "python"


@pytest.fixture
def paper(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    import paper

    return paper


@pytest.fixture
def plan(paper, tmp_path):
    clips = [("walk", "train", []), ("jump", "valid", ["inertia"]), ("flip", "flips", [])]
    index = [{"clip": c, "split": s, "tags": tags, "frames": 120, "fps": 60} for c, s, tags in clips]
    (tmp_path / "index.json").write_text(json.dumps(index))
    return paper.Plan(folder=tmp_path, stages=tmp_path, motions=tmp_path, index=tmp_path / "index.json", device="cpu")


def writing(paper, folder: Path, name: str, needs: tuple[str, ...] = (), code: str = "", seconds: float = 1.0):
    """A job that writes the time at which it runs, unless its code ends it before."""
    output = folder / name
    script = f"import pathlib, time\n{code}\npathlib.Path({str(output)!r}).write_text(str(time.time()))"
    return paper.Job(name, (output,), (PYTHON, "-c", script), seconds, tuple(folder / need for need in needs))


def run(paper, plan, jobs: list, until: float = 100.0, workers: int = 2):
    backlog = paper.Backlog([job for job in jobs if not job.is_done], plan.folder, until)
    paper.run(backlog, [None] * workers, threading.Event())
    return backlog


def test_a_job_waits_for_what_it_needs_even_if_that_fails(paper, plan, tmp_path, capfd):
    jobs = [
        writing(paper, tmp_path, "last", ("first", "broken")),
        writing(paper, tmp_path, "first", code="time.sleep(0.3)"),
        writing(paper, tmp_path, "broken", code="raise SystemExit('no luck')"),
    ]
    backlog = run(paper, plan, jobs)
    assert backlog.failed == ["broken"] and not backlog.left
    assert float((tmp_path / "first").read_text()) < float((tmp_path / "last").read_text())
    assert "broken: FAILED with code 1" in (told := capfd.readouterr().out) and "no luck" in told


def test_what_is_done_is_not_done_again_and_what_takes_too_long_is_not_begun(paper, plan, tmp_path):
    (tmp_path / "old").write_text("old")
    jobs = [
        writing(paper, tmp_path, "old"),
        writing(paper, tmp_path, "long", seconds=500.0),
        writing(paper, tmp_path, "after", ("long",)),
        writing(paper, tmp_path, "short"),
    ]
    backlog = run(paper, plan, jobs)
    assert (tmp_path / "old").read_text() == "old" and (tmp_path / "short").is_file()
    assert [job.name for job in backlog.left] == ["long", "after"] and not backlog.failed


def test_every_command_is_understood_and_every_need_is_made(paper, plan):
    found = paper.jobs(plan)
    outputs = {path for job in found for path in job.outputs}
    assert len({job.name for job in found}) == len(found) and all(set(job.needs) <= outputs for job in found)
    verbs = parser()
    for job in found:
        if job.command[:3] == (PYTHON, "-m", "ssilk_core"):
            assert verbs.parse_args(job.command[3:]).verb in ("train", "simulate")
        else:
            assert job.command[0] == PYTHON and (Path(__file__).parents[2] / job.command[1]).is_file()
    trained = [job for job in found if job.name.startswith("cape_ssilk") and job.command[3] == "train"]
    assert len(trained) == 3 and len({job.command[-1] for job in trained}) == 1  # seeds differ in nothing else


def test_equal_iterations_are_as_many_as_the_baselines_have(paper, plan):
    found = {job.name: job for job in paper.jobs(plan)}

    def iterations(name: str) -> str:
        return next(word for word in found[name].command if word.startswith("iterations="))

    assert iterations("pants_equal") == iterations("pants_ncs") != iterations("pants_ssilk")
    measured = found["pants_equal_whole"]
    assert {path.stem for path in measured.needs} == {"pants_equal", "pants_ncs", "pants_ncs_star", "pants_snug"}
    assert measured.outputs[0].parent not in {path.parent for path in found["pants_whole"].outputs}


def test_only_models_that_are_there_are_measured(paper, plan, tmp_path):
    from helpers.paper_jobs import without_models

    job = next(job for job in paper.jobs(plan) if job.name == "pants_sequences")
    plan.model("pants_ncs").parent.mkdir()
    plan.model("pants_ncs").touch()
    kept = [word for word in without_models(job).command if word.endswith(".safetensors")]
    assert kept == [str(plan.model("pants_ncs"))]
