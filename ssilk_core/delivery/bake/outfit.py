# SPDX-License-Identifier: Apache-2.0
"""Garments of one character together: several baked into one glb, and shots of several verified."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from ...errors import VerificationError, fail
from ...events import Event, Message, Reporter, Result, silent
from ...files import replacing, sha256
from ...network.checkpoint import ModelFile, load_model
from ...physics.intersections.figures import EVERY, LAYERS, NOT_COUNTED, LayerFigures
from ...physics.intersections.pairs import can_find
from ...quality.levels import quality_named
from ...scene.mesh.joined import joined
from ..gltf.outfit import GARMENTS, garments_in, join_glbs, write_alone
from ..gltf.play import GlbShot
from ..targets import GLB
from .beneath import THICKNESS, changed_beneath
from .bodies import WornModel, worn
from .certificate.summary import CERTIFICATE
from .layered import depth, over_others, tell_layers, trained_over
from .opened import add_provenance, provenance_of
from .origin import REFINED, read_origin
from .request import BakeRequest
from .result import BakeResult, Verification
from .shots import changed_in, finished, is_stage, place_of
from .stated_layers import all_stated
from .task import garment_name
from .verification import verify
from .write import bake

AT_MOST = 1e-6  # [m] between a garment alone and joined with others


def bake_outfit(
    requests: Sequence[BakeRequest],
    output: Path,
    *,
    quality: str | None = None,
    budget: str | None = None,
    include_body: bool = True,
    verify: bool = True,
    report: Reporter = silent,
) -> list[BakeResult]:
    """Bake several garments over one motion into one glb: one skeleton, one body, a skin for each garment.

    Args:
        requests: of one stage and motion, each with another model.
        others: as `bake` takes them, for each garment.

    Returns:
        A result for each garment, in the order of the requests.

    Raises:
        SsilkError: as `bake` does; or the requests are not of one motion, ask for a file that holds one garment, or
            for a body without the faces that are covered.
        VerificationError: a garment is not what was computed; no file is kept.
    """
    names = [garment_name(request) for request in requests]
    _need_together(requests, names, output)
    results = dict[str, BakeResult]()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        parts = {name: folder / f"{name}{GLB}" for name in names}
        asked = dict(zip(names, requests))
        over = _beneath(requests, names, quality)
        for name, beneath in over.items():
            result = bake(
                asked[name], parts[name], quality=quality, budget=budget,
                include_body=include_body and name == names[0], verify=verify,
                report=_without_results(report), place=output,
                beneath={inner: parts[inner] for inner in beneath},
            )  # fmt: skip
            if any(name in others for others in over.values()):  # and may be refined over it
                add_provenance(parts[name], {THICKNESS: load_model(asked[name].model).fabric.thickness})
            results[name] = replace(result, path=output)
            report(Result("bake", {"garment": name, **results[name].figures()}))
        with replacing(output) as unverified:
            join_glbs(parts, unverified)
            _need_unchanged(parts, unverified, folder, output)
            models = _worn(requests, names)
            _tell_other_models(models, requests, output, report)
            layers = _layers(models, parts, report)
            add_provenance(unverified, {LAYERS: [each.to_metadata() for each in layers]} if layers else {})
    for each in layers:
        report(Result("bake", {"garment": each.outer, "over": each.inner, **each.summary("time code")}))
    report(Result("bake", {"output": str(output), "garments": len(names), "bytes": output.stat().st_size}))
    return [results[name] for name in names]


def verify_garments(
    shot: Path, *, device: str | None = None, report: Reporter = silent
) -> tuple[dict[str, Verification], list[LayerFigures]]:
    """Verify each garment of a shot that `holds_several`, and count how those in layers lie over one another.

    Args:
        device: where networks run; None for where they ran for the bake.

    Returns:
        What `verify` says of each garment, by name, and what `tell_layers` says of all; of a glb it is counted when
        it is baked.

    Raises:
        SsilkError, VerificationError: as `verify` does.
    """
    if shot.suffix != GLB:
        from ssilk_usd.shots.layers import Layout

        folder, name = place_of(shot)
        layers = {each: Layout(folder, each, name).animation for each in finished(folder, name)}
        proven = {each: verify(path, device=device, report=report) for each, path in layers.items()}
        return proven, tell_layers(folder, name, report, "verify")
    proven, said = {}, provenance_of(shot)[GARMENTS]
    with tempfile.TemporaryDirectory() as folder_name:
        parts = {name: Path(folder_name) / f"{name}{GLB}" for name in said}
        for name, alone in parts.items():
            write_alone(shot, name, alone)
        for name, alone in parts.items():  # beside those that it is refined or certified over
            origin = read_origin(shot, {}, provenance=said[name])
            proven[name] = verify(alone, device=device, report=_without_results(report), **origin.request.inputs)
            report(Result("verify", {"shot": str(shot), "garment": name, **proven[name].figures()}))
    return proven, []


def stated_over(shot: Path) -> list[LayerFigures]:
    """Return what the stage of a shot in layers says of how its garments lie over one another.

    There is none of other files, and none where the stage does not tell of all pairs.

    Raises:
        SsilkError: it cannot be read.
    """
    return all_stated(shot, finished(*place_of(shot))) if shot.suffix != GLB and is_stage(shot) else []


def changed_since(shot: Path) -> list[str]:
    """Return in words which garments of a shot were refined or certified over others than lie beneath them now.

    Raises:
        SsilkError: it cannot be read.
    """
    if is_stage(shot):
        return list(changed_in(finished(*place_of(shot))))
    said, made = provenance_of(shot), {REFINED: "refined", CERTIFICATE: "certified"}
    parts = {word: facts for name, word in made.items() if isinstance(facts := said.get(name), Mapping)}
    return [text for word, facts in parts.items() for text in changed_beneath(facts, shot, word)]


def holds_several(shot: Path) -> bool:
    """Return whether a file is the stage of a shot in layers, or a glb of several garments."""
    if shot.suffix == GLB:
        return shot.is_file() and bool(garments_in(provenance_of(shot)))
    return is_stage(shot)


def _beneath(requests: Sequence[BakeRequest], names: Sequence[str], quality: str | None) -> dict[str, list[str]]:
    """Return the garments that each is refined or certified over, by name, inner ones first; none where neither is
    asked."""
    if not (requests[0].meets_beneath or (quality and quality_named(quality).refine)):
        return {name: [] for name in names}
    called = {str(request.model): name for name, request in zip(names, requests)}
    over = trained_over(called)
    ordered = sorted(called, key=lambda model: depth(model, over))
    return {called[model]: [called[each] for each in over[model]] for model in ordered}


def _need_together(requests: Sequence[BakeRequest], names: Sequence[str], output: Path) -> None:
    if output.suffix != GLB:
        found = f"{len(requests)} garments, shots or bodies in one file"
        fail(str(output), found, "several garments over one motion go into a .glb or a folder", "name one of these")
    if len({(each.stage, each.motion, each.root) for each in requests}) > 1:
        fail(str(output), "several motions or characters", "a glb has one of each", "name a folder")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        fail(str(output), f"two garments named '{twice}'", "each has a name of its own", "rename a model")
    if any(each.hide_covered for each in requests):
        found, allowed = "several garments in one glb", "faces are left out that one garment covers"
        fail("--hide-covered", found, allowed, "name a folder, whose shots hide what any garment covers")


def _without_results(report: Reporter) -> Reporter:
    """Return what takes all events but results, whose files are not kept."""

    def told(event: Event) -> None:
        if not isinstance(event, Result):
            report(event)

    return told


def _need_unchanged(parts: Mapping[str, Path], joined: Path, folder: Path, output: Path) -> None:
    """Raise `VerificationError` where a garment is elsewhere in the joined file than in its own."""
    for name, part in parts.items():
        alone = folder / f"alone_{name}{GLB}"
        write_alone(joined, name, alone)
        before, after = GlbShot(part), GlbShot(alone)
        for time in before.frame_times:
            away = float(np.abs(before.garment_points(time) - after.garment_points(time)).max(initial=0.0))
            if not away <= AT_MOST:
                raise VerificationError(
                    f"{output}: '{name}' is {away:.3g} m away at time code {time:g} once it is joined with others; "
                    f"at most {AT_MOST:g} m is allowed; bake it alone."
                )


def _worn(requests: Sequence[BakeRequest], names: Sequence[str]) -> dict[str, WornModel]:
    """Return the garments as they lie on the character of their stage, which may be any of a model's family."""
    from ssilk_usd.opening.stage import open_stage

    stage = open_stage(requests[0].stage)
    return {name: worn(load_model(each.model), stage, each.root) for name, each in zip(names, requests)}


def _tell_other_models(
    models: Mapping[str, WornModel], requests: Sequence[BakeRequest], output: Path, report: Reporter
) -> None:
    """Warn of garments that were trained over others than they are worn with, as folders of layers do."""
    known = {
        name: (sha256(request.model), dict(each.file.provenance.get("over") or {}))
        for (name, each), request in zip(models.items(), requests)
    }
    for name in known:
        if text := over_others(name, known):
            report(Message(f"{output}: {name}: {text}", "warning"))


def _layers(models: Mapping[str, WornModel], parts: Mapping[str, Path], report: Reporter) -> list[LayerFigures]:
    """Count how the garments lie over one another, in every `EVERY`-th frame, as their files have them.

    The body of their character in the bind pose tells the outside of cloth.
    """
    if not can_find():
        report(Message(f"cloth through other garments is {NOT_COUNTED}", "warning"))
        return []
    from ...physics.intersections.layers import ClothLayers

    found = []
    body = joined([each.mesh for each in next(iter(models.values())).scene.character.bodies])
    shots = {name: GlbShot(path) for name, path in parts.items()}
    for one, other in combinations(models, 2):
        meshes = {name: models[name].scene.garment.mesh for name in (one, other)}
        order = [pair for pair in ((one, other), (other, one)) if _is_over(models[pair[0]].file, shots[pair[1]])]
        layers = (
            ClothLayers(order[0], meshes[order[0][0]], meshes[order[0][1]], body)
            if order
            else ClothLayers.by_cover((one, meshes[one]), (other, meshes[other]), body)
        )
        times = shots[one].frame_times[::EVERY]
        outer, inner = ([shots[name].garment_points(time) for time in times] for name in layers.names)
        figures = layers.figures([("the shot", layers.counts(outer, inner, times))])
        if figures.shown is not None or figures.worst:
            found.append(figures)
    return found


def _is_over(outer: ModelFile, inner: GlbShot) -> bool:
    """Return whether a model was trained over that of a shot."""
    return inner.provenance.get("model_sha256") in (outer.provenance.get("over") or {}).values()
