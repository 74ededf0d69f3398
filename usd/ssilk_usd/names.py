# SPDX-License-Identifier: Apache-2.0
"""Names in stages: attributes that say what a garment is, blendshapes, suffixes of files. Without `pxr`."""

from __future__ import annotations

CLASS = "primvars:ssilk:class"
PIN = "primvars:ssilk:pin"  # 1 where a vertex is to be pinned when classes are found
LEVEL = "primvars:ssilk:tightness"  # the least tightness at which a vertex is tight, 0 where it is pinned
STIFFNESS = "primvars:ssilk:stiffness"  # by which the fabric's own is multiplied, 1 where there is none
GARMENT = "ssilk:garment"
PROXIES = "ssilk:proxyJoints"
JOINTS = "skel:joints"
# Indices, weights and, where the mesh names its joints, their order.
SKEL = ("primvars:skel:jointIndices", "primvars:skel:jointWeights", JOINTS)
GEOM_BIND = "primvars:skel:geomBindTransform"
LBS_SKIN = ("primvars:ssilk:plainJointIndices", "primvars:ssilk:plainJointWeights", "ssilk:plainJoints")
# Of a PhysicsScene, in the stage's units of length and its axes: wind and the RMS speed of gusts [1/s], size, seed.
WIND, GUSTS, GUST_LENGTH, GUST_SEED = "ssilk:wind", "ssilk:gusts", "ssilk:gustLength", "ssilk:gustSeed"
# Of a garment in a shot: 1 where it moves freely, 0 where it is held to linear blend skinning; frames of each pose;
# whether the shot is a cycle. Of a part of it, named after another colon: FREE, and 1 where it is as posed by hand.
FREE, HOLD, LOOP, POSED = "ssilk:free", "ssilk:hold", "ssilk:loop", "ssilk:posed"
# Of what rides on a garment: the garment's mesh, three vertices of it that carry the rider, whether it is soft.
RIDES_ON, RIDE_VERTICES, RIDE_SOFT = "ssilk:ridesOn", "ssilk:rideVertices", "ssilk:rideSoft"
# Of a baked garment: those of its proxy joints that carry riders.
RIDER_JOINTS = "ssilk:riderJoints"
# Of a garment that was put onto another skeleton: the joints of the character that it was made on, and for each the
# one that stands for it, or "".
FROM_JOINTS, ONTO_JOINTS = "ssilk:fromJoints", "ssilk:ontoJoints"
# Of a blendshape of a body: which weights a body may have of it; joints, and how far each moves at a weight of one.
WEIGHT_RANGE, OFFSET_JOINTS, JOINT_OFFSETS = "ssilk:weightRange", "ssilk:offsetJoints", "ssilk:jointOffsets"
SHAPES_SET = "ssilk:shapesSet"  # of a mesh whose points have the shape of these blendshapes, which it had
LAYER_SUFFIXES = (".usdc", ".usd", ".usda")


def shape_name(index: int) -> str:
    """Return what a blendshape is called."""
    return f"shape_{index:03d}"
