# SPDX-License-Identifier: Apache-2.0
"""From a plain mesh to a garment that can be trained: checks and repairs, classes, weights, proxy joints.

In: a character and a garment. Out: a rigged `Scene`, and findings with what to do about them.
Open `setup/prepare.py` first: it makes what an artist has not made. `preflight/inspection.py` lists all checks.
Public: no package; `ssilk rig` and `ssilk inspect` are the ways in, and `preflight.repair` is what `ssilk_usd` takes.
"""
