# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs one training that outlives Blender, when its turn comes, and keeps its state in a small file.

Run by the Python that has ssilk, from its standard library alone: `python runner.py JOB QUEUE`. JOB is a folder with
`job.json`; `state.json` is written in it, and a file named `cancel` in it asks for an end. QUEUE is a folder in which
all runners of a user line up: one of them trains at a time.

A job that improves goes on after its command is done, until it is asked to end: in rounds, each of which resumes the
training with twice the time spent so far, so that the learning rate falls again to where it ended. It ends by itself
after a round without a better model. Rounds line up behind all first trainings, and make way for them.
"""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

ORDER, STATE, CANCEL, LOG = "job.json", "state.json", "cancel", "log.txt"
LOOK = 0.25  # seconds between two looks at the queue, the training and the wish to cancel
BEAT = 2.0  # seconds after which the state is written though nothing was heard: Blender sees that somebody is there
MOST_POINTS = 300  # of the curve
UNLOCKED = 5.0  # seconds that a new place in the queue may be unlocked before it counts as left behind
DONE, FAULT, BAD_INPUT, WORSE, INTERRUPTED = 0, 1, 2, 5, 130  # exit codes of ssilk; worse: than linear blend skinning
KEPT = ("curve", "checkpoint", "done", "total", "round", "spent", "minutes", "best_before")  # of an earlier run
GROWTH = 2.0  # of the time that is spent, from round to round
LATER = "later-"  # begins names of places in the queue, after all digits

# On Windows an interrupt reaches a whole group, so that the training needs one of its own.
if sys.platform == "win32":
    NEW_GROUP, INTERRUPT = subprocess.CREATE_NEW_PROCESS_GROUP, signal.CTRL_BREAK_EVENT
else:
    NEW_GROUP, INTERRUPT = 0, signal.SIGINT


class StateFile:
    """The state of a job: what its training said last, written whole."""

    def __init__(self, folder):
        """Take up what an earlier run has reached."""
        self.path = folder / STATE
        before = read(self.path)
        kept = {name: before[name] for name in KEPT if name in before}
        self.fields = {"curve": [], "round": 0, "spent": 0.0, **kept}
        self.written = 0.0

    def hear(self, event):
        """Take in one event of ssilk, a dictionary."""
        kind = event.pop("event", "")
        if kind == "started":
            self.fields["total"] = event["total"]
        elif kind == "progress":
            self.fields.update(event)
            self._add_point(event["done"], event["terms"])
        elif kind == "message":
            self.fields["text"] = event["text"]
        elif kind == "checkpoint":
            self.fields["checkpoint"] = event["done"]
        elif kind == "failed":
            self.fields["error"] = event["error"]

    def _add_point(self, done, terms):
        curve = [point for point in self.fields["curve"] if point[0] < done]
        curve.append([done, terms])
        self.fields["curve"] = curve if len(curve) <= MOST_POINTS else curve[::2]

    def write(self, **fields):
        """Write the state with these fields changed."""
        self.fields.update(fields, beat=time.time())
        temporary = self.path.with_suffix(".partial")
        temporary.write_text(json.dumps(self.fields), encoding="utf-8")
        with contextlib.suppress(PermissionError):  # somebody reads it, on Windows; the next one comes soon
            temporary.replace(self.path)
        self.written = time.monotonic()


def read(path):
    """Return what a file of JSON holds; nothing where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


@contextlib.contextmanager
def place_in(folder, prefix=""):
    """Yield a function that says whether it is our turn: whether all who come earlier have left the queue."""
    folder.mkdir(parents=True, exist_ok=True)
    own = folder / f"{prefix}{time.time_ns():020d}-{os.getpid()}"
    with own.open("w") as stream:
        if not locks(stream):
            raise OSError(f"{own} cannot be locked")
        try:
            yield lambda: not any(waits(other) for other in sorted(folder.iterdir()) if other.name < own.name)
        finally:
            if os.name != "nt":  # where an open file cannot be removed
                own.unlink(missing_ok=True)
    own.unlink(missing_ok=True)


def waits(place):
    """Return whether somebody holds a place in the queue; one that was left behind is removed."""
    try:
        with place.open("r+") as stream:
            if not locks(stream) or time.time() - place.stat().st_mtime < UNLOCKED:
                return True
        place.unlink(missing_ok=True)
    except FileNotFoundError:
        pass
    return False


def locks(stream):
    """Return whether an open file could be locked; the lock ends with the process at the latest."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def wait(folder, record, our_turn):
    """Wait for our turn; return whether to begin."""
    while not (folder / CANCEL).exists():
        if our_turn():
            return True
        if time.monotonic() - record.written > BEAT:
            record.write()
        time.sleep(LOOK)
    return False


def train(folder, record, command, our_turn):
    """Run the training; return its exit code and whether it was asked to end: INTERRUPTED then, however it did."""
    with (folder / LOG).open("w", encoding="utf-8") as log:
        process = subprocess.Popen(
            [sys.executable, *command], cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log,
            encoding="utf-8", errors="replace", creationflags=NEW_GROUP,
        )  # fmt: skip
    said: queue.SimpleQueue[str] = queue.SimpleQueue()
    reader = threading.Thread(target=pass_on, args=(process.stdout, said.put), daemon=True)
    reader.start()
    try:
        asked = attend(process, said, reader, folder, record, our_turn)
    finally:
        if process.poll() is None:  # the folder is gone, and nobody will ask for the model
            process.terminate()
    told = process.returncode in (DONE, FAULT, BAD_INPUT, WORSE)
    return (INTERRUPTED if asked and not told else process.returncode), asked


def attend(process, said, reader, folder, record, our_turn):
    """Write what a training says until it ends; interrupt it when that is asked for. Return whether it was."""
    asked, began, before = False, time.monotonic(), record.fields["spent"]
    while process.poll() is None or reader.is_alive() or not said.empty():
        if not asked and process.poll() is None and ((folder / CANCEL).exists() or not our_turn()):
            process.send_signal(INTERRUPT)
            asked = True
        record.fields["spent"] = before + time.monotonic() - began
        if listen(said, record) or time.monotonic() - record.written > BEAT:
            record.write()
        time.sleep(LOOK)
    return asked


def pass_on(stream, take):
    """Give every line of a stream away, until it ends."""
    for line in stream:
        take(line)


def listen(said, record):
    """Take in the lines of a training; return whether there were any."""
    heard = False
    while not said.empty():
        with contextlib.suppress(ValueError):  # a library printed something
            record.hear(json.loads(said.get()))
        heard = True
    return heard


def last_words(folder):
    """Return the last line that a training wrote to standard error."""
    lines = (folder / LOG).read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line for line in reversed(lines) if line.strip()), "it ended without a word")


def main(folder, queue_folder):
    """Wait and train; the state says how it ended."""
    record, order = StateFile(folder), read(folder / ORDER)
    while not (end := run_round(folder, queue_folder, record, order)):
        pass
    record.write(**end)


def run_round(folder, queue_folder, record, order):
    """Wait and train once; return how the job ended, as fields of its state, or nothing where there is more to do."""
    fields, improves = record.fields, order.get("improves", False)
    later = fields["round"] > 0
    record.write(state="waiting")
    with place_in(queue_folder, LATER if later else "") as our_turn:
        if not wait(folder, record, our_turn):
            return {"state": "stopped"}
        record.write(state="running")
        code, asked = train(folder, record, command_of(order, fields), our_turn if later else lambda: True)
    if code == INTERRUPTED:  # by the artist, to make way, or by somebody else
        makes_way = asked and later and not (folder / CANCEL).exists()
        return {} if makes_way else {"state": "stopped", "seconds_left": None}
    if code not in (DONE, WORSE):
        return {"state": "failed", "error": fields.get("error") or last_words(folder)}
    best = fields.get("checkpoint")
    if not improves or (later and best == fields["best_before"]):
        return {"state": "done", "seconds_left": None}
    minutes = GROWTH * fields["spent"] / 60
    fields.update(round=fields["round"] + 1, minutes=minutes, best_before=best, seconds_left=None)
    return {}


def command_of(order, fields):
    """Return the arguments of a round: all but the first resume, with minutes in place of the preset's iterations."""
    if not fields["round"]:
        return order["command"]
    command = [word for word in order["command"] if word != "--resume"]
    return [*command, "--resume", "--minutes", f"{fields['minutes']:g}"]


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the training would inherit that it is ignored
    main(Path(sys.argv[1]), Path(sys.argv[2]))
