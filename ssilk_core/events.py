# SPDX-License-Identifier: Apache-2.0
"""Events of long tasks: a closed set of types, reported as JSON lines or as text."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol, TextIO

_ONE = {"bodies": "body", "vertices": "vertex", "isolated vertices": "isolated vertex"}


@dataclass(frozen=True)
class Started:
    task: str
    total: int
    detail: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Progress:
    """`done` of `total` steps; `seconds_left` is None until there is an estimate; `terms` are energies [J]."""

    done: int
    total: int
    seconds_left: float | None = None
    terms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Message:
    """`level` is "info" or "warning"."""

    text: str
    level: str = "info"


@dataclass(frozen=True)
class Checkpoint:
    path: str
    done: int
    best: bool


@dataclass(frozen=True)
class Result:
    task: str
    detail: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Failed:
    error: str


TaskEvent = Started | Progress | Message | Checkpoint | Result | Failed


@dataclass(frozen=True)
class GarmentEvent:
    """An event of one of several concurrent tasks, with the task's name."""

    name: str
    said: TaskEvent


Event = TaskEvent | GarmentEvent


class Reporter(Protocol):
    """A function that receives events."""

    def __call__(self, event: Event) -> None: ...


def silent(event: Event) -> None:
    """Ignore an event."""


class Countdown:
    """Report each step of a task as it is done, with the time that those to come take at the pace so far.

    The first step tells no time and does not count for the pace, because it often loads or settles what the others
    find ready.

    Args:
        done: steps that are done already.
        at_once: steps that end together, as several threads do them: the pace is that of so many.
    """

    def __init__(self, total: int, report: Reporter, done: int = 0, at_once: int = 1) -> None:
        self.total, self.report, self.done, self.at_once = total, report, done, at_once
        self._first: tuple[float, int] | None = None
        self._pace: float | None = None
        self._counted = done

    def __call__(self, steps: int = 1) -> None:
        """Report that so many more steps are done."""
        self.done += steps
        if self.done >= self._counted + self.at_once:
            self._counted, now = self.done, time.monotonic()
            since, before = self._first = self._first or (now, self.done)
            self._pace = (now - since) / (self.done - before) if self.done > before else None
        left = None if self._pace is None else self._pace * (self.total - self.done)
        self.report(Progress(self.done, self.total, left))


class JsonReporter:
    """Print one JSON object per line, by default on standard output: {"event": "progress", "done": ...}."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout

    def __call__(self, event: Event) -> None:
        print(json.dumps(_document(event), allow_nan=False, default=str), file=self.stream, flush=True)


def _document(event: Event) -> dict[str, Any]:
    if isinstance(event, GarmentEvent):
        return {"event": "garment", "name": event.name, "said": _document(event.said)}
    return {"event": type(event).__name__.lower(), **finite(asdict(event))}


def read_event(line: str) -> TaskEvent:
    """Parse a line that `JsonReporter` wrote for a single task (no `GarmentEvent`).

    Raises:
        ValueError: the line is not such an event.
    """
    kinds = {kind.__name__.lower(): kind for kind in (Started, Progress, Message, Checkpoint, Result, Failed)}
    try:
        document = json.loads(line)
        event = kinds[document.pop("event")](**document)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"not an event: {line.strip()}") from error
    if isinstance(event, Progress):
        return replace(event, terms={name: math.nan if x is None else x for name, x in event.terms.items()})
    return event


def finite(value: Any) -> Any:
    """Return a value with NaN and infinity replaced by None, because JSON has neither."""
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class TextReporter:
    """Print events as text; progress rewrites one line on a terminal, and adds one every ten seconds elsewhere.

    Attributes:
        since: when the times at the front of lines of progress count from, as `time.monotonic` tells it [s]; None for
            no times.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.since: float | None = None
        self.live = self.stream.isatty()
        self.last = 0.0
        self.open_line = False

    def __call__(self, event: Event) -> None:
        if isinstance(event, Progress):
            self._progress(event)
            return
        self._end_line()
        text = describe(event)
        if text:
            told = "" if isinstance(event, Failed | Result) else self._time()
            print(told + text, file=self.stream, flush=True)

    def _progress(self, event: Progress) -> None:
        now = time.monotonic()
        if now - self.last < (0.1 if self.live else 10.0) and event.done < event.total:
            return
        self.last = now
        line = (self._time() or "  ") + describe_progress(event)
        print(f"\r\x1b[K{line}" if self.live else line, end="" if self.live else "\n", file=self.stream, flush=True)
        self.open_line = self.live

    def _time(self) -> str:
        """Return what a line begins with: hours, minutes and seconds, where they are asked for."""
        if self.since is None:
            return ""
        minutes, seconds = divmod(int(time.monotonic() - self.since), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}  "

    def _end_line(self) -> None:
        if self.open_line:
            print(file=self.stream)
            self.open_line = False


def describe_progress(event: Progress) -> str:
    """Format progress as one line: "40/500  3 min 05 s left  stretch 0.12"."""
    left = "" if event.seconds_left is None else f"  {format_seconds(event.seconds_left)} left"
    terms = "  ".join(f"{name} {value:.4g}" for name, value in event.terms.items())
    return f"{event.done}/{event.total}{left}  {terms}"


def describe(event: Event) -> str:
    """Format an event as text; empty for events that are not shown."""
    match event:
        case Started():
            return f"{event.task} ..."
        case Message():
            return event.text if event.level == "info" else f"warning: {event.text}"
        case Failed():
            return f"error: {event.error}"
        case Result():
            return "\n".join(f"  {name}: {value}" for name, value in event.detail.items())
        case GarmentEvent():
            return f"{event.name}: {describe(event.said)}"
    return ""


def format_count(count: int, elements: str) -> str:
    """Format a number of elements: "1 vertex", "1,200 faces"."""
    return f"{count:,} {elements}" if count != 1 else f"1 {_ONE.get(elements, elements.removesuffix('s'))}"


def format_seconds(seconds: float) -> str:
    """Format a duration: "42 s", "3 min 05 s", "2 h 10 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
