# SPDX-License-Identifier: Apache-2.0
"""The part of the body that each sample of the cloth can touch.

The nearest body point does not tell which side the cloth came from. A sleeve that one bad step takes through the arm
would be pushed out on the far side and stay there. Loose cloth can touch any part of the body. Tight cloth can touch
only the patch of the body that lies beneath it in the bind pose, within `distance.TIGHT_REACH`: it is pushed back to
its own side, and is not caught where a body intersects itself, as in an armpit. Loose cloth that a limb went through
is pushed along the limb instead (`pierced`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.assets import PINNED, TIGHT, Ints, Scene
from ...scene.mesh import topology
from ...scene.mesh.blocks import compact_blocks
from .. import kernels
from ..samples import ContactSamples
from .closest_point import closest_on_faces
from .distance import MAX_DEPTH, Patches, PosedBody, nearest_planes, signed_distance_to_planes, smoothed_planes
from .limb_axes import loose_faces
from .nearest_vertex import GARMENT_BLOCK
from .patches import faces_around, patches_beneath
from .pierced import PiercedCloth, Piercing
from .smoothed_distance import SmoothedDistance

NO_CONTACT_DISTANCE = 1e6  # [m]
# What a smoothed distance may be below the Euclidean one, relative to it; and the length of a gradient below which a
# distance is no measure of how near the body is, as where a limb pierces the cloth.
SMOOTHED_BELOW, SHORT_GRADIENT = 0.02, 0.9


@dataclass(frozen=True, eq=False)
class _Group:
    """Samples that query the body in the same way: their indices, compact blocks and body patches."""

    rows: Tensor
    blocks: Tensor
    patches: Patches | None


class Contacts:
    """Finds the tangent plane of the body that each sample of the cloth can touch.

    Args:
        samples: of the garment, which are queried; S positions are expected.
        vertices: the body vertices that are posed, all by default.
        pinned: whether pinned cloth collides too. Training, which cannot move them, leaves them out.
        patches: whether tight cloth touches its patches alone; all of the body otherwise.
        limbs: as `Piercing` takes them.
    """

    def __init__(
        self,
        scene: Scene,
        samples: ContactSamples,
        *,
        vertices: Ints | None = None,
        pinned: bool = True,
        patches: bool = True,
        limbs: NDArray[np.bool_] | None = None,
        device: torch.device,
    ) -> None:
        body = scene.character.merged_body().mesh
        points, classes = samples.points(scene.garment.mesh.points), samples.classes(scene.classes)
        chosen = np.arange(body.vertex_count) if vertices is None else vertices
        tight = np.flatnonzero(classes == TIGHT)[: None if patches else 0]
        beneath = patches_beneath(points[tight], body, chosen)
        covered = beneath[:, 0] > 0
        elsewhere = np.ones(len(points), dtype=bool) if pinned else classes != PINNED
        elsewhere[tight[covered]] = False

        def tensor(values: Ints) -> Tensor:
            return torch.as_tensor(values, device=device)

        def group(rows: Ints, found: Patches | None = None) -> _Group:
            return _Group(tensor(rows), tensor(compact_blocks(points[rows], GARMENT_BLOCK)), found)

        can = len(loose_faces(scene)) > 0
        self._piercing = Piercing(scene, samples, limbs=limbs, device=device) if can else None
        self._groups = [group(np.flatnonzero(elsewhere))] if elsewhere.any() else []
        if covered.any():
            vertices = beneath[covered]
            faces = faces_around(vertices, topology.faces_among(body, chosen), len(chosen))
            self._groups.append(group(tight[covered], Patches(tensor(vertices.astype(np.int32)), tensor(faces))))

    def planes(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return unit normals (S, 3, N) and offsets (S, N) of the planes that x (S, 3, N) can touch, without
        gradients.

        Samples that can touch nothing get planes far below them. Those far from their patch get planes across the
        direction from its nearest vertex.
        """
        normal, offset = self._nearest_planes(x, body)
        if self._piercing and body.limbs:
            self._piercing.replace_planes(x, body.limbs, normal, offset)
        return normal, offset

    def _nearest_planes(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return the result of `planes` where no limb pierces the cloth."""
        normal, offset = self._query_groups(x, body, nearest_planes, no_planes)
        return normal, offset

    def pierced(self, x: Tensor, body: PosedBody) -> PiercedCloth | None:
        """Return where limbs pierce the cloth with the samples x (S, 3, N); None where none ever can."""
        if not (self._piercing and body.limbs):
            return None
        return self._piercing.find(x[: self._piercing.count].float(), body.limbs)

    def smoothed(
        self, x: Tensor, body: PosedBody, within: float = math.inf, held: PiercedCloth | None = None
    ) -> SmoothedDistance:
        """Return smoothed distances of x (S, 3, N) to the body, in the precision of x.

        Args:
            within: distances that matter outside of the body [m] (`smoothed_planes`).
            held: what limbs pierce, wherever x is; found by default.
        """

        def find(x: Tensor, body: PosedBody, blocks: Tensor, patches: Patches | None) -> Sequence[Tensor]:
            return smoothed_planes(x, body, blocks, patches, within).tensors()

        def no_contact(x: Tensor) -> Sequence[Tensor]:
            return *no_planes(x), x.new_zeros(len(x), 3, *x.shape[1:], dtype=torch.float32)

        found = SmoothedDistance(*self._query_groups(x, body, find, no_contact))
        if self._piercing and body.limbs:
            self._piercing.replace_planes(x, body.limbs, found.normal, found.offset, found.curvature, held)
        return found

    def touched(self, x: Tensor, search_radius: Tensor, body: PosedBody) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the nearest body points of samples x (S, 3, N) as `closest_on_faces` does, on what each can touch.

        Args:
            search_radius: upper bound of each distance [m], shape (S, N); negative values skip a sample.
        """
        assert body.faces is not None
        parts = []
        for group in self._groups:
            candidates = group.patches.faces if group.patches else None
            given = x.index_select(0, group.rows), search_radius.index_select(0, group.rows)
            row, *found = closest_on_faces(*given, body.points, body.faces, candidates)
            parts.append((group.rows[row], *found))
        row, frame, corners, weights = (torch.cat(part, dim=-1) for part in zip(*parts))
        return row, frame, corners, weights

    def smoothed_nearby(
        self, x: Tensor, body: PosedBody, known: SmoothedDistance, at: Tensor, within: float
    ) -> SmoothedDistance:
        """Return smoothed distances of x (S, 3, N) to a body to which those at other positions are known.

        No distance falls by more than a sample has moved, so loose cloth that was far enough away is not queried
        again. What is returned for it is some distance greater than `within`. On a processor alone this saves time.

        Args:
            known: distances of the samples at the positions `at` (S, 3, N), to the same body.
            within: distances that matter [m].
        """
        if kernels.supports(x):
            return self.smoothed(x, body)
        distance, moved = known.distance(at), (x - at).norm(dim=1)
        sure = ((1 - SMOOTHED_BELOW) * distance - moved > within) & (known.distance(x) > within)
        # What is deeper than that inside the body touches nothing, and has the distance of what is outside.
        sure &= (distance + moved < MAX_DEPTH) | (distance - moved > MAX_DEPTH)
        sure &= known.normal.square().sum(1) > SHORT_GRADIENT**2
        near = ~sure.all(1)
        found = SmoothedDistance(*(values.clone() for values in known.tensors()))
        for group in self._groups:
            chosen = near[group.rows] if group.patches is None else torch.ones_like(group.rows, dtype=torch.bool)
            rows = group.rows[chosen]
            asked = smoothed_planes(x.index_select(0, rows), body, patches=group.patches)
            for full, part in zip(found.tensors(), asked.tensors()):
                full.index_copy_(0, rows, part)
        if self._piercing and body.limbs:
            self._piercing.replace_planes(x, body.limbs, found.normal, found.offset, found.curvature)
        return found

    def _query_groups(
        self,
        x: Tensor,
        body: PosedBody,
        find: Callable[..., Sequence[Tensor]],
        no_contact: Callable[[Tensor], Sequence[Tensor]],
    ) -> Sequence[Tensor]:
        """Return the results of `find` for all groups, and of `no_contact` for other samples.

        Samples come first.
        """
        if len(self._groups) == 1 and len(self._groups[0].rows) == len(x):
            return find(x, body, self._groups[0].blocks, self._groups[0].patches)
        gathered = no_contact(x)
        for group in self._groups:
            found = find(x.index_select(0, group.rows), body, group.blocks, group.patches)
            for full, part in zip(gathered, found, strict=True):
                full.index_copy_(0, group.rows, part)
        return gathered

    def distances(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return signed distances of x (S, 3, N) [m] to nearest planes and to the whole body, both (S, N).

        Where a limb pierces the cloth they are those to the skin: `CoveredSkin` counts such limbs.
        """
        planes = signed_distance_to_planes(x, *self._nearest_planes(x, body))
        nearest = planes.clone()
        for group in self._groups:
            if group.patches is not None:
                part = x.index_select(0, group.rows)
                nearest.index_copy_(
                    0, group.rows, signed_distance_to_planes(part, *nearest_planes(part, body, group.blocks))
                )
        return planes, nearest


def no_planes(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return planes that no sample of x (S, 3, N) touches."""
    return x.new_zeros(x.shape), x.new_full((len(x), x.shape[2]), -NO_CONTACT_DISTANCE)
