# SPDX-License-Identifier: Apache-2.0
"""How far a shot shows a character's meshes from where its motion moves those of the character's stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Character, Floats, Garment, Ints, Mesh, Motion, ProxyRig, SkinWeights
from ssilk_core.scene.assets.body_shape import shaped

from ..opening.stage import PRIMS, column_matrix, value, world_matrix
from ..opening.times import change_times
from ..units import StageUnits
from .clips import spread
from .posed import SkinnedMesh, posed_mesh, skinning_of
from .same_meshes import faces_of
from .skin import match_joints
from .spaces import SkelSource, similarity_scale

SAME = 1e-3  # of a mesh's size, by which its points may differ unseen
LOOKED_AT = 16  # times at which points are compared, of each kind


@dataclass(frozen=True)
class Off:
    """How far points of a mesh are from where its character has them.

    Attributes:
        metres: at most; None where these are other points, and not in the same places.
        code: time code at which this was found; None where it is at rest.
    """

    metres: float | None
    code: float | None = None

    def __str__(self) -> str:
        if self.metres is None:
            return "with other points"
        size = f"{1000 * self.metres:.3g}" if self.metres < 1 else f"{1000 * self.metres:.0f}"
        at = "" if self.code is None else f" at time code {self.code:g}"
        return f"by up to {size} mm{at}"


@dataclass(frozen=True, eq=False)
class _Met:
    """A mesh at rest, with its weights over the character's joints, then over the joints of `rig`, if any.

    `body` is its index among bodies and stand-ins; -1 where it is none.
    """

    mesh: Mesh
    skin: SkinWeights
    rig: ProxyRig | None = None
    body: int = -1


class Compared:
    """Meshes as a motion's joints move those of the character, beside the meshes that its own stage shows."""

    def __init__(
        self, character: Character, garment: Garment | None, rig: ProxyRig | None, motion: Motion, there: SkelSource
    ) -> None:
        self.met = {
            _prim_path(body.mesh): _Met(body.mesh, body.skin, body=number)
            for number, body in enumerate((*character.bodies, *character.stand_ins))
        }
        if garment is not None and rig is not None:
            self.met[_prim_path(garment.mesh)] = _Met(garment.mesh, rig.skin, rig)
        elif garment is not None and garment.skin is not None:
            self.met[_prim_path(garment.mesh)] = _Met(garment.mesh, garment.skin)
        self.motion, self.skeleton, self.there = motion, character.skeleton, there
        self.skinned = skinning_of(there.stage)
        cache = UsdSkel.Cache()
        cache.Populate(UsdSkel.Root(there.root), PRIMS)
        self.query = cache.GetSkelQuery(UsdSkel.Skeleton(there.prim))

    def meets(self, own: Usd.Prim) -> bool:
        """Return whether a character's own mesh is a body that cloth meets, or a garment that joints move."""
        return str(own.GetPath()) in self.met

    def off(self, own: Usd.Prim, other: Usd.Prim) -> Off | None:
        """Return how far points of a mesh that is met are from where the motion has them; None if nobody sees it."""
        if not value(other, "points"):
            return Off(None)
        met, shown = self.met[str(own.GetPath())], posed_mesh(other, self.skinned)
        codes = self._codes(shown)
        at = np.array(codes) * self.motion.fps / self.there.stage.GetTimeCodesPerSecond() - self.motion.start
        frames = np.clip(at.round().astype(int), 0, self.motion.frame_count - 1)
        unseen = SAME * float(np.ptp(met.mesh.points, axis=0).max(initial=0))
        found, in_order = Off(0.0, codes[0]), faces_of(own) == faces_of(other)
        for code, frame in zip(codes, frames.tolist()):
            (points,) = kinematics.skin_points(self._at_rest(met, frame), met.skin, self._matrices(met, frame, code))
            seen = self.there.units.points_to_core(shown.points(Usd.TimeCode(code), UsdGeom.XformCache(code)))
            unseen = max(unseen, 1e-6 * float(np.abs(points).max(initial=0)))  # of float32, far from the origin
            paired = len(seen) == len(points)
            away = float(np.linalg.norm(seen - points, axis=1).max(initial=0)) if paired else np.inf
            if not np.isfinite(seen).all():
                return Off(None, code)
            if away > unseen and not (paired and in_order):
                away = _nearest(points, seen)  # the same points may stand in another order
                if away > unseen and not paired:
                    return Off(None, code)
            if away > (found.metres or 0.0) * (1 + 1e-6):  # the first of several that are the same
                found = Off(away, code)
        return found if (found.metres or 0.0) > unseen else None

    def _at_rest(self, met: _Met, frame: int) -> Floats:
        """Return the points of a mesh in the bind pose as the motion shapes it in a frame [m], shape (V, 3)."""
        weights = self.motion.shape_weights
        if weights is None or met.body < 0:
            return met.mesh.points
        return shaped(met.mesh.points, self.motion.shapes, weights[frame : frame + 1], met.body)[0]

    def _matrices(self, met: _Met, frame: int, code: float) -> Floats:
        """Return what moves what each joint carries at a frame, shape (1, J + P, 4, 4)."""
        world = kinematics.motion_transforms(self.motion.clip(frame, frame + 1), self.skeleton.parents)
        binds = self.skeleton.bind_transforms
        if met.rig is not None:
            binds, parents = (
                np.concatenate([getattr(of, name) for of in (self.skeleton, met.rig)])
                for name in ("bind_transforms", "parents")
            )
            proxies = self._proxies(met.rig, kinematics.local_transforms(binds, parents), code)
            local = kinematics.local_transforms(world, self.skeleton.parents)
            world = kinematics.world_transforms(np.concatenate([local, proxies[None]], axis=1), parents)
        return kinematics.skinning_matrices(world, binds)

    def _proxies(self, rig: ProxyRig, at_rest: Floats, code: float) -> Floats:
        """Return proxies in their parents [m] as the shot poses them, at rest where it lacks them, shape (P, 4, 4).

        What is compared is the garment, however its proxies are posed.
        """
        local = np.array(at_rest[self.skeleton.joint_count :])
        posed = self.there.unscaled(column_matrix(self.query.ComputeJointSkelTransforms(Usd.TimeCode(code))))
        for proxy, joint in enumerate(match_joints(rig.joint_names, self.there.joints)):
            if joint >= 0 and self.there.parents[joint] >= 0:
                local[proxy] = np.linalg.inv(posed[self.there.parents[joint]]) @ posed[joint]
                local[proxy, :3, 3] *= self.there.joint_scale
        return local

    def _codes(self, shown: object) -> list[float]:
        """Return times at which to compare: of frames, and of blendshapes that are on most; some if many.

        Among the frames are those at which a joint is turned farthest. Samples between frames are not looked at, and
        those beyond them are.
        """
        rate = self.there.stage.GetTimeCodesPerSecond() / self.motion.fps
        frames = (self.motion.start + np.arange(self.motion.frame_count)) * rate
        chosen = [*spread(frames, LOOKED_AT), *frames[self._most_turned()]]
        if isinstance(shown, SkinnedMesh) and (weights := shown.weights_attribute()):
            times = np.array(change_times([weights]))
            whole = np.abs((times - frames[0]) / rate % 1 - 0.5) > 0.49
            # Value clips have a sample just before the frame of a cut.
            times = np.where(whole, frames[0] + ((times - frames[0]) / rate).round() * rate, times)
            times = times[(times < frames[0]) | (times > frames[-1]) | whole]
            chosen += [*spread(times, LOOKED_AT), *times[_most_on(shown, times)]]
        return sorted({float(code) for code in chosen})

    def _most_turned(self) -> Ints:
        """Return the frames at which joints are turned farthest from rest, for those that turn most."""
        rest = kinematics.quaternion_from_matrix(self.skeleton.rest_transforms[:, :3, :3])
        cosines = np.abs(np.einsum("fjc,jc->fj", self.motion.rotations, rest))
        joints = np.argsort(cosines.min(axis=0))[:LOOKED_AT]
        return np.unique(cosines[:, joints].argmin(axis=0))


def _most_on(shown: SkinnedMesh, times: Floats) -> Ints:
    """Return the rows of times at which blendshapes weigh most or least, for those that move points farthest."""
    if not len(times):
        return np.zeros(0, dtype=np.int64)
    rows = np.array([shown.weights(Usd.TimeCode(time)) for time in times.tolist()], dtype=np.float64)
    course = np.ptp(rows, axis=0) * shown.reach()
    shapes = np.argsort(-course)[:LOOKED_AT]
    shapes = shapes[course[shapes] > 0]
    return np.unique([rows[:, shapes].argmax(axis=0), rows[:, shapes].argmin(axis=0)])


def _prim_path(mesh: Mesh) -> str:
    """Return the path of the prim that a mesh was read from."""
    return "/" + mesh.path.rpartition(":/")[2]


def rest_off(own: Usd.Prim, other: Usd.Prim) -> Off | None:
    """Return how far a mesh that no joint moves is from another, each in its own space; None if nobody sees it."""
    points, seen = map(_in_metres, (own, other))
    if len(points) != len(seen):
        return Off(None)
    away = float(np.linalg.norm(points - seen, axis=1).max(initial=0))
    return Off(away) if away > SAME * float(np.ptp(points, axis=0).max(initial=0)) else None


def _in_metres(prim: Usd.Prim) -> Floats:
    """Return the points of a mesh in its own axes [m], shape (V, 3)."""
    metres = similarity_scale(world_matrix(prim)) * StageUnits.of(prim.GetStage()).meters_per_unit
    return metres * np.array(value(prim, "points") or [], dtype=np.float64).reshape(-1, 3)


def _nearest(points: Floats, others: Floats) -> float:
    """Return how far points are at most from the nearest of others; infinite without others."""
    from scipy.spatial import cKDTree

    return float(max(cKDTree(a).query(b)[0].max(initial=0) for a, b in ((points, others), (others, points))))
