# SPDX-License-Identifier: Apache-2.0
"""Members of a family of bodies, made of one toy character."""

from dataclasses import replace

import numpy as np

from ssilk_core.scene.family import with_joints


def shaped(character, change, path):
    """Return a character whose bodies and joints are moved by `change`."""
    bodies = tuple(replace(b, mesh=replace(b.mesh, points=change(b.mesh.points))) for b in character.bodies)
    joints = change(np.array(character.skeleton.bind_transforms[:, :3, 3]))
    return replace(character, path=path, skeleton=with_joints(character.skeleton, joints), bodies=bodies)


def members_of(character):
    """Return a character, a taller one and a heavier one."""
    taller = shaped(character, lambda points: points * [1, 1.2, 1], "/taller")
    heavier = shaped(character, lambda points: points * [1.3, 1, 1.25], "/heavier")
    return [character, taller, heavier]
