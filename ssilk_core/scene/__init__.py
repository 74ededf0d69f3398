# SPDX-License-Identifier: Apache-2.0
"""The scene as frozen arrays, and what needs nothing but them: skeletons, meshes, fabrics.

In: arrays, from files or from Blender. Out: `Scene`, `Motion`, `GarmentPose`; joint transforms; mesh topology.
Open `assets/scene.py` first: a scene is what every other room works on.
Public: `scene.assets`, and `scene.decomposition`, which fits joints and blendshapes to moving points.
"""
