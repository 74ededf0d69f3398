# SPDX-License-Identifier: Apache-2.0
"""Messages of 'ssilk live': what is sent is what is read, and nothing else is taken for one."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from ssilk_core.delivery.live.messages import HEAD, MAGIC, MOST_DATA, MOST_WORDS, LiveMessage, read_message
from ssilk_core.scene.assets import GarmentPose, Motion


def motion(frames: int = 3, joints: int = 2) -> Motion:
    rng = np.random.default_rng(0)
    return Motion("m", 24.0, rng.normal(size=(frames, joints, 4)), rng.normal(size=(frames, joints, 3)), 5.0)


def sent(words: object, data: bytes = b"", *, magic: bytes = MAGIC) -> io.BytesIO:
    text = words if isinstance(words, bytes) else json.dumps(words).encode()
    return io.BytesIO(HEAD.pack(magic, len(text), len(data)) + text + data)


def test_a_motion_arrives_as_a_file_of_it_would_hold_it():
    own = motion()
    stream = io.BytesIO(2 * LiveMessage.of_motion(7, own).to_bytes())
    for _ in range(2):
        found = read_message(stream)
        assert found.kind == "motion" and found.numbers["number"] == 7
        read = found.motion()
        stored = Motion("m", 24.0, own.rotations.astype(np.float32), own.translations.astype(np.float32))
        np.testing.assert_array_equal(read.rotations, stored.rotations)
        np.testing.assert_array_equal(read.translations, stored.translations)
        assert (read.fps, read.start) == (24.0, 5.0)
    assert read_message(stream) is None


@pytest.mark.parametrize("moves", [True, False])
def test_poses_arrive_bit_by_bit(moves):
    rng = np.random.default_rng(1)
    moved = rng.normal(size=(2, 3, 3)) if moves else None
    own = GarmentPose(4, rng.normal(size=(2, 3, 4)), rng.random((2, 5)), moved)
    found = read_message(io.BytesIO(LiveMessage.of_pose(1, own, [4]).to_bytes()))
    read = found.pose()
    assert found.numbers == {"number": 1, "start": 4, "lost": [4]} and read.start == 4
    np.testing.assert_array_equal(read.rotations, own.rotations)
    np.testing.assert_array_equal(read.weights, own.weights)
    assert (read.translations is None) != moves
    if moves:
        np.testing.assert_array_equal(read.translations, own.translations)


def test_the_end_within_a_message_is_an_end():
    whole = LiveMessage.of_motion(0, motion()).to_bytes()
    for length in (0, 3, HEAD.size, HEAD.size + 10, len(whole) - 1):
        assert read_message(io.BytesIO(whole[:length])) is None


ARRAYS = {"rotations": [1, 1, 4], "translations": [1, 1, 3]}
MOTION = {"kind": "motion", "number": 0, "fps": 30.0, "start": 0, "arrays": ARRAYS}


@pytest.mark.parametrize(
    ("stream", "complaint"),
    [
        (sent(MOTION, bytes(28), magic=b"HTTP"), "begins with b'HTTP'"),
        (io.BytesIO(HEAD.pack(MAGIC, MOST_WORDS + 1, 0)), "too much"),
        (io.BytesIO(HEAD.pack(MAGIC, 2, MOST_DATA + 1)), "too much"),
        (sent(b"{"), "no JSON"),
        (sent(b"[" * 100_000), "no JSON"),
        (sent([]), "its kind is None"),
        (sent({"kind": ["motion"]}), r"its kind is \['motion'\]"),
        (sent({"kind": "pickle"}), "its kind is pickle"),
        (sent({**MOTION, "fps": "30"}, bytes(28)), "'fps' of 'motion' is 30"),
        (sent(b'{"kind": "motion", "number": 0, "fps": NaN}'), "'fps' of 'motion' is nan"),
        (sent({**MOTION, "number": True}, bytes(28)), "'number' of 'motion' is True"),
        (sent({**MOTION, "arrays": None}, bytes(28)), "no shapes"),
        (sent({**MOTION, "arrays": {"rotations": [1, 1, 4]}}, bytes(28)), "no valid shape of 'translations'"),
        (sent({**MOTION, "arrays": {**ARRAYS, "rotations": [-1, 1, 4]}}, bytes(28)), "no valid shape of 'rotations'"),
        (sent({**MOTION, "arrays": {**ARRAYS, "rotations": [1 << 62, 1, 4]}}, bytes(28)), "too few"),
        (sent(MOTION, bytes(24)), "too few for 'translations'"),
        (sent(MOTION, bytes(32)), "its arrays take 28"),
        (sent({"kind": "solved", "number": 0, "start": 0, "lost": ["x"]}), "'lost' of 'solved'"),
    ],
)  # fmt: skip
def test_what_is_no_message_is_told(stream, complaint):
    with pytest.raises(ValueError, match=complaint):
        read_message(stream)
