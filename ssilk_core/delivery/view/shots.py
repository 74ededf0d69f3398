# SPDX-License-Identifier: Apache-2.0
"""Films and contact sheets of shots, alone or side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import fail
from ...events import Countdown, Reporter, silent
from ...scene.assets import Floats
from .camera import Camera, follow_cameras
from .colours import BODY, METAL, fabric_colour
from .ordered_map import ordered_map
from .output import FILM, PICTURE, check_suffix, write_film, write_image
from .panels import add_captions, compare, contact_sheet
from .player import PlayerMesh, ShotPlayer
from .props import FigureBox, ShotProps
from .render import Image, render
from .surface import Surface


@dataclass(frozen=True)
class Look:
    """How shots are shown.

    Attributes:
        width, height: of one panel [pixels].
        azimuth: where the camera stands, turned from +z towards +x [degrees].
        ground: height of the floor [m]; None puts it at a level floor among the props, or where the skin is lowest
            in the median frame.
        samples: rays for each pixel on an edge, 1 or 4.
        workers: threads that draw; the pictures do not depend on it.
    """

    width: int = 480
    height: int = 640
    azimuth: float = 35.0
    ground: float | None = None
    samples: int = 4
    workers: int = 2

    def __post_init__(self) -> None:
        size = f"{self.width} x {self.height} pixels"
        if not all(16 <= side <= 8192 for side in (self.width, self.height)):
            fail("view", size, "16 to 8192 each are drawn")
        if not np.isfinite(self.azimuth):
            fail("view", f"azimuth = {self.azimuth}", "it must be finite")
        if not self.workers > 0:
            fail("view", f"workers = {self.workers}", "at least 1 is needed")


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture to be drawn."""

    surfaces: tuple[Surface, ...]
    camera: Camera
    ground: float
    top: str
    bottom: str


def film_of_shots(
    path: str | Path,
    players: Sequence[ShotPlayer],
    *,
    labels: Sequence[str] = (),
    fps: float = 30.0,
    look: Look | None = None,
    props: Sequence[ShotProps | None] = (),
    report: Reporter = silent,
) -> int:
    """Write an MP4 film of shots side by side, seen by one camera, and return its number of frames.

    Args:
        path: output, .mp4.
        players: one shot or several of the same length and rate.
        labels: a word for each shot, drawn on its panel.
        fps: at most so many frames per second; frames of faster shots are skipped evenly.
        look: size, view and effort.
        props: of each shot, where its cloth met any.
        report: takes a `Progress` for each panel.

    Raises:
        SsilkError: another suffix, shots that do not match, nothing to draw, or a file that cannot be written.
    """
    check_suffix(path, (FILM,))
    if not 0 < fps < np.inf:
        fail("view", f"fps = {fps:g}", "a positive rate is needed")
    look = look or Look()
    step = int(np.ceil(players[0].fps / fps - 1e-6)) if players else 1
    frames = range(0, need_matching(players), step)
    images = _drawn(_panels(players, frames, labels, look, props), look, len(frames) * len(players), report)
    return write_film(path, map(compare, zip(*[images] * len(players))), players[0].fps / step)


def sheet_of_shots(
    path: str | Path,
    players: Sequence[ShotPlayer],
    *,
    labels: Sequence[str] = (),
    columns: int = 6,
    rows: int = 1,
    frames: Sequence[int] | None = None,
    look: Look | None = None,
    props: Sequence[ShotProps | None] = (),
    report: Reporter = silent,
) -> int:
    """Write a PNG with up to `columns` x `rows` moments spread over the shots and return how many it shows.

    `frames` are shown in one row instead, where they are given. Each row of moments is one row of panels for each
    shot, so that two shots stand above each other. The other arguments and the errors are those of `film_of_shots`,
    with .png for .mp4.
    """
    check_suffix(path, (PICTURE,))
    if not (columns > 0 and rows > 0):
        fail("contact sheet", f"{columns} columns and {rows} rows", "both are at least 1")
    look = look or Look(width=320, height=440)
    count = need_matching(players)
    if frames is None:
        frames = np.linspace(0, count - 1, min(columns * rows, count)).round().astype(int).tolist()
    else:
        columns = len(frames)
        if not frames or not all(0 <= frame < count for frame in frames):
            fail("contact sheet", f"frames {list(frames)}", f"one or more of 0 to {count - 1} are shown")
    panels = _panels(players, frames, labels, look, props, label_every=columns)
    images = list(_drawn(panels, look, len(frames) * len(players), report))
    strips = []
    for start in range(0, len(frames), columns):
        for shot in range(len(players)):
            strip = images[shot :: len(players)][start : start + columns]
            strips.append(contact_sheet(strip, columns=min(columns, len(frames))))
    write_image(path, contact_sheet(strips, columns=1))
    return len(frames)


def need_matching(players: Sequence[ShotPlayer]) -> int:
    """Return the number of frames of shots that match; raise `SsilkError` when they do not."""
    if not players:
        fail("view", "no shot", "at least one is needed")
    first = players[0]
    count = len(first.frame_times)
    if not count:
        fail("view", "the shot has no frames", "at least one is needed")
    for other in players[1:]:
        if not (len(other.frame_times) == count and abs(other.fps - first.fps) < 1e-6 * first.fps):
            fail(
                "view",
                f"{count} frames at {first.fps:g} fps beside {len(other.frame_times)} at {other.fps:g}",
                "shots shown together have the same length and rate",
                "bake them from the same motion",
            )
    return count


def _panels(
    players: Sequence[ShotPlayer],
    frames: Sequence[int],
    labels: Sequence[str],
    look: Look,
    props: Sequence[ShotProps | None],
    label_every: int = 1,
) -> Iterator[Picture]:
    """Yield the panels of each frame in turn, one for each player."""
    cameras, ground, figures = _survey(players, look, props)
    all_frames = range(len(cameras))
    ways = [met.in_the_way(own, cameras, all_frames) if met else {} for met, own in zip(props, figures)]
    for number, frame in enumerate(frames):
        for shot, player in enumerate(players):
            label = labels[shot] if shot < len(labels) and number % label_every == 0 else ""
            surfaces, met = shot_surfaces(player, frame), props[shot] if shot < len(props) else None
            if met:
                surfaces += tuple(met.surfaces(frame, figures[shot][frame], cameras[frame], ground, ways[shot]))
            yield Picture(surfaces, cameras[frame], ground, label, f"{frame / player.fps:.2f} s")


def _survey(
    players: Sequence[ShotPlayer], look: Look, props: Sequence[ShotProps | None]
) -> tuple[list[Camera], float, list[list[FigureBox]]]:
    """Return one camera for each frame, the same whichever frames are drawn, the height of the floor, and the boxes
    around the figure of each shot."""
    lows: list[float] = []
    sizes: list[float] = []
    figures: list[list[FigureBox]] = [[] for _ in players]

    def frames() -> Iterator[Floats]:
        for frame in range(len(players[0].frame_times)):
            shown = [shot_surfaces(player, frame) for player in players]
            for own, boxes in zip(shown, figures):
                boxes.append(FigureBox.of(np.concatenate([surface.points for surface in own])))
            surfaces = [surface for own in shown for surface in own]
            skins = [surface for surface in surfaces if not surface.two_sided] or surfaces
            lows.append(min(surface.points[:, 1].min() for surface in skins))
            every = np.concatenate([surface.points for surface in surfaces])
            sizes.append(float(np.ptp(every, axis=0).max()))
            yield every

    cameras = follow_cameras(frames(), players[0].fps, look.width / look.height, azimuth=look.azimuth)
    if look.ground is not None:
        return cameras, look.ground, figures
    lowest, size = float(np.median(lows)), float(np.median(sizes))
    floors = (met.ground(lowest, size) for met in props if met)
    return cameras, next((floor for floor in floors if floor is not None), lowest), figures


def shot_surfaces(player: ShotPlayer, frame: int) -> tuple[Surface, ...]:
    """Return the meshes of a shot at one frame: skin in grey, each garment in a colour of its own."""
    points = player.points(player.frame_times[frame])
    return tuple(
        Surface(mesh.name, at, mesh.faces, colour, two_sided=mesh.is_garment)
        for mesh, at, colour in zip(player.meshes, points, mesh_colours(player))
    )


def mesh_colours(player: ShotPlayer) -> list[Floats]:
    """Return a colour in sRGB, shape (3,), for each mesh: skin in grey, all else its own or a plain one."""
    garments = np.cumsum([mesh.is_garment for mesh in player.meshes]) - 1

    def colour(mesh: PlayerMesh, number: int) -> Floats:
        if mesh.is_rider:
            return METAL if mesh.colour is None else np.array(mesh.colour)
        if not mesh.is_garment:
            return BODY
        return fabric_colour(number) if mesh.colour is None else np.array(mesh.colour)

    return [colour(mesh, number) for mesh, number in zip(player.meshes, garments)]


def _drawn(panels: Iterator[Picture], look: Look, total: int, report: Reporter) -> Iterator[Image]:
    """Yield the panels as pictures, in order, and report each."""

    def draw(panel: Picture) -> Image:
        image = render(
            panel.surfaces, panel.camera, look.width, look.height, samples=look.samples, ground=panel.ground
        )
        return add_captions(image, top=panel.top, bottom=panel.bottom)

    told = Countdown(total, report, at_once=look.workers)
    for image in ordered_map(draw, panels, look.workers):
        told()
        yield image
