# SPDX-License-Identifier: Apache-2.0
"""Fit blendshape weights and proxies to garment vertices: mass-weighted least squares for each frame.

Levenberg-Marquardt [Marquardt 1963] on what a shot stores, several frames at once: blendshape weights, rotations of
proxies, and their translations where the poses to start from have any. Rotating a proxy by a small w about its
position c moves a vertex by w x (q - W c), where W is the sum of the vertex's weights of the proxy and its
descendants, and q the sum of its positions under each, weighted alike. Moving the proxy by t moves the vertex by W t.
A step is accepted only where it reduces a frame's error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ..assets import PINNED, Deformer, Floats, GarmentPose, Ints, Motion
from ..kinematics import (
    combined_transforms,
    hub_places,
    local_transforms,
    matrix_from_quaternion,
    quaternion_from_matrix,
    skinning_matrices,
)

MAX_STEPS = 25
MIN_GAIN = 1e-3  # relative reduction of a frame's squared error below which its fit stops
DAMPING = 1e-4, 1e-9, 1e3  # relative to the mean diagonal: initial, minimum, and where the fit of a frame stops
# Of proxies at their places at rest: 30 mm of all cost as much as a millimetre of all vertices. Each frame is fitted
# by itself, and without it proxies jump from frame to frame, which is seen between frames.
STIFFNESS = 1e-3
FRAMES_PER_BLOCK = 16  # frames; the Jacobian of one takes 4 MB for 2,700 vertices, 64 shapes and 20 proxies


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Fitted poses of consecutive frames and their errors.

    Attributes:
        rms: RMS distance to the target vertices, weighted by mass [m], shape (F,).
        largest: largest distance of any vertex [m], shape (F,).
    """

    pose: GarmentPose
    rms: Floats
    largest: Floats


class PoseFitter:
    """Fits poses of one garment.

    Args:
        mass: of the vertices [kg], shape (V,).
        vertices: those that are fitted; None for all that are not pinned.
        lower, upper: bounds of the blendshape weights, shape (K,), equal where a weight is constant; by default all
            weights lie in [0, 1], and the last blendshape, which recentres all others, keeps its weight of one.
        steps: most iterations for a frame.
        device: where the linear algebra runs.
    """

    def __init__(
        self,
        deformer: Deformer,
        mass: Floats,
        *,
        vertices: Ints | None = None,
        lower: Floats | None = None,
        upper: Floats | None = None,
        steps: int = MAX_STEPS,
        device: torch.device | str = "cpu",
    ) -> None:
        scene, skin = deformer.scene, deformer.skin
        self.deformer, self.steps, self.device = deformer, steps, torch.device(device)
        self.lower = model_bounds(deformer.shape_count)[0] if lower is None else lower
        self.upper = model_bounds(deformer.shape_count)[1] if upper is None else upper
        self.moving = np.flatnonzero(self.lower < self.upper)
        self.joints, self.proxies = scene.character.skeleton.joint_count, scene.rig.proxy_count
        self.free = np.flatnonzero(scene.classes != PINNED) if vertices is None else vertices
        self.above = scene.rig.parents.tolist()
        self.places = local_transforms(scene.bind_transforms, scene.parents)[self.joints :, :3, 3]
        self.indices = self._tensor(skin.indices[self.free], torch.int64)
        self.weights = self._tensor(skin.weights[self.free])
        self.rest = self._tensor(scene.garment.mesh.points[self.free])
        self.shapes = self._tensor(deformer.shapes[:, self.free])
        self.share = self._tensor(mass[self.free] / mass.sum())[:, None]
        self.below = self._tensor(_below(scene.parents, self.joints))[self.indices]  # (V, I, P)
        self.bound = torch.einsum("vip,vi->vp", self.below, self.weights)

    def _tensor(self, values: np.ndarray, dtype: torch.dtype = torch.float64) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype, device=self.device)

    def fit(self, motion: Motion, poses: Iterable[GarmentPose], vertices: Iterable[Floats]) -> Iterator[PoseFit]:
        """Yield fits, one block of frames at a time.

        Args:
            motion: of the character over the whole shot.
            poses: consecutive frames to start from.
            vertices: target of each of these frames in world space [m], shape (V, 3).
        """
        wanted = iter(vertices)
        for pose in poses:
            for at in range(0, pose.frame_count, FRAMES_PER_BLOCK):
                part = slice(at, at + FRAMES_PER_BLOCK)
                some = pose.part(part)
                yield self.fit_block(motion, some, np.stack([next(wanted) for _ in range(some.frame_count)]))

    def fit_block(self, motion: Motion, pose: GarmentPose, vertices: Floats) -> PoseFit:
        """Return the fit of a few frames to vertices in world space [m], shape (F, V, 3)."""
        where = f"frames {pose.start} to {pose.start + pose.frame_count - 1}"
        if not np.isfinite(vertices).all():
            fail(where, "NaN or infinity among the vertices", "all must be finite")
        skeleton = self.deformer.scene.character.skeleton
        places = hub_places(skeleton, motion.rotations, motion.translations)[:, None]
        about = motion.translations.copy()
        about[:, skeleton.parents < 0] -= places
        root = places[pose.start : pose.start + pose.frame_count]
        about_hub = replace(motion, translations=about)
        search = _Search(self, about_hub, pose, self._tensor((vertices - root)[:, self.free]))
        for _ in range(self.steps):
            if not search.advance():
                break
        return search.found()


def model_bounds(shapes: int) -> tuple[Floats, Floats]:
    """Return the bounds of a trained model's blendshape weights, the last of which is constant, shape (shapes,)."""
    upper = np.ones(shapes)
    return np.where(np.arange(shapes) == shapes - 1, 1.0, 0.0), upper


def _below(parents: np.ndarray, joints: int) -> Floats:
    """Return which combined joints rotate with each proxy: itself and its descendants, shape (J + P, P)."""
    turning = np.zeros((len(parents), len(parents) - joints))
    for joint in range(joints, len(parents)):
        turning[joint, joint - joints] = 1
        if parents[joint] >= joints:
            turning[joint] += turning[parents[joint]]
    return turning


@dataclass(frozen=True, eq=False)
class _Posed:
    """The garment in a pose, for F frames.

    Attributes:
        world: joint to world, all combined joints, shape (F, J + P, 4, 4).
        blended: blended linear parts of the skinning matrices, shape (F, V, 3, 3).
        moved: weighted position of a vertex under each influence, shape (F, V, I, 3).
        away: target minus posed vertices, shape (F, V, 3).
        error: mean squared distance, weighted by mass [m2], shape (F,).
        cost: what is minimised, the error and `STIFFNESS` times the proxies' mean squared distance from rest [m2].
    """

    world: Tensor
    blended: Tensor
    moved: Tensor
    away: Tensor
    error: Tensor
    cost: Tensor


class _Search:
    """The iterative fit of a block of frames.

    Its unknowns are M weights, then rotations about the world's axes, then translations along these [m] if any: N.
    """

    def __init__(self, fitter: PoseFitter, motion: Motion, pose: GarmentPose, wanted: Tensor) -> None:
        self.fitter, self.motion, self.pose, self.wanted = fitter, motion, pose, wanted
        self.unknowns = len(fitter.moving) + (3 if pose.translations is None else 6) * fitter.proxies
        self.posed = self._at(pose)
        self.damping = torch.full_like(self.posed.cost, DAMPING[0])
        self.active = torch.ones_like(self.posed.cost, dtype=torch.bool)

    def _at(self, pose: GarmentPose) -> _Posed:
        fitter = self.fitter
        world = combined_transforms(fitter.deformer, self.motion, pose)
        matrices = fitter._tensor(skinning_matrices(world, fitter.deformer.scene.bind_transforms)[:, :, :3])
        points = fitter.rest + torch.einsum("fk,kvc->fvc", fitter._tensor(pose.weights), fitter.shapes)
        each = matrices[:, fitter.indices] * fitter.weights[..., None, None]
        moved = (each[..., :3] @ points[:, :, None, :, None])[..., 0] + each[..., 3]
        away = self.wanted - moved.sum(2)
        error = (fitter.share * away**2).sum((1, 2))
        cost = error if pose.translations is None else error + STIFFNESS * (self._strayed(pose) ** 2).sum(2).mean(1)
        return _Posed(fitter._tensor(world), each[..., :3].sum(2), moved, away, error, cost)

    def _strayed(self, pose: GarmentPose) -> Tensor:
        """Return where proxies are from their places at rest, in their parents' axes [m], shape (F, P, 3)."""
        assert pose.translations is not None
        return self.fitter._tensor(pose.translations - self.fitter.places)

    def advance(self) -> bool:
        """Make one step; return whether any frame can still improve."""
        trial = self._stepped(self._step())
        posed, before = self._at(trial), self.posed
        nearer = (posed.cost < before.cost) & self.active
        gain = 1 - posed.cost / before.cost.clamp_min(torch.finfo(before.cost.dtype).tiny)
        self.damping = torch.where(nearer, self.damping / 10, self.damping * 10).clamp_min(DAMPING[1])
        self.active &= torch.where(nearer, gain > MIN_GAIN, self.damping < DAMPING[2])
        self._accept(nearer, trial, posed)
        return bool(self.active.any())

    def _accept(self, nearer: Tensor, pose: GarmentPose, posed: _Posed) -> None:
        def chosen(new: Tensor, old: Tensor) -> Tensor:
            return torch.where(nearer.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        def stored(new: Floats, old: Floats | None) -> Floats:
            assert old is not None
            return np.where(rows.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        rows, own = nearer.cpu().numpy(), self.pose
        self.pose = GarmentPose(
            own.start,
            stored(pose.rotations, own.rotations),
            stored(pose.weights, own.weights),
            None if pose.translations is None else stored(pose.translations, own.translations),
        )
        self.posed = _Posed(*(chosen(new, old) for new, old in zip(vars(posed).values(), vars(self.posed).values())))

    def _step(self) -> Tensor:
        """Return changes of the unknowns, shape (F, N)."""
        fitter, posed = self.fitter, self.posed
        root = fitter.share.sqrt()[..., None]
        jacobian = (root * self._jacobian()).float().flatten(1, 2)
        residual = (root[..., 0] * posed.away).float().flatten(1)
        slope = (jacobian.transpose(1, 2) @ residual[..., None]).double()
        stuck = self._stuck(slope[..., 0])
        normal = (jacobian.transpose(1, 2) @ jacobian).double()
        if self.pose.translations is not None:
            moves, stiffness = slice(-3 * fitter.proxies, None), STIFFNESS / fitter.proxies
            above = posed.world[:, fitter.above, :3, :3]
            slope[:, moves] -= stiffness * (above @ self._strayed(self.pose)[..., None]).flatten(1)[..., None]
            normal.diagonal(dim1=1, dim2=2)[:, moves] += stiffness
        normal = normal * ~(stuck[:, :, None] | stuck[:, None])
        slope = slope.masked_fill(stuck[..., None], 0)
        diagonal = normal.diagonal(dim1=1, dim2=2)
        scale = diagonal.mean(1, keepdim=True).clamp_min(1e-30)
        normal = normal + torch.diag_embed(self.damping[:, None] * (diagonal + scale) + stuck * scale)
        return torch.linalg.solve(normal, slope)[..., 0]

    def _jacobian(self) -> Tensor:
        """Return derivatives of the vertices, shape (F, V, 3, N)."""
        fitter, posed = self.fitter, self.posed
        by_weight = torch.einsum("fvij,kvj->fvik", posed.blended, fitter.shapes[fitter.moving])
        centre = posed.world[:, fitter.joints :, :3, 3]
        q = torch.einsum("vip,fvic->fvpc", fitter.below, posed.moved)
        x, y, z = (q - fitter.bound[..., None] * centre[:, None]).unbind(-1)
        zero = torch.zeros_like(x)
        turns = [torch.stack(axis, dim=2) for axis in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
        by_turn = torch.stack(turns, dim=-1).flatten(3)
        if self.pose.translations is None:
            return torch.cat([by_weight, by_turn], dim=-1)
        along = torch.eye(3, dtype=q.dtype, device=q.device)
        by_move = torch.einsum("vp,cd->vcpd", fitter.bound, along).flatten(2)
        return torch.cat([by_weight, by_turn, by_move.expand(len(q), -1, -1, -1)], dim=-1)

    def _stuck(self, slope: Tensor) -> Tensor:
        """Return which unknowns are weights at an active bound of their range, shape (F, N)."""
        fitter, moving = self.fitter, self.fitter.moving
        weights, slope = fitter._tensor(self.pose.weights[:, moving]), slope[:, : len(moving)]
        low, high = (fitter._tensor(bound[moving]) for bound in (fitter.lower, fitter.upper))
        ends = ((weights <= low) & (slope < 0)) | ((weights >= high) & (slope > 0))
        return torch.cat([ends, ends.new_zeros(len(ends), self.unknowns - len(moving))], dim=1)

    def _stepped(self, step: Tensor) -> GarmentPose:
        """Return the pose after a step."""
        fitter, pose = self.fitter, self.pose
        moving, shapes = fitter.moving, len(fitter.moving)
        weights = pose.weights.copy()
        moved = weights[:, moving] + step[:, :shapes].cpu().numpy()
        weights[:, moving] = moved.clip(fitter.lower[moving], fitter.upper[moving])
        unknown = step[:, shapes:].reshape(len(step), -1, 3)  # a vector of each proxy's turn, then of each one's move
        turn = torch.matrix_exp(_cross(unknown[:, : fitter.proxies])).cpu().numpy()
        above = self.posed.world[:, fitter.above, :3, :3].cpu().numpy()
        back = np.swapaxes(above, -1, -2)
        turned = quaternion_from_matrix(back @ turn @ above @ matrix_from_quaternion(pose.rotations))
        if pose.translations is None:
            return GarmentPose(pose.start, turned, weights)
        moved = (back @ unknown[:, fitter.proxies :, :, None].cpu().numpy())[..., 0]
        return GarmentPose(pose.start, turned, weights, pose.translations + moved)

    def found(self) -> PoseFit:
        """Return the current poses."""
        distance = self.posed.away.norm(dim=2).amax(1)
        return PoseFit(self.pose, self.posed.error.sqrt().cpu().numpy(), distance.cpu().numpy())


def _cross(vectors: Tensor) -> Tensor:
    """Return the matrices whose products are cross products with vectors (..., 3), shape (..., 3, 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*x.shape, 3, 3)
