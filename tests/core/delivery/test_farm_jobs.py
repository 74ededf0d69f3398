# SPDX-License-Identifier: Apache-2.0
"""Jobs, records and bundles as files, and what Open Job Description's own model says of them."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from openjd.model import IntRangeExpr, create_job, decode_job_template, preprocess_job_parameters
from pxr import Tf

from ssilk_core.delivery.bake import BakeRequest, BakeResult, BakeTask, FrameSpan, Verification, plan_layers
from ssilk_core.delivery.bake.inputs import InputContents, InputFiles, InputHashes
from ssilk_core.delivery.bake.layered import in_levels
from ssilk_core.delivery.bake.naming import file_name, pattern_name, prim_name
from ssilk_core.delivery.bake.record import (
    RECORD,
    RecordedInput,
    TaskRecord,
    current_record,
    read_record,
    task_key,
    write_record,
)
from ssilk_core.delivery.bake.request import INPUTS
from ssilk_core.delivery.bake.task import named_by_bodies
from ssilk_core.delivery.farm.job import FarmJob, numbers, read_job, submitted, write_job
from ssilk_core.delivery.farm.openjd import BundleOptions, OpenJdReporter, template, write_bundle
from ssilk_core.errors import SsilkError
from ssilk_core.events import Failed, GarmentEvent, Message, Progress, Result, Started
from ssilk_core.files import sha256
from ssilk_core.quality.reduction import ModelSize

REQUEST = BakeRequest(model="/m/cape.safetensors", stage="/s/hero.usd", motion="/s/walk.usd")
TASK = BakeTask(garment="cape", shot="walk", request=REQUEST)
CONTENTS = InputHashes(model="0", stage="0", motion="0")
SETTINGS = settings(max_examples=200, deadline=None, derandomize=True, database=None,
                    suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip


def requests(models: list[tuple[str, str | None]], motions: list[str]) -> list[BakeRequest]:
    """Each model over each motion, the motions first, so that planning has to sort."""
    return [replace(REQUEST, model=model, root=root, motion=motion) for motion in motions for model, root in models]


def test_tasks_of_one_model_follow_each_other():
    models = [("/m/cape.safetensors", "/World/Anna"), ("/m/hat.safetensors", "/World/Anna"),
              ("/m/cape.safetensors", "/World/Bert")]  # fmt: skip
    tasks = plan_layers(requests(models, ["a/01 walk.usd", "b/run.usd:/Clips/Fast"]))
    assert [task.name for task in tasks] == [
        f"{shot}/{garment}" for garment in ("Anna_cape", "Anna_hat", "Bert_cape") for shot in ("01_walk", "run_Fast")
    ]


@pytest.mark.parametrize(("models", "motions", "says"), [
    (["a/x.safetensors", "b/x.safetensors"], ["w.usd"], "'a/x.safetensors' and 'b/x.safetensors' would both"),
    (["x.safetensors"], ["a/w.usd", "b/w.usda"], "'a/w.usd' and 'b/w.usda' would both be the shot 'w'"),
    (["x.safetensors"], ["a/w.usd", "b/W.usda"], "would both be the shots 'w' and 'W', one on some disks"),
    (["x.safetensors", "x.safetensors"], ["w.usd"], "'w/x' is to be baked twice"),
])  # fmt: skip
def test_no_two_tasks_write_the_same_file(models, motions, says):
    with pytest.raises(SsilkError, match=says):
        plan_layers(requests([(model, None) for model in models], motions))


def test_bodies_are_a_dimension_of_names_beside_shots_and_garments():
    stages = {"/s/tall.usd": "tall", "/s/2 heavy.usd": "2 heavy"}
    asked = [replace(REQUEST, stage=stage, motion=name, level_of="coat") for stage in stages for name in ("a", "b")]
    tasks = plan_layers(named_by_bodies(asked, stages))
    assert [task.name for task in tasks] == [
        f"{body}_{shot}/{body}_cape" for body in ("tall", "_2_heavy") for shot in ("a", "b")
    ]
    assert [task.level_of for task in tasks] == ["tall_coat", "tall_coat", "_2_heavy_coat", "_2_heavy_coat"]
    assert {task.request.shot or task.request.garment for task in tasks} == {None}


@pytest.mark.parametrize("names", [("a-b", "a_b"), ("tall", "Tall")])
def test_two_bodies_of_one_name_are_refused(names):
    stages = {f"/s/{number}.usd": name for number, name in enumerate(names)}
    with pytest.raises(SsilkError, match=r"'/s/0.usd' and '/s/1.usd' would both be the bod.*--body-name"):
        named_by_bodies([replace(REQUEST, stage=stage) for stage in stages], stages)


def test_names_of_other_letters_stay_apart():
    tasks = plan_layers(requests([("/m/cape.safetensors", None)], ["衣.usd", "空.usd", "e\u0301.usd", "walk 2.usd"]))
    names = [task.shot for task in tasks]
    assert len(set(names)) == 4 and names[3] == "walk_2" and re.fullmatch(r"e_[0-9a-f]{8}", names[2])
    assert file_name("\u00e9") == names[2]  # the same letter, as other file systems store it
    assert all(re.fullmatch(r"[\w-]+", name, re.ASCII) for name in names)
    assert Tf.IsValidIdentifier(prim_name("1-衣")) and len(file_name("x" * 300)) < 120


@pytest.mark.parametrize(("pattern", "expected"), [
    ("{parent2}_{stem}", "show_01 walk"), ("s010", "s010"), ("{parent}-{prim}", "s-Fast"),
])  # fmt: skip
def test_patterns_over_paths(pattern, expected):
    assert pattern_name(pattern, "/show/s/01 walk.usd:/Clips/Fast", "--shot-name") == expected


@pytest.mark.parametrize("pattern", ["{stem.__class__}", "{parent9}", "{}", "{prim}"])
def test_patterns_that_a_path_does_not_have(pattern):
    with pytest.raises(SsilkError, match=re.escape(f"--shot-name {pattern}: '/show/walk.usd' has no {pattern}")):
        pattern_name(pattern, "/show/walk.usd", "--shot-name")


@pytest.mark.parametrize(("change", "says"), [
    ({"target": "arkit"}, "--target arkit: layers; it takes .usdz"),
    ({"keep": ModelSize(shapes=1, joints=1, influences=1)}, "bake models that 'ssilk reduce' made"),
])  # fmt: skip
def test_requests_that_cannot_share_an_asset_are_refused(change, says):
    with pytest.raises(SsilkError, match=says):
        plan_layers([replace(REQUEST, **change)])


def test_shots_of_one_garment_ask_for_one_version():
    asked = [replace(REQUEST, motion=name, asset_version=version) for name, version in (("a", "v1"), ("b", "v2"))]
    with pytest.raises(SsilkError, match="--asset-version: 'v1' and 'v2' for the garment 'cape'; all"):
        plan_layers(asked)
    (task,) = plan_layers(asked[:1])
    assert task.asset_version == "v1" and task.request.asset_version is None


def test_refined_points_are_written_beside_the_joints():
    assert [task.points for task in plan_layers([replace(REQUEST, refine=2, refined_output="points")])] == [True]
    assert [task.points for task in plan_layers([replace(REQUEST, refine=2)])] == [False]


@pytest.mark.parametrize(("text", "expected"), [("0-3", [0, 1, 2, 3]), ("4", [4]), ("1,3-4", [1, 3, 4])])
def test_numbers_of_tasks(text, expected):
    assert numbers(text, 5) == expected


@pytest.mark.parametrize("text", ["", "5", "3-1", "-1", "a", "0-", "1-99999999999999", "0x1"])
def test_numbers_that_name_no_task(text):
    with pytest.raises(SsilkError, match="--tasks"):
        numbers(text, 5)


def test_a_key_is_of_all_that_decides_what_is_written():
    key = task_key(TASK, CONTENTS)
    others = [task_key(replace(TASK, request=replace(REQUEST, **{name: value})), CONTENTS) for name, value in (
        ("fps", 24.0), ("samples_per_frame", 2), ("target", "game4"), ("lbs", True), ("refine", 1),
    )]  # fmt: skip
    others += [task_key(replace(TASK, **{name: value}), CONTENTS) for name, value in (
        ("include_body", False), ("points", True), ("garment", "hat"), ("shot", "run"),
    )]  # fmt: skip
    others += [task_key(TASK, replace(CONTENTS, **{name: "1"})) for name in REQUEST.inputs]
    assert len({key, *others}) == len(others) + 1
    moved = replace(TASK, request=replace(REQUEST, model="/elsewhere/cape.safetensors"))
    assert task_key(moved, CONTENTS) == key
    assert task_key(replace(TASK, asset_version="v1", asset_identifier="studio:/cape"), CONTENTS) == key


def result(path: Path) -> BakeResult:
    found = Verification(frames=9, largest_error_m=1e-7, allowed_error_m=1e-5)
    return BakeResult(
        path=path, frames=9, fps=24, joints=3, proxies=1, blendshapes=2, size_bytes=4, verification=found,
        recovered=(FrameSpan(2, 5),),
    )  # fmt: skip


def record(path: Path, files: dict[str, str]) -> TaskRecord:
    inputs = {name: RecordedInput(f"../{name}.usda", name) for name in INPUTS}
    return TaskRecord(key="k", files=files, result=result(path), inputs=inputs, root=None)


def test_a_task_is_current_while_its_files_are_as_written(tmp_path):
    path = tmp_path / "anim.usdc"
    path.write_bytes(b"shot")
    write_record(tmp_path, record(path, {"anim.usdc": sha256(path)}))
    assert current_record(tmp_path, "k") and not current_record(tmp_path, "other")
    path.write_bytes(b"shut")
    assert not current_record(tmp_path, "k")


def test_a_record_tells_the_result_again_wherever_its_folder_goes(tmp_path):
    path = tmp_path / "here" / "anim.usdc"
    write_record(path.parent, record(path, {}))
    path.parent.rename(tmp_path / "there")
    found = read_record(tmp_path / "there")
    assert found == record(tmp_path / "there" / "anim.usdc", {})


@pytest.mark.parametrize("text", [
    "", "{", "[]", '{"key": 1}', '{"key": "k", "files": 3}', "[" * 100_000,
    '{"key": "k", "files": {}, "detail": {"path": "anim.usdc", "frames": "9"}}',
])  # fmt: skip
def test_a_damaged_record_means_that_the_task_is_done_again(tmp_path, text):
    (tmp_path / RECORD).write_text(text)
    assert read_record(tmp_path) is None and not current_record(tmp_path, "k")


def test_a_job_reads_as_it_was_written_and_where_its_inputs_lie_now(tmp_path):
    other = replace(REQUEST, motion="/s/run.usd:/Clip", fps=24.0)
    write_job(tmp_path / "job.json", FarmJob((TASK, replace(TASK, shot="run", request=other)), {}))
    assert read_job(tmp_path / "job.json").tasks[0] == TASK
    rules = [{"source_path_format": "POSIX", "source_path": "/s", "destination_path": "/farm/7"}]
    (tmp_path / "rules.json").write_text(json.dumps({"version": "pathmapping-1.0", "path_mapping_rules": rules}))
    mapped = read_job(tmp_path / "job.json", tmp_path / "rules.json").tasks[1].request
    assert (mapped.model, mapped.stage, mapped.motion) == (
        "/m/cape.safetensors", "/farm/7/hero.usd", "/farm/7/run.usd:/Clip")  # fmt: skip


@pytest.mark.parametrize("change", [
    {"garment": "../../etc"}, {"shot": "a/b"}, {"shot": ".."}, {"garment": ""}, {"shot": "/tmp"}, {"unknown": 1},
    {"request": {"model": 3}}, {"request": {"samples_per_frame": "2"}}, {"request": {"fps": "24"}},
    {"request": {"lbs": 1}}, {"request": {"pre_roll": 601}}, {"points": 1}, {"request": 3},
])  # fmt: skip
def test_a_job_cannot_name_files_elsewhere_or_values_of_other_types(tmp_path, change):
    write_job(tmp_path / "job.json", FarmJob((TASK,), {}))
    document = json.loads((tmp_path / "job.json").read_text())
    nested = change.get("request")
    if isinstance(nested, dict):
        document["tasks"][0]["request"] |= nested
    else:
        document["tasks"][0] |= change
    (tmp_path / "job.json").write_text(json.dumps(document))
    with pytest.raises(SsilkError, match="it is no job"):
        read_job(tmp_path / "job.json")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


@SETTINGS
@given(document=VALUES | st.fixed_dictionaries({"tasks": VALUES | st.lists(st.fixed_dictionaries(
    {"garment": VALUES, "shot": VALUES, "request": VALUES | st.fixed_dictionaries(
        dict.fromkeys(("model", "stage", "motion", "fps", "keep"), VALUES))}), max_size=2)}))  # fmt: skip
def test_any_json_is_a_job_or_one_sentence(tmp_path, document):
    path = tmp_path / "job.json"
    path.write_text(json.dumps(document))
    try:
        assert all(isinstance(task, BakeTask) for task in read_job(path).tasks)
    except SsilkError as error:
        assert str(error).startswith(str(path)) and str(error).endswith(".")


@pytest.mark.parametrize(("device", "gpu"), [("cpu", False), ("auto", False), ("cuda", True), ("cuda:1", True)])
def test_a_template_passes_the_specification(device, gpu):
    tasks = [TASK, replace(TASK, shot="run", request=replace(REQUEST, device=device))]
    decoded = decode_job_template(
        template=template(tasks, BundleOptions(memory=4096, timeout=60)), supported_extensions=["TASK_CHUNKING"]
    )
    values = preprocess_job_parameters(
        job_template=decoded,
        job_parameter_values={"ChunkSize": "7", "ChunkSeconds": "60"},
        job_template_dir=Path("/bundle"),
        current_working_dir=Path("/"),
    )
    job = create_job(job_template=decoded, job_parameter_values=values)
    assert values["Job"].value == "/bundle/job.json" and values["Output"].value == "/bundle/layers"
    bake, check = job.steps
    chunks = bake.parameterSpace.taskParameterDefinitions["Shots"].chunks
    assert (int(chunks.defaultTaskCount), int(chunks.targetRuntimeSeconds)) == (7, 60)
    assert str(bake.script.actions.onRun.cancelation.mode.value) == "NOTIFY_THEN_TERMINATE"
    needs = {amount.name: amount.min for amount in bake.hostRequirements.amounts}
    assert needs["amount.worker.memory"] == 4096 and ("amount.worker.gpu" in needs) == gpu
    assert bake.parameterSpace.taskParameterDefinitions["Shots"].range == IntRangeExpr.from_str("0-1")
    assert bake.script.actions.onRun.timeout == 60
    assert [dependency.dependsOn for dependency in check.dependencies] == ["Bake"]


def test_outer_garments_come_in_steps_after_those_that_they_are_certified_over(monkeypatch):
    over = {"vest": (), "coat": ("vest",), "cape": ("vest", "coat"), "hat": ()}
    tasks = [
        replace(TASK, garment=name, shot=shot, over=names) for shot in ("walk", "run") for name, names in over.items()
    ]
    levels = in_levels(tasks)
    assert [[task.garment for task in level] for level in levels] == [["vest", "hat"] * 2, ["coat"] * 2, ["cape"] * 2]
    decoded = decode_job_template(
        template=template([task for level in levels for task in level], BundleOptions()),
        supported_extensions=["TASK_CHUNKING"],
    )
    names = [(step.name, [each.dependsOn for each in step.dependencies or ()]) for step in decoded.steps]
    assert names == [
        ("Bake", []), ("BakeOver", ["Bake"]), ("BakeOver2", ["BakeOver"]), ("Check", ["BakeOver2"])
    ]  # fmt: skip
    circle = [replace(TASK, garment="a", over=("b",)), replace(TASK, garment="b", over=("a",))]
    assert in_levels(circle) == [circle]  # each fails with a sentence
    # Steps count the tasks of the job as it was submitted, in whatever order they came.
    monkeypatch.setattr(InputFiles, "contents", lambda self, name, path: InputContents(((path, "0"),)))
    monkeypatch.setattr("ssilk_core.delivery.farm.job.tell_impossible", lambda *_: None)  # no file is there
    backwards = submitted(tasks[::-1], lambda event: None).tasks
    assert [task.name for task in backwards] == [task.name for level in in_levels(tasks[::-1]) for task in level]
    assert {task.name for task in backwards[: len(levels[0])]} == {task.name for task in levels[0]}
    assert task_key(tasks[1], CONTENTS) == task_key(replace(tasks[1], over=()), CONTENTS)


@pytest.mark.parametrize("name", ["memory", "timeout"])
def test_hosts_and_chunks_need_something(name):
    with pytest.raises(SsilkError, match=f"--{name}: 0; a positive number is needed"):
        BundleOptions(**{name: 0})


def test_a_bundle_names_the_files_that_it_takes_and_gives(tmp_path):
    write_bundle(tmp_path, FarmJob((TASK,), {}), tmp_path / "out", BundleOptions())
    assets = json.loads((tmp_path / "asset_references.json").read_text())["assetReferences"]
    assert assets["inputs"]["filenames"] == ["/m/cape.safetensors", "/s/hero.usd", "/s/walk.usd"]
    assert assets["outputs"]["directories"] == [str(tmp_path / "out")]
    values = json.loads((tmp_path / "parameter_values.json").read_text())["parameterValues"]
    assert values == [{"name": "Output", "value": str(tmp_path / "out")}]


def test_no_name_is_a_command_of_a_session():
    stream = io.StringIO()
    report, name = OpenJdReporter(stream), "a\nopenjd_fail: forged\r\u2028\x85\x1b[2J"
    results = Result("bake", {"path": name}), GarmentEvent(name, Result("bake", {name: name}))
    said = Failed(name), Message(name), Message("openjd_fail: forged"), GarmentEvent(name, Started("bake", 1))
    for event in (*said, *results):
        report(event)
    lines = stream.getvalue().splitlines()
    assert len(lines) == 6 and not any(ord(each) < 32 for line in lines for each in line)
    assert [line.partition(":")[0] for line in lines if line.startswith("openjd_")] == [
        "openjd_fail",
        "openjd_status",
    ]


def test_what_sessions_read_of_a_worker():
    stream = io.StringIO()
    report = OpenJdReporter(stream)
    for event in (
        GarmentEvent("walk/cape", Started("bake", 1)), Progress(1, 8), Progress(1, 8), Progress(8, 8),
        Message("mind this", "warning"), GarmentEvent("walk/cape", Failed("x: bad.")),
    ):  # fmt: skip
        report(event)
    assert stream.getvalue().splitlines() == [
        "openjd_status: bake walk/cape", "openjd_progress: 12.5", "openjd_progress: 100.0", "warning: mind this",
        "openjd_fail: walk/cape: error: x: bad.",
    ]  # fmt: skip
