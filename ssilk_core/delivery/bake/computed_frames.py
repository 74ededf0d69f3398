# SPDX-License-Identifier: Apache-2.0
"""Frames that were computed for a rollout, and are kept in memory: refined, solved for in latents, or certified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ...scene.assets import Deformer, Floats, GarmentPose
from .looped import LoopedPoses
from .result import CertificateSummary, LatentSummary, RefinementSummary

if TYPE_CHECKING:
    from .beneath import GarmentsBeneath


@dataclass(frozen=True, eq=False)
class Refinement:
    """The refined frames of a rollout, all in memory: 65 MB for 1,000 frames of 2,700 vertices.

    Attributes:
        points: garment vertices of each frame in the world [m], shape (V, 3).
        poses: poses fitted to them with the rollout's deformer, where joints are written.
        summary: what the solver changed.
        before: the garment that the network's poses are of.
        beneath: the garments that it was refined over; None without.
    """

    points: tuple[Floats, ...]
    poses: tuple[GarmentPose, ...]
    summary: RefinementSummary
    before: Deformer
    beneath: GarmentsBeneath | None = None


@dataclass(frozen=True, eq=False)
class SolvedLatents:
    """The poses of states that were solved for in latents, all in memory: 4 MB for 1,000 frames; and how it went.

    Attributes:
        loop: the round that they are, where the shot is a loop.
    """

    poses: tuple[GarmentPose, ...]
    summary: LatentSummary
    loop: LoopedPoses | None = None


@dataclass(eq=False)
class Certificate:
    """Frames that were moved until nothing in them intersects or shows, as blendshapes of the shot's own.

    Attributes:
        poses: of all frames, with weights of these blendshapes.
        poses_before: the same without them.
        moved: frames in which they weigh something.
        deformer: the garment without them.
        work: what it was made with (`delivery.bake.certificate`).
        summary: what was found in the written file; None before.
    """

    poses: tuple[GarmentPose, ...]
    poses_before: tuple[GarmentPose, ...]
    moved: frozenset[int]
    deformer: Deformer
    work: Any
    summary: CertificateSummary | None = None
