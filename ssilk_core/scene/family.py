# SPDX-License-Identifier: Apache-2.0
"""A family of bodies: stages of one topology and one skeleton, as points of a small linear space.

A body is where its joints are bound and where its points are. Members span an affine space, in which a body is a
point: its coordinates count along the members' principal directions, from the first member, the base, which is at
zero. Along each direction the farthest member is at a distance of one. Shape keys, casts of a crowd and parameters of
a body generator are all lists of members. One space serves them all, because what a garment meets is where joints
and skin are, and not what an artist turned to bring them there. A body that is no member is projected into it, and
its distance from the space, and from the members' convex hull, is told.

Joints move and do not turn: their bind rotations are the base's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import fail
from .assets import Body, Character, Floats, Ints, Motion, Scene, Skeleton
from .assets.arrays import assign, frozen, need_finite
from .kinematics import bind_pose, local_transforms

SAME_DIRECTION = 1e-6  # of the largest principal value, up to which members do not span a direction
SAME_PLACE = 1e-4  # [m], root mean square, within which a body of a family was not moved as a whole
SAME_ROTATION = 1e-3  # between entries of bind rotations, as for bakes
SAME_BONES = 1e-3  # [m]
STORED_POINTS = 512  # of a body, in model files
MOST_DIRECTIONS = 64
STEPS = 2000  # at most, to find the nearest point of a hull; each costs a product with the members
SAME_SHARE = 1e-12


@dataclass(frozen=True, eq=False)
class BodyPlace:
    """Where a body is in the space of a family.

    Attributes:
        coordinates: of its projection, shape (K,).
        joints_off, points_off: root mean square distances from its joints and points to those of the projection [m].
        beyond: distance from the projection to the members' convex hull, in units of that from the members' mean to
            the farthest member; zero inside.
    """

    coordinates: Floats
    joints_off: float
    points_off: float
    beyond: float


@dataclass(frozen=True, eq=False)
class BodyFamily:
    """The affine space that M bodies span.

    Attributes:
        names: of the members, the base first, length M.
        members: their coordinates, the base's zero, shape (M, K).
        rows: which points of the base's merged body this knows, shape (V',).
        joints, points: of the base in the bind pose [m], shapes (J, 3) and (V', 3).
        joint_moves, point_moves: how far a unit along each direction moves these [m], shapes (K, J, 3), (K, V', 3).
        taller: how much a unit along each direction adds to the height of the hub over the lowest point, relative to
            that of the base, shape (K,).
        meshes: names of the prims of the base's body meshes, in the order in which they were merged.
        counts: how many points each of these has.
    """

    names: tuple[str, ...]
    members: Floats
    rows: Ints
    joints: Floats
    points: Floats
    joint_moves: Floats
    point_moves: Floats
    taller: Floats
    meshes: tuple[str, ...]
    counts: tuple[int, ...]

    def __post_init__(self) -> None:
        assign(self, names=tuple(self.names), rows=frozen(self.rows, np.int64))
        assign(self, meshes=tuple(self.meshes), counts=tuple(map(int, self.counts)))
        for name in ("members", "joints", "points", "joint_moves", "point_moves", "taller"):
            assign(self, **{name: frozen(getattr(self, name), np.float64)})
            need_finite(getattr(self, name), "body family", name.replace("_", " "))
        size, joints, points = self.size, len(self.joints), len(self.points)
        shapes = {
            "members": (len(self.names), size), "rows": (points,), "joints": (joints, 3), "points": (points, 3),
            "joint_moves": (size, joints, 3), "point_moves": (size, points, 3), "taller": (size,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if (found := getattr(self, name).shape) != shape:
                fail("body family", f"{name} of shape {found}", f"{shape} is needed")
        if len(self.meshes) != len(self.counts) or min(self.counts, default=0) < 1:
            found = f"meshes {', '.join(self.meshes)} of {', '.join(map(str, self.counts))} points"
            fail("body family", found, "one count for each mesh is needed")
        if not ((self.rows >= 0) & (self.rows < self.vertex_count)).all():
            fail("body family", "points that the body does not have", f"they lie in 0 to {self.vertex_count - 1}")
        if not (1 <= size <= MOST_DIRECTIONS and len(self.names) > 1):
            fail(
                "body family", f"{len(self.names)} members along {size} directions", "two members or more are needed"
            )

    def mirrored(self, signs: Floats) -> BodyFamily:
        """Return the family with some of its directions the other way round, where signs (K,) are negative."""
        moves = {name: getattr(self, name) * signs[:, None, None] for name in ("joint_moves", "point_moves")}
        return replace(self, members=self.members * signs, taller=self.taller * signs, **moves)

    @property
    def size(self) -> int:
        """The number K of directions."""
        return int(self.members.shape[-1])

    @property
    def vertex_count(self) -> int:
        """The number of points of the base's merged body."""
        return sum(self.counts)

    @classmethod
    def of(cls, characters: Sequence[Character]) -> BodyFamily:
        """Return the family of characters, the first of which is its base.

        Joints and points count alike: each group's mean square distance is one term of the metric.

        Raises:
            SsilkError: there is one alone, all are the same body, or they are no family (`authoring.bodies` says
                why).
        """
        bodies = [character.merged_body().mesh.points for character in characters]
        base = characters[0].skeleton
        if len(characters) < 2:
            fail(characters[0].path, "one body", "a family has two or more", "name further members")
        for character, points in zip(characters, bodies):
            if character.skeleton.joint_names != base.joint_names or points.shape != bodies[0].shape:
                fail(character.path, "other joints or points", "members share them", "see 'ssilk inspect --family'")
        places = np.stack([character.skeleton.bind_transforms[:, :3, 3] for character in characters])
        moved = np.concatenate([_scaled(places), _scaled(np.stack(bodies))], axis=1)
        _, values, axes = np.linalg.svd(moved - moved.mean(axis=0), full_matrices=False)
        if not values[0] > 0:
            fail(characters[1].path, f"the same body as {characters[0].path}", "members differ", "leave one out")
        kept = axes[values > SAME_DIRECTION * values[0]][:MOST_DIRECTIONS]
        along = (moved - moved[0]) @ kept.T
        # Linear algebra leaves open which way a direction goes: each goes to its farthest member, the first of these.
        reached = np.abs(along) >= (1 - SAME_DIRECTION) * np.abs(along).max(axis=0)
        signs = np.sign(along[reached.argmax(axis=0), np.arange(len(kept))])
        kept, along = kept * signs[:, None], along * signs
        farthest = np.abs(along).max(axis=0)
        moves = kept * farthest[:, None]
        joints, count = places.shape[1], bodies[0].shape[0]
        joint_moves = moves[:, : 3 * joints].reshape(-1, joints, 3) * np.sqrt(joints)
        point_moves = moves[:, 3 * joints :].reshape(-1, count, 3) * np.sqrt(count)
        lowest = int(bodies[0][:, 1].argmin())
        height = places[0, base.hub, 1] - bodies[0][lowest, 1]
        taller = (joint_moves[:, base.hub, 1] - point_moves[:, lowest, 1]) / height if height > 0 else 0 * farthest
        names = tuple(character.path for character in characters)
        rows = np.arange(count)
        meshes = [body.mesh for body in characters[0].bodies]
        return cls(
            names, along / farthest, rows, places[0], bodies[0], joint_moves, point_moves, taller,
            meshes=tuple(_leaf(mesh.path) for mesh in meshes), counts=tuple(mesh.vertex_count for mesh in meshes),
        )  # fmt: skip

    def height_ratio(self, coordinates: Floats) -> float:
        """Return the height of a body's hub over its lowest point, relative to the base's; coordinates (K,)."""
        return 1 + float(self.taller @ coordinates)

    def place(self, joints: Floats, points: Floats) -> BodyPlace:
        """Return where a body is in this space.

        Args:
            joints: where its joints are bound [m], shape (J, 3).
            points: those of its points that this family knows [m], shape (V', 3).
        """
        wanted = np.concatenate([_scaled((joints - self.joints)[None]), _scaled((points - self.points)[None])], 1)[0]
        moves = np.concatenate([_scaled(self.joint_moves), _scaled(self.point_moves)], axis=1)
        found = np.linalg.lstsq(moves.T, wanted, rcond=None)[0]
        # What rounding leaves of the base is none of its shape.
        found = np.where(np.abs(found) < SAME_DIRECTION, 0.0, found)
        joints_off, points_off = (
            float(np.sqrt(np.square(there - np.tensordot(found, each, 1)).sum(axis=1).mean()))
            for there, each in ((joints - self.joints, self.joint_moves), (points - self.points, self.point_moves))
        )
        return BodyPlace(found, joints_off, points_off, self.beyond(found))

    def place_of(self, character: Character) -> BodyPlace:
        """Return where a character with these joints and this topology is.

        Raises:
            SsilkError: it has not the body meshes of the family.
        """
        mesh = self.known_meshes(character).merged_body().mesh
        return self.place(character.skeleton.bind_transforms[:, :3, 3], mesh.points[self.rows])

    def known_meshes(self, character: Character) -> Character:
        """Return a character with those of its meshes alone that this knows: it may have been made of some.

        They are those of the same names. Where one of these is missing, as in a program that renamed it, they are all
        body meshes, if these have as many points, in their order, else those that alone have as many.

        Raises:
            SsilkError: it has them not.
        """
        named = {_leaf(each.mesh.path): each for each in (*character.stand_ins, *character.bodies)}
        found = tuple(named[name] for name in self.meshes if name in named)
        if tuple(each.mesh.vertex_count for each in found) != self.counts:
            found = character.bodies
        counts = tuple(each.mesh.vertex_count for each in found)
        if counts != self.counts and all(counts.count(each) == self.counts.count(each) == 1 for each in self.counts):
            found, counts = tuple(found[counts.index(count)] for count in self.counts), self.counts
        if counts != self.counts:
            wanted = ", ".join(f"'{name}' with {count}" for name, count in zip(self.meshes, self.counts))
            told = ", ".join(f"'{_leaf(each.mesh.path)}' with {each.mesh.vertex_count}" for each in found)
            what = f"body meshes {told} points" if told else "no body mesh"
            allowed = f"the model's family of bodies has {wanted} points"
            fail(character.path, what, allowed, "take a body of the same topology, and name its meshes so")
        return replace(character, bodies=found, stand_ins=())

    def displacement(self, joints: Floats, points: Floats) -> Floats:
        """Return by how much a body is to be moved as a whole for this family to have it best [m], shape (3,).

        It is nothing for a body that the family has where it is. Arguments are those of `place`.
        """
        there = self.place(joints, points)
        if max(there.joints_off, there.points_off) < SAME_PLACE:
            return np.zeros(3)
        axes = np.eye(3)[:, None]
        wanted, moves = (
            np.concatenate([_scaled(of_joints), _scaled(of_points)], axis=1)
            for of_joints, of_points in (
                ((joints - self.joints)[None], (points - self.points)[None]),
                (
                    np.concatenate([self.joint_moves, np.repeat(axes, len(self.joints), axis=1)]),
                    np.concatenate([self.point_moves, np.repeat(axes, len(self.points), axis=1)]),
                ),
            )
        )
        return -np.linalg.lstsq(moves.T, wanted[0], rcond=None)[0][self.size :]

    def nearest_member(self, coordinates: Floats) -> tuple[str, float]:
        """Return the name of the member whose body is nearest, and how far its points are off on average [m].

        Args:
            coordinates: of a body, shape (K,).
        """
        off = np.tensordot(coordinates - self.members, self.point_moves, 1)
        away = np.linalg.norm(off, axis=-1).mean(axis=-1)
        return self.names[int(away.argmin())], float(away.min())

    def beyond(self, coordinates: Floats) -> float:
        """Return how far coordinates (K,) are beyond the members, as `BodyPlace.beyond`."""
        apart = float(np.linalg.norm(self.nearest(coordinates) - coordinates))
        spread = float(np.linalg.norm(self.members - self.members.mean(axis=0), axis=1).max())
        return apart / spread if apart > SAME_DIRECTION * spread else 0.0

    def nearest(self, coordinates: Floats) -> Floats:
        """Return the point of the members' convex hull that is nearest to coordinates (K,).

        By accelerated projected gradients on the members' shares (Beck and Teboulle 2009).
        """
        shares = np.full(len(self.members), 1 / len(self.members))
        gram, pull = self.members @ self.members.T, self.members @ coordinates
        step = 1 / np.linalg.eigvalsh(gram)[-1]
        ahead, momentum = shares, 1.0
        for _ in range(STEPS):
            new = _onto_simplex(ahead - step * (gram @ ahead - pull))
            if np.abs(new - ahead).max() < SAME_SHARE:
                return new @ self.members  # a step leaves what is nearest where it is
            faster = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            ahead = new + (momentum - 1) / faster * (new - shares)
            shares, momentum = new, faster
        return shares @ self.members

    def skeleton_at(self, skeleton: Skeleton, coordinates: Floats) -> Skeleton:
        """Return the base's skeleton as it is bound at coordinates (K,)."""
        return with_joints(skeleton, self.joints + np.tensordot(coordinates, self.joint_moves, 1))

    def body_at(self, body: Body, coordinates: Floats) -> Body:
        """Return the base's merged body at coordinates (K,); this family knows all its points."""
        points = body.mesh.points + np.tensordot(coordinates, self.point_moves, 1)
        return replace(body, mesh=replace(body.mesh, points=points))

    def stored(self) -> BodyFamily:
        """Return the family with few of its points, spread over the body, as model files hold it."""
        chosen = spread_points(self.points, STORED_POINTS)
        return replace(
            self, rows=self.rows[chosen], points=self.points[chosen], point_moves=self.point_moves[:, chosen]
        )


def with_joints(skeleton: Skeleton, joints: Floats) -> Skeleton:
    """Return a skeleton whose joints are bound elsewhere [m], shape (J, 3); its rest pose moves along."""
    if np.array_equal(joints, skeleton.bind_transforms[:, :3, 3]):
        return skeleton
    binds = np.array(skeleton.bind_transforms)
    binds[:, :3, 3] = joints
    before, after = (local_transforms(each, skeleton.parents) for each in (skeleton.bind_transforms, binds))
    rest = np.array(skeleton.rest_transforms)
    rest[:, :3, 3] += after[:, :3, 3] - before[:, :3, 3]
    return replace(skeleton, bind_transforms=binds, rest_transforms=rest)


def turned_joint(base: Skeleton, other: Skeleton) -> tuple[int, float] | None:
    """Return the joint whose bind rotations differ most, and by which angle [degrees]; None where none differs."""
    turned = np.swapaxes(base.bind_transforms[:, :3, :3], -1, -2) @ other.bind_transforms[:, :3, :3]
    if np.abs(turned - np.eye(3)).max() < SAME_ROTATION:
        return None
    cosine = (np.trace(turned, axis1=-2, axis2=-1) - 1) / 2
    angles = np.degrees(np.arccos(cosine.clip(-1, 1)))
    return int(angles.argmax()), float(angles.max())


def has_bones(motion: Motion, skeleton: Skeleton) -> bool:
    """Return whether the joints of a motion are between the bones of a skeleton, but for what moves it as a whole."""
    others = np.setdiff1d(np.arange(skeleton.joint_count), skeleton.hub_path)
    apart = np.abs(motion.translations - bind_pose(skeleton)[1])[:, others]
    return bool(apart.max(initial=0.0) < SAME_BONES)


def motion_on(motion: Motion, base: Skeleton, other: Skeleton, ratio: float) -> Motion:
    """Return a motion of the base as another body of its family moves: joints turn alike, between its own bones.

    What moves the character as a whole, which is the hub and all above it, grows with `ratio`, so that feet that
    stood on the ground stand there.

    Args:
        ratio: height of the hub over the ground, relative to the base's.
    """
    before, after = bind_pose(base)[1], bind_pose(other)[1]
    grows = np.ones((base.joint_count, 1))
    grows[list(base.hub_path)] = ratio
    return replace(motion, translations=after + grows * (motion.translations - before))


@dataclass(frozen=True, eq=False)
class DressedFamily:
    """A family of bodies, and where a garment lies on each of them in the bind pose.

    Attributes:
        bodies: the family.
        cloth_moves: how far a unit along each direction moves the garment's vertices [m], shape (K, V, 3).
        proxy_moves: likewise of its proxies, shape (K, P, 3).
    """

    bodies: BodyFamily
    cloth_moves: Floats
    proxy_moves: Floats

    def __post_init__(self) -> None:
        for name in ("cloth_moves", "proxy_moves"):
            values = frozen(getattr(self, name), np.float64)
            assign(self, **{name: values})
            need_finite(values, "body family", name.replace("_", " "))
            if not (values.ndim == 3 and len(values) == self.bodies.size and values.shape[2] == 3):
                fail("body family", f"{name} of shape {values.shape}", f"({self.bodies.size}, N, 3) is needed")

    @classmethod
    def of(cls, bodies: BodyFamily, dressed: Sequence[Scene]) -> DressedFamily:
        """Return a garment as it lies on the members, the base first: exactly where they span M - 1 directions."""
        inverse = np.linalg.pinv(bodies.members)
        cloth = np.stack([scene.garment.mesh.points - dressed[0].garment.mesh.points for scene in dressed])
        proxies = np.stack(
            [(each.rig.bind_transforms - dressed[0].rig.bind_transforms)[:, :3, 3] for each in dressed]
        )
        return cls(bodies, np.tensordot(inverse, cloth, 1), np.tensordot(inverse, proxies, 1))

    def along(self, other: DressedFamily) -> DressedFamily:
        """Return this with its directions the way round that another of the same bodies has them.

        Model files of earlier versions have them as linear algebra left them.
        """
        if self.bodies.joint_moves.shape != other.bodies.joint_moves.shape:
            return self
        signs = np.where((self.bodies.members * other.bodies.members).sum(axis=0) < 0, -1.0, 1.0)
        moves = {name: getattr(self, name) * signs[:, None, None] for name in ("cloth_moves", "proxy_moves")}
        return replace(self, bodies=self.bodies.mirrored(signs), **moves)

    def stored(self) -> DressedFamily:
        """Return the family as model files hold it."""
        return replace(self, bodies=self.bodies.stored())

    def scene_at(self, scene: Scene, coordinates: Floats) -> Scene:
        """Return the base's scene at coordinates (K,), its garment sewn as it is there.

        Bodies that the scene has must be known whole.
        """
        if not np.any(coordinates):
            return scene
        character = scene.character
        skeleton = self.bodies.skeleton_at(character.skeleton, coordinates)
        bodies = (self.bodies.body_at(character.merged_body(), coordinates),) if character.bodies else ()
        mesh, rig = scene.garment.mesh, scene.rig
        points = mesh.points + np.tensordot(coordinates, self.cloth_moves, 1)
        binds = np.array(rig.bind_transforms)
        binds[:, :3, 3] += np.tensordot(coordinates, self.proxy_moves, 1)
        return Scene(
            replace(character, skeleton=skeleton, bodies=bodies, stand_ins=()),
            replace(scene.garment, mesh=replace(mesh, points=points), sewn=scene.garment.sewn_mesh.points),
            replace(rig, bind_transforms=binds),
        )


def names_of(character: Character) -> set[str]:
    """Return the names of the prims of a character's meshes."""
    return {_leaf(each.mesh.path) for each in (*character.stand_ins, *character.bodies)}


def _leaf(path: str) -> str:
    return path.rpartition("/")[2]


def spread_points(points: Floats, count: int) -> Ints:
    """Return up to `count` of some points (V, 3), each the farthest from those before it, sorted."""
    if len(points) <= count:
        return np.arange(len(points))
    chosen = [0]
    apart = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.sort(chosen)


def _scaled(places: Floats) -> Floats:
    """Return places (M, N, 3) as rows whose squared length is the mean square of the N places, shape (M, 3 N)."""
    return places.reshape(len(places), -1) / np.sqrt(places.shape[1])


def _onto_simplex(values: Floats) -> Floats:
    """Return the nearest shares that are not negative and sum to one, shape (M,)."""
    ordered = np.sort(values)[::-1]
    excess = (np.cumsum(ordered) - 1) / np.arange(1, len(values) + 1)
    return np.maximum(values - excess[np.flatnonzero(ordered > excess)[-1]], 0)
