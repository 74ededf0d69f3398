# SPDX-License-Identifier: Apache-2.0
"""Give a garment weights, classes and proxy joints, written into a copy of the stage.

The proxies are joints at the end of the skeleton and can be edited by hand like any other joint. Weights, classes and
proxies that the stage already has are kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import EXIT_OK
from ..events import Reporter, Result, Started
from ..setup.classes import ClassOptions
from ..setup.rig import RigOptions
from . import options as shared


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    shared.add_scene(verb)
    verb.add_argument("-o", "--output", type=Path, required=True, help="stage to write (.usdc, .usd or .usda)")
    verb.add_argument(
        "--tight-distance", type=float, default=ClassOptions.tight_distance, metavar="METRES",
        help="cloth farther than this from the body is loose (default %(default)s)",
    )  # fmt: skip
    verb.add_argument(
        "--proxies", type=int, default=RigOptions.proxies, help="proxy joints on the loose part (default %(default)s)"
    )
    verb.add_argument(
        "--roots", type=int, default=RigOptions.roots_per_cluster, metavar="N",
        help="proxies of each connected loose part that hang from the character itself (default %(default)s)",
    )  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Prepare the scene and write it."""
    import numpy as np
    from ssilk_usd.rig_io import write_rigged_stage

    from ..assets import CLASS_NAMES

    shared.check_output(options.output, options.stage, shared.wardrobe(options)[0])
    report(Started("rig", options.proxies))
    scene = shared.load_scene(
        options,
        report,
        classes=ClassOptions(tight_distance=options.tight_distance),
        rigging=RigOptions(proxies=options.proxies, roots_per_cluster=options.roots),
    )
    write_rigged_stage(options.stage, scene, options.output)
    counts = np.bincount(scene.classes, minlength=3)
    report(
        Result(
            "rig",
            {
                "stage": str(options.output),
                "garment": scene.garment.mesh.path,
                "proxies": scene.rig.proxy_count,
                **{f"{name} vertices": int(count) for name, count in zip(CLASS_NAMES, counts)},
            },
        )
    )
    return EXIT_OK
