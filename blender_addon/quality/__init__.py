# SPDX-License-Identifier: GPL-3.0-or-later
"""How good a garment is: meshes come in; findings, repairs, colours and masks go out.

Before a training, `checks` finds what to mend and `repairs` mends it. After it, `heat.py` (open it first) colours
stretch, penetration and skin that shows, `heat_updates` follows the timeline, `lbs_copy` shows linear blend skinning
beside the garment, and `covered_skin` hides skin that is covered in every frame. At any time `tried_on` shows it on
another body.
"""
