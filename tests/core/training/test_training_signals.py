# SPDX-License-Identifier: Apache-2.0
"""Training is stopped: at once told of, between steps, or inside a long one."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from ssilk_core.events import Message
from ssilk_core.training.signals import stop_on_signals


def interrupted() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_is_told_of_at_once_and_acts_when_it_is_asked_for():
    heard, told = [], threading.Event()

    def report(event):
        heard.append(event)
        told.set()

    with stop_on_signals(report, patience=60) as stop:
        assert not stop.is_set()
        interrupted()
        assert stop.is_set() and told.wait(10)
        with pytest.raises(KeyboardInterrupt):
            interrupted()
            time.sleep(10)
    assert [type(event) for event in heard] == [Message] and "stopping" in heard[0].text


def test_a_step_that_takes_longer_is_interrupted_and_what_follows_a_stop_is_not():
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), stop_on_signals(lambda event: None, patience=0.2):
        interrupted()
        while time.monotonic() - began < 60:  # a step, in which Python runs now and then
            time.sleep(0.01)
    with stop_on_signals(lambda event: None, patience=0.2) as stop:
        interrupted()
        stop.obeyed()
        time.sleep(0.5)


def test_handlers_are_those_of_before_afterwards():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with stop_on_signals(lambda event: None) as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.is_set()
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
