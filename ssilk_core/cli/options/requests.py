# SPDX-License-Identifier: Apache-2.0
"""The requests for bakes that the options of `bake.add_bake` make."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from ...delivery.bake import BakeRequest, naming
from ...delivery.bake.task import named_by_bodies
from ...errors import fail
from ...files import split_location
from .files import LIST, MODEL


def requests_of(options: argparse.Namespace) -> list[BakeRequest]:
    """Return a request for each model on each body over each motion, as the options of `add_bake` say."""
    shots = _shots(options)
    worn = [
        (model, split_location(model), _name(options.garment_name, model, "--garment-name"))
        for model in _models(options.model)
    ]
    requests = [
        BakeRequest(
            model=model,
            stage=str(stage),
            motion=shot.motion,
            root=root,
            fps=options.fps,
            range=shot.range or options.range,
            handles=options.handles,
            samples_per_frame=options.samples_per_frame,
            pre_roll=options.pre_roll,
            target=options.target,
            lbs=options.lbs,
            refine=options.refine,
            feedback=options.feedback,
            latent_iterations=options.latent_iterations,
            latent_elements=options.latent_elements,
            refined_output=options.refined_output,
            certify=options.certify,
            hide_covered=options.hide_covered,
            hold=options.hold or 0,
            loop=options.loop,
            start_cloth=options.start_cloth,
            colliders=tuple(options.collider),
            wind=options.wind,
            gusts=options.gusts,
            gravity=options.gravity,
            fabric=options.fabric,
            material=tuple(options.material),
            device=options.device,
            garment=garment,
            shot=name,
            level_of=options.level_of,
            asset_version=_name(options.asset_version, whole, "--asset-version"),
            asset_identifier=_name(options.asset_identifier, whole, "--asset-identifier"),
        )
        for whole, (model, root), garment in worn
        for stage in options.stage
        for name, shot in shots
    ]
    return _named_by_bodies(requests, options)


def _shots(options: argparse.Namespace) -> list[tuple[str | None, naming.ListedShot]]:
    """Return shots with their names, None for the names of their files."""
    if options.shots:
        if options.shot_name:
            fail("--shot-name", "a pattern and a list of shots", "the list names them", "leave one of them out")
        return list(naming.read_shots(options.shots).items())
    listed = map(naming.ListedShot, options.motion)
    return [(_name(options.shot_name, shot.motion, "--shot-name"), shot) for shot in listed]


def _named_by_bodies(requests: list[BakeRequest], options: argparse.Namespace) -> list[BakeRequest]:
    """Return requests whose shots and garments are also named by their bodies, where one is named or several are."""
    if not options.body_name and len(options.stage) == 1:
        return requests
    bodies = {
        str(stage): naming.pattern_name(options.body_name or "{stem}", str(stage), "--body-name")
        for stage in options.stage
    }
    return named_by_bodies(requests, bodies)


def _models(named: Iterable[str]) -> list[str]:
    """Return models, "MODEL[:/ROOT]" each, with those of a list in its place, inner ones first.

    Raises:
        SsilkError: a list cannot be read, or a model that it stands for is not beside it.
    """
    found = list[str]()
    for each in named:
        path, root = split_location(each)
        if not path.endswith(LIST):
            found.append(each)
            continue
        from ...training.wardrobe.listing import read_list

        for entry in read_list(Path(path)):
            model = Path(path).with_name(f"{entry.name}{MODEL}")
            if not model.is_file():
                missing, allowed = f"there is no {model}", "the models of a list lie beside it"
                todo = "train it with 'ssilk wardrobe', and name the list in the folder of its models"
                fail(f"{path}: table '{entry.name}'", missing, allowed, todo)
            found.append(f"{model}:{root}" if root else str(model))
    return found


def _name(pattern: str | None, location: str, option: str) -> str | None:
    return naming.pattern_name(pattern, location, option) if pattern else None


def layer_options(options: argparse.Namespace) -> dict[str, bool]:
    """Return what `plan_layers` takes beside requests, as the options of `add_bake` say."""
    return {
        "include_body": not options.no_body,
        "points": options.points,
        "verify": not options.no_verify,
        "replace_names": options.replace,
    }
