# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames that a process outside Blender solves while a garment is played, in order, as a cache of physics is made.

The whole motion is sent whenever it changes. The process keeps what it has solved of the one before, and goes on from
where they differ, so that a late edit costs few frames. Until a frame is there, the network's is played.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy

from ssilk_core.delivery.live.messages import LiveMessage
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.scene.assets import GarmentPose, Motion

from ..errors import SetupError
from ..outside.conversation import Conversation
from ..outside.wording import recall, reworded, with_bones
from ..preferences import interpreter, preferences, unready
from ..scene.gather import gather
from ..scene.handover import STAGE, hand_over
from ..scene.objects import Pair
from .fabrics import played_options
from .models import TrainedGarment

ITERATIONS = ["--latent-iterations", str(QUALITIES["latent"].latent_iterations)]
SOLVED = {"latent": ITERATIONS, "latent_few": [*ITERATIONS, "--latent-elements", "few"]}  # as 'ssilk live' has them


def no_solver(level: str) -> str:
    """Return why nothing can run outside that solves at a level of quality; empty if it can, or need not."""
    return unready(bpy.context) if level in SOLVED else ""


def need_solver(level: str) -> None:
    """Raise `SetupError` where nothing can run outside that solves at a level of quality."""
    if reason := no_solver(level):
        raise SetupError(f"{reason.removesuffix('.')}.")


class Solving:
    """What a process has solved of a motion.

    Attributes:
        total: frames of the motion; zero before there is one.
        frames: those that are solved, one pose each, from the first one on.
        started: whether the process is ready.
        complete: whether all frames are there.
        error: why there will be no more, in a sentence; empty where nothing went wrong.
        failed, lost: at how many steps no state had less energy, and which frames were put to rest.
    """

    def __init__(
        self, garment: bpy.types.Object, armature: bpy.types.Object, model: Path, trained: TrainedGarment, level: str,
        pre_roll: float,
    ) -> None:  # fmt: skip
        """Write what the process reads; it starts with the first motion. In object mode.

        Raises:
            SetupError: there is no Python outside, or the character cannot be used.
        """
        need_solver(level)
        self._model, self._bones, self._words = model, trained.joints.bones, dict[str, str]()
        stage = model.parent / STAGE
        scene = None
        if trained.on:
            scene = trained.on.moved(gather(garment, joints=trained.joints))
        elif not stage.exists():
            scene = gather(garment, joints=trained.joints)
        self._temporary = tempfile.TemporaryDirectory(prefix="ssilk-", dir=bpy.app.tempdir or None)
        if scene:
            given = hand_over(scene, Pair.of(garment, armature), self.folder)
            stage, self._words = given.stage, given.words
        self._command = [
            interpreter(preferences(bpy.context)), "-m", "ssilk_core", "live", str(model), "--stage", str(stage),
            "--pre-roll", f"{pre_roll:g}", *SOLVED[level], *(played_options(garment) if trained.file.fabrics else []),
        ]  # fmt: skip
        self._talk: Conversation | None = None
        self._asked: Motion | None = None
        self._number, self._forgot = 0, False  # whether frames were forgotten that were not asked for again
        self.frames: list[GarmentPose] = []
        self.total, self.failed = 0, 0
        self.lost: set[int] = set()
        self.started = self.complete = False
        self.error = ""

    @property
    def waits(self) -> bool:
        """Whether more frames will come."""
        return bool(self.total) and not self.complete and not self.error

    @property
    def pid(self) -> int | None:
        """The number of the process; None where there is none."""
        return self._talk and self._talk.pid

    def follow(self, motion: Motion) -> None:
        """Solve another motion from where it differs on; a process that has ended is started again."""
        same = self._asked.same_frames(motion) if self._asked else 0
        if same == motion.frame_count == self.total and not self.error and not self._forgot:
            return
        self.forget_from(same)
        self._asked, self.total, self.error, self._forgot = motion, motion.frame_count, "", False
        if self._talk is None:
            self.started = False
            try:
                self._talk = Conversation(self._command, self.folder)
            except OSError as error:
                python, why = self._command[0], error.strerror or error
                self.error = f"{python} cannot be started ({why}); choose another Python."
                return
        self._talk.send(LiveMessage.of_motion(self._number, motion))

    def forget_from(self, frame: int) -> None:
        """Forget what was solved of a frame on, and of the one before: at another rate it looks ahead.

        What still comes in about the motion as it was is not listened to.
        """
        self._number, self._forgot = self._number + 1, True
        first = max(frame - 1, 0)
        del self.frames[first:]
        self.lost = {number for number in self.lost if number < first}
        self.complete = False

    def poll(self) -> None:
        """Take in what was solved, and whether the process has ended."""
        if self._talk is None:
            return
        ending = self._talk.ending  # before what it said last is taken in
        for message in self._talk.heard():
            self.started = self.started or message.kind == "ready"
            if message.numbers.get("number") == self._number:
                self._take(message)
        if ending:
            self._end_talk()
            self.error = "" if self.complete else self._in_words(ending)

    def close(self) -> None:
        """End the process, and remove what was written for it."""
        self._end_talk()
        self._temporary.cleanup()

    @property
    def folder(self) -> Path:
        """Where the process runs; it goes with `close`."""
        return Path(self._temporary.name)

    def _take(self, message: LiveMessage) -> None:
        if message.kind == "done":
            self.complete, self.failed = True, message.numbers["failed"]
        elif message.kind == "solved":
            pose = message.pose()
            frames = [pose.part(slice(row, row + 1)) for row in range(pose.frame_count)]
            self.frames[pose.start : pose.start + len(frames)] = frames
            self.lost |= set(message.numbers["lost"])

    def _end_talk(self) -> None:
        if self._talk:
            self._talk.close()
            self._talk = None

    def _in_words(self, sentence: str) -> str:
        sentence = reworded(sentence, self.folder, self._words)
        return with_bones(reworded(sentence, self._model.parent, recall(self._model.parent)), self._bones)
