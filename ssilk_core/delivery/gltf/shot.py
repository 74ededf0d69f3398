# SPDX-License-Identifier: Apache-2.0
"""Write a baked garment and its character as one glb: joints, morph targets, and both in one animation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...files import replacing
from ...scene.assets import Body, Deformer, Floats, GarmentPose, Ints, Mesh, Motion, SkinWeights
from ...scene.kinematics import (
    combined_transforms,
    continuous,
    invert_rigid,
    local_transforms,
    quaternion_from_matrix,
    sorted_influences,
)
from .container import INDICES, VERTICES, GlbBuilder
from .file import GlbFile
from .geometry import ShapeNormals, drawn_mesh

SET = 4  # influences in one attribute
ARMATURE = 0  # the node above the joints, which follow it in their order
GARMENT, BODY, RIDER = "garment", "body", "rider"  # kinds of meshes, as the file says them
AT_REST = 1e-7  # [m] by which a joint's place may differ and still count as the same
# Plain colours, linear, where a garment has none: the bake knows no materials. Cloth is seen from both sides.
MATERIALS = (
    ("Garment", (0.30, 0.06, 0.08, 1.0), True),
    ("Body", (0.45, 0.42, 0.40, 1.0), False),
)


@dataclass(frozen=True, kw_only=True)
class GlbLabels:
    """Names and times that a glb holds beside its arrays.

    Attributes:
        character: name of the node above the joints.
        joints: name of each joint, then of each proxy.
        shapes: name of each blendshape of the deformer.
        garment, bodies, riders: names of the meshes.
        start: time code of the first frame.
        samples_per_frame: how many of the motion's frames make one of the shot's.
    """

    character: str
    joints: Sequence[str]
    shapes: Sequence[str]
    garment: str
    bodies: Sequence[str]
    riders: Sequence[str] = ()
    start: float = 0.0
    samples_per_frame: int = 1


def write_glb(
    path: str | Path,
    deformer: Deformer,
    motion: Motion,
    poses: Iterable[GarmentPose],
    labels: GlbLabels,
    *,
    include_body: bool = True,
    riders: Sequence[Body] = (),
    rider_shapes: Sequence[Floats | None] = (),
    hidden: Sequence[tuple[int, bool]] = (),
    hidden_polygons: Sequence[NDArray[np.bool_]] | None = None,
    provenance: Mapping[str, object] | None = None,
) -> int:
    """Write rest points, morph targets, weights and joint animation in metres, y up; return the number of targets.

    Nodes stand as in the first frame. What stays there has no channel. All influences are written, four to a set.

    Args:
        motion: the character's motion at the shot's samples.
        poses: consecutive chunks of frames that together cover the motion.
        riders: what rides on the garment, bound to joints of the deformer.
        rider_shapes: of each, its offsets by the deformer's blendshapes [m], shape (K, M, 3); None where it is rigid.
        hidden: from which frames of the motion on the character is hidden (True) or seen (False). Hidden, its joints
            are scaled to nothing, because plain glTF has no visibility.
        hidden_polygons: of each body, those that are left out.
        provenance: where the shot came from; looked at once the poses are taken.

    Raises:
        SsilkError: the file would be larger than its format allows, or cannot be written.
    """
    glb, scene = GlbBuilder(), deformer.scene
    shapes = np.flatnonzero(deformer.shapes.any(axis=(1, 2)))
    rotations, translations, weights = _sampled(deformer, motion, poses, shapes)
    glb.add("nodes", {"name": labels.character})
    for name, rotation, translation in zip(labels.joints, rotations[0], translations[0]):
        glb.add("nodes", {"name": name, "rotation": rotation.tolist(), "translation": translation.tolist()})
    nodes = glb.document["nodes"]
    for joint, parent in enumerate(scene.parents):
        nodes[ARMATURE if parent < 0 else 1 + parent].setdefault("children", []).append(1 + joint)
    authored = scene.garment.colour
    for name, plain, both in MATERIALS:
        colour = (*authored, 1.0) if authored and name == "Garment" else plain
        surface = {"baseColorFactor": colour, "metallicFactor": 0, "roughnessFactor": 0.9}
        glb.add("materials", {"name": name, "doubleSided": both, "pbrMetallicRoughness": surface})
    binds = invert_rigid(scene.bind_transforms).swapaxes(1, 2).astype(np.float32).reshape(-1, 16)  # by columns
    joints = list(range(1, 1 + len(scene.parents)))
    glb.add("skins", {"joints": joints, "skeleton": ARMATURE, "inverseBindMatrices": glb.array(binds, "MAT4")})
    offsets = {labels.shapes[index]: deformer.shapes[index] for index in shapes}
    worn = scene.garment.mesh
    drawn = [_add_mesh(glb, labels.garment, worn, deformer.skin, offsets=offsets, at=weights[0], kind=GARMENT)]
    morphed = [(drawn[0], weights)] if weights.shape[1] else []
    if include_body:
        bodies = scene.character.bodies
        masks: Sequence[NDArray[np.bool_] | None] = hidden_polygons or [None] * len(bodies)
        for number, (name, body, mask) in enumerate(zip(labels.bodies, bodies, masks, strict=True)):
            if mask is None or not mask.all():
                targets, course = _body_targets(motion, number, body.mesh.vertex_count)
                drawn.append(_add_mesh(glb, name, body.mesh, body.skin, offsets=targets, at=course[0], hidden=mask))
                morphed += [(drawn[-1], course)] if targets else []
    for name, rider, own in zip(labels.riders, riders, rider_shapes, strict=True):
        moved = None if own is None else {labels.shapes[index]: own[index] for index in shapes}
        drawn.append(_add_mesh(glb, name, rider.mesh, rider.skin, offsets=moved, at=weights[0], kind=RIDER))
        morphed += [(drawn[-1], weights)] if moved else []
    glb.add("scenes", {"nodes": [ARMATURE, *drawn]})
    glb.document["scene"] = 0
    _animate(glb, labels.character, motion.fps, (rotations, translations), hidden, morphed)
    timing = {"startTimeCode": labels.start, "timeCodesPerSecond": motion.fps / labels.samples_per_frame,
              "samplesPerFrame": labels.samples_per_frame,
              "characterJoints": scene.character.skeleton.joint_count}  # fmt: skip
    glb.document["asset"]["extras"] = {**timing, "ssilk": _plain(provenance or {})}
    with replacing(path) as temporary:
        glb.write(temporary)
    return len(shapes)


def add_glb_provenance(path: Path, facts: Mapping[str, object]) -> None:
    """Add to what a glb of `write_glb` says of its origin; raise `SsilkError` where it cannot be read or written."""
    file = GlbFile(path)
    said = file.document["asset"]["extras"].setdefault("ssilk", {})
    said.update(_plain(facts))
    with replacing(path) as temporary:
        file.write(temporary)


def _sampled(
    deformer: Deformer, motion: Motion, poses: Iterable[GarmentPose], shapes: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats]:
    """Return rotations (x, y, z, w), shape (F, J, 4), translations [m], shape (F, J, 3), and weights (F, K)."""
    parts, before = [], None
    for pose in poses:
        local = local_transforms(combined_transforms(deformer, motion, pose), deformer.scene.parents)
        turned = continuous(quaternion_from_matrix(local[..., :3, :3]), before)
        before = turned[-1:]
        parts.append((turned[..., [1, 2, 3, 0]], local[..., :3, 3], pose.weights[:, shapes]))
    turns, places, weights = (np.concatenate(part).astype(np.float32) for part in zip(*parts))
    return turns, places, weights


def _body_targets(motion: Motion, body: int, points: int) -> tuple[dict[str, Floats], Floats]:
    """Return the morph targets (V, 3) [m] by which a motion shapes a body, and their weights (F, K)."""
    targets: dict[str, Floats] = {}
    own = [index for index, shape in enumerate(motion.shapes) if shape.body == body]
    for index in own:
        shape = motion.shapes[index]
        copies = chain([shape.name], (f"{shape.name}_{copy}" for copy in count(2)))
        name = next(name for name in copies if name not in targets)
        targets[name] = np.zeros((points, 3))
        targets[name][shape.rows] = shape.offsets
    weights = np.zeros((motion.frame_count, 0)) if motion.shape_weights is None else motion.shape_weights
    return targets, weights[:, own].astype(np.float32)


def _add_mesh(
    glb: GlbBuilder,
    name: str,
    mesh: Mesh,
    skin: SkinWeights,
    *,
    offsets: Mapping[str, Floats] | None = None,
    at: Floats | None = None,
    hidden: NDArray[np.bool_] | None = None,
    kind: str = BODY,
) -> int:
    """Add a skinned mesh and its node; return the node's index.

    Args:
        offsets: of each morph target [m], by name; none by default.
        at: weights of the targets where no animation plays.
    """
    drawn, normals = drawn_mesh(mesh, hidden), ShapeNormals(mesh.points, mesh.faces)
    points = mesh.points.astype(np.float32)[drawn.source]
    attributes = {
        "POSITION": glb.array(points, "VEC3", use=VERTICES, bounds=True),
        "NORMAL": glb.array(normals.rest.astype(np.float32)[drawn.source], "VEC3", use=VERTICES),
        **_influences(glb, skin, drawn.source),
    }
    if drawn.uvs is not None:
        attributes["TEXCOORD_0"] = glb.array(drawn.uvs, "VEC2", use=VERTICES)
    wide = len(points) > 2**16 - 1  # the largest number of each type means something else to graphics cards
    faces = drawn.faces.reshape(-1).astype("<u4" if wide else "<u2")
    primitive = {"attributes": attributes, "indices": glb.array(faces, "SCALAR", use=INDICES),
                 "material": 0 if kind == GARMENT else 1}  # fmt: skip
    item: dict[str, object] = {"name": name, "primitives": [primitive]}
    if offsets and at is not None:
        primitive["targets"] = [
            {"POSITION": glb.offsets(offset[drawn.source].astype(np.float32)),
             "NORMAL": glb.offsets(normals.change(offset).astype(np.float32)[drawn.source])}
            for offset in offsets.values()
        ]  # fmt: skip
        item["weights"] = at.tolist()
    item["extras"] = {"targetNames": list(offsets or ()), "kind": kind, "points": mesh.vertex_count}
    return glb.add("nodes", {"name": name, "mesh": glb.add("meshes", item), "skin": 0})


def _influences(glb: GlbBuilder, skin: SkinWeights, source: Ints) -> dict[str, int]:
    """Add the influences in sets of four; return their attributes."""
    indices, weights = sorted_influences(skin)
    padding = ((0, 0), (0, -indices.shape[1] % SET))
    indices, weights = (np.pad(part, padding)[source] for part in (indices, weights))
    few = "u1" if indices.max() < 2**8 else "<u2"
    found = {}
    for number, start in enumerate(range(0, indices.shape[1], SET)):
        part = slice(start, start + SET)
        joints = np.where(weights[:, part] > 0, indices[:, part], 0).astype(few)
        found[f"JOINTS_{number}"] = glb.array(joints, "VEC4", use=VERTICES)
        found[f"WEIGHTS_{number}"] = glb.array(weights[:, part], "VEC4", use=VERTICES)
    return found


def _animate(
    glb: GlbBuilder,
    name: str,
    fps: float,
    samples: tuple[Floats, Floats],
    hidden: Sequence[tuple[int, bool]],
    morphed: Sequence[tuple[int, Floats]],
) -> None:
    """Add one animation of what moves, and of the first joint's path, so that it always lasts as long.

    Args:
        samples: rotations and translations of the joints.
        morphed: nodes whose morph targets move, each with their weights (F, K).
    """
    rotations, translations = samples
    samplers: list[dict[str, object]] = []
    channels: list[dict[str, object]] = []
    times = glb.array((np.arange(len(rotations)) / fps).astype(np.float32), "SCALAR", bounds=True)

    def add(node: int, path: str, values: Floats, kind: str, at: int = times, between: str = "LINEAR") -> None:
        samplers.append({"input": at, "output": glb.array(values, kind), "interpolation": between})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    for joint in range(rotations.shape[1]):
        if np.ptp(rotations[:, joint], axis=0).any():
            add(1 + joint, "rotation", rotations[:, joint], "VEC4")
        if joint == 0 or _moves(translations[:, joint]):
            add(1 + joint, "translation", translations[:, joint], "VEC3")
    for node, weights in morphed:
        add(node, "weights", weights.reshape(-1), "SCALAR")
    if hidden:
        when = glb.array(np.array([frame / fps for frame, _ in hidden], dtype=np.float32), "SCALAR", bounds=True)
        scales = np.array([[0.0 if gone else 1.0] * 3 for _, gone in hidden], dtype=np.float32)
        add(ARMATURE, "scale", scales, "VEC3", when, "STEP")
    glb.add("animations", {"name": name, "samplers": samplers, "channels": channels})


def _moves(places: Floats) -> bool:
    """Return whether a joint leaves its place (F, 3) by more than what float64 rounds off on the way there."""
    return bool((np.ptp(places, axis=0) > AT_REST).any())


def _plain(value: object) -> object:
    """Return nested mappings and lists as JSON holds them; what is no plain value as text, empty ones left out."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items() if item not in (None, [], {}, ())}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if isinstance(value, bool | int | float | str) else str(value)
