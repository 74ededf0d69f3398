# SPDX-License-Identifier: Apache-2.0
"""Sections of a page from what other commands write: learning curves, extremes, trades, evaluations, bodies."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...errors import SsilkError, fail
from ...network.checkpoint import ModelFile
from ...physics.intersections.figures import SelfIntersections
from ...physics.skin.figures import ShownSkin
from ...quality.charts import ChartPanel, svg_chart
from ...quality.kept_rows import GO_ON, UNFINISHED
from ...quality.stress.outcome import HEADER, CaseOutcome
from ...quality.trade.plot import trade_panels
from ...quality.trade.point import TradePoint
from ...scene.plain import from_plain
from ...training.step_errors import StepErrors
from .page import Section, facts, flattened, table, worded
from .terms import BARE, SHARE, SHOWN

NOT_MEASURED = "–"
MISSED = "energy that steps miss"

MAX_COLUMNS = 12  # of a table of records; a page is not wider


def read_json(path: Path) -> Any:
    """Read a JSON file; raise `SsilkError` where it is missing or not JSON."""
    if not path.is_file():
        fail(str(path), "there is no such file", "figures in JSON are needed")
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise SsilkError(f"{path}: not a JSON file ({error}); name a file that ssilk wrote.") from error


def section_of(path: Path) -> Section:
    """Return the section of a file of figures, chosen by what it holds.

    Raises:
        SsilkError: the file is not one of 'ssilk stress', 'ssilk trade' or 'ssilk evaluate'.
    """
    document = read_json(path)
    kinds = {"outcomes": extremes, "points": trade, "figures": evaluation}
    kind = next((key for key in kinds if isinstance(document, dict) and isinstance(document.get(key), list)), None)
    if not kind:
        fail(
            str(path),
            "not figures of a known kind",
            f"a document with {' or '.join(kinds)} is needed",
            "name a file that 'ssilk stress', 'ssilk trade' or 'ssilk evaluate' wrote",
        )
    return _made(path, kinds[str(kind)], document)


def learning_of(path: Path) -> list[Section]:
    """Return the section of the learning curve beside a model; none without a curve, or without validations.

    Raises:
        SsilkError: the file is not a learning curve.
    """
    document = read_json(path) if path.is_file() else {"points": []}
    return [_made(path, learning, document)] if document.get("points", True) else []


def _made(path: Path, make: Callable[[Mapping[str, Any]], Section], document: Mapping[str, Any]) -> Section:
    try:
        return make(document)
    except (KeyError, TypeError, ValueError) as error:
        raise SsilkError(f"{path}: these figures are incomplete ({error}); measure again.") from error


def extremes(document: Mapping[str, Any]) -> Section:
    """Return the table of 'ssilk stress'."""
    found = [from_plain(CaseOutcome, each, figures=True) for each in document["outcomes"]]
    bad = [number for number, outcome in enumerate(found) if outcome.verdict == "breaks"]
    rows = table(HEADER, [outcome.row() for outcome in found], bad)
    return _section("Extremes", rows + facts(document["inputs"]), document)


def trade(document: Mapping[str, Any]) -> Section:
    """Return the charts and the tables of 'ssilk trade'."""
    points = [TradePoint.of(each) for each in document["points"]]
    panels = trade_panels(points, document["asked"].get("frames", {}))
    chart = svg_chart("errors over costs", panels, size=(4.0, 3.4)) if points else ""
    judged = records(document.get("judging", ()))
    return _section("Trade", chart + records(document["points"]) + judged + facts(document["asked"]), document)


def evaluation(document: Mapping[str, Any]) -> Section:
    """Return the table of 'ssilk evaluate'."""
    rest = facts({name: value for name, value in document.items() if name not in ("figures", "inputs", UNFINISHED)})
    return _section("Evaluation", records(document["figures"]) + rest, document)


def _section(title: str, body: str, document: Mapping[str, Any]) -> Section:
    """Return the section of a file; of an unfinished one, its title and its first words say so."""
    if UNFINISHED in document:
        return Section(f"{title}, unfinished", f'<p class="note">Unfinished: {GO_ON}.</p>{body}')
    return Section(title, body)


def records(found: Sequence[Mapping[str, Any]]) -> str:
    """Return records as a table with a column for each name that occurs, or a row for each where these are many."""
    flat = [flattened(record) for record in found]
    names = list(dict.fromkeys(name for record in flat for name in record))
    if len(names) > MAX_COLUMNS:
        return table(
            ("", *(str(number) for number in range(1, len(flat) + 1))),
            [[name, *(record.get(name, "") for record in flat)] for name in names],
        )
    return table(names, [[record.get(name, "") for name in names] for record in flat])


def judged(validation: Mapping[str, Any]) -> float:
    """Return the energy by which the best validation is chosen, as `training.validation.Score.judged` is [J]."""
    totals = [validation["total"], *(body["total"] for body in validation.get("bodies", ()))]
    return float(sum(totals) / len(totals))


def bodies_of(file: ModelFile) -> list[Section]:
    """Return the section of the bodies that a model dresses: who they are, and what its training measured on them.

    There is none for a model of one body.
    """
    if file.bodies is None:
        return []
    names, validation = file.bodies.family.bodies.names, file.provenance.get("validation", {})
    lbs, others = file.provenance.get("lbs", {}), {each["name"]: each for each in validation.get("bodies", ())}
    first = {"total": validation["total"], "lbs": lbs["total"], "collisions": validation["collisions"]} if lbs else {}
    rows = []
    for name in names:
        found = first if name == names[0] else others.get(name, {})
        figures = [worded(found[key]) if found else NOT_MEASURED for key in ("total", "lbs")]
        rows.append([name, *figures, f"{found['collisions']:.2%}" if found else NOT_MEASURED])
    graded = file.scene.garment.graded
    how = "graded to each body: its rest shape is where it lies there" if graded else "one for all bodies"
    words = f"The garment is {how}. Validations measured the first body and those farthest apart."
    header = ("body", "energy [J]", "linear blend skinning [J]", "inside the body")
    return [Section("Bodies", table(header, rows) + f'<p class="note">{words}</p>')]


def learning(document: Mapping[str, Any]) -> Section:
    """Return the section of the learning curve that a training writes beside its model."""
    points, lbs = document["points"], document["lbs"]
    bodies = [point["validation"].get("bodies", []) for point in points]  # of a family, and fabrics of a range
    best = min(range(len(points)), key=lambda number: judged(points[number]["validation"]))
    times = [point["seconds"] for point in points]
    totals, inside = ([point["validation"][name] for point in points] for name in ("total", "collisions"))
    shown = {"total at validation": ("J", totals), SHARE: ("%", [100 * share for share in inside])}
    found = [point["validation"].get("shown_skin") for point in points]
    if all(found):
        shown[SHOWN] = ("%", [100 * each["mean"] for each in found])
        shown[BARE] = ("%", [100 * each["bare"] for each in found])
    steps = [point["validation"].get("step_errors") for point in points]
    if all(steps):
        shown[MISSED] = ("mJ", [1000 * each["energy"] for each in steps])
    rows = [
        [ChartPanel(title=title, x="training time [s]", y=unit, curves={"": (times, values)},
                    marks={"best": (times[best], values[best])})]
        for title, (unit, values) in shown.items()
    ]  # fmt: skip
    if all(bodies):
        names = [each["name"] for each in bodies[best]]
        curves = {name: (times, [found[row]["total"] for found in bodies]) for row, name in enumerate(names)}
        panel = ChartPanel(
            title="total on other bodies and of other fabrics", x="training time [s]", y="J", curves=curves
        )
        rows.insert(1, [panel])
    words = (
        f"Best: {totals[best]:.4g} J at {times[best]:.0f} s. "
        f"Linear blend skinning: {lbs['total']:.4g} J, {lbs['collisions']:.2%} inside the body."
    )
    if found[best]:
        words += f" At the best, {ShownSkin(**found[best])}."
    if crossed := points[best]["validation"].get("intersections"):
        words += f" At the best, {SelfIntersections(**crossed)}."
    if steps[best]:
        words += f" At the best, {StepErrors(**steps[best])}."
    return Section("Training", svg_chart("validations during training", rows) + f'<p class="note">{words}</p>')
