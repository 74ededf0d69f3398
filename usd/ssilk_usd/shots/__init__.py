# SPDX-License-Identifier: Apache-2.0
"""Bakes as files: joints, blendshape weights and points over time go in, a shot goes out, and is played back.

Open `shot.py` first: one self-contained UsdSkel shot; `samples` holds what changes over time. `layers` writes a bake
as an asset with a layer for each shot, `points` a point cache. `read` and `play` read them back, `trajectories` reads
the vertices of any cache. `skinned` is a garment as joints and blendshapes, without `pxr`.
"""
