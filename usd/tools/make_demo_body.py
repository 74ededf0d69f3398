# SPDX-License-Identifier: Apache-2.0
"""Make the bodies of the demo from Anny, on its 31-joint CMU rig, as small USD stages.

    pip install 'ssilk[body]' && python usd/tools/make_demo_body.py

The first is a neutral adult. The others are of its family: the same joints and order of points, and joints that are
bound elsewhere at the same rotations. The mesh is Anny's own coarse watertight topology (1,229 vertices), so nothing
is decimated here. Metres, y up, facing +z, standing on y = 0 in Anny's A-pose, which is the rest pose and the bind
pose.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.stages import DEMO_BODIES, demo_body_path

from ssilk_core.files import replacing
from ssilk_core.scene.kinematics import local_transforms

INFLUENCES = 4
# What differs from the neutral adult, whose phenotypes are all 0.5. Beyond zero and one Anny extrapolates.
PHENOTYPES: dict[str, dict[str, float]] = {
    "": {},
    "tall": {"age": 0.6, "height": 0.62, "gender": 0.4, "muscle": 0.55},
    "heavy": {"age": 0.7, "height": 0.33, "weight": 1.5, "muscle": 0.45},
    "slight": {"age": 0.45, "height": 0.42, "weight": 0.1, "muscle": 0.3},
    "muscular": {"age": 0.67, "height": 0.4, "gender": 0.1, "muscle": 1.1, "weight": 0.6},
    "man": {"age": 0.7, "height": 0.42, "gender": 0.2, "muscle": 0.6, "weight": 0.8},
    "young": {"age": 0.55, "gender": 0.4, "height": 0.5, "muscle": 0.5},
    "stout": {"age": 0.65, "height": 0.25, "gender": 0.6, "weight": 1.1},
}
TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@dataclass(frozen=True, eq=False)
class RiggedBody:
    """Joint names and parents, bind transforms (J, 4, 4), points [m] (V, 3), faces (F, 3), weights (V, J)."""

    names: list[str]
    parents: list[int]
    bind: np.ndarray
    points: np.ndarray
    faces: np.ndarray
    weights: np.ndarray


def anny_body(phenotypes: Mapping[str, float]) -> RiggedBody:
    """Return a body with these phenotypes and all others neutral, standing on the ground in its A-pose."""
    import anny

    model = anny.Anny(rig="cmu_mb", topology="notoes_collapse10pc", extrapolate_phenotypes=bool(phenotypes))
    rest = model(phenotype_kwargs={**dict.fromkeys(model.phenotype_labels, 0.5), **phenotypes})
    points = rest["rest_vertices"][0].numpy().astype(np.float64) @ TO_Y_UP.T
    bind = np.array(rest["rest_bone_poses"][0].numpy(), dtype=np.float64)
    bind[:, :3] = TO_Y_UP @ bind[:, :3]
    ground = points[:, 1].min()
    points[:, 1] -= ground
    bind[:, 1, 3] -= ground
    weights = np.zeros((len(points), len(bind)))
    rows = np.arange(len(points))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    return RiggedBody(model.bone_labels, list(model.bone_parents), bind, points, model.faces.numpy(), weights)


def of_family(base: RiggedBody, other: RiggedBody) -> RiggedBody:
    """Return a body with its joints bound at the base's rotations, and skinned as the base."""
    bind = np.array(base.bind)
    bind[:, :3, 3] = other.bind[:, :3, 3]
    return replace(base, bind=bind, points=other.points)


def joint_paths(names: list[str], parents: list[int]) -> list[str]:
    """Return UsdSkel joint paths ("Hips/Spine") of joints whose parents come first."""
    paths: list[str] = []
    for name, parent in zip(names, parents):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return paths


def define_skeleton(stage: Usd.Stage, path: str, body: RiggedBody) -> UsdSkel.Skeleton:
    """Define the skeleton with its bind pose as rest pose."""
    skeleton = UsdSkel.Skeleton.Define(stage, path)
    rest = local_transforms(body.bind, np.array(body.parents))
    skeleton.CreateJointsAttr(joint_paths(body.names, body.parents))
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(matrix.T.tolist()) for matrix in body.bind]))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(matrix.T.tolist()) for matrix in rest]))
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    return skeleton


def define_mesh(stage: Usd.Stage, path: str, points: np.ndarray, faces: np.ndarray) -> UsdGeom.Mesh:
    """Define the triangle mesh with its extent."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return mesh


def bind_mesh(mesh: UsdGeom.Mesh, skeleton: UsdSkel.Skeleton, weights: np.ndarray) -> None:
    """Bind the mesh by the largest influences of each point, sorted and normalised."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    kept = np.take_along_axis(weights, order, axis=1)
    kept /= kept.sum(axis=1, keepdims=True)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
    indices = np.where(kept > 0, order, 0).astype(np.int32)
    binding.CreateJointIndicesPrimvar(False, INFLUENCES).Set(Vt.IntArray.FromNumpy(indices.reshape(-1)))
    binding.CreateJointWeightsPrimvar(False, INFLUENCES).Set(Vt.FloatArray.FromNumpy(kept.reshape(-1).astype("f4")))


def write_stage(path: str, body: RiggedBody, name: str) -> None:
    """Write a body as one SkelRoot, model kind component, to a USD file."""
    stage = Usd.Stage.CreateNew(path)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(30)
    stage.SetFramesPerSecond(30)
    root = UsdSkel.Root.Define(stage, "/Body")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    what = f"Body '{name}'" if name else "Neutral adult"
    root.GetPrim().SetDocumentation(f"{what} made with Anny from MakeHuman data (CC0); see LICENSE.md beside it.")
    skeleton = define_skeleton(stage, "/Body/Skeleton", body)
    mesh = define_mesh(stage, "/Body/Mesh", body.points, body.faces)
    bind_mesh(mesh, skeleton, body.weights)
    root.CreateExtentAttr(mesh.GetExtentAttr().Get())
    UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    stage.GetRootLayer().Save()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    folder = demo_body_path().parent
    parser.add_argument("-o", "--output", type=Path, default=folder, help="folder to write into [%(default)s]")
    options, base = parser.parse_args(), anny_body({})
    for name in DEMO_BODIES:
        body = of_family(base, anny_body(PHENOTYPES[name])) if name else base
        output = options.output / demo_body_path(name).name
        with replacing(output) as temporary:
            temporary.unlink()  # a stage is only ever created where no file stands
            write_stage(str(temporary), body, name)
        print(output)


if __name__ == "__main__":
    main()
