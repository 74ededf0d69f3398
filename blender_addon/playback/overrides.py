# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender shows in place of a bake: other keys, tracks, drivers and constraints on what was baked, and how far.

`overriding` reads what stands in the file, and is quick enough for a panel. `shown_away` compares what Blender
evaluates with the bake itself, whatever the cause may be.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from ssilk_usd.shots.skinned import BakedGarment

from ssilk_core.scene.kinematics import local_transforms, matrix_from_quaternion

from ..arrays.joints import Joints, joint_order
from ..motions.evaluating import evaluating
from ..motions.keys import SLOTS, curves_of, is_baked, strips_in
from ..motions.sampling import worlds
from ..scene.armature import proxy_names
from ..scene.linked import local_copy
from ..scene.meshes import PREFIX, world_points
from ..scene.objects import scene_units

LOOKS = 16  # frames that are compared at most
FAR = 1e-4  # how far vertices may be from the bake, as a share of the garment's size


def overriding(garment: bpy.types.Object, armature: bpy.types.Object) -> list[str]:
    """Return in words what has priority over the keys that were baked for a garment."""
    proxies = set(proxy_names(armature, garment))
    found = [*_animation(armature, garment, "pose.bones", proxies, "proxies")]
    keys = garment.data.shape_keys
    if keys:
        shapes = {block.name for block in keys.key_blocks if block.name.startswith(PREFIX)}
        found += _animation(keys, garment, "key_blocks", shapes, "shape keys")
        if any(block.mute for block in keys.key_blocks if block.name in shapes):
            found.append("baked shape keys are muted")
        if garment.show_only_shape_key and shapes:
            found.append(f"one shape key of '{garment.name}' is pinned (Solo Active Shape Key)")
    held = [name for name in proxies if any(item.enabled and item.influence for item in _constraints(armature, name))]
    if held:
        found.append(f"constraints on {_listed(held, 'proxies')}")
    off = [item for item in garment.modifiers if item.type == "ARMATURE" and item.object == armature]
    for modifier in off:
        if not (modifier.show_viewport and modifier.show_render):
            found.append(f"the modifier '{modifier.name}' is switched off in viewports or renders")
    return found


def shown_away(
    garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, baked: BakedGarment
) -> tuple[float, int]:
    """Return how far a vertex that Blender evaluates is from the bake at most [m], and in which frame.

    Of what moves the garment, the Armature modifier and shape keys are looked at, which a bake sets; zero where it is
    within `FAR`.
    """
    skinned, pose, start = baked.garment, baked.pose, round(baked.start)
    parents = _parents(skinned.joint_names)
    names = [path.rpartition("/")[2] for path in skinned.joint_names]
    order = joint_order(joints, skinned.joint_names, fewer_proxies=True)
    own = np.argsort(order[: joints.character_count])  # the character's joints in the order of the bake
    bones = [armature.pose.bones.find(joints.names[joint]) for joint in own]
    local = local_transforms(skinned.bind_transforms, parents)
    back, weights = np.linalg.inv(skinned.bind_transforms), skinned.skin.dense(len(names))
    worst, where = 0.0, start
    looks = np.unique(np.linspace(0, pose.frame_count - 1, min(LOOKS, pose.frame_count)).round().astype(int))
    with _probe(garment) as probe, evaluating(armature, probe) as frames:
        for index in looks.tolist():
            depsgraph = frames(start + index)
            placed = scene_units().transforms_to_core(worlds(armature.evaluated_get(depsgraph))[bones])
            wanted = _placed(placed, parents, local, pose, index)
            points = skinned.points + np.tensordot(pose.weights[index], skinned.shapes, 1)
            moved = np.einsum("vj,jab,vb->va", weights, (wanted @ back)[:, :3], _homogeneous(points), optimize=True)
            shown = scene_units().points_to_core(world_points(probe.evaluated_get(depsgraph)))
            away = float(np.linalg.norm(shown - moved, axis=1).max()) if len(shown) == len(moved) else np.inf
            if away > worst:
                worst, where = away, start + index
    size = max(float(np.ptp(skinned.points, axis=0).max()), 1e-9)
    return (worst, where) if worst > FAR * size else (0.0, where)


def told(garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, baked: BakedGarment) -> str:
    """Return in words what Blender shows in place of a bake; empty where it shows the bake."""
    away, frame = shown_away(garment, armature, joints, baked)
    if not away:
        return ""
    causes = overriding(garment, armature) or ["something else moves it; look at its modifiers and its armature"]
    return f"but Blender shows it {away * 1000:.3g} mm off at frame {frame}: {'; '.join(causes)}"


def _animation(thing: Any, garment: bpy.types.Object, kind: str, names: set[str], what: str) -> Iterator[str]:
    """Yield what animates named parts of an object or of shape keys besides what was baked, or switches that off."""
    animation = thing.animation_data
    if not animation or not names:
        return
    hit = _hit(_slot_curves(animation), kind, names) if animation.action else []
    if hit and not is_baked(animation.action):
        yield f"keys of the action '{animation.action.name}' on {_listed(hit, what)}; delete these keys"
    if driven := _hit(animation.drivers, kind, names):
        yield f"drivers on {_listed(driven, what)}"
    solo = [track for track in animation.nla_tracks if track.is_solo]
    for track in animation.nla_tracks:
        strips = list(strips_in([track]))
        own = any(strip.action and is_baked(strip.action, garment) for strip, _ in strips)
        if own and track.mute:
            yield f"the track '{track.name}' is muted"
        if own and solo and not track.is_solo:
            yield f"the track '{solo[0].name}' is solo (the star in the NLA editor)"
        for strip, muted in strips:
            if muted or own or not strip.action or is_baked(strip.action):
                continue
            if hit := _hit(_slot_curves(strip), kind, names):
                yield f"the strip '{strip.name}' of the track '{track.name}' on {_listed(hit, what)}"
    if not animation.use_nla and animation.nla_tracks:
        yield f"the NLA tracks of '{thing.name}' are switched off"


def _slot_curves(player: Any) -> Iterator[bpy.types.FCurve]:
    """Yield the curves that animation data or a strip plays, of its slot alone."""
    if not SLOTS:
        return curves_of(player.action)
    slot = player.action_slot
    return curves_of(player.action, slot) if slot else iter(())


def _hit(curves: Any, kind: str, names: set[str]) -> list[str]:
    """Return which named parts some curves animate."""
    quoted = [curve.data_path.split('"') for curve in curves if curve.data_path.startswith(f'{kind}["')]
    return sorted({parts[1] for parts in quoted if parts[1] in names and not _of_constraint(parts[2])})


def _of_constraint(rest: str) -> bool:
    """Return whether the rest of a path, after a bone's name, leads to a constraint."""
    return rest.startswith("].constraints")


def _constraints(armature: bpy.types.Object, name: str) -> Sequence[bpy.types.Constraint]:
    bone = armature.pose.bones.get(name)
    return bone.constraints if bone else ()


def _listed(names: Sequence[str], what: str) -> str:
    return f"'{names[0]}'" if len(names) == 1 else f"{len(names)} {what}, as '{sorted(names)[0]}'"


@contextmanager
def _probe(garment: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """Yield a copy of a garment that shape keys and bones move alone, without modifiers that refine it."""
    probe = local_copy(garment)
    probe.hide_viewport = False  # Blender does not evaluate what is disabled
    try:
        for modifier in list(probe.modifiers):
            if modifier.type != "ARMATURE":
                probe.modifiers.remove(modifier)
        yield probe
    finally:
        bpy.data.objects.remove(probe)


def _parents(paths: Sequence[str]) -> np.ndarray:
    index = {path: joint for joint, path in enumerate(paths)}
    return np.array([index.get(path.rpartition("/")[0], -1) for path in paths])


def _placed(placed: np.ndarray, parents: np.ndarray, local: np.ndarray, pose: Any, index: int) -> np.ndarray:
    """Return the joints of a bake in a frame: the character's as Blender has them, proxies as baked, (J, 4, 4).

    Args:
        placed: the character's joints to world [m], (J - P, 4, 4).
    """
    found = np.tile(np.eye(4), (len(parents), 1, 1))
    found[: len(placed)] = placed
    for proxy, joint in enumerate(range(len(placed), len(parents))):
        step = local[joint].copy()
        step[:3, :3] = matrix_from_quaternion(pose.rotations[index, proxy])
        if pose.translations is not None:
            step[:3, 3] = pose.translations[index, proxy]
        found[joint] = found[parents[joint]] @ step
    return found


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)
