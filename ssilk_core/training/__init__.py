# SPDX-License-Identifier: Apache-2.0
"""Training: from a scene and motions to a model file.

In: a `Scene`, motions and `TrainConfig`. Out: a model file, a state to resume from, a learning curve.
Open `run.py` first: it is the loop. `settings.py` has the presets, `objective.py` the loss, `step.py` one step.
`memory` and `prediction` tell before a run what it will need; `wardrobe` trains lists of garments.
Public: no package; `ssilk train` and `ssilk wardrobe` are the ways in.
"""
