# SPDX-License-Identifier: GPL-3.0-or-later
"""Models on garments: a model comes in; keys on the timeline, a garment played live or a glTF binary go out.

`bake.py` puts a bake's weights, shape keys and keys on a garment and its proxies. `live.py` plays one garment:
`dressed.py` is what it is put on, `rolled.py` the network over its motion, `solved.py` what is solved in its place.
`playing.py` keeps those that are played and updates them as frames change. `models` finds a garment's training and
model, `saving` keeps their paths valid, and `gltf` exports a bake.
"""
