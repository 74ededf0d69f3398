#!/usr/bin/env bash
# newton 1.8.0 with warp-lang 1.19.0: particles find no contact with a mesh whose vertices have left its first box.
#
# An animated body is a mesh whose points are assigned in each step and whose tree is then refitted. The documentation
# of `newton.Mesh` says that motion along the normal must be represented by updating the geometry. Before all else
# a particle is compared with the shape's box, which is that of the vertices the model was built with. A square moved
# by 1 m therefore finds no contact with a particle 5 cm above it, where a square built there finds one. Nothing is
# said, so cloth is free to pass through such a body. `Model.bvh_build_shapes` does not help. The documentation of
# `CollisionPipeline` warns of the boxes where a shape is rescaled, not where its vertices move.
#
# In a model finalized with `requires_grad=True` boxes rule no particle out, and the same motion finds the contact:
# asking for gradients changes what collides. With newton 1.7.0 in this script the moved square finds it as well.
# What helps is to assign the bounds of the whole motion to `Model.shape_collision_aabb_lower` and
# `Model.shape_collision_aabb_upper`.
#
# Seen on the CPU: "contacts: built there 1; moved there 0; moved there with gradients 1; moved there with bounds 1".
# Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet newton==1.8.0 warp-lang==1.19.0 numpy==1.26.4
export WARP_CACHE_PATH="$folder/kernels"
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import newton
import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_WARNING
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
UP = np.array([0, 0, 1], dtype=np.float32)


def contacts(built_at: float, bounds: float = 0.0, requires_grad: bool = False) -> int:
    """Return how many contacts a particle at 1.05 m has with a square that is at 1 m now."""
    builder = newton.ModelBuilder()
    mesh = newton.Mesh(SQUARE + built_at * UP, [0, 1, 2, 0, 2, 3], compute_inertia=False)
    builder.add_shape_mesh(-1, mesh=mesh)
    builder.add_particle(pos=(0.1, 0.2, 1.05), vel=(0.0, 0.0, 0.0), mass=1.0, radius=0.1)
    model = builder.finalize(requires_grad=requires_grad)
    if bounds:
        model.shape_collision_aabb_lower.fill_(-bounds)
        model.shape_collision_aabb_upper.fill_(bounds)
    pipeline = newton.CollisionPipeline(model)
    found = pipeline.contacts()
    mesh.mesh.points.assign(SQUARE + UP)
    mesh.mesh.refit()
    state = model.state()
    model.bvh_build_shapes(state)
    pipeline.collide(state, found)
    return int(found.soft_contact_count.numpy()[0])


with wp.ScopedDevice("cpu"):
    built, moved = contacts(1.0), contacts(0.0)
    gradients, bounded = contacts(0.0, requires_grad=True), contacts(0.0, bounds=2.0)
print(
    f"contacts: built there {built}; moved there {moved}; moved there with gradients {gradients}; "
    f"moved there with bounds {bounded}"
)
if (built, moved, gradients, bounded) != (1, 0, 1, 1):
    sys.exit("this has changed")
PYTHON
