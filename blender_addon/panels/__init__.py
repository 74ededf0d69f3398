# SPDX-License-Identifier: GPL-3.0-or-later
"""What is drawn in the sidebar of 3D views, one module for each panel; what it says is found elsewhere."""

from __future__ import annotations

from .baking import BakingPanel
from .classes import ClassesPanel
from .garment import GarmentPanel
from .rig import RigPanel
from .training import TrainingPanel

CLASSES = (GarmentPanel, ClassesPanel, RigPanel, TrainingPanel, BakingPanel)  # in the order of the sidebar
