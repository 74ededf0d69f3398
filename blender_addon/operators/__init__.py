# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators, one module for each of the things an artist does: a context comes in, Blender's data changes.

Open `reporting.py` first (work that is done at once), then `tasks.py` (work that runs outside while Blender stays
usable). `training` starts, stops and resumes trainings, `baking` bakes, `playback` plays live, and `make_it_move`
does all steps in a row.
"""
