# SPDX-License-Identifier: Apache-2.0
"""The network: its settings, its parts, its files, and the ways to play it.

In: a `Scene` and `ModelConfig`, or a model file. Out: latents, and `GarmentPose` for each frame of a motion.
Open `model/network.py` first: initialiser P, stepper S and decoder D stand there together.
`rollout` plays it with PyTorch, `runtime` with numpy alone, and `checkpoint` reads and writes its file.
Public: `network.runtime`.
"""
