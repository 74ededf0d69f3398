# SPDX-License-Identifier: Apache-2.0
"""The preflight as a whole: every check, in the order in which an artist would go through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np

from ..assets import Character, Garment, Motion, ProxyRig, Scene
from ..config import Preset
from ..errors import SsilkError
from ..setup.prepare import prepare_scene
from . import cost, fit, hold, motion, pose, units, winding
from . import mesh as meshes
from .finding import SEVERITIES, Finding, Findings
from .motion import MotionFile
from .repair import merge_targets
from .units import FileUnits

# What --fix repairs by changing vertices or faces.
RESHAPING = (
    "isolated-vertices", "duplicate-vertices", "duplicate-faces", "degenerate-faces", "inconsistent-winding",
    "inside-out",
)  # fmt: skip
# With these, automatic classes and proxies would only fail in other words.
BLOCKING = ("alignment", "character-size", "isolated-vertices", "degenerate-faces")


@dataclass(frozen=True, kw_only=True)
class Inspected:
    """All that the preflight looks at.

    Attributes:
        rig: proxies authored for the garment, or None.
        stage, wardrobe: units of the character's file and of the garment's, the same where they share one.
        locked: why vertices and faces of the garment must stay as they are; empty if they may change.
        motions, files: the motions, and what their files hold beside.
        preset: the training that memory and time are estimated for.
    """

    character: Character
    garment: Garment
    rig: ProxyRig | None
    stage: FileUnits
    wardrobe: FileUnits
    locked: str
    motions: Sequence[Motion]
    files: Sequence[MotionFile]
    preset: Preset


def inspect(world: Inspected) -> list[Finding]:
    """Return everything that there is to say, the worst first."""
    found = [*_on_files(world), *_on_mesh(world), *_on_fit(world), *_on_motions(world)]
    found = [_unfixable(finding, world.locked) if finding.code in RESHAPING else finding for finding in found]
    found += _on_scene(world, any(finding.severity == "error" and finding.code in BLOCKING for finding in found))
    return sorted(found, key=lambda finding: SEVERITIES.index(finding.severity))


def _unfixable(finding: Finding, locked: str) -> Finding:
    """Return a finding as one for the artist to fix, when the mesh is `locked`."""
    reason = f"; --fix leaves the mesh alone because of its {locked}"
    return replace(finding, fixable=False, fix=finding.fix + reason) if locked else finding


def _on_files(world: Inspected) -> Findings:
    own = world.stage == world.wardrobe
    for file in dict.fromkeys((world.stage, world.wardrobe)):
        for finding in units.unauthored(file):
            yield replace(finding, fixable=file == world.wardrobe)  # the file that --fix copies
    for finding in units.body_size(world.character.merged_body().mesh, world.stage):
        yield replace(finding, fixable=finding.fixable and own)


def _on_mesh(world: Inspected) -> Findings:
    mesh, target = world.garment.mesh, merge_targets(world.garment, world.rig, world.character)
    merged = np.flatnonzero(np.bincount(target, minlength=len(target))[target] > 1)
    corners = target[mesh.faces]
    yield from meshes.isolated_vertices(mesh)
    yield from meshes.duplicate_vertices(mesh, merged)
    yield from meshes.duplicate_faces(mesh)
    yield from meshes.non_manifold_edges(mesh)
    yield from meshes.degenerate_faces(mesh, int((corners == np.roll(corners, 1, axis=1)).any(axis=1).sum()))
    yield from winding.inconsistent_winding(mesh)


def _on_fit(world: Inspected) -> Findings:
    mesh, body, file = world.garment.mesh, world.character.merged_body().mesh, world.wardrobe
    yield from fit.body_holes(body)
    yield from fit.body_inside_out(body)
    free = file != world.stage and file.open_to(fit.misplacement(mesh, body))
    misplaced = list(fit.alignment(mesh, body, fixable=free))
    yield from misplaced
    if not misplaced:  # what lies elsewhere is neither inside the body nor inside out
        yield from fit.penetration(mesh, body)
        yield from winding.inside_out(mesh, body)
        yield from pose.rest_pose(world.character, mesh)


def _on_motions(world: Inspected) -> Findings:
    skeleton, preset = world.character.skeleton, world.preset
    for clip in world.motions:
        yield from motion.root_jumps(clip)
    for clip in world.motions:
        yield from motion.joint_snaps(clip, skeleton)
    for clip in world.motions:
        yield from motion.short_motion(clip, preset.model.fps, preset.train.window)
    for clip in world.motions:
        yield from motion.unusual_rate(clip)
    for file in world.files:
        yield from motion.sample_gaps(file)
    for file in world.files:
        yield from motion.missing_joints(file, skeleton)
    if world.motions:
        yield from motion.still_joints(world.motions, skeleton)


def _on_scene(world: Inspected, blocked: bool) -> Findings:
    """Check what needs classes and a rig; these are made, as training would, where they are not authored."""
    garment = world.garment
    if blocked:
        text = "classes, joints, memory and time were not looked at, because of the errors above"
        yield Finding(severity="info", code="not-checked", prim=garment.mesh.path, found=text)
        return
    if garment.classes is not None:
        yield from hold.class_coverage(garment.mesh, garment.classes)
        yield from hold.unheld_islands(garment.mesh, garment.classes)
        if any(hold.unheld_islands(garment.mesh, garment.classes)):
            return
    try:
        scene = prepare_scene(world.character, garment, world.rig)
    except SsilkError as error:
        yield Finding(severity="error", code="not-riggable", prim=garment.mesh.path, found=str(error))
        return
    if garment.classes is None:
        yield from hold.class_coverage(garment.mesh, scene.classes)
    yield from _on_training(scene, world)


def _on_training(scene: Scene, world: Inspected) -> Findings:
    if find_spec("torch"):
        yield from cost.training_cost(scene, world.motions, world.preset)
    else:
        text = "joints, memory and time were not looked at: torch is not installed (pip install 'ssilk[train]')"
        yield Finding(severity="info", code="not-checked", prim=scene.garment.mesh.path, found=text)
