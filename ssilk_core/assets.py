# SPDX-License-Identifier: Apache-2.0
"""The world as arrays: skeleton, character, garment, proxy rig, motion, and the scene they make.

Every class is a frozen dataclass, validated when built; arrays are made read-only. Conventions, everywhere
inside the core: metres, y up, gravity along -y, column vectors (``x_world = T @ x_joint``), quaternions as
(w, x, y, z), triangles counter-clockwise seen from outside. Readers convert to this, writers convert back.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .errors import need

PINNED, TIGHT, LOOSE = 0, 1, 2
CLASS_NAMES = ("pinned", "tight", "loose")
UP = np.array([0.0, 1.0, 0.0])

Floats = NDArray[np.floating]
Ints = NDArray[np.integer]


def _frozen(array: object, dtype: type) -> NDArray:
    copy: NDArray = np.array(array, dtype=dtype, order="C")
    copy.flags.writeable = False
    return copy


def _set(instance: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def _need_finite(array: NDArray, where: str, what: str) -> None:
    bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
    need(
        len(bad) == 0,
        where,
        f"{len(bad)} of {len(array)} {what} hold NaN or infinity, first number {bad[0] if len(bad) else 0}",
        "all must be finite",
        "repair or re-export the source",
    )


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of a character, parents before children.

    Attributes:
        path: where it was read, for messages.
        joint_names: UsdSkel joint paths ("Hips/Spine"), length J.
        parents: index of each joint's parent, -1 for roots, shape (J,).
        bind_transforms: joint to world at the bind pose, rigid, shape (J, 4, 4).
        rest_transforms: joint to parent at rest (world for roots), rigid, shape (J, 4, 4).
    """

    path: str
    joint_names: tuple[str, ...]
    parents: Ints
    bind_transforms: Floats
    rest_transforms: Floats

    def __post_init__(self) -> None:
        count = len(self.joint_names)
        need(count > 0, self.path, "the skeleton has no joints", "at least one is needed")
        need(len(set(self.joint_names)) == count, self.path, "joint names repeat", "each joint needs its own name")
        _set(
            self,
            joint_names=tuple(self.joint_names),
            parents=_frozen(self.parents, np.int32),
            bind_transforms=_frozen(self.bind_transforms, np.float64),
            rest_transforms=_frozen(self.rest_transforms, np.float64),
        )
        need(
            self.parents.shape == (count,),
            self.path,
            f"{len(self.parents)} parents for {count} joints",
            "one parent for each joint is needed",
        )
        bad = np.flatnonzero((self.parents >= np.arange(count)) | (self.parents < -1))
        need(
            bad.size == 0,
            self.path,
            f"joint '{self.joint_names[bad[0]] if bad.size else ''}' stands before its parent",
            "parents come first and a joint is never its own ancestor",
            "reorder the joints",
        )
        check_rigid(self.bind_transforms, self.path, "bind transform", self.joint_names)
        check_rigid(self.rest_transforms, self.path, "rest transform", self.joint_names)

    @property
    def joint_count(self) -> int:
        return len(self.joint_names)


def check_rigid(transforms: Floats, where: str, what: str, names: tuple[str, ...]) -> None:
    """Raise `SsilkError` unless every (4, 4) matrix is a proper rotation and a translation (to 1e-3)."""
    need(
        transforms.shape == (len(names), 4, 4),
        where,
        f"{what}s of shape {transforms.shape}",
        f"({len(names)}, 4, 4) is needed, one matrix for each joint",
    )
    _need_finite(transforms, where, f"{what}s")
    linear = transforms[:, :3, :3]
    error = np.abs(linear @ linear.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((error > 1e-3) | (np.linalg.det(linear) < 0))
    need(
        bad.size == 0,
        where,
        f"the {what} of joint '{names[bad[0]] if bad.size else ''}' scales, shears or mirrors",
        "joints may rotate and move only",
        "apply the scale to the rig and export again",
    )


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """Sparse skinning weights: `indices` (V, I) into the joints, `weights` (V, I), rows sum to one."""

    path: str
    indices: Ints
    weights: Floats

    def __post_init__(self) -> None:
        _set(self, indices=_frozen(self.indices, np.int32), weights=_frozen(self.weights, np.float64))
        need(
            self.indices.ndim == 2 and self.indices.shape == self.weights.shape,
            self.path,
            f"joint indices of shape {self.indices.shape} and weights of shape {self.weights.shape}",
            "both need the shape (vertices, influences)",
        )
        _need_finite(self.weights, self.path, "weight rows")
        negative = int(np.count_nonzero(self.weights < 0))
        need(
            negative == 0,
            self.path,
            f"{negative} skinning weights are negative",
            "weights lie in [0, 1]",
            "normalise the weights and export again",
        )
        sums = self.weights.sum(axis=1)
        empty = int(np.count_nonzero(sums <= 1e-8))
        need(
            empty == 0,
            self.path,
            f"{empty} vertices have no skinning weight",
            "each vertex needs at least one",
            "bind or paint these vertices, or leave the weights out so that they are transferred from the body",
        )
        _set(self, weights=_frozen(self.weights / sums[:, None], np.float64))

    @property
    def vertex_count(self) -> int:
        return len(self.indices)

    def check_joints(self, joint_count: int) -> None:
        """Raise `SsilkError` when an index points past the joints."""
        bad = int(np.count_nonzero((self.indices < 0) | (self.indices >= joint_count)))
        need(
            bad == 0,
            self.path,
            f"{bad} joint indices lie outside 0 to {joint_count - 1}",
            "an index names a joint of the skeleton",
            "bind the mesh again",
        )

    def dense(self, joint_count: int) -> Floats:
        """Return the weights as a dense float64 matrix, shape (vertices, joints)."""
        matrix = np.zeros((self.vertex_count, joint_count))
        np.add.at(matrix, (np.arange(self.vertex_count)[:, None], self.indices), self.weights)
        return matrix

    @classmethod
    def from_dense(cls, path: str, matrix: Floats, influences: int | None = None) -> SkinWeights:
        """Keep the `influences` largest weights of each row (default: as many as any row uses)."""
        used = int((matrix > 0).sum(axis=1).max())
        count = max(1, min(influences or used, used))
        order = np.argsort(-matrix, axis=1, kind="stable")[:, :count]
        kept = np.take_along_axis(matrix, order, axis=1)
        return cls(path, np.where(kept > 0, order, 0), kept)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh at the bind pose, in world space.

    Attributes:
        path: prim path (and file), for messages and for writing back.
        points: positions [m], shape (V, 3).
        faces: triangles, shape (F, 3).
        polygon_counts, polygon_indices: the faces as they were authored (n-gons), for writing back;
            the triangles themselves when left out.
        uvs: texture coordinates per polygon corner, shape (len(polygon_indices), 2), or None.
    """

    path: str
    points: Floats
    faces: Ints
    polygon_counts: Ints | None = None
    polygon_indices: Ints | None = None
    uvs: Floats | None = None

    def __post_init__(self) -> None:
        points, faces = _frozen(self.points, np.float64), _frozen(self.faces, np.int64)
        need(
            points.ndim == 2 and points.shape[-1] == 3 and len(points) > 0,
            self.path,
            "the mesh has no points",
            "a mesh needs points and faces",
        )
        need(
            faces.ndim == 2 and faces.shape[-1] == 3 and len(faces) > 0,
            self.path,
            "the mesh has no faces",
            "a mesh needs points and faces",
        )
        _need_finite(points, self.path, "points")
        bad = int(np.count_nonzero((faces < 0) | (faces >= len(points))))
        need(
            bad == 0,
            self.path,
            f"{bad} face indices lie outside 0 to {len(points) - 1}",
            "an index names a point of the mesh",
            "re-export the mesh",
        )
        counts = np.full(len(faces), 3) if self.polygon_counts is None else self.polygon_counts
        indices = faces.reshape(-1) if self.polygon_indices is None else self.polygon_indices
        uvs = None if self.uvs is None else _frozen(self.uvs, np.float32)
        _set(
            self,
            points=points,
            faces=faces,
            polygon_counts=_frozen(counts, np.int32),
            polygon_indices=_frozen(indices, np.int32),
            uvs=uvs,
        )
        corners = self.indices_of_corners
        need(
            np.sum(counts) == len(corners) and bool(((corners >= 0) & (corners < len(points))).all()),
            self.path,
            "the polygons do not fit their points",
            f"counts that add up to {len(corners)} corners, and indices from 0 to {len(points) - 1}, are needed",
            "re-export the mesh",
        )
        need(
            uvs is None or uvs.shape == (len(corners), 2),
            self.path,
            "texture coordinates do not match the face corners",
            "one (u, v) for each corner is needed",
        )

    @property
    def indices_of_corners(self) -> Ints:
        assert self.polygon_indices is not None
        return self.polygon_indices

    @property
    def vertex_count(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh that a skeleton deforms and garments collide with."""

    mesh: Mesh
    skin: SkinWeights

    def __post_init__(self) -> None:
        need(
            self.skin.vertex_count == self.mesh.vertex_count,
            self.mesh.path,
            f"{self.skin.vertex_count} weight rows for {self.mesh.vertex_count} points",
            "one row for each point is needed",
            "bind the mesh again",
        )


@dataclass(frozen=True, eq=False)
class Character:
    """A skeleton and the body meshes it deforms."""

    path: str
    skeleton: Skeleton
    bodies: tuple[Body, ...]

    def __post_init__(self) -> None:
        _set(self, bodies=tuple(self.bodies))
        for body in self.bodies:
            body.skin.check_joints(self.skeleton.joint_count)

    def merged_body(self) -> Body:
        """Return all body meshes as one, with point and face indices in their order.

        Raises:
            SsilkError: the character has no body mesh.
        """
        need(
            self.bodies,
            self.path,
            "the character has no skinned body mesh",
            "a garment collides with at least one",
            "bind a mesh to the skeleton, or name it with --body",
        )
        if len(self.bodies) == 1:
            return self.bodies[0]
        offsets = np.cumsum([0] + [body.mesh.vertex_count for body in self.bodies])
        width = max(body.skin.indices.shape[1] for body in self.bodies)

        def padded(array: NDArray) -> NDArray:
            return np.pad(array, ((0, 0), (0, width - array.shape[1])))

        mesh = Mesh(
            self.path,
            np.concatenate([body.mesh.points for body in self.bodies]),
            np.concatenate([body.mesh.faces + offset for body, offset in zip(self.bodies, offsets)]),
        )
        skin = SkinWeights(
            self.path,
            np.concatenate([padded(body.skin.indices) for body in self.bodies]),
            np.concatenate([padded(body.skin.weights) for body in self.bodies]),
        )
        return Body(mesh, skin)


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment mesh fitted to the character's bind pose.

    Attributes:
        mesh: the garment at rest; its rest shape for the energies.
        skin: weights onto the character's joints ("plain skinning"), or None when none are authored.
        classes: PINNED, TIGHT or LOOSE for each vertex, shape (V,), or None when none are authored.
    """

    mesh: Mesh
    skin: SkinWeights | None = None
    classes: Ints | None = None

    def __post_init__(self) -> None:
        count = self.mesh.vertex_count
        if self.skin is not None:
            need(
                self.skin.vertex_count == count,
                self.mesh.path,
                f"{self.skin.vertex_count} weight rows for {count} points",
                "one row for each point is needed",
            )
        if self.classes is not None:
            classes = _frozen(self.classes, np.int8)
            _set(self, classes=classes)
            need(
                classes.shape == (count,),
                self.mesh.path,
                f"{classes.size} vertex classes for {count} points",
                "primvars:ssilk:class needs one value for each point",
                "paint the classes again",
            )
            bad = int(np.count_nonzero((classes < PINNED) | (classes > LOOSE)))
            need(
                bad == 0,
                self.mesh.path,
                f"{bad} vertex classes are not 0, 1 or 2",
                "pinned is 0, tight is 1, loose is 2",
                "paint the classes again",
            )


@dataclass(frozen=True, eq=False)
class ProxyRig:
    """Proxy joints of one garment and the initial weights of the whole garment (paper, Appendix A).

    Joint indices here run over character joints first, then proxies: proxy p is joint J + p. A rig
    without proxies (P = 0) is a garment on the character's joints alone.

    Attributes:
        joint_names: UsdSkel joint paths of the proxies, length P.
        parents: combined index of each proxy's parent, shape (P,); a parent comes before its child.
        bind_transforms: proxy to world at the bind pose, rigid, shape (P, 4, 4).
        skin: initial weights of every garment vertex over the combined joints.
    """

    path: str
    joint_names: tuple[str, ...]
    parents: Ints
    bind_transforms: Floats
    skin: SkinWeights

    def __post_init__(self) -> None:
        _set(
            self,
            joint_names=tuple(self.joint_names),
            parents=_frozen(self.parents, np.int32),
            bind_transforms=_frozen(np.reshape(self.bind_transforms, (-1, 4, 4)), np.float64),
        )
        need(
            self.parents.shape == (self.proxy_count,),
            self.path,
            f"{len(self.parents)} parents for {self.proxy_count} proxy joints",
            "one for each is needed",
        )
        need(
            len(set(self.joint_names)) == self.proxy_count,
            self.path,
            "proxy joint names repeat",
            "each needs its own name",
        )
        if self.proxy_count:
            check_rigid(self.bind_transforms, self.path, "bind transform", self.joint_names)

    @property
    def proxy_count(self) -> int:
        return len(self.joint_names)


@dataclass(frozen=True, eq=False)
class Motion:
    """An animation of the character's joints at a constant rate.

    Attributes:
        path: where it was read, for messages.
        fps: frames per second [1/s].
        rotations: local joint rotations, unit quaternions (w, x, y, z), shape (F, J, 4).
        translations: local joint translations [m], shape (F, J, 3); roots are in world space.
        start: index of the first frame, counted from time zero at `fps`; it begins at `start / fps` seconds.
    """

    path: str
    fps: float
    rotations: Floats
    translations: Floats
    start: float = 0.0

    def __post_init__(self) -> None:
        rotations, translations = _frozen(self.rotations, np.float64), _frozen(self.translations, np.float64)
        need(
            np.isfinite(self.fps) and self.fps > 0,
            self.path,
            f"a rate of {self.fps} frames per second",
            "the rate must be positive",
        )
        need(
            rotations.ndim == 3 and rotations.shape[-1] == 4 and translations.shape == (*rotations.shape[:2], 3),
            self.path,
            f"rotations of shape {rotations.shape} and translations of shape {translations.shape}",
            "(frames, joints, 4) and (frames, joints, 3) are needed",
        )
        need(len(rotations) > 0, self.path, "the motion has no frames", "at least one is needed")
        _need_finite(rotations, self.path, "frames of rotations")
        _need_finite(translations, self.path, "frames of translations")
        norms = np.linalg.norm(rotations, axis=-1, keepdims=True)
        need(norms.min() > 1e-6, self.path, "a rotation is the zero quaternion", "rotations are unit quaternions")
        _set(self, rotations=_frozen(rotations / norms, np.float64), translations=translations)

    @property
    def frame_count(self) -> int:
        return len(self.rotations)

    def clip(self, start: int, stop: int) -> Motion:
        """Return frames `start` (inclusive) to `stop` (exclusive) as a motion of its own."""
        return replace(
            self,
            rotations=self.rotations[start:stop],
            translations=self.translations[start:stop],
            start=self.start + start,
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """What a model is trained on: a character, one prepared garment, and its proxy rig.

    Built once the garment has weights and classes and the rig exists; everything downstream relies on it.
    """

    character: Character
    garment: Garment
    rig: ProxyRig
    joint_names: tuple[str, ...] = field(init=False)
    parents: Ints = field(init=False)
    bind_transforms: Floats = field(init=False)

    def __post_init__(self) -> None:
        skeleton, rig, where = self.character.skeleton, self.rig, self.garment.mesh.path
        need(
            self.garment.skin is not None,
            where,
            "the garment has no skinning weights",
            "weights are needed",
            "run 'ssilk rig' on it",
        )
        need(
            self.garment.classes is not None,
            where,
            "the garment has no vertex classes",
            "classes are needed",
            "run 'ssilk rig' on it",
        )
        self.plain_skin.check_joints(skeleton.joint_count)
        total = skeleton.joint_count + rig.proxy_count
        rig.skin.check_joints(total)
        need(
            rig.skin.vertex_count == self.garment.mesh.vertex_count,
            rig.path,
            f"{rig.skin.vertex_count} rig weight rows for {self.garment.mesh.vertex_count} points",
            "one row for each point is needed",
            "generate the rig again",
        )
        late = np.flatnonzero(rig.parents >= skeleton.joint_count + np.arange(rig.proxy_count))
        need(
            late.size == 0 and (rig.parents >= 0).all(),
            rig.path,
            "a proxy joint stands before its parent or has none",
            "each proxy hangs from an earlier joint",
        )
        _set(
            self,
            joint_names=(*skeleton.joint_names, *rig.joint_names),
            parents=_frozen(np.concatenate([skeleton.parents, rig.parents]), np.int32),
            bind_transforms=_frozen(np.concatenate([skeleton.bind_transforms, rig.bind_transforms]), np.float64),
        )

    @property
    def plain_skin(self) -> SkinWeights:
        assert self.garment.skin is not None
        return self.garment.skin

    @property
    def classes(self) -> Ints:
        assert self.garment.classes is not None
        return self.garment.classes


@dataclass(frozen=True, eq=False)
class Deformer:
    """A trained garment as any UsdSkel reader sees it: rest points, blendshapes, weights (Eqs. 5 and 8).

    Attributes:
        scene: the garment, its character and its rig.
        skin: trained weights over the combined joints.
        shapes: blendshape offsets in rest space [m], shape (K, V, 3); zero rows for pinned vertices.
    """

    scene: Scene
    skin: SkinWeights
    shapes: Floats

    def __post_init__(self) -> None:
        _set(self, shapes=_frozen(self.shapes, np.float32))
        count = self.scene.garment.mesh.vertex_count
        need(
            self.shapes.ndim == 3 and self.shapes.shape[1:] == (count, 3),
            self.scene.garment.mesh.path,
            f"blendshapes of shape {self.shapes.shape}",
            f"(shapes, {count}, 3) is needed",
        )
        self.skin.check_joints(len(self.scene.joint_names))

    @property
    def shape_count(self) -> int:
        return len(self.shapes)


@dataclass(frozen=True, eq=False)
class GarmentPose:
    """Some consecutive frames of a garment: what the network says and what a shot stores (Eq. 7).

    Attributes:
        start: index of the first frame within the shot.
        rotations: local rotations of the proxies, (w, x, y, z), relative to their parents, shape (F, P, 4).
        weights: blendshape weights in [0, 1], shape (F, K).
    """

    start: int
    rotations: Floats
    weights: Floats

    def __post_init__(self) -> None:
        _set(self, rotations=_frozen(self.rotations, np.float64), weights=_frozen(self.weights, np.float32))

    @property
    def frame_count(self) -> int:
        return len(self.weights)
