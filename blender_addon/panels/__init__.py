# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels in the sidebar of 3D views; they only draw what other modules find.

Open `base.py` first: what all panels share. `CLASSES` is the order of the sidebar.
"""

from __future__ import annotations

from .classes import ClassesPanel
from .garment import FabricPanel, GarmentPanel, TryOnPanel
from .playback import BakingPanel, HeldProxyPanel, PlaybackPanel, PlayedFabricPanel
from .preflight import FindingList, PreflightPanel
from .quality import QualityPanel
from .rig import RigPanel
from .training import EnergiesPanel, MotionList, TrainingPanel

CLASSES = (
    FindingList,
    MotionList,
    GarmentPanel,
    FabricPanel,
    TryOnPanel,
    PreflightPanel,
    ClassesPanel,
    RigPanel,
    TrainingPanel,
    EnergiesPanel,
    BakingPanel,
    HeldProxyPanel,
    PlaybackPanel,
    PlayedFabricPanel,
    QualityPanel,
)  # in the order of the sidebar
