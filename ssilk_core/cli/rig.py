# SPDX-License-Identifier: Apache-2.0
"""Give a garment weights, classes and proxy joints, written into a copy of the stage.

The proxies are joints at the end of the skeleton, to be edited by hand like any other; what is already authored
(weights, classes, proxies) is kept. --anew makes the rig again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import EXIT_OK
from ..events import Reporter, Result, Started
from . import options as shared


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    shared.add_scene(verb)
    verb.add_argument("-o", "--output", type=Path, required=True, help="stage to write (.usdc, .usd or .usda)")
    verb.add_argument("--anew", action="store_true", help="make classes and proxies anew, whatever the stage says")
    shared.add_setup(verb)


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Prepare the scene and write it."""
    import numpy as np
    from ssilk_usd.rig_io import write_rigged_stage

    from ..assets import CLASS_NAMES

    shared.check_output(options.output, options.stage, shared.wardrobe(options)[0])
    report(Started("rig", options.proxies))
    scene = shared.load_scene(options, report, anew=options.anew)
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
