# SPDX-License-Identifier: GPL-3.0-or-later
"""Work in other processes: commands, trainings and their reports. No module here imports `bpy`, but for one script.

A command comes in; progress and a result go out. Open `work.py` first for one piece of work, and `jobs.py` for
trainings that outlive Blender: `runner.py` runs each, in the Python that has ssilk. `python` finds that Python, and
`probe`, `demo_motions` and `try_on` are scripts that it runs, `gltf_export` one that another Blender runs.
`training_report` and `wording` put what was said into an artist's words.
"""
