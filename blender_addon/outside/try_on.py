# SPDX-License-Identifier: GPL-3.0-or-later
"""Carry a garment onto other bodies, as `ssilk rig --onto` does. Run by the Python that has ssilk.

`python try_on.py STAGE GARMENT IN.npz OUT.npz`: IN holds for each body mesh, as `points.` and the name of its prim,
where K bodies have its points (K, S, 3), and in `told` which of the K is told of. OUT gets where the garment's
vertices and its proxies lie on each, `cloth` (K, V, 3) and `proxies` (K, P, 3). All in metres, y up.
"""

import sys
from dataclasses import replace

import numpy as np
from ssilk_usd.reading.scene import read_scene

from ssilk_core.authoring.bodies.carry import carry
from ssilk_core.authoring.preflight.fit import describe_left, describe_move
from ssilk_core.authoring.setup.prepare import prepare_scene
from ssilk_core.authoring.setup.rig import RigOptions
from ssilk_core.errors import SsilkError
from ssilk_core.events import Failed, JsonReporter, Progress, Result


def put_on(stage, prim, given, made, report):
    """Read a garment and bodies, and write where it lies on each; tell of the body that was asked for."""
    character, garment, rig = read_scene(stage, garment=prim)
    scene = prepare_scene(character, garment, rig, rig_options=RigOptions(proxies=1))
    with np.load(given) as read:
        points = [read[f"points.{body.mesh.path.rpartition('/')[2]}"] for body in character.bodies]
        told_of = int(read["told"])
    cloth, proxies, told, left, count = [], [], [], "", len(points[0])
    for place in range(count):
        report(Progress(place, count))
        bodies = tuple(
            replace(body, mesh=replace(body.mesh, points=its[place])) for body, its in zip(character.bodies, points)
        )
        carried = carry(scene, replace(character, bodies=bodies))
        cloth.append(carried.scene.garment.mesh.points)
        proxies.append(carried.scene.rig.bind_transforms[:, :3, 3])
        if place == told_of:
            if carried.settled.moved:
                told.append(f"settling {describe_move(carried.settled, 'moves')}")
            left = describe_left(carried.settled, carried.unsettled, carried.scene.character)
    np.savez(made, cloth=cloth, proxies=proxies)
    report(Result("try_on", {"told": told, "left": left}))


if __name__ == "__main__":
    say = JsonReporter(sys.stdout)
    stage, prim, given, made = sys.argv[1:]
    try:
        put_on(stage, prim, given, made, say)
    except SsilkError as error:
        say(Failed(str(error)))
        sys.exit(2)
