# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the demo's motions for a skeleton. Run by the Python that has ssilk: `python demo_motions.py IN.npz OUT.npz`.

IN holds paths, parents and binds of joints; OUT gets names and rates, and of each motion rotations and translations.
"""

import json
import sys

import numpy as np

from ssilk_core.demo.motions import training_motions
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Skeleton
from ssilk_core.scene.kinematics import local_transforms


def make(given, made):
    """Read a skeleton, and write its motions."""
    with np.load(given) as joints:
        paths, parents, binds = (joints[name] for name in ("paths", "parents", "binds"))
    motions = training_motions(Skeleton("/", tuple(paths.tolist()), parents, binds, local_transforms(binds, parents)))
    rotations = {f"rotations{number}": motion.rotations for number, motion in enumerate(motions)}
    translations = {f"translations{number}": motion.translations for number, motion in enumerate(motions)}
    names, rates = [motion.path for motion in motions], [motion.fps for motion in motions]
    np.savez(made, names=names, rates=rates, **rotations, **translations)


if __name__ == "__main__":
    try:
        make(*sys.argv[1:])
    except SsilkError as error:
        print(json.dumps({"event": "failed", "error": str(error)}))
        sys.exit(2)
