# SPDX-License-Identifier: Apache-2.0
"""Read stages: an open stage or a path comes in, arrays of `ssilk_core.scene.assets` go out [m, y up].

Open `scene.py` first: a character (`character`), its garment (`garment`) and its proxy rig (`rig`). `motion` reads
motions, `frame_range` and `visibility` what a shot plays and shows, `facts` what a file states beside that. All
others are about a part: `mesh`, `polygons`, `skeleton`, `skin`, `spaces`, `surface`, `carried`.
"""
