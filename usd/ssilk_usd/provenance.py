# SPDX-License-Identifier: Apache-2.0
"""Provenance that a shot holds."""

from __future__ import annotations

from typing import Any

from .read_stage import StageLike, open_stage


def read_provenance(source: StageLike) -> dict[str, Any]:
    """Return the provenance that `write_shot` stored; empty for other files.

    Raises:
        SsilkError: not a readable stage.
    """
    stage = open_stage(source)  # the layer lives only as long as its stage
    return dict(stage.GetRootLayer().customLayerData.get("ssilk", {}))
