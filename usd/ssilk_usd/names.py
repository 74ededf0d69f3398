# SPDX-License-Identifier: Apache-2.0
"""Names in stages: attributes that say what a garment is, blendshapes, suffixes of files. Without `pxr`."""

from __future__ import annotations

CLASS = "primvars:ssilk:class"
GARMENT = "ssilk:garment"
PROXIES = "ssilk:proxyJoints"
JOINTS = "skel:joints"
# Indices, weights and, where the mesh names its joints, their order.
SKEL = ("primvars:skel:jointIndices", "primvars:skel:jointWeights", JOINTS)
LBS_SKIN = ("primvars:ssilk:plainJointIndices", "primvars:ssilk:plainJointWeights", "ssilk:plainJoints")
LAYER_SUFFIXES = (".usdc", ".usd", ".usda")


def shape_name(index: int) -> str:
    """Return what a blendshape is called."""
    return f"shape_{index:03d}"
