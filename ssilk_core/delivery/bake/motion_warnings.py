# SPDX-License-Identifier: Apache-2.0
"""Warnings of a shot's motion: where it jumps, and where it changes the shape of bodies."""

from __future__ import annotations

from ...events import Message, Reporter
from ...scene.assets import Character, Motion, Skeleton
from ...scene.assets.reshaped import reshaped
from .request import BakeRequest


def warn_of_jumps(source: Motion, skeleton: Skeleton, request: BakeRequest, fps: float, report: Reporter) -> None:
    """Warn where the root or a joint jumps.

    Args:
        source: the frames of the motion that the shot shows, at their own rate.
        fps: of the shot's samples [1/s].
    """
    from ...authoring.preflight.motion import joint_jumps, root_jumps

    for found in (*root_jumps(source, skeleton), *joint_jumps(source, skeleton)):
        code = (source.start + found.indices[0]) * fps / source.fps / request.samples_per_frame
        text = f"{found.found.partition(' (first to frame')[0]} (first to time code {code:.9g})"
        report(Message(f"{found.prim}: {text}; {found.why}; {found.fix}", "warning"))


def warn_of_shapes(character: Character, motion: Motion, request: BakeRequest, report: Reporter) -> None:
    """Warn where a shot's motion changes the shape of bodies, which the network does not see."""
    if not (moved := reshaped(character, motion)):
        return
    code = (motion.start + moved[0].frame) / request.samples_per_frame
    text = f"{request.motion}: {'; '.join(map(str, moved))}, most at time code {code:.9g}"
    if request.lbs:
        report(Message(f"{text}; it is written so"))
    elif request.refine or request.latent_iterations:
        report(Message(f"{text}; the solver meets it so, and it is written so"))
    else:
        unseen = "it is written so, but the network was trained on one shape and does not see it change"
        report(Message(f"{text}; {unseen}: --refine N or --quality hero solve for it", "warning"))
