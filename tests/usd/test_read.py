# SPDX-License-Identifier: Apache-2.0
"""Characters, garments and motions from stages, with UsdSkel's own skinning as the independent reference."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from scipy.spatial.transform import Rotation
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.garment import read_garment
from ssilk_usd.reading.motion import motion_files, read_motion, read_motions
from ssilk_usd.reading.polygons import triangulate
from ssilk_usd.reading.scene import read_scene

from ssilk_core.errors import SsilkError
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Character, Mesh, Motion, Skeleton

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared character and motions are not here")

JOINTS = ("Hips", "Hips/Spine", "Hips/Spine/Head", "Hips/Leg", "Hips/Leg/Foot")
PARENTS = np.array([-1, 0, 1, 0, 3])
FRAMES = 6
TO_Y_UP = {"Y": np.eye(3), "Z": Rotation.from_euler("x", -90, degrees=True).as_matrix()}


def affine(linear: np.ndarray, translation=(0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, translation
    return matrix


def turned(axis: str, degrees: float, scale: float = 1, at=(0, 0, 0)) -> np.ndarray:
    return affine(Rotation.from_euler(axis, degrees, degrees=True).as_matrix() * scale, at)


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def without_scale(matrices: np.ndarray) -> np.ndarray:
    result = np.array(matrices)
    result[..., :3, :3] /= np.cbrt(np.linalg.det(result[..., :3, :3]))[..., None, None]
    return result


def gf(matrix: np.ndarray) -> Gf.Matrix4d:
    return Gf.Matrix4d(np.asarray(matrix).T.tolist())


class Truth:
    """A five-joint character in metres, y up, and six frames of it: what every stage below says in other words."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        places = np.array([[0, 1, 0], [0, 1.4, 0.02], [0, 1.7, 0], [0.1, 0.9, 0], [0.12, 0.1, 0.05]])
        self.bind = kinematics.rigid(Rotation.random(5, random_state=4).as_matrix(), places)
        local = kinematics.local_transforms(self.bind, PARENTS)
        turns = Rotation.from_rotvec(rng.normal(size=(FRAMES * 5, 3)) * 0.4).as_matrix().reshape(FRAMES, 5, 3, 3)
        self.local = np.repeat(local[None], FRAMES, axis=0)
        self.local[..., :3, :3] = self.local[..., :3, :3] @ turns
        self.local[:, 0, :3, 3] += np.linspace(0, 0.5, FRAMES)[:, None] * [1, 0.2, 0.5]
        self.points = rng.random((40, 3)) * [0.4, 1.8, 0.3]
        self.weights = rng.random((40, 3)).astype(np.float32)
        self.weights /= self.weights.sum(axis=1, keepdims=True)
        self.indices = rng.integers(0, 5, (40, 3))
        self.quads = np.arange(40).reshape(10, 4)


TRUTH = Truth()


@dataclass
class Recipe:
    """How `TRUTH` is put into a stage."""

    meters: float = 1.0
    up: str = "Y"
    placements: list[np.ndarray] = field(default_factory=lambda: [np.eye(4)])
    world_binds: bool = False
    geom_bind: np.ndarray = field(default_factory=lambda: np.eye(4))
    mesh_joints: tuple[str, ...] | None = None
    animation_joints: tuple[str, ...] = JOINTS
    rigid_to: int | None = None
    rest: bool = True
    scales: np.ndarray = field(default_factory=lambda: np.ones(5))  # of the joints' spaces

    @property
    def above(self) -> np.ndarray:
        return np.where(PARENTS < 0, 1.0, self.scales[PARENTS])

    @property
    def units(self) -> np.ndarray:
        return affine(TO_Y_UP[self.up] * self.meters)


def author(stage: Usd.Stage, recipe: Recipe = Recipe(), root: str = "/Hero") -> Usd.Stage:  # noqa: B008
    """Author the character of `TRUTH` with its animation at time codes 1 to 6."""
    UsdGeom.SetStageMetersPerUnit(stage, recipe.meters)
    UsdGeom.SetStageUpAxis(stage, recipe.up)
    stage.SetTimeCodesPerSecond(30)
    stage.SetFramesPerSecond(30)
    skel_root = UsdSkel.Root.Define(stage, root)
    operation = skel_root.AddTransformOp()
    for index, placement in enumerate(recipe.placements):
        time = Usd.TimeCode.Default() if len(recipe.placements) == 1 else Usd.TimeCode(index + 1)
        operation.Set(gf(placement), time)
    to_skeleton = np.linalg.inv(recipe.units @ recipe.placements[0])
    to_bind = recipe.placements[0] @ to_skeleton if recipe.world_binds else to_skeleton
    skeleton = _author_skeleton(stage, f"{root}/Rig", recipe, to_skeleton, to_bind)
    _author_animation(stage, f"{root}/Rig/Walk", recipe, to_skeleton)
    binding = UsdSkel.BindingAPI.Apply(skel_root.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([f"{root}/Rig/Walk"])
    _author_body(stage, f"{root}/Body", recipe, to_bind)
    stage.SetDefaultPrim(skel_root.GetPrim())
    return stage


def _author_skeleton(stage, path, recipe, to_skeleton, to_bind) -> UsdSkel.Skeleton:
    bind = to_bind @ without_scale_on_right(TRUTH.bind, to_skeleton)
    rest = kinematics.local_transforms(without_scale(to_skeleton @ TRUTH.bind), PARENTS)
    bind[:, :3, :3] *= recipe.scales[:, None, None]
    rest[:, :3, :3] *= (recipe.scales / recipe.above)[:, None, None]
    rest[:, :3, 3] /= recipe.above[:, None]
    skeleton = UsdSkel.Skeleton.Define(stage, path)
    skeleton.CreateJointsAttr(JOINTS)
    skeleton.CreateBindTransformsAttr([gf(matrix) for matrix in bind])
    if recipe.rest:
        skeleton.CreateRestTransformsAttr([gf(matrix) for matrix in rest])
    return skeleton


def without_scale_on_right(transforms: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """Let `similarity @ result` be free of the similarity's scale."""
    return transforms @ np.diag([*[1 / np.cbrt(np.linalg.det(similarity[:3, :3]))] * 3, 1])


def _author_animation(stage, path, recipe, to_skeleton) -> None:
    world = kinematics.world_transforms(TRUTH.local, PARENTS)
    local = kinematics.local_transforms(without_scale(to_skeleton @ world), PARENTS)
    order = [JOINTS.index(name) for name in recipe.animation_joints]
    animation = UsdSkel.Animation.Define(stage, path)
    animation.CreateJointsAttr(recipe.animation_joints)
    local[..., :3, 3] /= recipe.above[:, None]
    animation.CreateScalesAttr([Gf.Vec3h(scale) for scale in (recipe.scales / recipe.above)[order].tolist()])
    for frame, joints in enumerate(local[:, order]):
        quats = Rotation.from_matrix(joints[:, :3, :3]).as_quat()
        rotations = [Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in quats]
        animation.CreateRotationsAttr().Set(Vt.QuatfArray(rotations), frame + 1)
        animation.CreateTranslationsAttr().Set(Vt.Vec3fArray.FromNumpy(joints[:, :3, 3].astype("f4")), frame + 1)


def _author_body(stage, path, recipe, to_bind) -> None:
    points = moved(np.linalg.inv(recipe.geom_bind) @ to_bind, TRUTH.points).astype("f4")
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr([4] * 10)
    mesh.CreateFaceVertexIndicesAttr(TRUTH.quads.reshape(-1).tolist())
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateGeomBindTransformAttr(gf(recipe.geom_bind))
    if recipe.rigid_to is not None:
        binding.CreateJointIndicesPrimvar(True, 1).Set([recipe.rigid_to])
        binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
        return
    indices = TRUTH.indices
    if recipe.mesh_joints:
        binding.CreateJointsAttr(recipe.mesh_joints)
        indices = np.array([recipe.mesh_joints.index(name) for name in JOINTS])[indices]
    binding.CreateJointIndicesPrimvar(False, 3).Set(indices.reshape(-1).tolist())
    binding.CreateJointWeightsPrimvar(False, 3).Set(TRUTH.weights.reshape(-1).tolist())


def usdskel_points(stage: Usd.Stage, mesh: str, codes) -> np.ndarray:
    """World positions [m], y up, as UsdSkel alone computes them."""
    prim = stage.GetPrimAtPath(mesh)
    root = UsdSkel.Root.Find(prim)
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.TraverseInstanceProxies())
    skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    query, skinning = cache.GetSkelQuery(skeleton), cache.GetSkinningQuery(prim)
    frames = []
    for code in codes:
        points = UsdGeom.Mesh(prim).GetPointsAttr().Get(code)
        assert skinning.ComputeSkinnedPoints(query.ComputeSkinningTransforms(code), points, code)
        world = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(skeleton.GetPrim())).T
        frames.append(moved(world, np.array(points, dtype=float)))
    axes = TO_Y_UP[UsdGeom.GetStageUpAxis(stage)]
    return np.array(frames) @ axes.T * UsdGeom.GetStageMetersPerUnit(stage)


def our_points(character: Character, motion: Motion) -> np.ndarray:
    world = kinematics.motion_transforms(motion, character.skeleton.parents)
    matrices = kinematics.skinning_matrices(world, character.skeleton.bind_transforms)
    body = character.bodies[0]
    return kinematics.skin_points(body.mesh.points, body.skin, matrices)


UPRIGHT_Z = turned("x", -90)
RECIPES = {
    "metres, y up": Recipe(),
    "centimetres, z up": Recipe(meters=0.01, up="Z"),
    "inches": Recipe(meters=0.0254),
    "moved and turned": Recipe(placements=[turned("y", 70, at=(3, 0.5, -2))]),
    "moved, binds in world": Recipe(placements=[turned("y", 70, at=(3, 0.5, -2))], world_binds=True),
    "centimetres under a scale of 0.01": Recipe(placements=[turned("y", 20, 0.01, (1, 0, 0))]),
    "the same, binds in world": Recipe(placements=[turned("y", 20, 0.01, (1, 0, 0))], world_binds=True),
    "z up under a quarter turn": Recipe(placements=[UPRIGHT_Z]),
    "y up in a z-up stage": Recipe(up="Z", placements=[np.linalg.inv(UPRIGHT_Z)]),
    "animated xform": Recipe(placements=[turned("y", 9 * i, at=(0.1 * i, 0, 0)) for i in range(FRAMES)]),
    "geomBindTransform": Recipe(geom_bind=turned("z", 30, 2, (0.2, 1, 0)) @ np.diag([1, 1.5, 1, 1])),
    "mesh joints in another order": Recipe(mesh_joints=JOINTS[::-1]),
    "animation joints in another order": Recipe(animation_joints=(*JOINTS[2:], *JOINTS[:2])),
    "a mirrored leg and a larger head": Recipe(scales=np.array([1, -1, -3, -1, 1.0]), animation_joints=JOINTS[::-1]),
    "scaled joints under a scale of 0.01, binds in world": Recipe(
        placements=[turned("y", 20, 0.01, (1, 0, 0))], world_binds=True, scales=np.array([1, 1, 3, -1, -1.0])
    ),
    "one rigid influence": Recipe(rigid_to=2, geom_bind=turned("x", 40)),
}


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_skinned_points_are_those_of_usdskel(recipe):
    stage = author(Usd.Stage.CreateInMemory(), recipe)
    character = read_character(stage)
    motion = read_motion(stage, character.skeleton)
    assert (motion.fps, motion.frame_count, motion.start) == (30, FRAMES, 1)
    expected = usdskel_points(stage, "/Hero/Body", range(1, FRAMES + 1))
    np.testing.assert_allclose(our_points(character, motion), expected, atol=1e-5)


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_every_wording_of_one_character_reads_the_same(recipe):
    stage = author(Usd.Stage.CreateInMemory(), recipe)
    character = read_character(stage)
    bind, points = character.skeleton.bind_transforms, character.bodies[0].mesh.points
    # The bind pose is free to stand elsewhere, upright; what belongs together must stay together.
    there = bind[0] @ kinematics.invert_rigid(TRUTH.bind[:1])[0]
    np.testing.assert_allclose(there[1, :3], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(bind, there @ TRUTH.bind, atol=2e-6)
    np.testing.assert_allclose(points, moved(there, TRUTH.points), atol=2e-6)
    if len(recipe.placements) == 1:
        motion = read_motion(stage, character.skeleton)
        world = kinematics.world_transforms(TRUTH.local, PARENTS)
        np.testing.assert_allclose(kinematics.motion_transforms(motion, PARENTS), world, atol=2e-6)


def test_units_and_axes_alone_change_no_array():
    metres, other = (author(Usd.Stage.CreateInMemory(), recipe) for recipe in (Recipe(), Recipe(meters=0.01, up="Z")))
    a, b = read_character(metres), read_character(other)
    for name in ("bind_transforms", "rest_transforms", "parents"):
        np.testing.assert_allclose(getattr(a.skeleton, name), getattr(b.skeleton, name), atol=1e-7)
    np.testing.assert_allclose(a.bodies[0].mesh.points, b.bodies[0].mesh.points, atol=1e-6)
    p, q = read_motion(metres, a.skeleton), read_motion(other, b.skeleton)
    np.testing.assert_allclose(p.translations, q.translations, atol=1e-6)
    np.testing.assert_allclose(p.rotations, q.rotations, atol=1e-6)


def test_missing_rest_transforms_come_from_the_bind_pose():
    with_rest, without = (
        read_character(author(Usd.Stage.CreateInMemory(), Recipe(rest=rest))) for rest in (True, False)
    )
    np.testing.assert_allclose(with_rest.skeleton.rest_transforms, without.skeleton.rest_transforms, atol=1e-9)


def test_what_rounding_scales_along_a_chain_of_joints_does_not_add_up():
    stage = author(Usd.Stage.CreateInMemory())
    rest = np.array(stage.GetPrimAtPath(RIG).GetAttribute("restTransforms").Get())
    rest[:, :3, :3] *= 1 - 4.5e-4  # 1.3e-3 at the head
    stage.GetPrimAtPath(RIG).GetAttribute("restTransforms").Set([gf(matrix.T) for matrix in rest])
    found, expected = read_character(stage).skeleton, SKELETON
    assert found.scales is None
    np.testing.assert_allclose(found.bind_transforms, expected.bind_transforms, atol=1e-9)


def test_a_clip_that_stands_alone_has_the_scales_of_its_skeleton():
    plain, scaled = (
        author(Usd.Stage.CreateInMemory(), Recipe(scales=np.array(scales)))
        for scales in (np.ones(5), [1, 1, 1, -1, -1])
    )
    skeleton, own = read_character(plain).skeleton, read_character(scaled).skeleton
    expected = read_motion(plain, skeleton)
    scaled.GetPrimAtPath(RIG).RemoveProperty("skel:animationSource")
    np.testing.assert_allclose(read_motion(scaled, own).translations, expected.translations, atol=1e-6)
    with pytest.raises(SsilkError, match="2 joints are scaled otherwise than at rest, Hips/Leg first"):
        read_motion(scaled, skeleton)


def test_payload_variant_and_layer_offset_are_composed(tmp_path):
    author(Usd.Stage.CreateNew(str(tmp_path / "asset.usdc"))).Save()
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.SetTimeCodesPerSecond(30)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    prim = stage.DefinePrim("/World/Actor")
    variants = prim.GetVariantSets().AddVariantSet("take")
    for name, offset in (("early", 0), ("late", 100)):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            payload = Sdf.Payload("./asset.usdc", Sdf.Path("/Hero"), Sdf.LayerOffset(offset, 2))
            prim.GetPayloads().AddPayload(payload)
    prim.SetInstanceable(True)
    stage.Save()
    path = str(tmp_path / "shot.usda")
    character = read_character(path)
    motion = read_motion(path, character.skeleton)
    assert character.path == f"{path}:/World/Actor"
    assert (motion.start, motion.frame_count, motion.fps) == (102, 2 * FRAMES - 1, 30)
    codes = motion.start + np.arange(motion.frame_count)
    opened = Usd.Stage.Open(path)
    expected = usdskel_points(opened, "/World/Actor/Body", codes[::2])
    np.testing.assert_allclose(our_points(character, motion)[::2], expected, atol=1e-5)


def test_of_several_characters_one_is_chosen():
    stage = author(author(Usd.Stage.CreateInMemory(), root="/World/A"), root="/World/B")
    with pytest.raises(SsilkError, match=r"2 skeletons.*/World/A \(Rig\), /World/B \(Rig\).*--root"):
        read_character(stage)
    assert read_character(stage, root="B").path.endswith("/World/B")
    assert read_character(stage, root="/World/A/Rig").path.endswith("/World/A")
    for root in ("/World/A", "/World/B"):
        Sdf.CopySpec(stage.GetRootLayer(), f"{root}/Body", stage.GetRootLayer(), f"{root}/Cape")
    for root in ("B", "/World/B/Rig"):  # whose garment has the name of another character's
        assert read_scene(stage, garment="Cape", root=root)[1].mesh.path.endswith("/World/B/Cape")


def test_bodies_are_drawn_bound_meshes_that_are_no_garments():
    stage = author(Usd.Stage.CreateInMemory())
    for name in ("Hidden", "Guide", "Cape", "Dress", "Coat"):
        Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Body", stage.GetRootLayer(), f"/Hero/{name}")
    UsdGeom.Mesh.Define(stage, "/Hero/Unbound")
    UsdGeom.Imageable(stage.GetPrimAtPath("/Hero/Hidden")).MakeInvisible()
    UsdGeom.Imageable(stage.GetPrimAtPath("/Hero/Guide")).CreatePurposeAttr("guide")
    stage.GetPrimAtPath("/Hero/Cape").CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    classes = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Hero/Dress")).CreatePrimvar(
        "ssilk:class", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex
    )
    classes.Set([1.0] * 40)

    def names(**options) -> list[str]:
        return [body.mesh.path.rpartition("/")[2] for body in read_character(stage, **options).bodies]

    assert names(garment="Coat") == ["Body"]
    assert names() == ["Body", "Coat"]
    assert names(bodies=["/Hero/Hidden", "Body"]) == ["Hidden", "Body"]
    with pytest.raises(SsilkError, match=r"no mesh 'Unbound' is bound.*/Hero/Body"):
        read_character(stage, bodies=["Unbound"])


# Meshes


def polygon_area(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)) / 2)


def triangle_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return np.cross(b - a, c - a) / 2


POLYGONS = {
    "convex quad": [[0, 0], [2, 0], [2, 1], [0, 1]],
    "arrow": [[0, 0], [2, -1], [0.5, 0], [2, 1]],
    "narrow arrow": [[0, 0], [3, -0.3], [2.5, 0], [3, 0.3]],
    "arrow, started elsewhere": [[2, -1], [0.5, 0], [2, 1], [0, 0]],
    "L": [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]],
    "comb": [[0, 0], [5, 0], [5, 3], [4, 1], [3, 3], [2, 1], [1, 3], [0, 1]],
    "with a corner on an edge": [[0, 0], [1, 0], [2, 0], [2, 2], [0, 2]],
    "spiral": [[0, 0], [4, 0], [4, 4], [1, 4], [1, 2], [2, 2], [2, 3], [3, 3], [3, 1], [0, 1]],
}


@pytest.mark.parametrize("flat", POLYGONS.values(), ids=POLYGONS)
def test_polygons_are_covered_once_and_keep_their_winding(flat):
    points = np.pad(np.array(flat, dtype=float), ((0, 0), (0, 1))) @ Rotation.random(random_state=1).as_matrix()
    count = len(points)
    triangles = triangulate(points, np.array([count]), np.arange(count))
    normals = triangle_normals(points, triangles)
    normal = normals.sum(axis=0) / np.linalg.norm(normals.sum(axis=0))
    assert triangles.shape == (count - 2, 3)
    assert (normals @ normal > -1e-12).all()
    # Signed areas add up by telescoping; unsigned ones only if no triangle leaves the polygon.
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(polygon_area(points), rel=1e-12)
    newell = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    assert newell @ normal > 0


def test_mixed_polygons_stay_in_order():
    points = np.random.default_rng(0).random((12, 3))
    counts, indices = np.array([4, 3, 5]), np.arange(12)
    triangles = triangulate(points, counts, indices)
    assert [sorted(set(part.ravel())) for part in np.split(triangles, [2, 3])] == [
        [0, 1, 2, 3],
        [4, 5, 6],
        [7, 8, 9, 10, 11],
    ]


def plain_mesh(stage: Usd.Stage, path: str = "/Cape") -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4, 4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 1, 4, 5, 2])
    return mesh


SKELETON = Skeleton("s", JOINTS, PARENTS, TRUTH.bind, kinematics.local_transforms(TRUTH.bind, PARENTS))


@pytest.mark.parametrize("interpolation", ["vertex", "faceVarying"])
@pytest.mark.parametrize("left_handed", [False, True])
def test_texture_coordinates_follow_their_corners(interpolation, left_handed):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    mesh = plain_mesh(stage)
    points = np.array(mesh.GetPointsAttr().Get())
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
    st.Set(Vt.Vec2fArray.FromNumpy(points[::-1, :2].astype("f4")))
    st.SetIndices(Vt.IntArray((5 - (corners if interpolation == "faceVarying" else np.arange(6))).tolist()))
    if left_handed:
        mesh.CreateOrientationAttr("leftHanded")
    read = read_garment(stage, SKELETON).mesh
    np.testing.assert_allclose(read.uvs, points[read.polygon_indices, :2])
    side = -1 if left_handed else 1
    assert (triangle_normals(read.points, read.faces)[:, 2] * side > 0).all()


def test_holes_are_left_out():
    stage = Usd.Stage.CreateInMemory()
    plain_mesh(stage).CreateHoleIndicesAttr([0])
    mesh: Mesh = read_garment(stage, SKELETON).mesh
    assert mesh.polygon_indices.tolist() == [1, 4, 5, 2]


# Garments


def test_garment_in_its_own_file_stands_in_the_world_of_that_file():
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.Xform.Define(stage, "/Wardrobe").AddTranslateOp().Set((0, 0, 150))
    plain_mesh(stage, "/Wardrobe/Cape")
    garment = read_garment(stage, SKELETON)
    assert garment.skin is None and garment.classes is None
    np.testing.assert_allclose(garment.mesh.points[3], [0, 1.5, -0.01], atol=1e-9)


@pytest.mark.parametrize(
    "name",
    ["metres, y up", "centimetres, z up", "moved, binds in world", "the same, binds in world", "geomBindTransform"]
    + ["moved and turned", "centimetres under a scale of 0.01", "z up under a quarter turn", "y up in a z-up stage"],
)
@pytest.mark.parametrize("path", ["/Hero/Cape", "/Set/Cape"])
def test_garment_without_weights_stands_beside_the_body_it_is_fitted_to(name, path):
    stage = author(Usd.Stage.CreateInMemory(), RECIPES[name])
    body = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get())
    # In world the cape lies where the body lies in its bind pose.
    world = moved(np.linalg.inv(RECIPES[name].units), TRUTH.points)
    cape = UsdGeom.Mesh.Define(stage, path)
    above = np.array(UsdGeom.XformCache().GetParentToWorldTransform(cape.GetPrim())).T
    cape.AddTransformOp().Set(gf(turned("z", 33, 1, (0, 0.2, 0))))
    local = moved(np.linalg.inv(above @ turned("z", 33, 1, (0, 0.2, 0))), world)
    cape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(local.astype("f4")))
    cape.CreateFaceVertexCountsAttr([4] * 10)
    cape.CreateFaceVertexIndicesAttr(TRUTH.quads.reshape(-1).tolist())
    character, garment, rig = read_scene(stage, garment="Cape")
    assert rig is None and len(body) == 40
    np.testing.assert_allclose(garment.mesh.points, character.bodies[0].mesh.points, atol=2e-6)


def test_skinned_garment_brings_its_weights_by_joint_name():
    stage = author(Usd.Stage.CreateInMemory(), Recipe(mesh_joints=JOINTS[::-1], geom_bind=turned("y", 50)))
    stage.GetPrimAtPath("/Hero/Body").CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    expected = read_character(author(Usd.Stage.CreateInMemory())).bodies[0]
    garment = read_garment(stage, SKELETON)
    np.testing.assert_allclose(garment.skin.dense(5), expected.skin.dense(5), atol=1e-7)
    np.testing.assert_allclose(garment.mesh.points, TRUTH.points, atol=1e-6)


def with_classes(values, kind=Sdf.ValueTypeNames.IntArray, interpolation="vertex") -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    primvars = UsdGeom.PrimvarsAPI(plain_mesh(stage))
    primvars.CreatePrimvar("ssilk:class", kind, interpolation).Set(values)
    return stage


@pytest.mark.parametrize("kind", ["IntArray", "FloatArray", "UCharArray", "HalfArray"])
def test_classes_are_read_from_whole_numbers_of_any_type(kind):
    stage = with_classes([0, 1, 2, 2, 1, 0], getattr(Sdf.ValueTypeNames, kind))
    assert read_garment(stage, SKELETON).classes.tolist() == [0, 1, 2, 2, 1, 0]


def test_several_garments_need_a_name():
    stage = Usd.Stage.CreateInMemory()
    plain_mesh(stage, "/Shirt")
    plain_mesh(stage, "/Set/Pants")
    with pytest.raises(SsilkError, match=r"several garments: /Shirt, /Set/Pants"):
        read_garment(stage, SKELETON)
    assert read_garment(stage, SKELETON, garment="Pants").mesh.path.endswith(":/Set/Pants")
    plain_mesh(stage, "/Set/Belt")
    with pytest.raises(SsilkError, match=r"several meshes are, or lie beneath, 'Set': /Set/Pants, /Set/Belt; one is"):
        read_garment(stage, SKELETON, garment="Set")


# Motions


def clip(joints, samples: dict[float, float], *, fps: float | None = 30, codes: float = 30) -> Usd.Stage:
    """An animation whose joints turn about z by the given degrees at the given time codes."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetTimeCodesPerSecond(codes)
    if fps:
        stage.SetFramesPerSecond(fps)
    animation = UsdSkel.Animation.Define(stage, "/Clip")
    animation.CreateJointsAttr(joints)
    for code, degrees in samples.items():
        x, y, z, w = Rotation.from_euler("z", degrees, degrees=True).as_quat()
        animation.CreateRotationsAttr().Set([Gf.Quatf(w, x, y, z)] * len(joints), code)
    rest = {name: matrix[:3, 3] for name, matrix in zip(JOINTS, SKELETON.rest_transforms)}
    translations = np.array([rest.get(name, np.full(3, 0.2)) for name in joints])
    animation.CreateTranslationsAttr(Vt.Vec3fArray.FromNumpy(translations.astype("f4")))
    return stage


def degrees_of(motion: Motion) -> np.ndarray:
    return np.degrees(2 * np.arctan2(motion.rotations[:, 0, 3], motion.rotations[:, 0, 0]))


def test_sparse_and_uneven_samples_are_read_at_every_frame():
    motion = read_motion(clip(JOINTS, {10: 0, 12: 20, 17.5: 75}), SKELETON)
    assert (motion.start, motion.fps) == (10, 30)
    np.testing.assert_allclose(degrees_of(motion), np.arange(8) * 10, atol=1e-4)


@pytest.mark.parametrize(
    ("codes", "fps", "frames", "rate"), [(1, 30, 31, 30), (60, None, 2, 60), (120, 30, 1, 30), (1, 24, 25, 24)]
)
def test_frames_per_second_sets_the_rate_where_it_is_authored(codes, fps, frames, rate):
    motion = read_motion(clip(JOINTS, {0: 0, 1: 60}, codes=codes, fps=fps), SKELETON)
    assert (motion.frame_count, motion.fps) == (frames, rate)
    np.testing.assert_allclose(degrees_of(motion), np.arange(frames) * codes / rate * 60, atol=1e-4)


@pytest.mark.parametrize(("codes", "fps", "start"), [(60, 30, 60), (30, 30, 120), (24, None, 120), (1, 24, 2880)])
def test_a_motion_starts_at_its_own_time_whatever_the_time_codes(codes, fps, start):
    motion = read_motion(clip(JOINTS, {120: 0, 121: 60}, codes=codes, fps=fps), SKELETON)
    assert motion.start == start and motion.start / motion.fps == 120 / codes


def test_of_a_damaged_line_the_beginning_is_told(tmp_path):
    path = tmp_path / "long.usda"
    path.write_text('#usda 1.0\ndef "A"\n{\n    point3f[] points = [(1, 2 3)' + ", (0, 0, 0)" * 1000 + "]\n}\n")
    with pytest.raises(SsilkError, match=r"long.usda:4:.* at '3\), .*\.\.\.\); a complete .usd") as refused:
        open_stage(path)
    assert len(str(refused.value)) < 700


def test_a_single_sample_is_a_motion_of_one_frame():
    motion = read_motion(clip(JOINTS, {7: 30}), SKELETON)
    assert (motion.frame_count, motion.start) == (1, 7)


def test_frames_last_as_long_as_the_xforms_above_move():
    stage = author(Usd.Stage.CreateInMemory(), Recipe(placements=[turned("y", 9 * i) for i in range(FRAMES + 4)]))
    motion = read_motion(stage, SKELETON)
    assert (motion.start, motion.frame_count) == (1, FRAMES + 4)


def test_joints_are_matched_by_leaf_name_and_lacking_ones_rest():
    motion = read_motion(clip(("Armature/Hips", "Armature/Hips/Chest/Spine", "Leg"), {0: 0, 1: 60}), SKELETON)
    world = kinematics.rigid(kinematics.matrix_from_quaternion(motion.rotations), motion.translations)
    for joint in (2, 4):
        np.testing.assert_allclose(world[:, joint], SKELETON.rest_transforms[[joint, joint]], atol=1e-9)
    turned_by = Rotation.from_quat(motion.rotations[1][[0, 1, 3]][:, [1, 2, 3, 0]]).magnitude()
    np.testing.assert_allclose(np.degrees(turned_by), 60, atol=1e-4)


def two_clips(path: Path) -> Path:
    one, other = clip(JOINTS, {0: 0, 1: 60}), clip(JOINTS, {5: 0, 7: 60})
    Sdf.CopySpec(other.GetRootLayer(), "/Clip", one.GetRootLayer(), "/Other")
    one.GetRootLayer().Export(str(path))
    return path


def test_of_several_animations_one_is_named_with_the_file(tmp_path):
    path = two_clips(tmp_path / "two.usda")
    with pytest.raises(
        SsilkError, match=f"several animations: /Clip, /Other; one is needed; name one, such as {path}:/Clip"
    ):
        read_motion(path, SKELETON)
    motions = read_motions([f"{path}:/Other", Path(f"{path}:/Clip")], SKELETON)
    assert [(motion.path, motion.start) for motion in motions] == [(f"{path}:/Other", 5), (f"{path}:/Clip", 0)]
    assert motion_files([Path(f"{path}:/Other"), tmp_path]) == [path, path]
    (tmp_path / "link").symlink_to(tmp_path)
    again = read_motions([f"{path}:/Other", f"{path}:/Clip", f"{tmp_path}/link/two.usda:/Other"], SKELETON)
    assert [motion.path for motion in again] == [motion.path for motion in motions]
    with pytest.raises(SsilkError, match="no SkelAnimation is named '/Hat'"):
        read_motion(f"{path}:/Hat", SKELETON)


def test_motion_file_in_other_units_and_axes():
    stage = author(Usd.Stage.CreateInMemory(), Recipe(meters=0.01, up="Z"))
    alone = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(alone, 0.01)
    UsdGeom.SetStageUpAxis(alone, "Z")
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Rig/Walk", alone.GetRootLayer(), "/Walk")
    motion = read_motion(alone, SKELETON)
    world = kinematics.world_transforms(TRUTH.local, PARENTS)
    np.testing.assert_allclose(kinematics.motion_transforms(motion, PARENTS), world, atol=2e-6)


# Real data


@needs_shared
@pytest.mark.parametrize("name", ["character", "character_dense"])
def test_shared_character_moves_as_usdskel_moves_it(name, tmp_path):
    path = SHARED / "data" / f"{name}.usdc"
    clip_path = SHARED / "data" / "motions" / "cmu_backflip.usdc"
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.GetRootLayer().subLayerPaths = [str(path)]
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetTimeCodesPerSecond(60)
    stage.DefinePrim("/Motion").GetReferences().AddReference(str(clip_path))
    UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/Character/Rig")).CreateAnimationSourceRel().SetTargets(["/Motion"])
    character = read_character(path)
    motion = read_motion(clip_path, character.skeleton)
    assert (motion.frame_count, motion.fps, character.skeleton.joint_count) == (106, 60, 31)
    codes = [0, 31, 105]
    picked = Motion("", 60, motion.rotations[codes], motion.translations[codes])
    expected = usdskel_points(stage, "/Character/Body", codes)
    np.testing.assert_allclose(our_points(character, picked), expected, atol=1e-5)


@needs_shared
def test_shared_garments_and_motions_read():
    character, garment, rig = read_scene(
        SHARED / "data" / "character.usdc", garment=str(SHARED / "data" / "garments" / "tshirt.usdc:/tshirt")
    )
    assert rig is None and garment.mesh.vertex_count == 2822
    body = character.bodies[0].mesh.points
    assert (garment.mesh.points.min(axis=0) > body.min(axis=0) - 0.05).all()
    assert (garment.mesh.points.max(axis=0) < body.max(axis=0) + 0.05).all()
    motions = SHARED / "data" / "motions"
    read = read_motions([motions / "09_11.usdc", motions / "49_08a.usdc"], character.skeleton)
    assert [Path(motion.path.rpartition(":")[0]).stem for motion in read] == ["09_11", "49_08a"]


# Bad input


def broken(change) -> Usd.Stage:
    stage = author(Usd.Stage.CreateInMemory())
    change(stage)
    return stage


def set_on(path: str, name: str, value):
    return lambda stage: stage.GetPrimAtPath(path).GetAttribute(name).Set(value)


def refer(stage: Usd.Stage) -> Usd.Stage:
    """Let the stage get its character from another layer."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(stage.GetRootLayer())
    stage.GetRootLayer().Clear()
    stage.GetRootLayer().subLayerPaths.append(layer.identifier)
    stage.KEPT = layer
    return stage


NAN = float("nan")
BODY, RIG, WALK = "/Hero/Body", "/Hero/Rig", "/Hero/Rig/Walk"
BAD_CHARACTERS = {
    "no skeleton": (lambda stage: stage.RemovePrim(RIG), "no SkelRoot with a Skeleton;.*export the character"),
    "no root": (lambda stage: stage.GetPrimAtPath("/Hero").SetTypeName("Xform"), "; /Hero/Rig lies beneath none"),
    "typed over a root": (
        lambda stage: UsdGeom.Xform.Define(refer(stage), "/Hero"),
        "; /Hero refers to one and is declared as 'Xform' over it; .*declare it without a type, as in: def \"Hero\"",
    ),
    "unordered joints": (set_on(RIG, "joints", JOINTS[::-1]), "out of order"),
    "repeated joint": (set_on(RIG, "joints", ("Hips",) * 5), "'Hips' is listed twice"),
    "no joints": (set_on(RIG, "joints", []), "no joints"),
    "no binds": (lambda stage: stage.GetPrimAtPath(RIG).RemoveProperty("bindTransforms"), "no bindTransforms"),
    "few binds": (set_on(RIG, "bindTransforms", [Gf.Matrix4d(1)]), "1 bindTransforms for 5 joints"),
    "NaN bind": (set_on(RIG, "bindTransforms", [Gf.Matrix4d(NAN)] * 5), "NaN or infinity"),
    "flat bind": (set_on(RIG, "bindTransforms", [Gf.Matrix4d(0)] * 5), "cannot be inverted"),
    "scaled binds": (
        set_on(RIG, "bindTransforms", [Gf.Matrix4d(i + 1.0) for i in range(5)]),
        "scales, shears or mirrors",
    ),
    "squashed": (
        lambda stage: UsdGeom.Xformable(stage.GetPrimAtPath("/Hero")).AddScaleOp().Set((1, 2, 1)),
        "scale non-uniformly",
    ),
    "no units": (lambda stage: stage.SetMetadata("metersPerUnit", 0.0), "metersPerUnit is 0"),
    "NaN points": (set_on(BODY, "points", [(NAN, 0, 0)] * 40), "40 of 40 points hold NaN"),
    "no points": (set_on(BODY, "points", []), "120 values for 0 x 3|indices lie outside"),
    "counts and indices": (set_on(BODY, "faceVertexCounts", [4] * 9), "add up to 36 but there are 40"),
    "two corners": (set_on(BODY, "faceVertexCounts", [2] * 20), "20 faces have fewer than three corners"),
    "index beyond points": (set_on(BODY, "faceVertexIndices", [99] * 40), "40 face indices lie outside 0 to 39"),
    "few weights": (set_on(BODY, "primvars:skel:jointWeights", [1.0] * 7), "holds 7 values for 40 x 3"),
    "negative weights": (
        set_on(BODY, "primvars:skel:jointWeights", [-1.0] * 120),
        "120 skinning weights are negative",
    ),
    "no weights": (set_on(BODY, "primvars:skel:jointWeights", [0.0] * 120), "40 vertices have no skinning weight"),
    "only indices": (
        lambda stage: stage.GetPrimAtPath(BODY).RemoveProperty("primvars:skel:jointWeights"),
        "only one of",
    ),
    "index beyond joints": (
        set_on(BODY, "primvars:skel:jointIndices", [9] * 120),
        "120 joint indices lie outside 0 to 4",
    ),
    "foreign joints": (
        lambda stage: UsdSkel.BindingAPI(stage.GetPrimAtPath(BODY)).CreateJointsAttr(["a", "b", "c", "d", "e"]),
        "joint 'a', which the character's skeleton does not have",
    ),
}


@pytest.mark.parametrize(("change", "message"), BAD_CHARACTERS.values(), ids=BAD_CHARACTERS)
def test_bad_characters_give_one_sentence(change, message):
    with pytest.raises(SsilkError, match=message) as caught:
        read_character(broken(change))
    assert "\n" not in str(caught.value)


def grow_head(stage: Usd.Stage) -> None:
    for code in (1, 6):
        scales = [Gf.Vec3h(1 + 0.01 * code if name.endswith("Head") else 1) for name in JOINTS]
        stage.GetPrimAtPath(WALK).GetAttribute("scales").Set(scales, code)


def grown_at_rest() -> Usd.Stage:
    """Return a shot whose head is larger at rest and in its motion, and not in the bind pose: its points move."""
    stage = author(Usd.Stage.CreateInMemory(), Recipe(scales=np.array([1, 1, 2, 1, 1.0])))
    plain = author(Usd.Stage.CreateInMemory())  # prims live as long as it
    set_on(RIG, "bindTransforms", plain.GetPrimAtPath(RIG).GetAttribute("bindTransforms").Get())(stage)
    return stage


BAD_MOTIONS = {
    "foreign": (
        clip(("a", "b", "Hips"), {0: 0}),
        r"another skeleton: 1 of 5 joints match its 3 \(it lacks Hips/Spine",
    ),
    "no joints": (clip((), {0: 0}), "another skeleton: 0 of 5"),
    "no animation": (Usd.Stage.CreateInMemory(), "no SkelAnimation"),
    "scaled": (broken(set_on(WALK, "scales", [Gf.Vec3h(2)] * 5)), "5 joints are scaled otherwise than at rest, Hips"),
    "head that is larger at rest than bound": (grown_at_rest(), "1 joints are scaled .*, Hips/Spine/Head first"),
    "growing head": (broken(grow_head), "1 joints are scaled otherwise than at rest, Hips/Spine/Head"),
    "count": (broken(set_on(WALK, "joints", JOINTS[:4])), "rotations for 5 joints; 4 are needed"),
    "no rotations": (broken(lambda s: s.GetPrimAtPath(WALK).RemoveProperty("rotations")), "has no rotations"),
    "units": (broken(lambda s: UsdGeom.SetStageMetersPerUnit(s, 0.01)), "0.01 times as long"),
    "stray sample": (clip(JOINTS, {0: 0, 1e9: 0}), "time code 0 to 1e\\+09"),
    "far": (
        broken(lambda s: s.GetPrimAtPath(WALK).GetAttribute("translations").Set([(0, 1e30, 0)] * 5, 3)),
        "m from the origin at time code 3; at most 100000 m",
    ),
    "growing": (
        author(Usd.Stage.CreateInMemory(), Recipe(placements=[turned("y", 0, 1 + i) for i in range(FRAMES)])),
        "animate scale",
    ),
}


@pytest.mark.parametrize(("stage", "message"), BAD_MOTIONS.values(), ids=BAD_MOTIONS)
def test_bad_motions_give_one_sentence(stage, message):
    with pytest.raises(SsilkError, match=message) as caught:
        read_motion(stage, SKELETON)
    assert "\n" not in str(caught.value)


def test_broken_values_in_a_sample_are_found():
    stage = author(Usd.Stage.CreateInMemory())
    stage.GetPrimAtPath(WALK).GetAttribute("translations").Set([(NAN, 0, 0)] * 5, 3)
    with pytest.raises(SsilkError, match="translations hold NaN"):
        read_motion(stage, SKELETON)
    stage = author(Usd.Stage.CreateInMemory())
    stage.GetPrimAtPath(WALK).GetAttribute("rotations").Set([Gf.Quatf(0)] * 5, 3)
    with pytest.raises(SsilkError, match="zero quaternion"):
        read_motion(stage, SKELETON)


BAD_CLASSES = {
    "count": (with_classes([0, 1]), "2 vertex classes for 6 points"),
    "range": (with_classes([0, 1, 2, 3, 4, 5]), "3 vertex classes are not 0, 1 or 2"),
    "fractions": (with_classes([0.5] * 6, Sdf.ValueTypeNames.FloatArray), "6 vertex classes are not integers"),
    "faces": (with_classes([0, 1], interpolation="uniform"), "uniform interpolation"),
}


@pytest.mark.parametrize(("stage", "message"), BAD_CLASSES.values(), ids=BAD_CLASSES)
def test_bad_classes_give_one_sentence(stage, message):
    with pytest.raises(SsilkError, match=message):
        read_garment(stage, SKELETON)


def test_unmarked_meshes_of_a_character_are_no_garments():
    with pytest.raises(SsilkError, match=r"no mesh is marked.*/Hero/Body"):
        read_garment(author(Usd.Stage.CreateInMemory()), SKELETON)
    with pytest.raises(SsilkError, match="no mesh is named 'Cape'"):
        read_garment(author(Usd.Stage.CreateInMemory()), SKELETON, garment="Cape")


@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "text", "syntax", "folder", "foreign"])
def test_files_that_are_no_stages_give_one_sentence(damage, tmp_path, capfd):
    path = tmp_path / {"foreign": "hero.obj", "syntax": "hero.usda"}.get(damage, "hero.usdc")
    if damage == "folder":
        path.mkdir()
    elif damage == "truncated":
        author(Usd.Stage.CreateNew(str(tmp_path / "whole.usdc"))).Save()
        path.write_bytes((tmp_path / "whole.usdc").read_bytes()[:-400])
    elif damage != "missing":
        text = {"empty": "", "text": "not a stage", "foreign": "v 0 0 0", "syntax": "#usda 1.0\n( a = 1 b = 2 )"}
        path.write_text(text[damage])
    with pytest.raises(SsilkError, match="hero") as caught:
        read_character(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_values_that_cannot_be_unpacked_give_one_sentence(tmp_path):
    path = tmp_path / "hero.usdc"
    author(Usd.Stage.CreateNew(str(path))).Save()
    data = path.read_bytes()
    sentences = 0
    for start in range(88, len(data) - 64, len(data) // 40):
        path.write_bytes(data[:start] + bytes(range(1, 65)) + data[start + 64 :])
        try:
            read_motion(path, read_character(path).skeleton)
        except SsilkError as error:
            sentences += "\n" not in str(error)
    assert sentences > 20


def test_what_is_assumed_is_said():
    stage, said = author(Usd.Stage.CreateInMemory()), []
    plain_mesh(stage)
    stage.ClearMetadata("metersPerUnit")
    UsdSkel.BindingAPI(stage.GetPrimAtPath(BODY)).CreateSkinningMethodAttr("dualQuaternion")
    read_scene(stage, garment="Cape", report=said.append)
    assert "dualQuaternion skinning is evaluated as linear" in said[0].text
    assert "metersPerUnit is not authored" in said[1].text


def test_a_garment_that_usd_skins_otherwise_is_told():
    stage, said = author(Usd.Stage.CreateInMemory()), []
    Sdf.CopySpec(stage.GetRootLayer(), BODY, stage.GetRootLayer(), "/Hero/Cape")
    UsdSkel.BindingAPI(stage.GetPrimAtPath("/Hero/Cape")).CreateSkinningMethodAttr("dualQuaternion")
    read_scene(stage, garment="Cape", report=said.append)
    (told,) = said
    assert told.text.endswith("/Hero/Cape: its dualQuaternion skinning is evaluated as linear blend skinning")


@pytest.mark.parametrize("arc", ["references", "payload", "subLayers"])
def test_missing_layers_are_named(arc, tmp_path, capfd):
    path = tmp_path / "shot.usda"
    head = "(\n subLayers = [@./gone.usd@]\n)\n" if arc == "subLayers" else ""
    over = "" if arc == "subLayers" else f"({arc} = @./gone.usd@)"
    path.write_text(f'#usda 1.0\n{head}def "Hero" {over} {{}}\n')
    with pytest.raises(SsilkError, match=r"gone\.usd") as caught:
        read_character(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_an_empty_folder_of_motions_gives_one_sentence(tmp_path):
    with pytest.raises(SsilkError, match="holds no USD files"):
        read_motions([tmp_path], SKELETON)


# Which joint carries the body


def game_skeleton(case: str) -> Usd.Stage:
    """The character of `TRUTH` beneath joints that stand still, in the world as it was."""
    stage = author(Usd.Stage.CreateInMemory())
    above = {
        "a root": ["root"],
        "two": ["world", "world/root"],
        "stray weights": ["root"],
        "targets of inverse kinematics": ["root", "root/ik", "root/ik/hand"],
        "another root first": ["helper"],
    }.get(case, ["root", "root/hand"])
    under = {"two": "world/root/", "another root first": ""}.get(case, "root/")
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    for attribute in (skeleton.GetBindTransformsAttr(), skeleton.GetRestTransformsAttr()):
        attribute.Set([*[Gf.Matrix4d(1)] * len(above), *attribute.Get()])
    skeleton.GetJointsAttr().Set([*above, *(under + name for name in JOINTS)])
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Walk"))
    animation.GetJointsAttr().Set([under + name for name in JOINTS])
    animation.GetScalesAttr().Set([Gf.Vec3h(1)] * len(JOINTS))
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath("/Hero/Body"))
    indices = np.array(binding.GetJointIndicesPrimvar().Get()) + len(above)
    if case == "stray weights":
        weights = np.array(binding.GetJointWeightsPrimvar().Get())
        weights[0], indices[0] = 0.05, 0
        binding.GetJointWeightsPrimvar().Set(weights.tolist())
    binding.GetJointIndicesPrimvar().Set(indices.tolist())
    return stage


def add_prop(stage: Usd.Stage, joints: list[int], size: float) -> None:
    """Add a triangle of some size, each corner of which follows one of the joints."""
    prop = UsdGeom.Mesh.Define(stage, "/Hero/Prop")
    prop.CreatePointsAttr([Gf.Vec3f(0, 1, 0), Gf.Vec3f(size, 1, 0), Gf.Vec3f(0, 1 + size, 0)])
    prop.CreateFaceVertexCountsAttr([3])
    prop.CreateFaceVertexIndicesAttr([0, 1, 2])
    binding = UsdSkel.BindingAPI.Apply(prop.GetPrim())
    binding.CreateJointIndicesPrimvar(False, 1).Set(joints)
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 3)


def beside(case: str) -> Usd.Stage:
    """The character of `game_skeleton`, and what else is in its stage, or not."""
    stage = game_skeleton("a prop" if case != "a root" else case)
    root, body = UsdSkel.Root(stage.GetPrimAtPath("/Hero")), stage.GetPrimAtPath("/Hero/Body")
    if case == "a prop that a joint beside the hips moves":
        add_prop(stage, [1, 1, 1], 2.0)
    elif case == "a small prop with two such joints":
        add_prop(stage, [0, 1, 1], 0.2)
    elif case == "a stand-in":
        add_prop(stage, [0, 1, 1], 2.0)
        UsdGeom.Imageable(stage.GetPrimAtPath("/Hero/Prop")).CreatePurposeAttr("proxy")
    elif case == "a garment alone":
        body.CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    elif case == "parts that joints carry":
        cache = UsdSkel.Cache()
        cache.Populate(root, Usd.PrimDefaultPredicate)
        query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")))
        poses = [query.ComputeSkinningTransforms(code) for code in range(1, FRAMES + 1)]
        for joint in (2, 3, 4, 5):
            Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Body", stage.GetRootLayer(), f"/Hero/Part{joint}")
            part = stage.GetPrimAtPath(f"/Hero/Part{joint}")
            for name in ("Indices", "Weights"):
                part.RemoveProperty(f"primvars:skel:joint{name}")
            place = UsdGeom.Xformable(part).AddTransformOp()
            for code, pose in enumerate(poses, start=1):
                place.Set(pose[joint], code)
        body.SetActive(False)
    return stage


BESIDE = ("a prop that a joint beside the hips moves", "a small prop with two such joints", "a stand-in",
          "a garment alone", "parts that joints carry")  # fmt: skip


@pytest.mark.parametrize("case", BESIDE)
def test_what_else_is_in_a_stage_does_not_move_the_hub(case):
    skeleton = read_character(beside(case)).skeleton
    assert skeleton.joint_names[skeleton.hub] == "root/Hips"


@pytest.mark.parametrize(
    "case", ["a root", "two", "stray weights", "targets of inverse kinematics", "another root first"]
)
def test_the_joint_that_carries_the_body_is_found_beneath_still_ones(case):
    stage = game_skeleton(case)
    skeleton = read_character(stage).skeleton
    assert skeleton.joint_names[skeleton.hub].endswith("Hips")
    motion = read_motion(stage, skeleton)
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/Hero")), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")))
    expected = [query.ComputeJointSkelTransforms(code)[skeleton.hub].ExtractTranslation() for code in range(1, 7)]
    found = kinematics.hub_places(skeleton, motion.rotations, motion.translations)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_first_joint_carries_the_body_that_hangs_from_it():
    assert read_character(author(Usd.Stage.CreateInMemory())).skeleton.hub == 0


# Clips that stand alone, of characters whose axis or scale stands in an Xform


def alone(stage: Usd.Stage, *, meters: float, up: str) -> Usd.Stage:
    """The animation of a character in a file of its own."""
    clip = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(clip, meters)
    UsdGeom.SetStageUpAxis(clip, up)
    clip.SetTimeCodesPerSecond(30)
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Rig/Walk", clip.GetRootLayer(), "/Walk")
    return clip


TILTED = {
    "a quarter turn": Recipe(placements=[UPRIGHT_Z]),
    "a quarter turn and centimetres": Recipe(placements=[turned("x", -90, 0.01)]),
    "centimetres": Recipe(placements=[turned("x", 0, 0.01)]),
    "y up in a z-up stage": Recipe(up="Z", placements=[np.linalg.inv(UPRIGHT_Z)]),
    "centimetres, y up, in a z-up stage of metres": Recipe(up="Z", placements=[turned("x", 90, 0.01)]),
    "turned, moved and scaled": Recipe(placements=[turned("y", 30, at=(2, 0, 1)) @ turned("x", -90, 0.01)]),
    "turned and moved": Recipe(placements=[turned("y", 70, at=(3, 0.5, -2))]),
    "moved": Recipe(placements=[turned("y", 0, at=(3, 0, 2))]),
}


@pytest.mark.parametrize("recipe", TILTED.values(), ids=TILTED)
def test_a_clip_alone_moves_its_character_as_usdskel_shows_it_bound(recipe):
    stage = author(Usd.Stage.CreateInMemory(), recipe)
    character = read_character(stage)
    motion = read_motion(alone(stage, meters=recipe.meters, up=recipe.up), character.skeleton)
    expected = usdskel_points(stage, "/Hero/Body", range(1, FRAMES + 1))
    np.testing.assert_allclose(our_points(character, motion), expected, atol=1e-5)


def lay_down(stage: Usd.Stage) -> None:
    """Turn the character of a stage over, face down or on its back, in the space of its skeleton."""
    over = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 0, 0), 180))
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Walk"))
    for code in animation.GetRotationsAttr().GetTimeSamples():
        turns, places = animation.GetRotationsAttr().Get(code), animation.GetTranslationsAttr().Get(code)
        turns[0] = Gf.Quatf(over.ExtractRotationQuat()) * turns[0]
        places[0] = Gf.Vec3f(over.TransformDir(Gf.Vec3d(places[0])))
        animation.GetRotationsAttr().Set(turns, code)
        animation.GetTranslationsAttr().Set(places, code)


@pytest.mark.parametrize(("scale", "says_axis"), [(1.0, False), (0.01, True), (0.01, False)])
def test_a_clip_alone_may_lie(scale, says_axis):
    """Upright by its own file's axis: the unit tells the space, and a file that says no axis converted nothing."""
    stage = author(Usd.Stage.CreateInMemory(), Recipe(placements=[turned("x", -90, scale)]))
    character = read_character(stage)
    lay_down(stage)
    clip = alone(stage, meters=1, up="Y")
    if not says_axis:
        clip.GetRootLayer().pseudoRoot.ClearInfo("upAxis")
    motion = read_motion(clip, character.skeleton)
    expected = usdskel_points(stage, "/Hero/Body", range(1, FRAMES + 1))
    np.testing.assert_allclose(our_points(character, motion), expected, atol=1e-5)


def test_a_clip_whose_file_states_its_axis_and_units_is_read_by_them():
    stage = author(Usd.Stage.CreateInMemory(), Recipe(placements=[turned("x", -90, 0.01)]))
    character = read_character(stage)
    motion = read_motion(alone(stage, meters=0.01, up="Z"), character.skeleton)
    expected = usdskel_points(stage, "/Hero/Body", range(1, FRAMES + 1))
    np.testing.assert_allclose(our_points(character, motion), expected, atol=1e-5)
    plain = author(Usd.Stage.CreateInMemory())  # converted when it was exported: metres, y up
    motion = read_motion(alone(plain, meters=1, up="Y"), character.skeleton)
    assert np.abs(our_points(character, motion) - usdskel_points(plain, "/Hero/Body", range(1, 7))).max() < 1e-5


# Which side is outside, under negative scales


def box_in(stage: Usd.Stage, path: str, scale, left_handed: bool) -> UsdGeom.Mesh:
    """A tetrahedron whose faces are seen from outside: its scales and its orientation turn them round together."""
    points = np.array([[0, 1, 0], [0.3, 1, 0], [0, 1.3, 0], [0, 1, 0.3]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh = UsdGeom.Mesh.Define(stage, path)
    UsdGeom.Xformable(mesh.GetPrim().GetParent()).AddScaleOp().Set(Gf.Vec3f(*scale))
    local = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()).GetInverse())
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy((points @ local[:3, :3] + local[3, :3]).astype("f4")))
    if (np.linalg.det(local[:3, :3]) < 0) != left_handed:
        faces = faces[:, ::-1]
    mesh.CreateFaceVertexCountsAttr([3] * 4)
    mesh.CreateFaceVertexIndicesAttr(faces.reshape(-1).tolist())
    mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded if left_handed else UsdGeom.Tokens.rightHanded)
    return mesh


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("fc,fc->f", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (2, -1, 1), (-1, -1, -1), (-1, 1, -1)])
def test_a_negative_scale_turns_no_face_inside_out(scale, left_handed):
    """UsdGeom: xforms that mirror turn a mesh's handedness, so that its outside stays outside."""
    stage = author(Usd.Stage.CreateInMemory())
    UsdGeom.Xform.Define(stage, "/Set")
    mesh = box_in(stage, "/Set/Cape", scale, left_handed)
    assert volume(read_garment(stage, SKELETON, garment="Cape").mesh) == pytest.approx(0.3**3 / 6)
    bound, placed = UsdSkel.BindingAPI.Apply(mesh.GetPrim()), UsdGeom.Xformable(mesh.GetPrim().GetParent())
    bound.CreateSkeletonRel().SetTargets(["/Hero/Rig"])
    bound.CreateJointIndicesPrimvar(True, 1).Set([0])
    bound.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    bound.CreateGeomBindTransformAttr(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()))
    for ignored in (scale, (1, 1, 1), (1, 1, -1)):  # skinned, it is where its geomBindTransform puts it
        placed.GetOrderedXformOps()[0].Set(Gf.Vec3f(*ignored))
        assert volume(read_garment(stage, SKELETON, garment="Cape").mesh) == pytest.approx(0.3**3 / 6)


def test_a_joint_that_is_listed_twice_is_refused_by_name():
    """UsdSkel takes one of both, and says nothing."""
    stage = author(Usd.Stage.CreateInMemory())
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Walk"))
    animation.GetJointsAttr().Set([*JOINTS[:4], JOINTS[1]])
    with pytest.raises(SsilkError, match=r"/Hero/Rig/Walk: joint 'Hips/Spine' is listed twice"):
        read_motion(stage, SKELETON)
    body = UsdSkel.BindingAPI(stage.GetPrimAtPath("/Hero/Body"))
    body.CreateJointsAttr([*JOINTS[:4], JOINTS[3]])
    with pytest.raises(SsilkError, match=r"/Hero/Body: joint 'Hips/Leg' is listed twice"):
        read_character(stage)


def test_an_animation_of_blendshapes_alone_is_called_that():
    stage = author(Usd.Stage.CreateInMemory())
    skeleton = read_character(stage).skeleton
    shapes = UsdSkel.Animation.Define(stage, "/Face")
    shapes.CreateBlendShapesAttr(["smile"])
    shapes.CreateBlendShapeWeightsAttr().Set([0.5], 1)
    with pytest.raises(SsilkError, match="turns no joint, it moves blendshapes alone") as raised:
        read_motion(stage, skeleton, prim="/Face")
    assert "retarget" not in str(raised.value)
