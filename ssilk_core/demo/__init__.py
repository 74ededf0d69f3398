# SPDX-License-Identifier: Apache-2.0
"""What `ssilk demo` shows without any file of the user's: garments, motions and trained models.

In: the demo body. Out: garment meshes, motions, and the models that ship, in `models/`.
Open `shipped.py` first: it says which models ship and which garments they fit. `garments.py` cuts the garments, and
`motions.py` makes the motions.
Public: no package; `ssilk demo` is the way in.
"""
