# SPDX-License-Identifier: Apache-2.0
"""Sections about a shot: a verdict in words, its worst frames as pictures, and figures over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from html import escape

import numpy as np

from ...events import Countdown, Message, Reporter, silent
from ...physics.intersections.figures import LayerFigures
from ...physics.skin.figures import ShownSkin
from ...physics.world.sunk import SunkCloth
from ...quality.charts import ChartPanel, svg_chart
from ...scene.assets import Floats, Mesh
from ...scene.fabrics import Fabric
from ...scene.mesh.joined import joined
from ..view.camera import follow_cameras
from ..view.player import ShotPlayer
from ..view.props import FigureBox, ShotProps
from ..view.render import Image, render
from ..view.shots import shot_surfaces
from .layers import LayersMeter, layers_section
from .page import Section, figure, table
from .player import played
from .terms import BARE, SHARE, SHOWN, UNITS, TermsMeter, worst_frames
from .verdict import verdict

PICTURES, SKIN_PICTURES = 4, 2  # worst frames to show: of the energy, and of the skin that shows
APART = 0.5  # the least time between them [s]
WIDTH, HEIGHT = 300, 400  # of a picture [pixels]
LETTERS = "ABCDEFGH"
LOST = "All covered skin counts as shown in them, and all triangles (100 %) as intersecting others."


@dataclass(frozen=True, eq=False)
class ShotGarment:
    """A garment of a shot.

    Attributes:
        index: among the player's meshes.
        mesh: where it lies at rest.
        fabric: what it is made of.
        sewn: the mesh in the rest shape of its energies; where it lies by default.
        note: what there is to say of that, in a sentence, or nothing.
    """

    index: int
    mesh: Mesh
    fabric: Fabric
    sewn: Mesh | None = None
    note: str = ""


def shot_sections(
    player: ShotPlayer,
    garments: Sequence[ShotGarment],
    bodies: Mapping[int, Mesh],
    report: Reporter = silent,
    *,
    sunk: Mapping[int, SunkCloth] | None = None,
    skin: Mapping[int, ShownSkin] | None = None,
    props: ShotProps | None = None,
    over: Sequence[LayerFigures] = (),
) -> list[Section]:
    """Return the sections about a shot.

    Args:
        player: the shot.
        garments: those to measure.
        bodies: the meshes that garments collide with, at rest, by their index in the player.
        sunk: what bakes counted inside colliders, of garments that had any, likewise.
        skin: what they counted of skin, for limbs through the cloth, which points alone do not tell.
        props: these colliders.
        over: what bakes counted of garments over one another; counted here where there is none.
    """
    whole = joined(list(bodies.values()))
    meters = [TermsMeter(each.mesh, whole, each.fabric, player.fps, each.sewn) for each in garments]
    named = {each.index: (player.meshes[each.index].name, each.mesh) for each in garments}
    layers = LayersMeter({} if over else named, whole)
    told = Countdown(len(player.frame_times), report)
    for time in player.frame_times:
        points = player.points(time)
        body = np.concatenate([points[index] for index in bodies]) if bodies else None
        for each, meter in zip(garments, meters):
            meter.add(points[each.index], body, time)
        layers.add(points, time)
        told()
    first, *others = [
        part
        for each, meter in zip(garments, meters)
        for part in _sections(player, each, meter, (sunk or {}).get(each.index), (skin or {}).get(each.index), props)
    ]
    pairs = over or layers.figures("the shot")
    between = [layers_section(pairs)] if pairs else []
    return [first, Section("The shot", _playing(player, props, report), plays=True), *between, *others]


def _playing(player: ShotPlayer, props: ShotProps | None, report: Reporter) -> str:
    """Return HTML that plays a shot; what it tells is reported, and no progress, which the measuring has told."""
    return played([player], (), lambda event: report(event) if isinstance(event, Message) else None, [props])


def _sections(
    player: ShotPlayer,
    garment: ShotGarment,
    meter: TermsMeter,
    sunk: SunkCloth | None,
    skin: ShownSkin | None,
    props: ShotProps | None,
) -> list[Section]:
    values = {name: np.array(found) for name, found in meter.values.items()}
    bad = values["total"] - values["gravity"]  # a raised garment is no worse
    apart = max(1, round(APART * player.fps))
    worst = worst_frames(bad, PICTURES, apart)
    worst += [
        frame
        for frame in worst_frames(np.where(meter.finite, values[SHOWN], np.nan), SKIN_PICTURES, apart)
        if values[SHOWN][frame] > 0 and frame not in worst
    ]
    times, marks = np.arange(len(values["total"])) / player.fps, dict(zip(worst, LETTERS))
    shown = [name for name in UNITS if meter.body or name not in ("collision", SHARE)]
    if meter.energy.stitching is None:
        shown.remove("stitch")
    if meter.covered is None:
        shown = [name for name in shown if name not in (SHOWN, BARE)]
    panels = [
        ChartPanel(
            title=name, x="time [s]", y=UNITS[name], curves={"": (times, values[name])},
            marks={letter: (times[frame], values[name][frame]) for frame, letter in marks.items()},
        )
        for name in shown
    ]  # fmt: skip
    charts = svg_chart(f"{', '.join(shown)} over time", [[panel] for panel in panels])
    rows = [[f"{name} [{UNITS[name]}]", *_spread(values[name])] for name in shown]
    name = player.meshes[garment.index].name

    def shown_skin(frame: int) -> str:
        share, bare = values[SHOWN][frame], values[BARE][frame]
        return f", {share:.2f} % of the covered skin shows, {bare:.1f} % is bare" if SHOWN in shown else ""

    pictures = "".join(
        figure(
            picture(player, frame, props),
            f"{letter}: frame {player.frame_times[frame]:g}, at {times[frame]:.2f} s, "
            f"{bad[frame]:.4g} J without gravity{shown_skin(frame)}",
            times[frame],
        )
        for frame, letter in marks.items()
    )
    found = meter.shown_skin(name)
    if found and skin:
        found = replace(found, pierced=skin.pierced, limbs=skin.limbs)
    charts += table(("", "mean", "median", "95 %", "most"), rows)
    charts += f'<p class="note">{escape(garment.note)}</p>' if garment.note else ""
    lost = [time for time, finite in zip(player.frame_times, meter.finite) if not finite]
    if lost:
        said = f"The garment is not finite in {len(lost)} of {len(times)} frames, first in frame {lost[0]:g}."
        charts += f'<p class="note">{said} Energies leave these frames out. {LOST}</p>'
    crossed = meter.intersections(name)
    figures = {**({"shown_skin": asdict(found)} if found else {}), "intersections": asdict(crossed)}
    figures |= {"sunk_cloth": asdict(sunk)} if sunk else {}
    return [
        verdict(name, values, found, crossed, player.frame_times, player.fps, sunk),
        Section(f"{name}: its worst frames", f'<div class="pictures">{pictures}</div>'),
        Section(f"{name}: over time", charts, {name: {**figures, "non-finite frames": len(lost)}}),
    ]


def _spread(values: Floats) -> list[str]:
    values = values[np.isfinite(values)]
    if not len(values):
        return ["–"] * 4
    return [f"{value:.4g}" for value in (values.mean(), np.median(values), np.quantile(values, 0.95), values.max())]


def picture(player: ShotPlayer, frame: int, props: ShotProps | None = None) -> Image:
    """Return a picture of one frame of a shot, framed to the figure, with the colliders that its cloth met."""
    surfaces = shot_surfaces(player, frame)
    points = np.concatenate([surface.points for surface in surfaces])
    (camera,) = follow_cameras([points], player.fps, WIDTH / HEIGHT)
    ground = float(points[:, 1].min())
    if props is not None:
        figure = FigureBox.of(points)
        floor = props.ground(ground, figure.size)
        ground = ground if floor is None else floor
        way = props.in_the_way([figure], [camera], [frame])
        surfaces += tuple(props.surfaces(frame, figure, camera, ground, way))
    return render(surfaces, camera, WIDTH, HEIGHT, ground=ground)
