# SPDX-License-Identifier: GPL-3.0-or-later
"""Which body of its model's family a character has now, and the model on that body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np

from ssilk_core.delivery.bake import WornModel, worn_by
from ssilk_core.network.checkpoint import ModelFile
from ssilk_core.scene.assets import Character

from ..arrays.joints import Joints, identifiers, joint_order
from ..arrays.renamed import TrainedJoints, known_as
from ..motions.shapes import changing_shapes
from ..scene.garment import bodies_of
from ..scene.gather import ROOT, SKELETON, GatheredScene, evaluated, moved_mesh, read_body
from ..scene.handover import expose_usd

SAME_AXES = 1e-5  # between entries of a rotation that is none


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A model of a family on the body of an armature.

    Attributes:
        worn: the model there, and what there is to say of the body.
        joints: of the armature, under the names that the model knows.
        base: where the garment lies on the family's first body [m], shape (V, 3).
        back: moves the scene to where the family has the body [m], rigid, (4, 4).
    """

    worn: WornModel
    joints: Joints
    base: np.ndarray
    back: np.ndarray

    @property
    def told(self) -> str:
        """What there is to say of the body, in sentences; empty for the first one."""
        return " ".join(f"{event.text}." for event in self.worn.told)

    def moved(self, scene: GatheredScene) -> GatheredScene:
        """Return a scene where `ssilk bake` and `ssilk live` find this body."""
        return scene.moved(self.back)


def on_its_body(
    file: ModelFile, garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, chosen: dict[str, str]
) -> BodyModel:
    """Put a model of a family on the body that a character has in this frame, wherever its armature is. In object
    mode.

    Args:
        joints: of the armature and the garment, as `read_joints` returns them.
        chosen: what bones were called when the garment was trained, by their names now.

    Raises:
        SsilkError: its bones or bodies are none of the family's, or its body is too far from all of them.
    """
    assert file.bodies is not None
    expose_usd()
    scene, family = file.scene, file.bodies.family.bodies
    known = known_as(joints, TrainedJoints(scene.joint_names, scene.bind_transforms), chosen)
    order = joint_order(known, scene.joint_names, fewer_proxies=True)
    own = np.argsort(order[: known.character_count])
    character = _character(garment, armature, known)
    now, trained = known.binds[own], scene.character.skeleton.bind_transforms
    back = np.eye(4)
    back[:3, :3] = trained[0, :3, :3] @ now[0, :3, :3].T
    if np.abs(back - np.eye(4)).max() < SAME_AXES:
        back = np.eye(4)
    points = family.known_meshes(character).merged_body().mesh.points[family.rows]
    back[:3, 3] = family.displacement(now[:, :3, 3] @ back[:3, :3].T, points @ back[:3, :3].T)
    moved = _moved(character, known, back)
    return BodyModel(worn_by(file, moved, moved), known, scene.garment.mesh.points, back)


def _character(garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints) -> Character:
    """Return the character of a garment at rest; messages call it by its armature."""
    things = bodies_of(garment, armature)
    names = identifiers((thing.name for thing in (garment, *things)), taken=(SKELETON,))[1:]
    with evaluated(things):
        bodies = [
            read_body(thing, armature, joints.character, f"{ROOT}/{name}") for thing, name in zip(things, names)
        ]
    name = f"'{armature.name}'"
    return Character(name, joints.skeleton(name, bodies), tuple(bodies))


def _moved(character: Character, joints: Joints, back: np.ndarray) -> Character:
    if np.array_equal(back, np.eye(4)):
        return character
    bodies = tuple(replace(body, mesh=moved_mesh(body.mesh, back)) for body in character.bodies)
    skeleton = replace(joints, binds=back @ joints.binds).skeleton(character.skeleton.path, bodies)
    return replace(character, skeleton=skeleton, bodies=bodies)


def shape_of(garment: bpy.types.Object, armature: bpy.types.Object) -> tuple[object, ...]:
    """Return what differs once the artist gives a character another body: shape keys that no motion changes."""
    found: list[object] = []
    for thing in bodies_of(garment, armature):
        keys, changing = thing.data.shape_keys, set(changing_shapes(thing))
        blocks = keys.key_blocks if keys else ()
        found += [(thing.name, key.name, key.value, key.mute) for key in blocks if key.name not in changing]
    return tuple(found)
