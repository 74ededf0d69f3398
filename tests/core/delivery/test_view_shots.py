# SPDX-License-Identifier: Apache-2.0
"""Films and sheets of shots, with a shot made in code: a ball that drifts under a flapping sheet."""

from __future__ import annotations

from dataclasses import dataclass, field

import imageio_ffmpeg
import numpy as np
import pytest
import trimesh
from PIL import Image

from ssilk_core.delivery.view.colours import BODY, fabric_colour
from ssilk_core.delivery.view.panels import GAP
from ssilk_core.delivery.view.shots import Look, film_of_shots, mesh_colours, sheet_of_shots, shot_surfaces
from ssilk_core.errors import SsilkError
from ssilk_core.events import Progress

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
SMALL = Look(width=60, height=80)
FLOOR = -0.25  # where the ball rests [m]


@dataclass(frozen=True)
class ToyMesh:
    name: str
    faces: np.ndarray
    is_garment: bool
    colour: tuple[float, float, float] | None = None
    is_rider: bool = False


@dataclass(frozen=True)
class ToyShot:
    frames: int = 8
    fps: float = 60.0
    interrupt_at: float = np.inf
    meshes: tuple[ToyMesh, ...] = (
        ToyMesh("ball", BALL.faces, False),
        ToyMesh("sheet", np.array([[0, 1, 2], [0, 2, 3]]), True),
    )
    asked: list[float] = field(default_factory=list)

    @property
    def frame_times(self) -> list[float]:
        return [100.0 + frame for frame in range(self.frames)]

    def points(self, time: float) -> list[np.ndarray]:
        self.asked.append(time)
        if len(self.asked) > self.interrupt_at:
            raise KeyboardInterrupt
        drift = np.array([0.02 * (time - 100), 0, 0])
        sheet = np.array([[-1, 1.2, -1], [-1, 1.2, 1], [1, 1.2, 1], [1, 1.2, -1]]) + drift
        sheet[:2, 1] += 0.2 * np.sin(time)
        return [BALL.vertices + [0, 0.5 + FLOOR, 0] + drift, sheet]


def test_garments_have_the_colour_that_is_theirs():
    sheet = np.array([[0, 1, 2], [0, 2, 3]])
    own = ToyMesh("dyed", sheet, True, (0.1, 0.6, 0.2))
    shot = ToyShot(meshes=(ToyMesh("skin", BALL.faces, False, (1.0, 0.0, 0.0)), own, ToyMesh("sheet", sheet, True)))
    np.testing.assert_allclose(mesh_colours(shot), [BODY, own.colour, fabric_colour(1)])


def frame_count(path) -> int:
    return imageio_ffmpeg.count_frames_and_secs(str(path))[0]


def test_a_film_of_two_shots(tmp_path):
    events: list[Progress] = []
    path = tmp_path / "film.mp4"
    written = film_of_shots(
        path, [ToyShot(), ToyShot()], labels=["linear blend skinning", "ssilk"], look=SMALL, report=events.append
    )
    assert written == frame_count(path) == 4  # 8 frames at 60 fps, shown at 30
    meta = next(imageio_ffmpeg.read_frames(str(path)))
    assert meta["size"] == (60 + GAP + 60, 80) and meta["fps"] == 30
    assert [event.done for event in events] == list(range(1, 9)) and {event.total for event in events} == {8}
    assert events[0].seconds_left is None and events[-1].seconds_left == 0


@pytest.mark.parametrize(("fps", "expected"), [(60.0, 8), (24.0, 3), (1.0, 1)])
def test_fast_shots_lose_frames_evenly(tmp_path, fps, expected):
    assert film_of_shots(tmp_path / "film.mp4", [ToyShot()], fps=fps, look=SMALL) == expected
    assert frame_count(tmp_path / "film.mp4") == expected


def test_a_sheet_of_two_shots(tmp_path):
    shown = sheet_of_shots(tmp_path / "sheet.png", [ToyShot(), ToyShot()], columns=3, rows=2, look=SMALL)
    assert shown == 6
    size = Image.open(tmp_path / "sheet.png").size
    assert size == (3 * 60 + 2 * GAP, 4 * 80 + 3 * GAP)


def test_a_sheet_of_chosen_frames(tmp_path):
    """In one row, each as in a sheet of all frames, and cut from the same camera."""
    whole, chosen = tmp_path / "whole.png", tmp_path / "chosen.png"
    sheet_of_shots(whole, [ToyShot()], columns=8, look=SMALL)
    assert sheet_of_shots(chosen, [ToyShot()], frames=[5, 2], look=SMALL) == 2
    panels = [np.asarray(Image.open(path)) for path in (whole, chosen)]
    for place, frame in enumerate((5, 2)):
        found, expected = (
            part[:, at * (60 + GAP) : at * (60 + GAP) + 60] for part, at in ((panels[1], place), (panels[0], frame))
        )
        np.testing.assert_array_equal(found, expected)
    for frames in ([], [8], [-1]):
        with pytest.raises(SsilkError, match="one or more of 0 to 7 are shown"):
            sheet_of_shots(chosen, [ToyShot()], frames=frames, look=SMALL)


def test_a_short_shot_gives_a_short_sheet(tmp_path):
    assert sheet_of_shots(tmp_path / "sheet.png", [ToyShot(frames=1)], look=SMALL) == 1
    assert Image.open(tmp_path / "sheet.png").size == (60, 80)


def test_threads_do_not_change_the_picture(tmp_path):
    for workers in (1, 3):
        look = Look(width=60, height=80, workers=workers)
        sheet_of_shots(tmp_path / f"{workers}.png", [ToyShot()], columns=4, look=look)
    assert (tmp_path / "1.png").read_bytes() == (tmp_path / "3.png").read_bytes()


def test_the_floor_lies_under_the_feet(tmp_path):
    for name, ground in (("found", None), ("given", FLOOR), ("deep", FLOOR - 0.5)):
        sheet_of_shots(tmp_path / f"{name}.png", [ToyShot()], columns=2, look=Look(60, 80, ground=ground))
    found, given, deep = (
        np.asarray(Image.open(tmp_path / f"{n}.png")).astype(int) for n in ("found", "given", "deep")
    )
    assert np.abs(found - given).max() <= 2 < np.abs(found - deep).max()


def test_garments_are_cloth_and_stand_out():
    skin, cloth = shot_surfaces(ToyShot(), 0)
    assert not skin.two_sided and cloth.two_sided
    assert np.ptp(skin.colour) < 0.1 < np.ptp(cloth.colour)


# The shot is posed eight times to place the cameras, then while frames are drawn.
@pytest.mark.parametrize("interrupt_at", [3, 12])
def test_an_interrupted_film_leaves_nothing(tmp_path, interrupt_at):
    with pytest.raises(KeyboardInterrupt):
        film_of_shots(tmp_path / "film.mp4", [ToyShot(interrupt_at=interrupt_at)], fps=60.0, look=SMALL)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("players", "message"),
    [
        ([], "no shot"),
        ([ToyShot(frames=0)], "no frames"),
        ([ToyShot(), ToyShot(frames=5)], "8 frames at 60 fps beside 5 at 60"),
        ([ToyShot(), ToyShot(fps=30.0)], "8 frames at 60 fps beside 8 at 30"),
    ],
)
def test_shots_that_cannot_be_shown(tmp_path, players, message):
    for write, name in ((film_of_shots, "film.mp4"), (sheet_of_shots, "sheet.png")):
        with pytest.raises(SsilkError, match=message):
            write(tmp_path / name, players, look=SMALL)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("write", "name"), [(film_of_shots, "film.gif"), (sheet_of_shots, "sheet.mp4")])
def test_a_wrong_suffix_fails_before_any_work(tmp_path, write, name):
    shot = ToyShot()
    with pytest.raises(SsilkError, match=f"{name}: suffix"):
        write(tmp_path / name, [shot], look=SMALL)
    assert shot.asked == []


@pytest.mark.parametrize("grid", [{"columns": 0}, {"rows": 0}])
def test_a_sheet_needs_a_grid(tmp_path, grid):
    with pytest.raises(SsilkError, match="at least 1"):
        sheet_of_shots(tmp_path / "sheet.png", [ToyShot()], look=SMALL, **grid)
