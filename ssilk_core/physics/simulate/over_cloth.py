# SPDX-License-Identifier: Apache-2.0
"""The incremental potential of a garment that is worn over others, which move by themselves.

Contact pushes the garment alone: where the inner ones are is given with the inputs of each step. It begins as contact
with the body does, from the outer face of the inner cloth on (`collision.inner_cloth`). The outside of the inner
cloth is known from the bind pose. So cloth that starts beneath it comes out, other than in contact on both sides
(`self_contact`), whose sides are those of a start. Forces of the body and of each garment beneath add up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Scene
from ...scene.fabrics import Fabric
from ..collision import SmoothedDistance
from ..collision.contacts import no_planes
from ..collision.inner_cloth import InnerCloth, InnerSurface, PosedBeneath
from ..collision.sampled_cloth import SampledCloth
from ..samples import ContactSamples
from .hessian import Hessian
from .incremental_potential import IncrementalPotential, StepInputs


class OverPotential(IncrementalPotential):
    """The incremental potential of a garment over others; positions are (V, 3, N).

    Samples that meet a garment beneath come once more after those that meet the body, for each of these garments.

    Attributes:
        beneath: what can be touched of each.

    Args:
        surfaces: of the garments beneath.
    """

    def __init__(
        self,
        scene: Scene,
        fabric: Fabric,
        surfaces: Sequence[InnerSurface],
        *,
        device: torch.device,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__(scene, fabric, device=device, dtype=dtype)
        own, shares = self.cloth.samples, self.cloth.stiffness
        every = np.ones(len(scene.classes), dtype=bool)
        self.beneath = [
            InnerCloth(
                scene, own, each.mesh, each.thickness, np.ones(each.mesh.vertex_count, dtype=bool), every,
                device=device,
            )
            for each in surfaces
        ]  # fmt: skip
        rows = np.concatenate([np.arange(len(own.area)), *(cloth.rows.cpu().numpy() for cloth in self.beneath)])
        more = ContactSamples(own.vertex_count, own.corners[rows], own.weights[rows], own.area[rows])
        self.cloth = SampledCloth(more, device, dtype, None if shares is None else shares[rows])
        known = self._hessian
        free = self.free.cpu().numpy()
        self.use(Hessian(known.membrane, known.hinges, more, free, known.stitching))

    def posed(self, points: Sequence[Floats], root: Tensor) -> PosedBeneath:
        """Return the garments beneath where all their vertices are at points in the world [m].

        Args:
            points: of each garment, float64, shape (W, 3, N).
            root: origin of the positions in the world [m], shape (3, N).
        """
        parts = []
        for cloth, whole in zip(self.beneath, points, strict=True):
            at = torch.as_tensor(whole, device=root.device)[cloth.vertices] - root
            parts.append(cloth.posed(at.float()))
        return PosedBeneath(tuple(parts))

    def body_distance(self, x: Tensor, inputs: StepInputs, allowance: float = math.inf) -> SmoothedDistance | None:
        """Return the distances of the samples of x to the body and to what is beneath, to second order."""
        return self._with_beneath(x, inputs, super().body_distance(x, inputs, allowance), allowance)

    def body_distance_nearby(
        self, x: Tensor, inputs: StepInputs, known: SmoothedDistance | None, at: Tensor
    ) -> SmoothedDistance | None:
        """Return distances where those at other positions are known, as that of one garment does."""
        own = known and SmoothedDistance(*(values[: self.sample_count] for values in known.tensors()))
        return self._with_beneath(x, inputs, super().body_distance_nearby(x, inputs, own, at), 0.0)

    def _with_beneath(
        self, x: Tensor, inputs: StepInputs, own: SmoothedDistance | None, allowance: float
    ) -> SmoothedDistance | None:
        """Return distances to the body, and to what is beneath after them."""
        if own is None or len(own.offset) > self.sample_count:  # the latter are of both
            return own
        samples, parts, first = self.cloth.positions(x), [own.tensors()], self.sample_count
        for number, cloth in enumerate(self.beneath):
            rows = samples[first : first + len(cloth)]
            first += len(cloth)
            if inputs.beneath is None:
                parts.append([*no_planes(rows), rows.new_zeros(len(rows), 3, *rows.shape[1:], dtype=torch.float32)])
            else:
                within = self.law.start + allowance
                parts.append(cloth.smoothed(rows, inputs.beneath.parts[number], within).tensors())
        return SmoothedDistance(*(torch.cat(values) for values in zip(*parts, strict=True)))
