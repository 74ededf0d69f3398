#!/usr/bin/env bash
# libigl 2.6.3: whether neighbours that lie on one another intersect depends on how they are wound.
#
# Two triangles share an edge and are folded flat, so that one lies in the other. `find_self_intersections` of
# `igl.predicates` finds the pair where both are wound alike, as in a mesh that one orientation runs through. Where one
# is turned round it finds nothing, though the triangles are the same sets of points. Whoever counts
# self-intersections of meshes whose patches were joined without a common orientation misses folds along the joints.
#
# Seen: "wound alike: True; one turned round: False". Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet libigl==2.6.3 numpy==1.26.4 scipy==1.17.1
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np
from igl.predicates import find_self_intersections

corners = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 0.9, 0]])
alike, turned = (
    find_self_intersections(corners, np.array(faces))[0] for faces in ([[0, 1, 2], [1, 0, 3]], [[0, 1, 2], [0, 1, 3]])
)
print(f"wound alike: {alike}; one turned round: {turned}")
if (alike, turned) != (True, False):
    sys.exit("this has changed")
PYTHON
