# SPDX-License-Identifier: Apache-2.0
"""What a program and 'ssilk live' say to each other through standard input and output, and in which bytes.

A message is a head of 16 bytes, words and data; all numbers are little-endian:

    4 bytes   b"SLK1"
    4 bytes   length of the words, at most `MOST_WORDS`
    8 bytes   length of the data, at most `MOST_DATA`
    words     JSON in UTF-8: "kind", the numbers of that kind, and "arrays", their shapes by name
    data      the arrays one after the other, C order, in the order and type that `ARRAYS` says

    kind     from      numbers and arrays
    ready    ssilk     joints, proxies, shapes: of the model, once it can be solved
    motion   program   number, fps, start; rotations (F, J, 4), translations (F, J, 3) and, where it is not the usual
                       one, gravity (F, 3), as `Motion` has them
    solved   ssilk     number, start, lost; rotations (F, P, 4), weights (F, K) and, where the model has them,
                       translations (F, P, 3) as `GarmentPose` has them, from frame `start` on
    done     ssilk     number, frames, unconverged, failed: counts, at the model's rate

A program sends a motion whenever it changes, as a whole, in place of the one before: `number` tells them apart.
Numbers are float32 in motions, as in files of motions, so that a bake sees the same ones. Frames come in order, and
those that a change did not reach come again at once. The end of standard input ends 'ssilk live'.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import GarmentPose, Motion

MAGIC = b"SLK1"
HEAD = struct.Struct("<4sIQ")
MOST_WORDS, MOST_DATA = 1 << 20, 1 << 32  # [bytes]
ARRAYS: dict[str, dict[str, str]] = {
    "ready": {},
    "motion": {"rotations": "<f4", "translations": "<f4", "gravity": "<f4"},
    "solved": {"rotations": "<f8", "weights": "<f4", "translations": "<f8"},
    "done": {},
}
NUMBERS: dict[str, dict[str, type]] = {
    "ready": {"joints": int, "proxies": int, "shapes": int},
    "motion": {"number": int, "fps": float, "start": float},
    "solved": {"number": int, "start": int, "lost": list},
    "done": {"number": int, "frames": int, "unconverged": int, "failed": int},
}
MAY_LACK = {"motion": ("gravity",), "solved": ("translations",)}


@dataclass(frozen=True, eq=False)
class LiveMessage:
    """One message.

    Attributes:
        kind: a name in `ARRAYS`.
        numbers: as `NUMBERS` has them; "lost" lists the frames, counted from the motion's first, that were put to
            rest.
        arrays: by name.
    """

    kind: str
    numbers: Mapping[str, Any]
    arrays: Mapping[str, NDArray] = field(default_factory=dict)

    @classmethod
    def of_motion(cls, number: int, motion: Motion) -> LiveMessage:
        """Return the message that a motion is to be followed."""
        own = {"rotations": motion.rotations, "translations": motion.translations}
        if motion.gravity is not None:
            own["gravity"] = motion.gravity
        return cls("motion", {"number": number, "fps": motion.fps, "start": motion.start}, own)

    @classmethod
    def of_pose(cls, number: int, pose: GarmentPose, lost: list[int]) -> LiveMessage:
        """Return the message that frames are solved."""
        own = {"rotations": pose.rotations, "weights": pose.weights}
        moved = {} if pose.translations is None else {"translations": pose.translations}
        return cls("solved", {"number": number, "start": pose.start, "lost": lost}, {**own, **moved})

    def motion(self) -> Motion:
        """Return the motion of a message; raise `SsilkError` where it makes no sense."""
        rotations, translations = self.arrays["rotations"], self.arrays["translations"]
        fps, start, gravity = self.numbers["fps"], self.numbers["start"], self.arrays.get("gravity")
        return Motion("the motion", fps, rotations, translations, start, gravity)

    def pose(self) -> GarmentPose:
        """Return the solved frames of a message."""
        arrays = self.arrays
        return GarmentPose(
            self.numbers["start"], arrays["rotations"], arrays["weights"], arrays.get("translations")
        )  # fmt: skip

    def to_bytes(self) -> bytes:
        """Return the message as it is sent."""
        kinds = ARRAYS[self.kind]
        own = {name: np.ascontiguousarray(array, kinds[name]) for name, array in self.arrays.items()}
        ordered = [(name, own[name]) for name in kinds if name in own]
        words = {"kind": self.kind, **self.numbers, "arrays": {name: array.shape for name, array in ordered}}
        text = json.dumps(words, allow_nan=False).encode()
        data = b"".join(array.tobytes() for _, array in ordered)
        return HEAD.pack(MAGIC, len(text), len(data)) + text + data


def read_message(stream: BinaryIO) -> LiveMessage | None:
    """Return the next message; None where the stream ends, also within a message.

    Raises:
        ValueError: what came is no such message.
    """
    head = _taken(stream, HEAD.size)
    if head is None:
        return None
    magic, words, size = HEAD.unpack(head)
    if magic != MAGIC:
        raise ValueError(f"it begins with {magic!r}, and not with {MAGIC!r}")
    if words > MOST_WORDS or size > MOST_DATA:
        raise ValueError(f"it says that it has {words} bytes of words and {size} of data, which is too much")
    text, data = _taken(stream, words), _taken(stream, size)
    return None if text is None or data is None else _parsed(text, data)


def _taken(stream: BinaryIO, count: int) -> bytes | None:
    """Return so many bytes; None where the stream ends before."""
    found = bytearray()
    while len(found) < count:
        part = stream.read(min(count - len(found), 1 << 20))
        if not part:
            return None
        found += part
    return bytes(found)


def _parsed(text: bytes, data: bytes) -> LiveMessage:
    try:
        words = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError("its words are no JSON") from error
    kind = words.get("kind") if isinstance(words, dict) else None
    if not isinstance(kind, str) or kind not in ARRAYS:
        raise ValueError(f"its kind is {str(kind)[:40]}; there are {', '.join(ARRAYS)}")
    numbers = {name: _number(kind, name, type_, words.get(name)) for name, type_ in NUMBERS[kind].items()}
    shapes = words.get("arrays")
    if not isinstance(shapes, dict):
        raise ValueError(f"'{kind}' has no shapes of its arrays")
    arrays, at = {}, 0
    for name, dtype in ARRAYS[kind].items():
        if name not in shapes and name in MAY_LACK.get(kind, ()):
            continue
        shape = shapes.get(name)
        if not isinstance(shape, list) or any(type(each) is not int or each < 0 for each in shape):
            raise ValueError(f"'{kind}' has no valid shape of '{name}'")
        count = math.prod(shape)
        stop = at + count * np.dtype(dtype).itemsize
        if stop > len(data):
            raise ValueError(f"'{kind}' has {len(data)} bytes of data, too few for '{name}' of shape {tuple(shape)}")
        arrays[name] = np.frombuffer(data, dtype, count, at).reshape(shape)
        at = stop
    if at != len(data):
        raise ValueError(f"'{kind}' has {len(data)} bytes of data, and its arrays take {at}")
    return LiveMessage(kind, numbers, arrays)


def _number(kind: str, name: str, wanted: type, value: object) -> Any:
    if wanted is float and type(value) is int:
        value = float(value)
    fits = type(value) is wanted and (wanted is not float or math.isfinite(value))  # type: ignore[arg-type]
    if not fits or (wanted is list and any(type(each) is not int for each in value)):  # type: ignore[attr-defined]
        raise ValueError(f"'{name}' of '{kind}' is {str(value)[:40]}, and not of the type {wanted.__name__}")
    return value
