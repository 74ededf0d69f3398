# SPDX-License-Identifier: Apache-2.0
"""What leaves the house: shots, layers, glTF, films, pages, farm jobs, frames for who plays live.

In: a model file, a stage and motions. Out: files that are verified after they were written.
Open `bake/write.py` first: it writes one shot. `targets.py` says who receives a bake, and in what form.
Public: `delivery.bake`, the only part outside `cli` that joins the core and USD.
"""
