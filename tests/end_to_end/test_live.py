# SPDX-License-Identifier: Apache-2.0
"""`ssilk live` on the toy world: fed with poses it answers as a bake does, and its process ends with its pipe.

What is answered is asked of the service in a thread, at the ends of two pipes; a process takes seconds to begin.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
import pytest
from pxr import Usd
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.cli.live import OVER_PIPE
from ssilk_core.delivery.bake import BakeRequest, bake, load_garment, load_rollout
from ssilk_core.delivery.bake.latents import solved
from ssilk_core.delivery.live.messages import LiveMessage, read_message
from ssilk_core.delivery.live.service import serve
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import GarmentPose, Motion
from ssilk_core.scene.kinematics import deform

FRAMES = 9
ITERATIONS, PRE_ROLL = 2, 0.1
PATIENCE = 300  # seconds, on a busy machine
REQUEST = BakeRequest(
    model="model.safetensors", stage="rigged.usda", motion="brief.usda", latent_iterations=ITERATIONS,
    pre_roll=PRE_ROLL,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    folder = toy.copy(tmp_path_factory.mktemp("live"))
    toy.write_clip(folder / "brief.usda", frames=FRAMES)
    toy.write_clip(folder / "film.usda", frames=FRAMES, fps=24.0)
    return folder


@pytest.fixture
def there(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def start(there) -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts the process in the toy world; kills what a test has left."""
    started: list[subprocess.Popen] = []

    def begin(*words: str, stage: str = "rigged.usda") -> subprocess.Popen:
        command = [sys.executable, "-m", "ssilk_core", "live", "model.safetensors", "--stage", stage]
        process = subprocess.Popen(
            [*command, "--pre-roll", str(PRE_ROLL), *words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout, process.stderr):
            with suppress(BrokenPipeError):
                stream.close()


@dataclass(frozen=True)
class Served:
    """The other ends of the pipes of a service, under the names that a process has for them.

    Attributes:
        unheard: set once the service has written what nobody reads.
    """

    stdin: BinaryIO
    stdout: BinaryIO
    unheard: threading.Event


class Unheard:
    """The end of a pipe to write to, which knows that nobody reads the other one."""

    def __init__(self, pipe: BinaryIO) -> None:
        self.pipe, self.found_out = pipe, threading.Event()

    def write(self, data: bytes) -> None:
        try:
            self.pipe.write(data)
        except BrokenPipeError:
            self.found_out.set()
            raise

    def flush(self) -> None:
        self.pipe.flush()


@contextmanager
def served(**options: object) -> Iterator[Served]:
    """A service in a thread, with some fields of the request; it ends when its pipe does."""
    garment = load_garment(replace(REQUEST, motion=OVER_PIPE, **options))
    (asked, stdin), (stdout, told) = os.pipe(), os.pipe()
    with ExitStack() as stack:
        incoming, outgoing = (stack.enter_context(open(*end, buffering=0)) for end in ((asked, "rb"), (told, "wb")))
        ended: list[None] = []
        told_to = Unheard(outgoing)
        thread = threading.Thread(target=lambda: ended.append(serve(garment, incoming, told_to)), daemon=True)
        thread.start()
        with open(stdout, "rb") as heard, open(stdin, "wb") as said:
            yield Served(said, heard, told_to.found_out)
            said.close()
            thread.join(PATIENCE)
        assert ended == [None]  # neither does it go on, nor does an error end it


def say(process: subprocess.Popen | Served, number: int, motion: Motion) -> None:
    process.stdin.write(LiveMessage.of_motion(number, motion).to_bytes())
    process.stdin.flush()


def heard(process: subprocess.Popen | Served, number: int) -> tuple[GarmentPose, LiveMessage]:
    """All frames of a motion, in order, and what is said at its end."""
    poses: list[GarmentPose] = []
    while (message := read_message(process.stdout)) is not None:
        if message.numbers.get("number") != number:
            continue
        if message.kind == "done":
            assert [pose.start for pose in poses] == list(np.cumsum([0, *(p.frame_count for p in poses[:-1])]))
            return GarmentPose.joined(poses), message
        poses.append(message.pose())
    raise AssertionError(process.stderr.read().decode() if isinstance(process, subprocess.Popen) else "it ended")


def motion_of(path: str) -> Motion:
    rollout = load_rollout(replace(REQUEST, motion=path))
    return read_motion(path, rollout.deformer.scene.character.skeleton)


def same(found: GarmentPose, wanted: GarmentPose, tolerance: float) -> None:
    for name in ("rotations", "weights", "translations"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=0, atol=tolerance)


def test_it_answers_with_what_a_bake_writes_and_ends_with_what_comes_in(start):
    """One process ends in the midst of another motion; one that nobody hears goes on, and says what it cannot use."""
    process, deaf = start("--latent-iterations", str(ITERATIONS)), start()
    assert read_message(deaf.stdout).kind == "ready"
    say(deaf, 0, motion_of("brief.usda"))
    deaf.stdout.close()
    check_answer(process, "brief.usda")
    say(process, 4, motion_of("brief.usda"))
    process.stdin.close()
    assert process.wait(PATIENCE) == 0 and process.stderr.read() == b""
    deaf.stdin.write(b"GET / HTTP/1.1\r\n\r\n")
    deaf.stdin.flush()
    assert deaf.wait(PATIENCE) == 2
    (line,) = deaf.stderr.read().decode().splitlines()
    assert "error: standard input: a message that cannot be read: it begins with b'GET '" in line


def test_it_answers_a_motion_at_another_rate(there):
    with served() as service:
        check_answer(service, "film.usda")


def check_answer(process: subprocess.Popen | Served, clip: str) -> None:
    ready = read_message(process.stdout)
    assert ready.kind == "ready" and ready.numbers == {"joints": 3, "proxies": 4, "shapes": 5}
    say(process, 3, motion_of(clip))
    found, done = heard(process, 3)
    baking = solved(load_rollout(replace(REQUEST, motion=clip)))
    same(found, GarmentPose.joined(baking.latents.poses), 1e-6)
    bake(replace(REQUEST, motion=clip), "shot.usda")
    shot = Shot("shot.usda")
    skinned = np.stack([shot.garment_points(time) for time in shot.frame_times])  # by UsdSkel
    np.testing.assert_allclose(deform(baking.deformer, baking.motion, found), skinned, rtol=0, atol=1e-5)
    assert np.ptp(found.rotations, axis=0).max() > 1e-3
    told = baking.latents.summary
    assert (done.numbers["frames"], done.numbers["failed"]) == (told.frames, told.failed)


def test_a_motion_that_changes_takes_the_place_of_the_one_before(there):
    motion = motion_of("brief.usda")
    translations = motion.translations.copy()
    translations[5:, 0, 0] += 0.1
    other = replace(motion, translations=translations)
    with served() as process:
        say(process, 0, motion)
        say(process, 1, other)  # before the first one is solved
        overtaken, _ = heard(process, 1)
        say(process, 2, motion)
        before, _ = heard(process, 2)
    assert np.abs(before.rotations - overtaken.rotations)[5:].max() > 1e-4
    same(before.part(slice(5)), overtaken.part(slice(5)), 1e-7)
    same(before, GarmentPose.joined(solved(load_rollout(REQUEST)).latents.poses), 1e-6)
    with served() as fresh:
        say(fresh, 0, other)
        same(overtaken, heard(fresh, 0)[0], 1e-6)


def test_few_elements_are_chosen_for_the_first_motion(there):
    with served(latent_elements="few") as process:
        say(process, 0, motion_of("brief.usda"))
        found, _ = heard(process, 0)
    same(found, GarmentPose.joined(solved(load_rollout(replace(REQUEST, latent_elements="few"))).latents.poses), 1e-6)


def test_it_ends_with_its_input_before_it_has_heard_anything_and_where_nobody_hears_it(there):
    with served():
        pass
    with served() as deaf:
        assert read_message(deaf.stdout).kind == "ready"
        deaf.stdout.close()
        say(deaf, 0, motion_of("brief.usda"))
        assert deaf.unheard.wait(PATIENCE)


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        (LiveMessage("ready", {"joints": 3, "proxies": 4, "shapes": 5}).to_bytes(), "of the kind 'ready'"),
        (LiveMessage.of_motion(0, Motion("m", 30.0, np.ones((2, 9, 4)), np.ones((2, 9, 3)))).to_bytes(), "9 joints"),
        (LiveMessage("motion", {"number": 0, "fps": 30.0, "start": 0.0}, {
            "rotations": np.ones((2, 3, 4)), "translations": np.full((2, 3, 3), np.nan),
        }).to_bytes(), "NaN or infinity"),
    ],
)  # fmt: skip
def test_messages_that_are_no_motion_of_the_character_are_refused(there, said, complaint):
    ours, theirs = os.pipe()
    with open(ours, "rb", buffering=0) as incoming, open(theirs, "wb", buffering=0) as end:
        end.write(said)  # and stays open: what a pipe that has ended held is not answered
        with pytest.raises(SsilkError, match=complaint):
            serve(load_garment(replace(REQUEST, motion=OVER_PIPE)), incoming, io.BytesIO())
        end.close()


def test_a_character_without_a_body_and_events_as_json_are_refused(there, capsys):
    shutil.copy("rigged.usda", "bare.usda")
    stage = Usd.Stage.Open("bare.usda")
    stage.RemovePrim("/Hero/Body")
    stage.GetRootLayer().Save()
    with pytest.raises(SsilkError, match="body"):
        serve(load_garment(replace(REQUEST, stage="bare.usda", motion=OVER_PIPE)), io.BytesIO(), io.BytesIO())
    assert main(["live", "model.safetensors", "--stage", "rigged.usda", "--json"]) == 2
    assert "messages go there" in capsys.readouterr().out
