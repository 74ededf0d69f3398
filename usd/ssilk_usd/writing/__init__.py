# SPDX-License-Identifier: Apache-2.0
"""Write stages: arrays of `ssilk_core.scene.assets` come in, USD files go out, completely or not at all.

Open `files.py` first: characters, garments and motions as files of their own. `author` defines the prims that do not
move, `rig` writes a proxy rig, `surface` a physics material, `repair` a repaired copy of a garment's file,
`body_faces` faces of the body that are hidden. `export` saves a layer.
"""
