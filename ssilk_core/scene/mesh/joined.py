# SPDX-License-Identifier: Apache-2.0
"""Meshes as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..assets import Mesh


def joined(meshes: Sequence[Mesh]) -> Mesh | None:
    """Return meshes as one, in their order; None for none."""
    if not meshes:
        return None
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)])
    return Mesh(meshes[0].path, np.concatenate([mesh.points for mesh in meshes]), faces)
