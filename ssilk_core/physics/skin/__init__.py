# SPDX-License-Identifier: Apache-2.0
"""The skin that shows: what it is, how it is measured, and which faces a garment hides.

In: a `Scene`, posed cloth and body. Out: `figures.ShownSkin`, and faces of the body that no frame shows.
Open `figures.py` first: it defines the share that shows and the share that is bare, without any library.
`covered_points` finds them on posed meshes, and `covered_skin` counts them by joints and limbs. `hidden_faces` finds
faces to hide with numpy alone, in Blender too.
"""
