# SPDX-License-Identifier: Apache-2.0
"""Pictures and films as files: PNG by Pillow, H.264 in MP4 by the ffmpeg that `imageio-ffmpeg` brings."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np

from ...errors import fail
from ...files import replacing
from .render import Image

FILM, PICTURE = ".mp4", ".png"
QUALITY = "20"  # constant rate factor of x264: hard to tell from the original

RETRY = "free some space or choose another output"


def check_suffix(path: str | Path, allowed: tuple[str, ...] = (FILM, PICTURE)) -> str:
    """Return the lower-case suffix of an output; raise `SsilkError` unless it is one of `allowed`."""
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        fail(str(path), f"suffix '{suffix}'", f"pictures are written as {' or '.join(allowed)}")
    return suffix


def write_image(path: str | Path, image: Image) -> None:
    """Write a picture (H, W, 3) as PNG; raise `SsilkError` for another suffix or an unwritable file."""
    check_suffix(path, (PICTURE,))
    from PIL import Image as Pictures

    with replacing(path) as temporary:
        Pictures.fromarray(image).save(temporary, optimize=True)


def write_film(path: str | Path, images: Iterable[Image], fps: float) -> int:
    """Write pictures of one size (H, W, 3) as H.264 film (yuv420p) and return how many; odd sizes gain a row.

    The file appears only when the last picture is in it.

    Raises:
        SsilkError: another suffix, no picture, pictures of different sizes, or ffmpeg failed.
    """
    check_suffix(path, (FILM,))
    stream = iter(images)
    first = next(stream, None)
    if first is None:
        fail(str(path), "no picture to write", "a film needs at least one")
    count, shape = 0, _even(first).shape
    with replacing(path) as temporary, _ffmpeg(path, temporary, shape, fps) as pipe:
        for image in chain([first], stream):
            even = _even(image)
            if even.shape != shape:
                fail(str(path), f"picture {count} has the shape {even.shape}", f"all need {shape}")
            pipe.write(even.tobytes())
            count += 1
    return count


def _even(image: Image) -> Image:
    """Repeat the last row and column where needed: yuv420p halves both sides."""
    height, width, _ = image.shape
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


@contextmanager
def _ffmpeg(path: str | Path, temporary: Path, shape: tuple[int, ...], fps: float) -> Iterator[IO[bytes]]:
    """Yield a pipe for raw RGB frames; on the way out wait for ffmpeg, or kill it if the block failed."""
    command = [*_program(), *_options(shape, fps), str(temporary)]
    with tempfile.TemporaryFile() as words:
        # A session of its own keeps Ctrl-C from ffmpeg, which would finish a short film as if it were whole.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=words, start_new_session=True)
        assert process.stdin is not None
        try:
            yield process.stdin
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg has gone: its exit code and its words, below, say why
        except BaseException:
            process.kill()
            raise
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()
            code = process.wait()
        if code != 0:
            fail(
                str(path), f"ffmpeg failed with code {code} ({_last_line(words)})", "the film was not written", RETRY
            )


def _last_line(words: IO[bytes]) -> str:
    words.seek(0)
    return words.read().decode(errors="replace").strip().rpartition("\n")[2] or "it said nothing"


def _program() -> list[str]:
    import imageio_ffmpeg

    return [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]


def _options(shape: tuple[int, ...], fps: float) -> list[str]:
    height, width = shape[:2]
    rate = str(Fraction(fps).limit_denominator(1001))
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "-"]
    return [*source, "-an", "-c:v", "libx264", "-crf", QUALITY, "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
