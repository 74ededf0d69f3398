# SPDX-License-Identifier: Apache-2.0
"""Pictures and films as files: decoded again, refused, interrupted, failing."""

from __future__ import annotations

import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from ssilk_core.cli.view import captions
from ssilk_core.delivery.view import output
from ssilk_core.delivery.view.output import write_film, write_image
from ssilk_core.delivery.view.panels import GAP, add_captions, compare, contact_sheet
from ssilk_core.errors import SsilkError


def pictures(count: int, shape=(48, 64, 3)):
    """Plain pictures that brighten from one to the next."""
    return (np.full(shape, 40 + 10 * k, dtype=np.uint8) for k in range(count))


def decoded(path):
    """Return meta data and frames of a film."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def test_a_film_holds_its_pictures(tmp_path):
    path = tmp_path / "film.mp4"
    assert write_film(path, pictures(9), 24.0) == 9
    meta, frames = decoded(path)
    assert meta["codec"] == "h264" and meta["pix_fmt"].startswith("yuv420p")
    assert meta["fps"] == 24 and meta["size"] == (64, 48)
    assert len(frames) == 9
    for k, frame in enumerate(frames):
        assert abs(frame.mean() - (40 + 10 * k)) < 4


def test_odd_sizes_are_made_even(tmp_path):
    write_film(tmp_path / "film.mp4", pictures(2, (47, 63, 3)), 30000 / 1001)
    meta, _ = decoded(tmp_path / "film.mp4")
    assert meta["size"] == (64, 48) and meta["fps"] == 29.97


def test_a_picture_comes_back(tmp_path):
    image = np.random.default_rng(2).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    write_image(tmp_path / "sheet.png", image)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "sheet.png")), image)


@pytest.mark.parametrize("name", ["film.avi", "film.png", "film"])
def test_films_are_mp4(tmp_path, name):
    with pytest.raises(SsilkError, match=rf"{name}: suffix '.*'; .*\.mp4"):
        write_film(tmp_path / name, pictures(1), 30.0)


@pytest.mark.parametrize("name", ["sheet.jpg", "sheet.mp4"])
def test_pictures_are_png(tmp_path, name):
    with pytest.raises(SsilkError, match=rf"{name}: suffix '.*'; .*\.png"):
        write_image(tmp_path / name, next(pictures(1)))


def interrupted():
    yield from pictures(3)
    raise KeyboardInterrupt


def test_an_interrupted_film_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "film.mp4", interrupted(), 30.0)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_film_leaves_the_old_one(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_film(path, interrupted(), 30.0)
    assert [item.read_bytes() for item in tmp_path.iterdir()] == [b"old"]


@pytest.mark.parametrize("count", [1, 400], ids=["short", "longer than the pipe"])
def test_a_failing_ffmpeg_is_one_sentence(tmp_path, monkeypatch, count):
    program = [sys.executable, "-c", "raise SystemExit('muxer: No space left on device')"]
    monkeypatch.setattr(output, "_program", lambda: program)
    with pytest.raises(
        SsilkError, match=r"film.mp4: ffmpeg failed with code 1 \(muxer: No space left on device\); .*\.$"
    ):
        write_film(tmp_path / "film.mp4", pictures(count), 30.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("images", "message"),
    [([], "no picture to write"), ([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 6, 3), np.uint8)], "picture 1 has")],
)
def test_films_need_pictures_of_one_size(tmp_path, images, message):
    with pytest.raises(SsilkError, match=message):
        write_film(tmp_path / "film.mp4", images, 30.0)
    assert list(tmp_path.iterdir()) == []


def test_a_contact_sheet_puts_its_images_in_rows():
    sheet = contact_sheet(list(pictures(5, (10, 20, 3))), columns=3)
    assert sheet.shape == (2 * 10 + GAP, 3 * 20 + 2 * GAP, 3)
    assert (sheet[0, [0, 20 + GAP, 40 + 2 * GAP]] == [[40], [50], [60]]).all()
    assert (sheet[10 + GAP, [0, 20 + GAP]] == [[70], [80]]).all()
    assert (sheet[10 + GAP :, 40 + 2 * GAP :] == 255).all() and (sheet[10 : 10 + GAP] == 255).all()
    assert compare(list(pictures(2, (10, 20, 3)))).shape == (10, 40 + GAP, 3)


def test_captions_stand_in_their_corners():
    lbs = np.full((120, 160, 3), 200, dtype=np.uint8)
    changed = (add_captions(lbs, top="linear blend skinning") != lbs).any(axis=2)
    assert changed[:30].any() and not changed[40:].any()
    changed = (add_captions(lbs, bottom="1.25 s") != lbs).any(axis=2)
    assert changed[90:].any() and not changed[:80].any()
    assert (lbs == 200).all()


def test_shots_of_one_name_are_told_apart_by_their_folders():
    assert captions([Path("a/walk.usdc"), Path("b/run.usdc")]) == ["walk", "run"]
    assert captions([Path("shots/walk/shot.usda"), Path("shots/run/shot.usda")]) == ["walk/shot", "run/shot"]
    assert captions([Path("x/walk/cape/anim.usdc"), Path("x/run/cape/anim.usdc")])[1] == "run/cape/anim"
    assert captions([Path("walk.usdc"), Path("walk.usdc")]) == ["walk", "walk"]
