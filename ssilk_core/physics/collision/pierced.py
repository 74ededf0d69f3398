# SPDX-License-Identifier: Apache-2.0
"""Loose cloth that a limb went through: it is pushed along the limb, past its tip.

A limb that is not buried pierces the cloth where its axis (`limb_axes`) crosses it an odd number of times. Around
the crossing nearest to the tip the cloth touches no skin. With the way w that is left along the axis to the tip, its
distance to the body is

    d = -SLOPE w,

so that the force points along the bone, and its work is the energy of contact at that distance. What lies around the
crossing is decided at rest, so that the same cloth is pushed until it is past the tip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.assets import LOOSE, Scene
from .. import kernels, loops
from ..framed import Framed
from ..samples import ContactSamples
from .limb_axes import MIN_LENGTH, PosedLimbs, along_paths, loose_faces
from .ray_casting import EDGE_TOLERANCE, RayCaster

# A tenth of a metre counts as 20 mm of depth. With a quarter of that, solver iterations did not free most hands.
SLOPE = 0.2
MARGIN = 0.02  # [m] around the skin of a limb: the spacing of samples


@dataclass(frozen=True, eq=False)
class PiercedCloth(Framed):
    """Where L limbs pierce the cloth in N frames.

    Attributes:
        bone, step: the last one that is crossed, and its place on the limb's path, shape (L, N).
        point: of the garment at rest, which the crossing nearest to the tip is at [m], shape (L, 3, N).
        direction: of the bone there, towards the tip, shape (L, 3, N).
        tip: where the limb ends, along that direction from the origin [m], shape (L, N).
        radius: of the cloth around the crossing that is pushed [m]; zero where the limb does not pierce, (L, N).
    """

    bone: Tensor
    step: Tensor
    point: Tensor
    direction: Tensor
    tip: Tensor
    radius: Tensor

    @classmethod
    def of(cls, bone: Tensor, step: Tensor, point: Tensor, radius: Tensor, limbs: PosedLimbs) -> PiercedCloth:
        """Return that of crossings on posed limbs."""
        start, end = (ends.gather(0, bone[:, None].expand(-1, 3, -1)) for ends in (limbs.start, limbs.end))
        length = (end - start).norm(dim=1).clamp_min(MIN_LENGTH)
        direction = (end - start) / length[:, None]
        tip = (direction * end).sum(1) + limbs.beyond.gather(1, step)
        return cls(bone, step, point, direction, tip, radius)

    def on(self, limbs: PosedLimbs) -> PiercedCloth:
        """Return the same cloth, pierced by the same limbs in another pose; none by those that are buried in it."""
        return PiercedCloth.of(self.bone, self.step, self.point, self.radius.where(~limbs.buried, 0), limbs)


@dataclass(frozen=True, eq=False)
class PiercedOutfit(Framed):
    """That of several garments, which are posed together; None for those that no limb can pierce."""

    parts: tuple[PiercedCloth | None, ...]

    @property
    def radius(self) -> Tensor:
        """Those of all, shape (M, N)."""
        return torch.cat([part.radius for part in self.parts if part is not None])

    def on(self, limbs: PosedLimbs) -> PiercedOutfit:
        """Return the same cloth, as `PiercedCloth.on` does."""
        return PiercedOutfit(tuple(part and part.on(limbs) for part in self.parts))


class Piercing:
    """Finds where limbs pierce the loose cloth of a garment.

    Args:
        samples: of the garment, which are pushed.
        limbs: which of those that are posed must not cross this garment, bool (L,); all by default.
    """

    def __init__(
        self,
        scene: Scene,
        samples: ContactSamples,
        *,
        limbs: NDArray[np.bool_] | None = None,
        device: torch.device,
    ) -> None:
        mesh, faces = scene.garment.mesh, loose_faces(scene)
        self.count = mesh.vertex_count
        self._caster = RayCaster(replace(mesh, faces=faces), device=device)
        self._limbs = None if limbs is None else torch.as_tensor(limbs, device=device)[:, None]
        self._loose = torch.as_tensor(samples.classes(scene.classes) == LOOSE, device=device)
        self._rest, self._middles = (
            torch.tensor(points, dtype=torch.float32, device=device)
            for points in (samples.points(mesh.points), mesh.points[faces].mean(axis=1))
        )

    @torch.no_grad()
    def find(self, x: Tensor, limbs: PosedLimbs) -> PiercedCloth:
        """Return where limbs pierce the cloth with the vertices x (V, 3, N)."""
        if kernels.supports(x):
            from ..kernels.crossings import crossings_kernel

            counts, triangle = crossings_kernel(limbs.start, limbs.end, x, self._caster.faces)
        elif loops.available(x.device):
            from ..loops.crossings import crossings_loop

            counts, triangle = crossings_loop(limbs.start, limbs.end, x, self._caster.faces, EDGE_TOLERANCE)
        else:
            counts, _, triangle = self._caster.crossings(limbs.start, limbs.end, x)
        paths = limbs.paths
        counts = along_paths(counts, paths)
        pierced = (counts.sum(1) % 2 == 1) & ~limbs.buried
        if self._limbs is not None:
            pierced &= self._limbs
        place = torch.arange(1, paths.shape[1] + 1, device=x.device)[:, None]
        step = (place * (counts > 0)).amax(1).sub(1).clamp_min(0)  # the last bone of the path that is crossed
        bone = paths.gather(1, step).clamp_max(len(limbs.start) - 1)
        point = self._middles[triangle.gather(0, bone)].movedim(2, 1)
        radius = (limbs.radii[bone] + MARGIN).where(pierced, 0)
        return PiercedCloth.of(bone, step, point, radius, limbs)

    @torch.no_grad()
    def replace_planes(
        self,
        x: Tensor,
        limbs: PosedLimbs,
        normal: Tensor,
        offset: Tensor,
        curvature: Tensor | None = None,
        held: PiercedCloth | None = None,
    ) -> None:
        """Replace, in place, the planes that pierced samples of x (S, 3, N) can touch.

        Args:
            normal: (S, 3, N); offset: [m], (S, N); curvature: (S, 3, 3, N), as in `SmoothedDistance`.
            held: what is pierced, wherever x is; found by default.
        """
        pierced = self.find(x[: self.count].float(), limbs) if held is None else held
        if kernels.available(normal.device):
            from ..kernels.crossings import replace_planes_kernel

            where = pierced.point, pierced.direction, pierced.tip, pierced.radius
            replace_planes_kernel(self._rest, self._loose, where, SLOPE, normal, offset, curvature)
            return
        for point, direction, tip, radius in zip(pierced.point, pierced.direction, pierced.tip, pierced.radius):
            (frames,) = radius.nonzero(as_tuple=True)
            if not len(frames):
                continue
            apart = (self._rest[..., None] - point[:, frames]).square().sum(1)
            row, place = ((apart < radius[frames].square()) & self._loose[:, None]).nonzero(as_tuple=True)
            at = frames[place]
            normal[row, :, at] = SLOPE * direction[:, at].T.to(normal.dtype)
            offset[row, at] = SLOPE * tip[at].to(offset.dtype)
            if curvature is not None:
                curvature[row, :, :, at] = 0
