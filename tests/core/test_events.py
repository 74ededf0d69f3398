# SPDX-License-Identifier: Apache-2.0
"""Events as JSON lines for machines and as text for people."""

import io
import json

import pytest

from ssilk_core import events
from ssilk_core.events import (
    Checkpoint,
    Failed,
    JsonReporter,
    Message,
    Progress,
    Result,
    Started,
    TextReporter,
    describe,
    format_seconds,
)

EVERY = [
    Started("train", 10, {"garment": "/cape"}),
    Progress(3, 10, 12.5, {"stretch": 0.25}),
    Message("resumed", "info"),
    Checkpoint("m.safetensors", 5, True),
    Result("train", {"total [J]": 1.5}),
    Failed("x: no; do that."),
]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines(*given: events.Event) -> list[dict]:
    stream = io.StringIO()
    report = JsonReporter(stream)
    for event in given:
        report(event)
    return [json.loads(line, parse_constant=pytest.fail) for line in stream.getvalue().splitlines()]


def test_each_event_is_one_json_object_on_one_line():
    found = lines(*EVERY)
    assert [line["event"] for line in found] == ["started", "progress", "message", "checkpoint", "result", "failed"]
    assert found[0] == {"event": "started", "task": "train", "total": 10, "detail": {"garment": "/cape"}}
    assert found[1] == {"event": "progress", "done": 3, "total": 10, "seconds_left": 12.5, "terms": {"stretch": 0.25}}
    assert found[3] == {"event": "checkpoint", "path": "m.safetensors", "done": 5, "best": True}


def test_numbers_that_json_lacks_become_null():
    (found,) = lines(Progress(1, 2, float("inf"), {"stretch": float("nan"), "bending": 1.0}))
    assert found["seconds_left"] is None and found["terms"] == {"stretch": None, "bending": 1.0}
    (found,) = lines(Result("train", {"list": [float("nan"), 2], "text": "NaN"}))
    assert found["detail"] == {"list": [None, 2], "text": "NaN"}


def test_line_breaks_within_an_event_do_not_break_its_line():
    assert lines(Failed("one\ntwo"))[0]["error"] == "one\ntwo"


def test_an_event_of_one_of_several_is_named():
    (found,) = lines(events.GarmentEvent("cape", Progress(1, 2, None, {"stretch": float("inf")})))
    said = {"event": "progress", "done": 1, "total": 2, "seconds_left": None, "terms": {"stretch": None}}
    assert found == {"event": "garment", "name": "cape", "said": said}


def test_text_for_people():
    assert describe(EVERY[0]) == "train ..."
    assert describe(Message("careful", "warning")) == "warning: careful"
    assert describe(EVERY[5]) == "error: x: no; do that."
    assert describe(EVERY[4]) == "  total [J]: 1.5"
    assert describe(EVERY[3]) == ""


def test_a_terminal_renews_one_line_and_ends_it_before_the_next_text(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(events.time, "monotonic", lambda: now[0])
    stream = Terminal()
    report = TextReporter(stream)
    for done in (1, 2, 3):  # the second comes too soon
        report(Progress(done, 10, 65.0, {"stretch": 0.12345}))
        now[0] += 0.06
    report(Message("done"))
    assert stream.getvalue() == (
        "\r\x1b[K  1/10  1 min 05 s left  stretch 0.1235\r\x1b[K  3/10  1 min 05 s left  stretch 0.1235\ndone\n"
    )


def test_a_log_gets_a_line_now_and_then_and_the_last_one_always(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(events.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    report = TextReporter(stream)
    for done in range(1, 31):
        report(Progress(done, 30))
        now[0] += 1
    assert stream.getvalue().split() == ["1/30", "11/30", "21/30", "30/30"]


def test_lines_begin_with_the_time_where_they_are_asked_to(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(events.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    report = TextReporter(stream)
    report(Message("before"))
    report.since = 100.0
    for now[0], event in ((102.9, Message("soon")), (3765.0, Progress(1, 2, 65.0)), (3766.0, Failed("no"))):
        report(event)
    assert stream.getvalue() == "before\n0:00:02  soon\n1:01:05  1/2  1 min 05 s left  \nerror: no\n"


def test_the_time_left_is_told_at_the_pace_since_the_first_step(monkeypatch):
    now, told = [100.0], []
    monkeypatch.setattr(events.time, "monotonic", lambda: now[0])
    done = events.Countdown(10, told.append, done=3)
    for seconds in (60, 2, 4):  # the first one loads what the others find ready
        now[0] += seconds
        done()
    assert told == [Progress(4, 10, None), Progress(5, 10, 10.0), Progress(6, 10, 12.0)]
    done(4)
    assert told[-1] == Progress(10, 10, 0.0)
    told.clear()
    done = events.Countdown(8, told.append, at_once=2)  # two threads end their steps together, every 4 s
    for seconds in (4, 0.01, 3.99, 0.01, 3.99, 0.01):
        now[0] += seconds
        done()
    assert [each.seconds_left for each in told] == [None, None, None, 8.0, 6.0, 4.0]


@pytest.mark.parametrize(
    "seconds, text",
    [
        (0.2, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (185, "3 min 05 s"),
        (3599.7, "1 h 00 min"),
        (7800, "2 h 10 min"),
    ],
)
def test_durations_read_as_people_say_them(seconds, text):
    assert format_seconds(seconds) == text
