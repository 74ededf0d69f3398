# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels in the sidebar of 3D views, one module each; they only draw what other modules find."""

from __future__ import annotations

from .baking import BakingPanel
from .classes import ClassesPanel
from .fabric import FabricPanel
from .garment import GarmentPanel
from .playback import PlaybackPanel
from .preflight import FindingList, PreflightPanel
from .quality import QualityPanel
from .rig import RigPanel
from .training import EnergiesPanel, MotionList, TrainingPanel

CLASSES = (
    FindingList,
    MotionList,
    GarmentPanel,
    FabricPanel,
    PreflightPanel,
    ClassesPanel,
    RigPanel,
    TrainingPanel,
    EnergiesPanel,
    BakingPanel,
    PlaybackPanel,
    QualityPanel,
)  # in the order of the sidebar
