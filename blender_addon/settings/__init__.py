# SPDX-License-Identifier: GPL-3.0-or-later
"""What an artist sets, and Blender stores: property groups of objects and of the window manager.

Open `garment.py` first: the settings of each garment, with those of its `fabric` and its `training`. `preflight`
holds the latest findings; they are not saved. The chosen Python is in `preferences.py` beside this package.
"""
