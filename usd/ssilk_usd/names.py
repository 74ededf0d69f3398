# SPDX-License-Identifier: Apache-2.0
"""Names of the attributes in which a stage says what a garment is."""

from __future__ import annotations

CLASS = "primvars:ssilk:class"
GARMENT = "ssilk:garment"
PROXIES = "ssilk:proxyJoints"
JOINTS = "skel:joints"
# Indices, weights and, where the mesh names its joints, their order.
SKEL = ("primvars:skel:jointIndices", "primvars:skel:jointWeights", JOINTS)
PLAIN = ("primvars:ssilk:plainJointIndices", "primvars:ssilk:plainJointWeights", "ssilk:plainJoints")
