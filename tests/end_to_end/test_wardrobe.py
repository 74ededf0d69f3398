# SPDX-License-Identifier: Apache-2.0
"""Lists of garments: what they may say, how they are trained side by side; and one garment in two processes."""

from __future__ import annotations

import io
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pxr import Sdf

from ssilk_core.cli import main, wardrobe
from ssilk_core.cli.main import parser
from ssilk_core.cli.options.bodies import read_member
from ssilk_core.cli.options.scene import read_stage
from ssilk_core.errors import EXIT_TASKS, EXIT_WORSE, SsilkError
from ssilk_core.events import Event, GarmentEvent, JsonReporter, Message, Progress, TaskEvent, read_event, silent
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model
from ssilk_core.training.wardrobe.listing import WardrobeEntry, read_list, write_list
from ssilk_core.training.wardrobe.panel import ProgressTable, table
from ssilk_core.training.wardrobe.queue import CommandTask, End, Queue
from ssilk_core.training.wardrobe.training import WORSE_FIGURE, GarmentTraining

LIST = """
[defaults]
stage = "rigged.usda"
motions = ["clip.usda"]
preset = "draft"

[defaults.set]
latent = 8
widths = [16]
shapes = 4
iterations = 120
static_fraction = 0.5
batch = 2
pretraining_batch = 4
window = 4

[skirt]
set = { valid_frames = 8, seed = 3 }

[torn]
motions = "torn.usda"
"""


# --- what a list says ---------------------------------------------------------------------------------------------


def listed(folder: Path, text: str) -> list[WardrobeEntry]:
    (folder / "list.toml").write_text(text)
    return read_list(folder / "list.toml")


def test_a_garment_has_its_own_keys_and_the_defaults(tmp_path):
    skirt, torn = listed(tmp_path, LIST + 'material = { drag = 0.2, damp = true }\nvalid = ["a", "b"]\n')
    assert (skirt.name, torn.name) == ("skirt", "torn")
    settings = (
        "--set latent=8 --set widths=16 --set shapes=4 --set iterations=120 --set static_fraction=0.5 --set batch=2 "
    )
    settings += "--set pretraining_batch=4 --set window=4"
    assert shlex.join(skirt.words) == (
        f"rigged.usda --motions clip.usda --preset draft {settings} --set valid_frames=8 --set seed=3"
    )
    material = "--material drag=0.2 --material damp=true"
    assert shlex.join(torn.words) == (
        f"rigged.usda --motions torn.usda --valid a b --preset draft {material} {settings}"
    )


def test_a_list_that_is_written_elsewhere_says_the_same(tmp_path):
    """Paths lead to the same files from the new folder, and all else is as it was."""
    text = (
        '[defaults]\nstage = "hero.usda"\nmotions = ["walks/", "/data/run.usda"]\nvalid = "held.usda"\n'
        'set = { seed = 3, widths = [16, 8], "a.b" = "\\"quoted\\" \u00fc \\u007f" }\n'
        '[coat]\ngarment = "cloth/coat.usd:/World/Coat"\nover = ["shirt", "tights.safetensors"]\n'
        '["shirt.1"]\n[shirt]\ngarment = "/Hero/Shirt"\nmaterial = { drag = 0.5 }\n'
    )
    before = listed(tmp_path, text)
    (tmp_path / "far" / "away").mkdir(parents=True)
    write_list(tmp_path / "far" / "away" / "new.toml", {each.name: each.located(tmp_path) for each in before})
    after = read_list(tmp_path / "far" / "away" / "new.toml")
    assert [(each.name, each.over) for each in after] == [(each.name, each.over) for each in before]
    for one, other in zip(before, after):
        places = [each.located(folder) for each, folder in ((one, tmp_path), (other, tmp_path / "far" / "away"))]
        plain = [json.loads(json.dumps(each), object_hook=dict) for each in places]
        for each in plain:
            each["motions"] = [os.path.normpath(path) for path in each["motions"]]
            each["valid"] = [os.path.normpath(path) for path in each["valid"]]
            each["over"] = [os.path.normpath(path) for path in each.get("over", [])]
            each |= {name: os.path.normpath(each[name]) for name in ("stage", "garment") if name in each}
        assert {**plain[0], "set": {}, "material": {}} == {**plain[1], "set": {}, "material": {}}
        assert one.table["set"] == other.table["set"]
        assert one.table.get("material") or other.table.get("material", {}) == {}
    assert after[0].located(tmp_path / "far" / "away")["motions"][1] == "/data/run.usda"


WRONG = {
    "no TOML": ("[cape", "list.toml: not a TOML file"),
    "nothing": ("", "list.toml: no garment in it"),
    "loose key": ('fabric = "silk"\n[cape]', "key 'fabric': it belongs to no table; each key belongs to"),
    "name": ('["../cape"]', "table '../cape': its name would be the name of files; letters"),
    "unknown": ("[cape]\nsteps = 3", "table 'cape', key 'steps': no such key; it is one of stage, garment, motions"),
    "default": ("[defaults]\nstage = 3\n[cape]", "table 'defaults', key 'stage': 3; the path of a stage is needed"),
    "missing": ('[cape]\nstage = "a"', "table 'cape', key 'motions': missing; it is needed here or in"),
    "fabric": ('[cape]\nfabric = "silkk"', "wool, leather is needed; did you mean 'silk'?"),
    "preset": ('[cape]\npreset = "fast"', "key 'preset': 'fast'; one of draft, preview, light, final, paper is"),
    "misspelt": ('[cape]\npreset = "finl"', "final, paper is needed; did you mean 'final'?"),
    "set": ('[cape]\nset = "batch=3"', "key 'set': 'batch=3'; a table of values, like { iterations = 20000 }, is"),
    "over": (
        '[cape]\nstage = "a"\nmotions = "b"\nover = ["shirt"]',
        "key 'over': no such garment; it is one of cape",
    ),
    "over text": ('[cape]\nover = "shirt"', "key 'over': 'shirt'; a list, like [\"a\"], is needed"),
    "over itself": (
        '[defaults]\nstage = "a"\nmotions = "b"\n[a]\nover = ["b", "a"]\n[b]',
        "table 'a', key 'over': it names itself; garments beneath it are named; remove its own name",
    ),
    "over twice": (
        '[defaults]\nstage = "a"\nmotions = "b"\n[a]\nover = ["b"]\n[b]\nover = ["a"]',
        "key 'over': a, b are worn over one another",
    ),
    "graded": ('[cape]\ngraded = "yes"', "key 'graded': 'yes'; true or false is needed"),
    "family": ("[cape]\nfamily = 3", "key 'family': 3; true, or a list of bodies, is needed"),
    "motions": ("[cape]\nmotions = []", "key 'motions': []; a path or a list of paths is needed"),
}


@pytest.mark.parametrize(("text", "says"), WRONG.values(), ids=WRONG)
def test_bad_entries_are_told_in_one_sentence(tmp_path, text, says):
    with pytest.raises(SsilkError) as error:
        listed(tmp_path, text)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_bodies_of_a_garment_are_words_of_its_training_and_inputs_of_it(tmp_path):
    text = '[defaults]\nstage = "a"\nmotions = "b"\nfamily = ["tall.usd", "/far/wide.usd"]\n'
    own, same = listed(tmp_path, text + "[own]\ngraded = true\n[same]\ngraded = false\n")
    assert own.words[-4:] == ("--family", "tall.usd", "/far/wide.usd", "--graded") and "--graded" not in same.words
    assert own.located(Path("/lists"))["family"] == ["/lists/tall.usd", "/far/wide.usd"]


def test_inner_garments_come_first(tmp_path):
    text = '[defaults]\nstage = "a"\nmotions = "b"\nover = ["shirt"]\n[coat]\nover = ["vest", "tights.safetensors"]\n'
    found = listed(tmp_path, text + "[vest]\n[shirt]\n[hat]\nover = []\n")
    assert [entry.name for entry in found] == ["shirt", "vest", "coat", "hat"]
    assert [entry.over for entry in found] == [(), ("shirt",), ("vest",), ()]
    assert found[2].words[-2:] == ("--over", "tights.safetensors")


BAD = {
    "setting": ("[cape]\nset = { speed = 3 }", "table 'cape': --set speed=3: no such setting; it is one of latent"),
    "value": ("[cape]\nset = { batch = 0 }", "table 'cape': setting 'batch': 0; it must lie between 1 and"),
    "file": ('[cape]\nmotions = "none.usda"', "there is no such file or folder; motions are"),
    "body": ('[cape]\nfamily = ["none.usda"]', "there is no file"),
    "shape": ('[cape]\nfamily = ["tall=1"]', "table 'cape': rigged.usda:tall=1: its bodies have no blendshapes"),
    "no shape": ('[cape]\nfamily = ["rigged.usda:tall"]', "'tall' is no shape with a weight"),
    "no marks": ("[cape]\nfamily = true", "table 'cape': rigged.usda: it marks no body parameters"),
    "one body": ("[cape]\ngraded = true", "table 'cape': --graded: no --family"),
    "garment": ('[cape]\ngarment = "none.usda:/Cape"', "there is no file"),
}


@pytest.mark.parametrize(("text", "says"), BAD.values(), ids=BAD)
def test_nothing_is_trained_when_an_entry_cannot_be(toy, tmp_path, monkeypatch, capsys, text, says):
    monkeypatch.chdir(toy.copy(tmp_path))
    Path("list.toml").write_text('[defaults]\nstage = "rigged.usda"\nmotions = "clip.usda"\n' + text)
    assert main(["wardrobe", "list.toml", "-o", "out", "--device", "cpu"]) == 2
    assert says in capsys.readouterr().err and not Path("out").exists()


def test_garments_of_a_list_that_a_stage_does_not_mark_are_no_bodies_of_each_other(toy, tmp_path, monkeypatch):
    """Nor on other bodies of a family, which may lack them or have them elsewhere."""
    monkeypatch.chdir(toy.copy(tmp_path))
    for file, meshes in (("dressed", "Tights Cloak Boots"), ("heavy", "Clothes/Tights Boots")):
        Path(f"{file}.usda").write_text(Path("rigged.usda").read_text())
        layer = Sdf.Layer.FindOrOpen(f"{file}.usda")
        Sdf.PrimSpec(layer.GetPrimAtPath("/Hero"), "Clothes", Sdf.SpecifierDef, "Xform")
        assert all(Sdf.CopySpec(layer, "/Hero/Body", layer, f"/Hero/{mesh}") for mesh in meshes.split())
        layer.Save()
    text = '[defaults]\nstage = "dressed.usda"\nmotions = "clip.usda"\n'
    text += '[cloak]\ngarment = "dressed.usda:/Hero/Cloak"\nover = ["tights"]\n'
    text += '[tights]\ngarment = "/Hero/Tights"\n[skirt]\ngarment = "Skirt"\n'
    entries, heard = listed(tmp_path, text), list[Event]()
    worn = {"cloak": ["^/Hero/Tights"], "tights": ["^/Hero/Cloak"], "skirt": ["^/Hero/Tights", "^/Hero/Cloak"]}
    train = parser(["train"])
    for entry in entries:
        words = wardrobe._with_bodies(entry, entries, tmp_path, heard.append).words
        options = train.parse_args(["train", *words, "-o", "out.safetensors"])
        assert options.body == worn[entry.name]
        first = read_stage(options, silent)[0]
        for character in (first, read_member(options, "heavy.usda", first, silent)):
            assert [body.mesh.path.rpartition("/")[2] for body in character.bodies] == ["Body", "Boots"], entry.name
    assert [event.text.partition(":")[0] for event in heard] == ["skirt does not meet tights, cloak"]
    alone = [entry for entry in entries if entry.name == "cloak"]
    assert wardrobe._with_bodies(alone[0], alone, tmp_path, heard.append) == alone[0]
    every = listed(tmp_path, text + '[boots]\ngarment = "Boots"\n[body]\ngarment = "Body"\n')
    words = wardrobe._with_bodies(every[0], every, tmp_path, silent).words
    assert not read_stage(train.parse_args(["train", *words, "-o", "out.safetensors"]), silent)[0].bodies


def test_a_body_is_not_left_out_for_the_name_of_a_garment_that_another_body_lacks(toy, tmp_path, monkeypatch):
    """Many stages call each mesh so, beneath a prim with the object's name."""
    monkeypatch.chdir(toy.copy(tmp_path))
    for file, meshes in (("dressed", "Torso Tights"), ("bare", "Torso"), ("also", "Torso Clothes/Tights")):
        Path(f"{file}.usda").write_text(Path("rigged.usda").read_text())
        layer = Sdf.Layer.FindOrOpen(f"{file}.usda")
        for place in [f"/Hero/{mesh}" for mesh in meshes.split()]:
            for prefix in Sdf.Path(place).GetPrefixes():
                prim = Sdf.CreatePrimInLayer(layer, prefix)
                prim.specifier, prim.typeName = Sdf.SpecifierDef, prim.typeName or "Xform"
            assert Sdf.CopySpec(layer, "/Hero/Body", layer, f"{place}/mesh")
        layer.Save()
    train = parser(["train"])
    words = [
        "train",
        "dressed.usda",
        "--motions",
        "clip.usda",
        "-o",
        "out.safetensors",
        "--body",
        "^/Hero/Tights/mesh",
    ]
    for garment in ("Skirt", "/Hero/Tights/mesh"):
        options = train.parse_args([*words, "--garment", garment])
        first = read_stage(options, silent)[0]
        for character in (first, *(read_member(options, f"{x}.usda", first, silent) for x in ("bare", "also"))):
            names = [body.mesh.path.partition(":/Hero/")[2] for body in character.bodies]
            assert names == ["Body", "Torso/mesh"]
    with pytest.raises(SsilkError, match=r"--body Body --body \^Body, which leave no mesh"):
        read_stage(train.parse_args([*words[:-1], "Body", "--body", "^Body"]), silent)


def test_a_layer_of_a_stage_is_an_input_of_its_training(toy, tmp_path, monkeypatch):
    """So a training is done again once a body has changed that a stage refers to, as with 'family = true'."""
    monkeypatch.chdir(toy.copy(tmp_path))
    Path("above.usda").write_text('#usda 1.0\n(\n    defaultPrim = "Hero"\n    subLayers = [@rigged.usda@]\n)\n')
    (entry,) = listed(tmp_path, '[skirt]\nstage = "above.usda"\nmotions = "clip.usda"\n')

    def asked() -> str:
        return wardrobe._request(parser(["train"]), entry, tmp_path / "list.toml", "cpu", {})

    before = asked()
    assert asked() == before
    (single,) = listed(tmp_path, '[skirt]\nstage = "rigged.usda"\nmotions = "clip.usda"\n')
    options = parser(["train"]).parse_args(["train", *single.words, "-o", "skirt.safetensors"])
    names = [path.name for path in wardrobe._inputs(options, tmp_path)]
    assert names == ["rigged.usda", "rigged.usda", "clip.usda"]  # stage, garment, motion: keys of finished trainings
    with Path("rigged.usda").open("a") as file:
        file.write("\n")
    assert asked() != before


# --- trainings side by side ---------------------------------------------------------------------------------------


def task(folder: Path, name: str, code: str) -> CommandTask:
    """A process that costs little, in place of a training."""
    told = "import json, os, signal, sys, time\ndef say(**event): print(json.dumps(event), flush=True)\n"
    return CommandTask(name, [sys.executable, "-S", "-c", told + code], folder, folder / f"{name}.log")


class Heard:
    """Runs tasks and keeps what they say."""

    def __init__(self, slots: list[dict[str, str]]) -> None:
        self.said: list[tuple[str, TaskEvent]] = []
        self.ends: dict[str, End] = {}
        self.stop = threading.Event()
        self.queue = Queue(slots, self.tell, self.ends.__setitem__)

    def tell(self, name: str, event: TaskEvent) -> None:
        self.said.append((name, event))

    def run(self, *tasks: CommandTask) -> dict[str, End]:
        waiting = iter(tasks)
        self.queue.run(lambda: next(waiting, None), self.stop)
        return self.ends


def test_each_slot_has_one_task_at_a_time_in_its_own_environment(tmp_path):
    code = "say(event='message', text=os.environ['SLOT'])\ntime.sleep(0.2)\nsay(event='message', text='end')"
    heard = Heard([{"SLOT": "a"}, {"SLOT": "b"}])
    ends = heard.run(*(task(tmp_path, str(number), code) for number in range(4)))
    assert {name: end.code for name, end in ends.items()} == dict.fromkeys("0123", 0)
    first = {name: event.text for name, event in reversed(heard.said) if event.text != "end"}
    assert sorted(first[name] for name in "01") == ["a", "b"]
    for slot in "ab":  # begin and end alternate
        texts = [event.text for name, event in heard.said if first[name] == slot]
        assert texts == [slot, "end"] * (len(texts) // 2)


def test_a_failure_stops_no_other_and_a_death_without_a_word_is_explained(tmp_path):
    heard = Heard([{}])
    ends = heard.run(
        task(tmp_path, "bad", "say(event='failed', error='no cloth.')\nsys.exit(2)"),
        task(tmp_path, "killed", "os.kill(os.getpid(), signal.SIGKILL)"),
        task(tmp_path, "good", "print('noise')\nsay(event='result', task='train', detail={'iterations': 5})"),
    )
    assert [ends[name].code for name in ("bad", "killed", "good")] == [2, -9, 0]
    assert ends["good"].result.detail == {"iterations": 5}
    failures = [(name, event.error) for name, event in heard.said if type(event).__name__ == "Failed"]
    assert failures[0] == ("bad", "no cloth.") and len(failures) == 2
    assert failures[1][1].endswith("killed.log: it ended by signal 9; the last lines of this log say more.")
    assert "noise" in (tmp_path / "good.log").read_text()


def test_a_task_that_cannot_begin_yet_is_taken_when_another_ends(tmp_path):
    heard = Heard([{}, {}])
    first, second = (task(tmp_path, name, "time.sleep(0.2)") for name in ("first", "second"))
    waiting = [first, second]

    def take() -> CommandTask | None:
        ready = bool(waiting) and (waiting[0] is first or "first" in heard.ends)
        return waiting.pop(0) if ready else None

    heard.queue.run(take, heard.stop)
    assert list(heard.ends) == ["first", "second"]


GENTLE = """
signal.signal(signal.SIGINT, lambda *_: (say(event='message', text='stopped'), sys.exit(130)))
say(event='message', text='begun')
time.sleep(60)
"""


def test_a_stop_asks_those_that_run_and_starts_no_more(tmp_path):
    class Stopping(Heard):
        def tell(self, name: str, event: TaskEvent) -> None:
            super().tell(name, event)
            if [said for _, said in self.said] == [Message("begun")] * 2:
                self.stop.set()

    heard = Stopping([{}, {}])
    ends = heard.run(*(task(tmp_path, name, GENTLE) for name in "abc"))
    assert {name: end.code for name, end in ends.items()} == {"a": 130, "b": 130}
    assert sum(event == Message("stopped") for _, event in heard.said) == 2


def test_a_task_that_is_stopped_before_it_listens_did_not_fail(tmp_path):
    """Python dies of the signal while it loads its modules."""

    class Stopping(Heard):
        def tell(self, name: str, event: TaskEvent) -> None:
            super().tell(name, event)
            self.stop.set()

    heard = Stopping([{}])
    ends = heard.run(
        task(
            tmp_path,
            "a",
            "signal.signal(signal.SIGINT, signal.SIG_DFL)\nsay(event='message', text='begun')\ntime.sleep(60)",
        )
    )
    assert ends["a"].code == 130


def test_a_second_interrupt_ends_all_at_once(tmp_path):
    class Impatient(Heard):
        def tell(self, name: str, event: TaskEvent) -> None:
            raise KeyboardInterrupt

    heard = Impatient([{}])
    with pytest.raises(KeyboardInterrupt):
        heard.run(task(tmp_path, "a", "say(event='message', text='begun')\ntime.sleep(60)"))
    assert heard.queue._running["a"].process.wait(10) == -signal.SIGKILL


# --- what is done again -------------------------------------------------------------------------------------------


def test_what_is_finished_is_skipped_unless_something_else_is_asked(tmp_path):
    entry, done = WardrobeEntry("cape", ("stage.usda",)), {"iterations": 5, "higher by": "3.0%", WORSE_FIGURE: True}
    first = GarmentTraining(entry, tmp_path, "request")
    assert (first.state, first.resumed, first.code) == ("waiting", False, 130)
    begun = first.begin(tmp_path, "cpu")
    assert "--resume" not in begun.command and begun.command[3:6] == ["train", "stage.usda", "-o"]
    assert GarmentTraining(entry, tmp_path, "request").plan == ""  # killed before it had a state
    (tmp_path / "cape.resume.safetensors").touch()
    again = GarmentTraining(entry, tmp_path, "request")
    assert again.resumed and again.begin(tmp_path, "cpu").command[-1] == "--resume"
    again.end(End(130, 2.0, None))
    assert (again.state, again.code) == ("stopped", 130)
    (tmp_path / "cape.safetensors").touch()
    last = GarmentTraining(entry, tmp_path, "request")
    last.end(End(5, 3.0, read_event(json.dumps({"event": "result", "task": "train", "detail": done}))))
    kept = GarmentTraining(entry, tmp_path, "request")
    assert (kept.state, kept.code, kept.plan) == ("finished", 5, "finished before; skipped")
    assert kept.row() == {
        "garment": "cape", "iterations": 5, "total [J]": None, "lower by": "-3.0%", "collisions": None,
        "skin shows": None, "bare": None, "time": 5.0, "state": "finished",
    }  # fmt: skip
    model = tmp_path / "cape.safetensors"
    model.write_bytes(b"another model")
    assert GarmentTraining(entry, tmp_path, "request").state == "waiting"
    changed = GarmentTraining(entry, tmp_path, "another request")
    assert changed.state == "waiting" and not changed.resumed and "have changed" in changed.plan
    changed.begin(tmp_path, "cpu")
    assert not (tmp_path / "cape.resume.safetensors").exists()  # it belongs to what was asked before
    changed.end(End(-9, 1.0, None))
    assert (changed.state, changed.code) == ("failed", 1)
    (tmp_path / "cape.json").write_text("{")
    with pytest.raises(SsilkError, match=r"cape.json: this record of finished work is damaged .*delete it"):
        GarmentTraining(entry, tmp_path, "request")


def test_what_lies_over_a_garment_is_trained_again_with_it(tmp_path):
    over = WardrobeEntry("coat", ("stage.usda",), ("shirt",))

    def trained(name: str) -> GarmentTraining:
        known: dict[str, GarmentTraining] = {}
        for entry in (WardrobeEntry("shirt", ("stage.usda",)), over):
            known[entry.name] = GarmentTraining(entry, tmp_path, "request", known)
        return known[name]

    def finish(name: str, contents: bytes) -> list[str]:
        training = trained(name)
        command = list(training.begin(tmp_path, "cpu").command)
        (tmp_path / f"{name}.safetensors").write_bytes(contents)
        training.end(End(0, 1.0, None))
        return command

    finish("shirt", b"a shirt")
    assert finish("coat", b"a coat")[4:7] == ["stage.usda", "--over", str(tmp_path / "shirt.safetensors")]
    assert trained("coat").state == trained("shirt").state == "finished"
    (tmp_path / "coat.resume.safetensors").touch()
    finish("shirt", b"another shirt")
    again = trained("coat")
    assert again.state == "waiting" and "what it is worn over is trained again" in again.plan
    assert "--resume" not in again.begin(tmp_path, "cpu").command  # its state is of the shirt before


# --- what is shown ------------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_has_a_line_for_each(monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setenv("LINES", "24")
    panel = ProgressTable(["cape", "skirt"], Terminal())
    for done in (1, 2):  # the second comes too soon
        panel(GarmentEvent("skirt", Progress(done, 9, 5.0, {"stretch": 0.5})))
    panel(GarmentEvent("cape", Message("a warning that is longer than the line", "warning")))
    first, second = panel.stream.getvalue().split("\x1b[2A")
    assert first == "\r\x1b[Kcape   waiting\n\r\x1b[Kskirt  1/9  5 s left  stretch\n"
    assert second == "\r\x1b[Kcape   warning: a warning tha\n\r\x1b[Kskirt  2/9  5 s left  stretch\n"


def test_elsewhere_lines_say_whose_they_are():
    stream = io.StringIO()
    panel = ProgressTable(["cape", "skirt"], stream)
    for name in ("cape", "skirt", "cape"):
        panel(GarmentEvent(name, Progress(1, 9, None, {"stretch": 0.5})))
    panel(GarmentEvent("skirt", Message("half of it")))
    assert stream.getvalue().splitlines() == [
        "cape: 1/9  stretch 0.5",
        "skirt: 1/9  stretch 0.5",
        "skirt: half of it",
    ]


def test_the_table_is_aligned():
    rows = [{"garment": "cape", "total": 0.25, "time": 65.0, "state": "finished"},
            {"garment": "t", "total": None, "time": 5.0, "state": "failed"}]  # fmt: skip
    assert table(rows).splitlines() == [
        "garment  total        time  state",
        "cape      0.25  1 min 05 s  finished",
        "t                      5 s  failed",
    ]


def test_events_are_read_as_they_were_written():
    stream = io.StringIO()
    said = Progress(1, 2, None, {"stretch": float("nan"), "bending": 0.5})
    JsonReporter(stream)(said)
    JsonReporter(stream)(GarmentEvent("cape", Message("well")))
    alone, named = stream.getvalue().splitlines()
    assert repr(read_event(alone)) == repr(said)
    inner = {"event": "message", "text": "well", "level": "info"}
    assert json.loads(named) == {"event": "garment", "name": "cape", "said": inner}
    for line in ("noise", "[1]", '{"event": "unknown"}', '{"event": "message"}', "{}", named):
        with pytest.raises(ValueError):
            read_event(line)


# --- whole trainings ----------------------------------------------------------------------------------------------


@pytest.fixture
def world(toy, tmp_path, monkeypatch) -> Path:
    """A folder with the toy's files, a list, and a motion that is cut short, as the working folder."""
    monkeypatch.chdir(toy.copy(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    Path("list.toml").write_text(LIST)
    Path("torn.usda").write_bytes(Path("clip.usda").read_bytes()[:300])
    return tmp_path


WAITING = """#!{python}
import signal, sys, time
from ssilk_core.cli import main
from ssilk_core.training.run import TrainingRun

step, before = TrainingRun.step, signal.default_int_handler

def stepped(run):
    step(run)
    while run.state.iteration > 1 and signal.getsignal(signal.SIGINT) is not before:  # which is set by a wish to stop
        time.sleep(0.01)

TrainingRun.step = stepped
sys.exit(main(sys.argv[3:]))
"""


@contextmanager
def interrupting(log: Path, word: str) -> Iterator[None]:
    """Interrupt this process as soon as a log has a word, of trainings that take two steps and wait for it."""
    over, script = threading.Event(), Path("waiting.py").absolute()
    script.write_text(WAITING.format(python=sys.executable))
    script.chmod(0o755)

    def watch() -> None:
        while not over.wait(0.02):
            if log.exists() and word in log.read_text():
                os.kill(os.getpid(), signal.SIGINT)
                return

    thread = threading.Thread(target=watch)
    thread.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "executable", str(script))
        yield
    over.set()
    thread.join()


OUTFIT = """
[coat]
over = ["skirt"]
set = { valid_frames = 8, iterations = 6 }

[cloak]
over = ["torn"]
"""


@pytest.mark.slow
def test_an_interrupted_list_goes_on_from_the_inside_out_and_a_failure_is_told(world, capsys):
    """Inner garments come first, and what lies over one that failed is not trained. The list is longer by then."""
    Path("list.toml").write_text(LIST.partition("[torn]")[0])
    command = shlex.split("wardrobe list.toml -o out --device cpu --jobs 2 --json")
    with interrupting(Path("out/skirt.log"), '"progress"'):
        assert main(command) == 130
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    states = {row["garment"]: row["state"] for row in events[-1]["detail"]["garments"]}
    assert states["skirt"] == "stopped" and Path("out/skirt.resume.safetensors").exists()
    Path("list.toml").write_text(LIST + OUTFIT)
    assert main(command) == EXIT_TASKS
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    rows = {row["garment"]: row for row in events[-1]["detail"]["garments"]}
    states = {name: row["state"] for name, row in rows.items()}
    assert states == {"skirt": "finished", "coat": "finished", "torn": "failed", "cloak": "failed"}
    assert rows["skirt"]["iterations"] == 120
    said = [(event["name"], event["said"]) for event in events if event["event"] == "garment"]
    torn = [event for name, event in said if name == "torn"]
    assert [event["event"] for event in torn] == ["message", "failed"] and "torn.usda" in torn[-1]["error"]
    assert any("resumed at iteration" in line for line in Path("out/skirt.log").read_text().splitlines())
    assert load_model("out/skirt.safetensors").provenance["train"]["seed"] == 3
    ended = next(k for k, (name, event) in enumerate(said) if name == "skirt" and event.get("text") == "finished")
    assert [name for name, _ in said].index("coat") > ended
    (error,) = [event["error"] for name, event in said if name == "cloak"]
    assert "it is worn over 'torn', of which there is no model" in error and not Path("out/cloak.log").exists()
    over = load_model("out/coat.safetensors").provenance["over"]
    assert over == {"skirt": sha256(Path("out/skirt.safetensors"))}


@pytest.mark.slow
def test_two_processes_train_one_garment_and_one_of_them_speaks(world, toy):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    command = [sys.executable, "-m", "ssilk_core", "train", "rigged.usda", "--motions", "clip.usda", "--json"]
    told = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    processes = [
        subprocess.Popen(
            [*command, "-o", "together.safetensors", *toy.training, "--set", "feedback_points=0"],
            env={**told, "RANK": rank, "LOCAL_RANK": rank},
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in "01"
    ]
    first, second = (process.communicate()[0].splitlines() for process in processes)
    assert [process.returncode for process in processes] == [EXIT_WORSE, EXIT_WORSE]  # three iterations teach little
    assert json.loads(first[-1])["event"] == "result" and not second
    assert load_model("together.safetensors").provenance["processes"] == 2
