# SPDX-License-Identifier: Apache-2.0
"""Membrane energies of triangles: St. Venant-Kirchhoff and Baraff-Witkin."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...scene.assets import Floats, Ints, Mesh
from ...scene.fabrics import Fabric
from ...scene.mesh.topology import NO_AREA, SLIVER
from ..operators import SparseOperator


def rest_frames(mesh: Mesh) -> tuple[Floats, Floats]:
    """Return the inverse rest shape matrices (F, 2, 2) [1/m] and areas (F,) [m2] of the triangles.

    The second in-plane axis (warp) points up, or along x in horizontal triangles. StVK is isotropic; Baraff-Witkin is
    not, so the axes must not depend on the order of the corners.

    Raises:
        SsilkError: a triangle has no area.
    """
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    first, second = b - a, c - a
    normal = np.cross(first, second)
    doubled = np.linalg.norm(normal, axis=1)
    flat = int(np.count_nonzero(doubled <= NO_AREA * np.maximum(_longest_squared(mesh), 1e-60) + 1e-30))
    if flat != 0:
        fail(
            mesh.path,
            f"{flat} of {len(mesh.faces)} triangles have no area",
            "each triangle needs one",
            "merge or dissolve the degenerate faces",
        )
    normal = normal / doubled[:, None]
    along = np.where(np.abs(normal[:, 1:2]) < 0.99, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    u = np.cross(along, normal)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    (p, q), (r, s) = ([np.sum(edge * axis, axis=1) for edge in (first, second)] for axis in (u, v))
    # In closed form: LAPACK solves each of many small systems by itself, on all cores.
    adjugate = np.stack([np.stack([s, -q], axis=-1), np.stack([-r, p], axis=-1)], axis=1)
    return adjugate / (p * s - q * r)[:, None, None], doubled / 2


def stretched_areas(mesh: Mesh) -> Floats:
    """Return the area that weights the stretch of each triangle [m2], shape (F,): its own, less for slivers.

    A vertex displaced by d stretches a triangle of height h by d / h, and StVK takes the fourth power of that: a few
    accidental slivers would outweigh a whole garment. Where h < h_0 = longest edge / `SLIVER`, the area is scaled by
    (h / h_0)^3, so that for equal d the energy is at most that of a triangle of height h_0.

    Stiffer cloth counts as more of it: both stretch models are linear in their stiffness.
    """
    _, areas = rest_frames(mesh)
    return stiffened(areas * np.minimum(1.0, SLIVER * 2 * areas / _longest_squared(mesh)) ** 3, mesh, mesh.faces)


def stiffened(values: Floats, mesh: Mesh, corners: Ints) -> Floats:
    """Return energies of elements (E,) with the stiffness of the mesh at their corners (E, C).

    It is linear over each triangle; so an element has the mean of its corners.
    """
    return values if mesh.stiffness is None else values * mesh.stiffness[corners].mean(axis=1)


def _longest_squared(mesh: Mesh) -> Floats:
    corners = mesh.points[mesh.faces]
    return ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(-1).max(axis=1)


def column_weights(mesh: Mesh) -> Floats:
    """Return the weights (F, 3, 2) of each triangle's corners in both columns of its deformation gradient [1/m].

    Raises:
        SsilkError: a triangle has no area.
    """
    inverse, _ = rest_frames(mesh)
    # F = [b - a, c - a] @ inverse
    return np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)


def deformation_gradient_operator(mesh: Mesh, device: torch.device, dtype: torch.dtype) -> SparseOperator:
    """Return the operator from positions to both columns of F (3x2): rows w_u of all triangles, then w_v."""
    count = len(mesh.faces)
    return SparseOperator(
        *gradient_places(mesh),
        column_weights(mesh).transpose(2, 0, 1).reshape(-1),
        (2 * count, mesh.vertex_count),
        device,
        dtype,
    )


def gradient_places(mesh: Mesh) -> tuple[Ints, Ints]:
    """Return the rows and columns of that operator's entries: for w_u, then for w_v, of each triangle's corners."""
    return np.repeat(np.arange(2 * len(mesh.faces)), 3), np.tile(mesh.faces.reshape(-1), 2)


def stvk_density(gradient: Tensor, mu: float | Tensor, lame_lambda: float | Tensor) -> Tensor:
    """Energy per rest area [J/m2], mu |G|^2 + lambda/2 tr(G)^2 with G = (F^T F - I)/2.

    Args:
        gradient: columns w_u, then w_v, shape (2 F, 3, N).
        mu, lame_lambda: Lame parameters [N/m], where they differ from frame to frame (N,).

    Returns:
        Shape (F, N).
    """
    w_u, w_v = gradient.chunk(2)
    g_uu = 0.5 * ((w_u * w_u).sum(1) - 1)
    g_vv = 0.5 * ((w_v * w_v).sum(1) - 1)
    g_uv = 0.5 * (w_u * w_v).sum(1)
    return mu * (g_uu**2 + g_vv**2 + 2 * g_uv**2) + 0.5 * lame_lambda * (g_uu + g_vv) ** 2


def baraff_witkin_density(gradient: Tensor, stretch: float | Tensor, shear: float | Tensor) -> Tensor:
    """Energy per rest area [J/m2], k_s ((|w_u|-1)^2 + (|w_v|-1)^2) + k_sh (w_u . w_v)^2; arguments as above."""
    w_u, w_v = gradient.chunk(2)
    # The length has no gradient at zero; a floor far below any real length keeps it finite.
    length_u = (w_u * w_u).sum(1).clamp_min(1e-12).sqrt()
    length_v = (w_v * w_v).sum(1).clamp_min(1e-12).sqrt()
    return stretch * ((length_u - 1) ** 2 + (length_v - 1) ** 2) + shear * (w_u * w_v).sum(1) ** 2


def stretch_density(gradient: Tensor, fabric: Fabric, moduli: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Energy per rest area [J/m2] of the fabric's own stretch model, shape (F, N), with its own moduli or others."""
    if fabric.stretch_model == "stvk":
        return stvk_density(gradient, *(moduli or (fabric.lame_mu, fabric.lame_lambda)))
    return baraff_witkin_density(gradient, *(moduli or (fabric.stretch, fabric.shear)))
