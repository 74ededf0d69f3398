# SPDX-License-Identifier: Apache-2.0
"""Run all checks of the preflight, in the order in which an artist would work through them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec

import numpy as np

from ...errors import SsilkError
from ...scene.assets import Character, Garment, Mesh, Motion, ProxyRig, Scene
from ...scene.fabrics import fabric_of_surface, stiffness_words, surface_message
from ...training.settings import Preset
from ..setup.prepare import prepare_scene
from . import attachment, cost, fit, motion, pose, units, winding, worn_over
from . import mesh as meshes
from .finding import SEVERITIES, Finding, Findings
from .motion import MotionFile
from .repair import merge_targets
from .units import FileUnits

# Findings that --fix repairs by changing vertices or faces.
TOPOLOGY_FIXES = (
    "isolated-vertices", "duplicate-vertices", "duplicate-faces", "degenerate-faces", "inconsistent-winding",
    "inside-out",
)  # fmt: skip
# Errors after which automatic classes and proxies would also fail, with a less specific message.
BLOCKING = ("alignment", "character-size", "isolated-vertices", "degenerate-faces")


@dataclass(frozen=True, kw_only=True)
class PreflightInput:
    """Everything that the preflight checks.

    Attributes:
        rig: proxies authored for the garment, or None.
        character_units, garment_units: units of the character's and the garment's file; equal if they share a file.
        locked: reason why the garment's vertices and faces must not change; empty if they may.
        motions, files: the motions, and further facts about their files.
        inner: garments that it is worn over in the bind pose, by name.
        unread: what keeps the other motions from being read, in a sentence, by their files.
        preset: settings for which memory and time are estimated.
        body_ranges: least and greatest weights of shapes that are marked as parameters of the body, by their names.
    """

    character: Character
    garment: Garment
    rig: ProxyRig | None
    character_units: FileUnits
    garment_units: FileUnits
    locked: str
    motions: Sequence[Motion]
    files: Sequence[MotionFile]
    preset: Preset
    unread: Mapping[str, str] = field(default_factory=dict)
    inner: Mapping[str, Mesh] = field(default_factory=dict)
    body_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def inspect(inputs: PreflightInput) -> list[Finding]:
    """Return all findings, the most severe first."""
    found = [*_on_files(inputs), *_on_mesh(inputs), *_on_fit(inputs), *_on_motions(inputs)]
    found = [_unfixable(finding, inputs.locked) if finding.code in TOPOLOGY_FIXES else finding for finding in found]
    found += _on_scene(inputs, any(finding.severity == "error" and finding.code in BLOCKING for finding in found))
    return sorted(found, key=lambda finding: SEVERITIES.index(finding.severity))


def _unfixable(finding: Finding, locked: str) -> Finding:
    """Return a finding that the artist must fix because the mesh is `locked`."""
    reason = f"; --fix does not change the mesh because of its {locked}"
    return replace(finding, fixable=False, fix=finding.fix + reason) if locked else finding


def _on_files(inputs: PreflightInput) -> Findings:
    own = inputs.character_units == inputs.garment_units
    for file in dict.fromkeys((inputs.character_units, inputs.garment_units)):
        for finding in units.unauthored_units(file):
            yield replace(finding, fixable=file == inputs.garment_units)  # the file that --fix copies
    for finding in units.body_size(inputs.character.merged_body().mesh, inputs.character_units):
        yield replace(finding, fixable=finding.fixable and own)


def _on_mesh(inputs: PreflightInput) -> Findings:
    mesh, target = inputs.garment.mesh, merge_targets(inputs.garment, inputs.rig, inputs.character)
    merged = np.flatnonzero(np.bincount(target, minlength=len(target))[target] > 1)
    corners = target[mesh.faces]
    yield from meshes.isolated_vertices(mesh)
    yield from meshes.duplicate_vertices(mesh, merged)
    yield from meshes.duplicate_faces(mesh)
    yield from meshes.non_manifold_edges(mesh)
    yield from meshes.degenerate_faces(mesh, int((corners == np.roll(corners, 1, axis=1)).any(axis=1).sum()))
    yield from winding.inconsistent_winding(mesh)
    if surface := inputs.garment.surface:
        told = surface_message(surface, fabric_of_surface(surface))
        yield Finding(severity="info", code="fabric", prim=surface.path, found=told)
    if mesh.stiffness is not None:
        yield Finding(severity="info", code="stiffness", prim=mesh.path, found=stiffness_words(mesh))


def _on_fit(inputs: PreflightInput) -> Findings:
    mesh, body, file = inputs.garment.mesh, inputs.character.merged_body().mesh, inputs.garment_units
    yield from fit.body_holes(body)
    yield from fit.body_inside_out(body)
    yield from fit.carried_by_no_joint(inputs.character)
    free = file != inputs.character_units and file.allows(fit.find_unit_correction(mesh, body))
    misplaced = list(fit.alignment(mesh, body, fixable=free))
    yield from misplaced
    if not misplaced:  # the other checks assume that the garment is on the body
        yield from fit.penetration(mesh, body)
        yield from worn_over.layers(mesh, inputs.character, inputs.inner)
        yield from winding.inside_out(mesh, body)
        yield from meshes.two_layers(mesh)  # by millimetres: in other units any sleeve is thin
        yield from pose.rest_pose(inputs.character, mesh)


def _on_motions(inputs: PreflightInput) -> Findings:
    skeleton, preset = inputs.character.skeleton, inputs.preset
    for path, reason in inputs.unread.items():
        yield motion.unread_motion(path, reason)
    for clip in inputs.motions:
        yield from motion.root_jumps(clip, skeleton)
    for clip in inputs.motions:
        yield from motion.lying(clip, skeleton)
    for file in inputs.files:
        yield from motion.axis_by_posture(file)
    for clip in inputs.motions:
        yield from motion.joint_jumps(clip, skeleton)
    for clip in inputs.motions:
        yield from motion.joint_snaps(clip, skeleton)
    for clip in inputs.motions:
        yield from motion.short_motion(clip, skeleton, preset.model.fps, preset.train.window)
    for clip in inputs.motions:
        yield from motion.unusual_rate(clip)
    for file in inputs.files:
        yield from motion.sample_gaps(file)
    for file in inputs.files:
        yield from motion.missing_joints(file, skeleton)
    if inputs.motions:
        yield from motion.still_joints(inputs.motions, skeleton)


def _on_scene(inputs: PreflightInput, blocked: bool) -> Findings:
    """Check what needs classes and a rig; missing ones are generated as in training."""
    garment = inputs.garment
    if blocked:
        text = "classes, joints, memory and time were not checked because of the errors above"
        yield Finding(severity="info", code="not-checked", prim=garment.mesh.path, found=text)
        return
    if garment.classes is not None:
        yield from attachment.class_coverage(garment.mesh, garment.classes)
        yield from attachment.unattached_islands(garment.mesh, garment.classes)
        if any(attachment.unattached_islands(garment.mesh, garment.classes)):
            return
    try:
        scene = prepare_scene(inputs.character, garment, inputs.rig, rough=True)
    except SsilkError as error:
        yield Finding(
            severity="error",
            code="not-riggable",
            prim=garment.mesh.path,
            found=error.found or str(error),
            why=error.allowed,
            fix=error.todo,
        )
        return
    if garment.classes is None:
        yield from attachment.class_coverage(garment.mesh, scene.classes)
    yield from attachment.stitched_islands(garment.mesh, scene.classes)
    yield from attachment.touching_islands(garment.mesh, scene.classes)
    yield from _on_training(scene, inputs)


def _on_training(scene: Scene, inputs: PreflightInput) -> Findings:
    if find_spec("torch"):
        yield from motion.buried_limbs(scene, inputs.motions)
        yield from cost.training_cost(scene, inputs.motions, inputs.preset)
    else:
        text = "limbs, joints, memory and time were not checked: torch is not installed (pip install 'ssilk[train]')"
        yield Finding(severity="info", code="not-checked", prim=scene.garment.mesh.path, found=text)
