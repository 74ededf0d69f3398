# SPDX-License-Identifier: Apache-2.0
"""Targets of a bake: the influences, units, axes and file formats that each receiving application supports."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Literal

from ..errors import fail
from ..scene.assets import Deformer, Scene, SkinWeights

GLB = ".glb"  # suffix of a glTF binary, which is written and read without USD


@dataclass(frozen=True, kw_only=True)
class Target:
    """Requirements of one kind of receiving application.

    Attributes:
        influences: largest number of joints per vertex; None for no limit.
        meters_per_unit, up_axis: units [m] and up axis of the file; None for those of the character's stage.
        lean: store the root's path as a translation of the SkelRoot. The layer is smaller, and exact far from the
            origin. The receiver must compose transforms as USD does.
        variants: it selects variants, so that a single file keeps hidden faces of bodies as one. For others these
            faces are left out of it. Layers keep them for all, because whoever reads layers composes them.
        name_bytes: it finds joints by the last part of their paths, cut to so many bytes: no two may be alike. None
            where it reads whole paths.
        suffixes: file suffixes that it accepts; layers need ".usdc".
        about: one-line description.
    """

    influences: int | None = None
    meters_per_unit: float | None = None
    up_axis: Literal["Y", "Z"] | None = None
    lean: bool = False
    variants: bool = False
    name_bytes: int | None = None
    suffixes: tuple[str, ...] = (".usdc", ".usd", ".usda", ".usdz")
    about: str = ""


# To add a target, add an entry: options, checks, bakes and their tests use this table.
TARGETS = {
    "usd": Target(lean=True, variants=True, about="film pipelines and renderers: the stage's units, nothing capped"),
    "blender": Target(
        meters_per_unit=1.0,
        up_axis="Z",
        variants=True,
        name_bytes=63,
        about="metres, z up, every joint animated, each with a name of its own",
    ),
    "game8": Target(influences=8, meters_per_unit=1.0, up_axis="Y", about="8 influences, as two sets of glTF hold"),
    "game4": Target(influences=4, meters_per_unit=1.0, up_axis="Y", about="4 influences, as one set of glTF holds"),
    "arkit": Target(
        influences=4, meters_per_unit=1.0, up_axis="Y", suffixes=(".usdz",), about="4 influences in one usdz package"
    ),
    "glb": Target(meters_per_unit=1.0, up_axis="Y", suffixes=(GLB,), about="one glTF binary, four influences a set"),
    "glb4": Target(
        influences=4,
        meters_per_unit=1.0,
        up_axis="Y",
        suffixes=(GLB,),
        about="one glTF binary, a single set",
    ),
}


def check_suffix(path: Path, name: str) -> None:
    """Raise `SsilkError` if target `name` takes no file of such a suffix, and say which ones do."""
    allowed = TARGETS[name].suffixes
    if path.suffix not in allowed:
        others = [f"--target {other}" for other, target in TARGETS.items() if path.suffix in target.suffixes]
        todo = f"{' or '.join(others)} writes it" if others else ""
        fail(str(path), f"the suffix is '{path.suffix}'", f"{name} takes {', '.join(allowed)}", todo)


def check_influences(found: int, name: str, model: str) -> None:
    """Raise `SsilkError` if a model has more influences per vertex, `found`, than target `name` supports."""
    most = TARGETS[name].influences
    if not (most is None or found <= most):
        fail(
            model,
            f"{found} joints move a vertex",
            f"--target {name} takes {most}",
            f"reduce them with 'ssilk reduce --influences {most}' and the motions of the shots",
        )


def cap_influences(deformer: Deformer, target: Target) -> Deformer:
    """Keep only the heaviest influences of each vertex of a garment and its character's bodies.

    The remaining weights of a vertex are scaled to a sum of one. This serves bodies and linear blend skinning. A
    trained garment with too many influences has already been reduced or refused (`check_influences`).
    """
    most = target.influences
    if most is None:
        return deformer
    scene = deformer.scene
    character = scene.character
    bodies, stand_ins = (
        tuple(replace(body, skin=_heaviest(body.skin, most)) for body in some)
        for some in (character.bodies, character.stand_ins)
    )
    scene = replace(scene, character=replace(character, bodies=bodies, stand_ins=stand_ins))
    return replace(deformer, scene=scene, skin=_heaviest(deformer.skin, most))


@dataclass(frozen=True)
class JointNames:
    """The joints of a scene as a target finds them.

    Attributes:
        paths: UsdSkel joint paths, the character's first, then those of proxies.
        renamed: the last part of each path before and after, where it changed.
    """

    paths: tuple[str, ...]
    renamed: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        pairs = ", ".join(f"'{old}' becomes '{new}'" for old, new in self.renamed[:3])
        more = f" and {len(self.renamed) - 3} more" if len(self.renamed) > 3 else ""
        return f"{len(self.renamed)} joints share the last part of their path with others: {pairs}{more}"


def joint_names(scene: Scene, target: Target) -> JointNames:
    """Return the joint paths of a scene for a target: renamed where it would take two joints for one."""
    if target.name_bytes is None:
        return JointNames(scene.joint_names)
    leaves = [path.rpartition("/")[2] for path in scene.joint_names]
    taken = {_cut(leaf, target.name_bytes) for leaf in leaves}
    free, paths, renamed = set(taken), list[str](), list[tuple[str, str]]()
    for leaf, parent in zip(leaves, scene.parents.tolist()):
        own = leaf
        if _cut(leaf, target.name_bytes) in free:
            free.remove(_cut(leaf, target.name_bytes))  # the first joint of a name keeps it
        else:
            endings = (f"_{copy}" for copy in count(2))
            tries = (_cut(leaf, target.name_bytes - len(ending)) + ending for ending in endings)
            own = next(name for name in tries if name not in taken)
            renamed.append((leaf, own))
        taken.add(own)
        paths.append(f"{paths[parent]}/{own}" if parent >= 0 else own)
    return JointNames(tuple(paths), tuple(renamed)) if renamed else JointNames(scene.joint_names)


def _cut(name: str, size: int) -> str:
    return name.encode()[:size].decode(errors="ignore")


def fit(deformer: Deformer, target: Target) -> Deformer:
    """Return a garment and its character with the influences and the joint names that a target takes."""
    deformer = cap_influences(deformer, target)
    scene, names = deformer.scene, joint_names(deformer.scene, target)
    if not names.renamed:
        return deformer
    skeleton, rig = scene.character.skeleton, scene.rig
    skeleton = replace(skeleton, joint_names=names.paths[: skeleton.joint_count])
    rig = replace(rig, joint_names=names.paths[skeleton.joint_count :])
    return replace(deformer, scene=replace(scene, character=replace(scene.character, skeleton=skeleton), rig=rig))


def _heaviest(skin: SkinWeights, most: int) -> SkinWeights:
    return SkinWeights.from_dense(skin.path, skin.dense(int(skin.indices.max()) + 1), most)
