# SPDX-License-Identifier: Apache-2.0
"""The solver that follows a program's motions: it solves the latest one in order, and is interrupted by the next.

A thread reads, so that the program never waits. Whatever the program does to its end, by closing the pipe or by being
killed, ends the service after the frame that it is at.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import BinaryIO

from ...errors import fail
from ...network.latent_solver import LatentMemory, LatentOptions, LatentRoller
from ...network.latent_solver.roller import LatentTally
from ...network.rollout import garment_poses
from ...scene.assets import Motion
from ..bake import LoadedGarment
from .messages import LiveMessage, read_message

CHUNK = 4  # frames that are sent at once


class _OvertakenError(Exception):
    """The motion that is solved is another one by now, or nobody listens any more."""


class _Inbox:
    """The latest motion, as a thread reads it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._changed = threading.Condition()
        self._latest: LiveMessage | None = None
        self._wrong = ""
        self._ended = False
        threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def _read(self, stream: BinaryIO) -> None:
        message, wrong, ended = None, "", False
        while not ended:
            try:
                message = read_message(stream)
            except ValueError as error:
                wrong = str(error)
            if message and message.kind != "motion":
                wrong = f"it is of the kind '{message.kind}', which only the solver says"
            ended = message is None or bool(wrong)
            with self._changed:
                self._latest, self._wrong, self._ended = message, wrong, ended
                self._changed.notify()

    def take(self) -> LiveMessage | None:
        """Wait for a motion; return None at the end.

        Raises:
            SsilkError: what came is no message with a motion.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._latest or self._ended)
            taken, self._latest = self._latest, None
            if self._wrong:
                allowed = "messages are those of ssilk_core/delivery/live/messages.py"
                fail("standard input", f"a message that cannot be read: {self._wrong}", allowed)
            return None if self._ended else taken

    @property
    def waits(self) -> bool:
        """Whether something else came, or the end."""
        return self._latest is not None or self._ended


def serve(garment: LoadedGarment, incoming: BinaryIO, outgoing: BinaryIO) -> None:
    """Solve motions that come in, one at a time, and send their frames, until the input ends.

    Args:
        garment: of a request that says how it is solved.

    Raises:
        SsilkError: the garment's character has no body, or what comes in is no motion of it.
    """
    assert garment.model is not None
    request, scene, inbox = garment.request, garment.model.scene, _Inbox(incoming)
    options = LatentOptions(iterations=request.latent_iterations, sampled=request.samples_elements)

    def look_up() -> None:
        if inbox.waits:
            raise _OvertakenError

    def send(message: LiveMessage) -> None:
        look_up()
        try:
            outgoing.write(message.to_bytes())
            outgoing.flush()
        except BrokenPipeError as error:
            raise _OvertakenError from error

    memory = LatentMemory()
    roller = LatentRoller(
        garment.model, garment.file.fabric, options, pre_roll=request.pre_roll, advanced=look_up, memory=memory,
        chunk=CHUNK,
    )  # fmt: skip
    sizes = {"joints": scene.character.skeleton.joint_count, "proxies": scene.rig.proxy_count}
    outgoing.write(LiveMessage("ready", {**sizes, "shapes": garment.deformer.shape_count}).to_bytes())
    outgoing.flush()
    while (asked := inbox.take()) is not None:
        motion = asked.motion()
        if motion.rotations.shape[1] != sizes["joints"]:
            found = f"a motion of {motion.rotations.shape[1]} joints"
            fail("standard input", found, f"the model's character has {sizes['joints']}")
        memory.begin()
        try:
            _answer(asked.numbers["number"], motion, roller, send)
        except _OvertakenError:
            continue


def _answer(number: int, motion: Motion, roller: LatentRoller, send: Callable[[LiveMessage], None]) -> None:
    """Send the frames of a motion as they are solved, then that it is done."""
    lost: list[int] = []
    roller.tally = LatentTally()
    for pose in garment_poses(roller.model, motion, motion.fps, on_recovery=lost.extend, roller=roller):
        send(LiveMessage.of_pose(number, pose, lost))
        lost.clear()
    tally = roller.tally
    counts = {"frames": tally.frames, "unconverged": tally.unconverged, "failed": tally.failed}
    send(LiveMessage("done", {"number": number, **counts}))
