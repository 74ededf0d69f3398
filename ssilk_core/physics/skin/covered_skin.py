# SPDX-License-Identifier: Apache-2.0
"""The skin that a garment covers in the bind pose, and where it shows through the cloth.

Points are spread evenly over the body. A point is covered when cloth lies within `COVER_REACH` above it, along the
normal of its triangle, in the bind pose. A covered point shows when cloth lies within `SHOW_DEPTH` beneath it and
none within `COVER_REACH` above it. The share of vertices inside the body counts cloth; this share counts what is
seen. A covered point is bare when neither is within reach: cloth that was thrown off, or swings away as a skirt may,
shows nothing, and neither does a leg that has left its dress. So the one share is never told without the other.
Skin that is not covered, such as hands, can be on either side. What is counted of it is the limbs that pierce the
cloth (`pierced`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Scene, SkinWeights
from ..collision import limb_axes
from ..collision.limb_axes import LimbPoser
from ..collision.pierced import Piercing
from ..samples import vertex_samples
from ..skinning import Skinning
from .covered_points import SKIN_POINTS, CoveredPoints, SkinStates
from .figures import ShownSkin

NAMED_REGIONS = 3


@dataclass(frozen=True, eq=False)
class ShownCounts:
    """How much of the covered skin shows in frames of one clip; on the CPU.

    Attributes:
        shares, bare: shares of the covered points that show, and that are bare, in each frame, both of shape (N,).
        points: frames in which each covered point shows, shape (P,).
        frames: numbers of the frames in the clip, or their time codes, shape (N,).
        pierced: which limbs pierce the cloth in each frame, bool (L, N); None where nothing is known.
    """

    shares: Tensor
    bare: Tensor
    points: Tensor
    frames: Tensor
    pierced: Tensor | None = None

    @classmethod
    def of(cls, states: SkinStates, frames: Sequence[float] | None = None) -> ShownCounts:
        """Return the counts of a clip, from the states (P, N) in `frames`, by default the first N."""
        shares, bare = (found.double().mean(0).cpu() for found in (states.shows, states.bare))
        numbers = torch.arange(len(shares)) if frames is None else torch.from_numpy(np.asarray(frames))
        pierced = None if states.pierced is None else states.pierced.cpu()
        return cls(shares, bare, states.shows.sum(1).cpu(), numbers, pierced)

    @property
    def pierced_share(self) -> float | None:
        """Share of the frames in which any limb pierces the cloth; None where nothing is known."""
        return None if self.pierced is None else float(self.pierced.any(0).double().mean())

    @classmethod
    def joined(cls, parts: Sequence[ShownCounts]) -> ShownCounts:
        """Return the counts of several parts together."""
        pierced = [part.pierced for part in parts if part.pierced is not None]
        return cls(
            torch.cat([part.shares for part in parts]),
            torch.cat([part.bare for part in parts]),
            torch.stack([part.points for part in parts]).sum(0),
            torch.cat([part.frames for part in parts]),
            torch.cat(pierced, dim=1) if len(pierced) == len(parts) else None,
        )


class CoveredSkin:
    """The skin of a character that a garment covers in the bind pose.

    Attributes:
        points: evenly spread ones.
        regions: the joint with the largest skinning weight at each point, shape (P,).
        joint_names: names of the character's joints.
        limbs: the joint at the tip of each limb that loose cloth must not cross, shape (L,).
    """

    def __init__(self, scene: Scene, *, count: int = SKIN_POINTS, device: torch.device) -> None:
        merged = scene.character.merged_body()
        body, skin = merged.mesh, merged.skin
        self.points = CoveredPoints(body, scene.garment.mesh, count=count, device=device)
        self.joint_names = scene.character.skeleton.joint_names
        corners, vertices = body.faces[self.points.faces], self.points.vertices
        influence = np.zeros((len(corners), len(self.joint_names)))
        shares = skin.weights[corners] * self.points.weights[..., None]
        np.add.at(influence, (np.arange(len(corners))[:, None, None], skin.indices[corners]), shares)
        self.regions = influence.argmax(axis=1)
        self._skinning = None
        if len(vertices):
            moved = SkinWeights(skin.path, skin.indices[vertices], skin.weights[vertices])
            self._skinning = Skinning(moved).to(device)
        self._rest = torch.as_tensor(body.points[vertices], dtype=torch.float32, device=device)
        axes = limb_axes(scene)
        self.limbs = axes.tips if axes else np.zeros(0, dtype=int)
        self._poser = LimbPoser(axes, merged, device) if axes else None
        samples = vertex_samples(scene.garment.mesh.vertex_count)
        self._piercing = Piercing(scene, samples, device=device) if axes else None

    def __len__(self) -> int:
        return len(self.points)

    @torch.no_grad()
    def states(self, x: Tensor, character: Tensor, body: Tensor | None = None) -> SkinStates:
        """Tell what shows, what is bare and what pierces; all shows in a frame where the cloth is not finite.

        Args:
            x: garment positions [m], shape (V, 3, N).
            character: skinning matrices of the character's joints in the same frames, shape (J, 3, 4, N).
            body: its points at `points.vertices` [m], shape (C, 3, N); as the matrices pose them by default.
        """
        if self._skinning is None:
            return SkinStates(*torch.zeros(2, 0, x.shape[2], dtype=torch.bool, device=x.device))
        if body is None:
            body = self._skinning(self._rest, None, self._skinning.weights, character)
        found = self.points.states(x, body)
        pierced = torch.zeros(0, x.shape[2], dtype=torch.bool, device=x.device)
        if self._piercing and self._poser:
            pierced = self._piercing.find(x, self._poser.pose(character)).radius > 0
        return replace(found, pierced=pierced)

    def figures(self, clips: Sequence[tuple[str, ShownCounts]]) -> ShownSkin | None:
        """Return the figures of clips by name; None where the garment covers nothing.

        Raises:
            ValueError: there is no frame.
        """
        found = shown_skin(clips, self._regions)
        together = ShownCounts.joined([counts for _, counts in clips])
        if found is None or together.pierced is None:
            return found
        shares = together.pierced.double().mean(1).tolist()
        limbs = sorted(zip(shares, self.limbs.tolist()), key=lambda each: -each[0])
        return replace(
            found,
            pierced=together.pierced_share,
            limbs={self._name(joint): share for share, joint in limbs[:NAMED_REGIONS] if share},
        )

    def _name(self, joint: int) -> str:
        return self.joint_names[joint].rpartition("/")[2]

    def _regions(self, shown_frames: Tensor) -> dict[str, float]:
        """Return the shares of what shows at the joints with the largest ones."""
        shown = np.bincount(self.regions, shown_frames.numpy(), len(self.joint_names))
        largest = Counter(dict(enumerate(shown.tolist()))).most_common(NAMED_REGIONS)
        return {self._name(joint): n / float(shown.sum()) for joint, n in largest if n}


def shown_skin(
    clips: Sequence[tuple[str, ShownCounts]], regions: Callable[[Tensor], dict[str, float]] = lambda points: {}
) -> ShownSkin | None:
    """Return the figures of clips by name; None where nothing is covered.

    Args:
        regions: tells where, from how often each point shows, shape (P,).

    Raises:
        ValueError: there is no frame.
    """
    together = ShownCounts.joined([counts for _, counts in clips])
    if not len(together.points):
        return None
    clip, worst = max(clips, key=lambda each: float(each[1].shares.max()))
    return ShownSkin(
        frames=len(together.shares),
        covered=len(together.points),
        mean=float(together.shares.mean()),
        worst=float(worst.shares.max()),
        bare=float(together.bare.mean()),
        worst_bare=float(together.bare.max()),
        clip=clip,
        frame=worst.frames[worst.shares.argmax()].item(),
        regions=regions(together.points),
    )
