# SPDX-License-Identifier: Apache-2.0
"""Bakes with a certificate: in the written file no triangle intersects another, and no covered skin shows.

Open `certified.py` first: `certified` moves the frames of a rollout that are wrong (`physics.certify`), and `proven`
looks at the file itself. `work` is kept between the two. `blendshapes` holds displacements, `written` finds what is
wrong in a file, `summary` says it, `verified` counts it again, and `requirements` names the libraries.
"""
