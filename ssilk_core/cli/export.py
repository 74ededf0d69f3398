# SPDX-License-Identifier: Apache-2.0
"""Write a trained model's network as ONNX, for engines that play it themselves.

One call computes one frame of any number of characters. Inputs are the states of the two previous frames, the
descriptors of the pose (static ones and rates, see ssilk_core/network/descriptors.py) and a flag for the first two
frames of a shot. Where the stepper sees points of the cloth, or the network colliders, the skinning matrices of the
character's joints about its root follow, and the root's position less twice the last one plus the one before. Outputs
are the new state, the weights of the blendshapes and the local rotations of the proxy joints, as in a shot. Where
proxies move, their local translations follow. Blendshapes and skinning weights are those of any baked shot.

Where the network sees colliders, the last input is their proximity (see ssilk_core/network/proximity.py), and the
last output the points to look for them from, about the root. These are of the frame itself: call with the proximity
of nothing, (0, 0, 0, 1, -1) at each point, look from the points that come out, and call again with what was found.
Without colliders the first call is all. How far to look is told, and the vertices that the points are.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..delivery.bake.fabrics import need_fabric
from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result
from .options.fabric import add_known_fabric
from .options.files import check_output

if TYPE_CHECKING:
    from ..network.checkpoint import ModelFile


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("model", type=Path, help="model written by 'ssilk train'")
    verb.add_argument("-o", "--output", type=Path, required=True, help="file to write (.onnx)")
    verb.add_argument(
        "--stage",
        type=Path,
        help="USD file with the body to export it for (default: the first of its family)",
    )
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    add_known_fabric(verb)


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Write the network; report its inputs and outputs."""
    from ..delivery.bake import in_fabric
    from ..network.checkpoint import load_model, network
    from ..network.model.export import FrameNetwork, export_onnx
    from ..network.parameters import descriptor_sizes
    from ..network.proximity import proximity_reach, proximity_vertices

    output: Path = options.output
    if output.suffix != ".onnx":
        fail(str(output), f"a file that ends in '{output.suffix}'", "ONNX files end in .onnx")
    if options.root and not options.stage:
        fail("--root", "a SkelRoot without a stage", "it says which character of --stage is meant", "give --stage")
    check_output(output, options.model)
    need_fabric(options.fabric, options.material)
    file = load_model(options.model)
    if options.stage:
        file = _on_body(options, file, report)
    elif file.bodies:
        text = "a model of a family of bodies: it is exported for the first of them; --stage names another one"
        report(Message(f"{options.model}: {text}"))
    file, told = in_fabric(file.on_base(), str(options.model), options.fabric, options.material)
    for event in told:
        report(event)
    if file.fabrics:
        text = "a model of a range of fabrics: it is exported for that of its training; --fabric names another one"
        report(Message(f"{options.model}: {text}"))
    model = network(file)
    export_onnx(model, output)
    static, rates = descriptor_sizes(file.scene, file.joints, file.config)
    seen = proximity_vertices(file.scene, file.config).tolist()
    near = (
        {"sees colliders at vertices": seen, "sees colliders up to [m]": proximity_reach(file.scene)} if seen else {}
    )
    report(
        Result(
            "export",
            {
                "network": str(output),
                "latents": file.config.latent,
                "numbers in a state": FrameNetwork(model).state_size,
                "static descriptors": static - model.proximity,
                "dynamic descriptors": rates,
                **near,
                "weights": file.config.shapes + model.decoder.has_constant,
                "proxies": file.scene.rig.proxy_count,
                "frames per second": file.config.fps,
                "bytes": output.stat().st_size,
            },
        )
    )
    return EXIT_OK


def _on_body(options: argparse.Namespace, file: ModelFile, report: Reporter) -> ModelFile:
    """Return a model for the body of the stage, and tell what there is to say of that."""
    from ssilk_usd.opening.stage import open_stage

    from ..delivery.bake import worn

    on = worn(file, open_stage(options.stage), options.root)
    for event in on.told:
        report(event)
    if on.scene.character.skeleton.seen is not None:
        found = "the garment was put onto it from a character with another skeleton"
        allowed = "descriptors of an exported network are of the skeleton that it was trained on"
        fail(str(options.stage), found, allowed, "leave --stage out, or train on this character")
    return on.file
