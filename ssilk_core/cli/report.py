# SPDX-License-Identifier: Apache-2.0
"""Write a page (.html) about a shot or a model: energies over time, worst frames, tables, provenance.

A shot is measured from the points that its file plays, whatever program computed them. The page of a model shows its
training; with --stage and --motion it is also baked and shown as a shot. --figures adds files that 'ssilk stress',
'ssilk trade' and 'ssilk evaluate' wrote with --output. The page loads nothing from elsewhere.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, fields
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result, Started
from ..files import replacing
from ..physics.intersections.figures import LAYERS, LayerFigures, SelfIntersections
from ..physics.skin.figures import ShownSkin
from ..physics.world.sunk import SunkCloth
from ..scene.fabrics import Fabric
from .options.files import check_output

if TYPE_CHECKING:
    from ssilk_usd.opening.garment_api import GarmentRecord
    from ssilk_usd.shots.read import ShotPart

    from ..delivery.report.page import Section
    from ..delivery.view.props import ShotProps
    from ..network.checkpoint import ModelFile
    from ..scene.assets import Mesh

MODEL = ".safetensors"


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("subject", type=Path, metavar="MODEL|SHOT", help="what the page is about")
    verb.add_argument("-o", "--output", type=Path, required=True, help="page to write (.html)")
    verb.add_argument("--stage", type=Path, help="for a model: USD file with the character")
    verb.add_argument("--motion", type=Path, metavar="SHOT[:/PRIM]", help="for a model: the motion to show it on")
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument(
        "--figures", type=Path, nargs="+", default=[], metavar="JSON", help="figures to show as tables and plots"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Measure, draw and write."""
    from ..delivery.report.figures import section_of
    from ..delivery.report.page import page
    from ..physics.intersections.pairs import need_predicates

    _check(options)
    if options.stage or options.subject.suffix != MODEL:
        need_predicates()
    given = [section_of(path) for path in options.figures]
    own = _model(options, report) if options.subject.suffix == MODEL else _shot(options.subject, report)
    *measured, provenance = own
    text = page(options.subject.name, [*measured, *given, provenance])
    with replacing(options.output) as temporary:
        temporary.write_text(text, encoding="utf-8")
    figures = {name: value for section in measured for name, value in section.figures.items()}
    told: dict[str, object] = {"garments": figures} if options.json and figures else _told(figures)
    report(Result("report", {"page": str(options.output), "bytes": options.output.stat().st_size, **told}))
    return EXIT_OK


def _told(figures: dict[str, Any]) -> dict[str, object]:
    """Return the figures of each garment in words."""
    found: dict[str, object] = {}
    over = figures.get(LAYERS, {})
    for outer, inner in over.items():
        found |= {f"{outer} over {each['inner']}": str(LayerFigures(**each)) for each in inner}
    for name, own in figures.items():
        if own is over:
            continue
        skin = own.get("shown_skin")
        found[name] = str(ShownSkin(**skin)) if skin else "it covers no skin"
        if crossed := own.get("intersections"):
            found[f"{name}: cloth through cloth"] = str(SelfIntersections(**crossed))
        if sunk := own.get("sunk_cloth"):
            found[f"{name}: cloth in colliders"] = str(SunkCloth(**sunk))
        if own.get("non-finite frames"):
            found[f"{name}: frames that are not finite"] = own["non-finite frames"]
    return found


def _check(options: argparse.Namespace) -> None:
    from ..delivery.bake.shots import need_no_folder

    if options.output.suffix != ".html":
        fail(str(options.output), "not a name for a page", "it ends in .html")
    check_output(options.output, options.subject, *options.figures)
    need_no_folder(options.subject, "a model or a shot is needed")
    if not options.subject.is_file():
        fail(str(options.subject), "there is no such file", "a model or a shot is needed")
    if bool(options.stage) != bool(options.motion):
        fail("report", "one of --stage and --motion", "a model is shown on both, or on neither")
    if not (options.subject.suffix == MODEL or not options.stage):
        fail(str(options.subject), "--stage for a shot", "shots hold their character")


def _shot(
    path: Path, report: Reporter, props: ShotProps | None = None, file: ModelFile | None = None
) -> list[Section]:
    """Return the sections of a shot, its provenance last.

    Args:
        props: the colliders that its cloth met; by default those that it names.
        file: the model that was baked; by default that which it names.
    """
    from ssilk_usd.reading.facts import read_provenance
    from ssilk_usd.shots.play import Shot
    from ssilk_usd.shots.read import read_parts
    from ssilk_usd.writing.body_faces import open_with_full_bodies

    from ..delivery.bake.met import props_of
    from ..delivery.bake.outfit import changed_since, stated_over
    from ..delivery.bake.shots import layers_of
    from ..delivery.bake.stated import stated_skin, stated_sunk
    from ..delivery.report.page import Section, facts
    from ..delivery.report.shots import ShotGarment, shot_sections

    shot = Shot(open_with_full_bodies(path))  # cloth is measured against all of the body
    parts = read_parts(shot)
    report(Started("report", len(shot.frame_times)))
    origins = {each: read_provenance(each) for each in (path, *layers_of(path))}
    said = origins[path] | {layer.parent.name: each for layer, each in origins.items() if layer != path}
    garments = [
        ShotGarment(index, part.mesh, _fabric(part.record), *_sewn(path, origins, part, file, report))
        for index, (mesh, part) in enumerate(zip(shot.meshes, parts))
        if mesh.is_garment
    ]
    if not garments:
        fail(str(path), "no mesh is marked as a garment", "at least one is needed", "see 'ssilk rig'")
    if not shot.frame_times:
        fail(str(path), "the shot has no frames", "at least one is needed")
    others = {index for index, mesh in enumerate(shot.meshes) if mesh.is_garment or mesh.is_rider}
    bodies = {index: part.mesh for index, part in enumerate(parts) if index not in others}
    places = {each.index: shot.meshes[each.index].path for each in garments}
    props = props or props_of(path, report)
    sunk, skin, over = stated_sunk(path, places), stated_skin(path, places), stated_over(path)
    sections = shot_sections(shot, garments, bodies, report, sunk=sunk, skin=skin, props=props, over=over)
    records = {str(part.mesh.path): asdict(part.record) for part in parts if part.record}
    if isinstance(certificate := said.get("certificate"), Mapping):
        sections.insert(1, Section("Certificate", f"<p>{escape(str(certificate.get('found')))}</p>"))
    if changed := changed_since(path):
        for text in changed:
            report(Message(text, "warning"))
        sections.insert(1, Section("Garments beneath", "".join(f"<p>{escape(text)}.</p>" for text in changed)))
    return [*sections, Section("Provenance", facts({**said, **records}))]


def _sewn(
    path: Path, origins: Mapping[Path, Mapping[str, Any]], part: ShotPart, file: ModelFile | None, report: Reporter
) -> tuple[Mesh, str]:
    """Return a garment in the rest shape of its energies, and what there is to say of that."""
    from ..delivery.report.sewn import model_of, sewn_mesh

    if part.record is None or not part.record.model_hash:
        return part.mesh, ""
    file = file or model_of(origins, part.record.model_hash)
    if file is not None:
        sewn = sewn_mesh(part.mesh, file)
        where, body = "was put onto another skeleton", "the body of its training"
        if file.bodies is not None:
            where, body = "is one for all bodies of its model", "the first of them"
        how = f"The garment {where}: stretch counts from its shape on {body}."
        graded = "The garment is graded to this body: stretch counts from where it lies on it."
        return sewn, how if sewn is not part.mesh else graded if file.scene.garment.graded else ""
    name = part.mesh.path.rpartition("/")[2]
    text = "its model is not where it was baked from, so that stretch counts from where the garment lies on this body"
    report(Message(f"{path}: {name}: {text}"))
    return part.mesh, f"{text[0].upper()}{text[1:]}."


def _fabric(record: GarmentRecord | None) -> Fabric:
    """Return the fabric that a garment states, or the default fabric."""
    if record is None:
        return Fabric("default")
    known = {item.name for item in fields(Fabric)}
    numbers: dict[str, Any] = {name: value for name, value in record.parameters.items() if name in known}
    return Fabric(record.fabric, **numbers)


def _model(options: argparse.Namespace, report: Reporter) -> list[Section]:
    """Return the sections of a model, its provenance last."""
    from ..delivery.report.figures import bodies_of, learning_of
    from ..delivery.report.page import Section, facts
    from ..network.checkpoint import load_model

    path: Path = options.subject
    file = load_model(path)
    sections = _baked(options, report) if options.stage else []
    sections += [*bodies_of(file), *learning_of(path.with_suffix(".curve.json"))]
    scene = file.scene
    sizes = {
        "vertices": scene.garment.mesh.vertex_count,
        "proxies": scene.rig.proxy_count,
        "parameters": sum(value.size for value in file.parameters.values()),
        "bytes": path.stat().st_size,
    }
    whole = {"garment": sizes, "model": asdict(file.config), "fabric": asdict(file.fabric), **file.provenance}
    return [*sections, Section("Provenance", facts(whole))]


def _baked(options: argparse.Namespace, report: Reporter) -> list[Section]:
    """Bake a model and return the sections of the shot without its provenance."""
    from ssilk_usd.shots.shot import write_shot

    from ..delivery.bake import BakeRequest, load_rollout
    from ..delivery.bake.counted import state_rollout_counts
    from ..delivery.bake.refinement import refined
    from ..delivery.view.props import ShotProps
    from ..network.checkpoint import load_model

    model, stage, motion = (str(path) for path in (options.subject, options.stage, options.motion))
    rollout = load_rollout(BakeRequest(model=model, stage=stage, motion=motion, root=options.root))
    rollout.tell(report)
    rollout = refined(rollout, report)  # nothing asks for that: it tells what the network sees
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / f"{options.subject.stem}.usdc"
        write_shot(
            shot,
            rollout.deformer,
            rollout.motion,
            rollout.poses(),
            units=rollout.units,
            record=rollout.played or rollout.record,
        )
        rollout.warn(report)
        state_rollout_counts(shot, rollout)
        world = rollout.around.seen
        props = ShotProps(world, rollout.samples.seconds) if world else None
        return _shot(shot, report, props, load_model(model))[:-1]
