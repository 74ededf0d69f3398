# SPDX-License-Identifier: Apache-2.0
"""Assets as arrays: skeleton, character, garment, proxy rig, motion, and the scene that combines them.

Every class is a frozen dataclass that validates its values and makes its arrays read-only. Conventions throughout
the core: metres, y up, gravity along -y, column vectors (``x_world = T @ x_joint``), quaternions (w, x, y, z), and
triangles counter-clockwise from outside. Readers convert to these conventions, and writers convert back.
"""

from .arrays import UP, Floats, Ints
from .body_shape import BodyShape
from .character import Body, Character
from .deformer import Deformer, GarmentPose
from .garment import CLASS_NAMES, LOOSE, PINNED, TIGHT, Garment, classes_at
from .mesh import SOFTEST, STIFFEST, Mesh
from .motion import Motion
from .rig import ProxyRig
from .scene import Scene
from .skeleton import Skeleton, carrying_joint, check_rigid, is_carried_by, moved_by_joints
from .skin import SkinWeights
from .surface import PLATE_THICKNESS, SurfaceMaterial
from .world import Air, Collider, ShotWorld

__all__ = [
    "CLASS_NAMES",
    "LOOSE",
    "PINNED",
    "PLATE_THICKNESS",
    "SOFTEST",
    "STIFFEST",
    "TIGHT",
    "UP",
    "Air",
    "Body",
    "BodyShape",
    "Character",
    "Collider",
    "Deformer",
    "Floats",
    "Garment",
    "GarmentPose",
    "Ints",
    "Mesh",
    "Motion",
    "ProxyRig",
    "Scene",
    "ShotWorld",
    "Skeleton",
    "SkinWeights",
    "SurfaceMaterial",
    "carrying_joint",
    "check_rigid",
    "classes_at",
    "is_carried_by",
    "moved_by_joints",
]  # fmt: skip
